/* The model's step in C: twin/model gas.py, plant.py and kernel.py, the same scheme line for line.

   It is the floor for the compiled Python beside it, and follows it: whoever changes the physics
   there changes them here, or the benchmark says that the results differ. With LANES it runs so
   many hypotheses at once, side by side in every row of the arrays, for vector instructions. */
#include <math.h>
#include <stdint.h>

#ifndef LANES
#define LANES 1
#endif
#define K(row) k[(row) * LANES] /* of one hypothesis: its pointers are to its own column */
#define S(row) state[(row) * LANES]
#define T(row) theta[(row) * LANES]
#define INLINED static inline __attribute__((always_inline)) /* only so loops become vectors */

enum { /* twin.model.theta.COEFFICIENTS */
    AMBIENT, AMBIENT_NOMINAL, TEMPERATURE, SUPPLY, DROOP, SUPPLY_LAG, SUPPLY_NOMINAL,
    SUPPLY_OPTIMUM, SUPPLY_CURVATURE, END_SLOPE, SUCTION, END_RATIO, EXHAUST_FOLLOWS, FILTER_AT,
    END_FOLLOWS, END_MOVES, MOVED, BULGE, SKEW, BEND_2, BEND_3, KINK, KINK_AT, RESPONSE, RESPONSE_OFF, RAMP_UP, SLOW_RAMP_UP,
    JET_FULL_AT, JET_DEPTH, RAMP_DOWN, BLOW_OFF, BLOW_OFF_SHAPE, BLOW_OFF_DRAIN,
    BLOW_OFF_REFILL, BLOW_OFF_RESPONSE, BLOW_OFF_RESPONSE_OFF, BLOW_OFF_RAMP, BLOW_OFF_RAMP_DOWN, RELIEF,
    RELIEF_PRESSURE, EXHAUST, CRACKING_PRESSURE, PORT_VOLUME, PORT_HEAT, LINE_VOLUME, LINE_HEAT,
    VOLUME, COMPLIANCE, SOFTNESS, STIFF_UNTIL, CREEP, CREEP_TIME, FILM, FREE_CONVECTION,
    FORCED_CONVECTION, AREA, NEAR_RESISTANCE, NEAR_LAMINAR, NEAR_INERTANCE,
    RESISTANCE, LAMINAR, INERTANCE, LINE_CRITICAL, PLACE, LEAK, LEAK_CRITICAL, LAMINAR_LEAK, INFLOW, PORT_INFLOW, BACK_FLOW,
    OPENING, HOLE, SENSOR_LAG, SLOW_SENSOR, SENSOR_OFFSET, GAUGE, SENSOR_GAIN, H1, H1_LOW, H1_FOLLOWS, H2, H2_LOW,
    RELEASE, CONTACT, CONTROL_SENSOR, AIR_SAVING, PERMITTED_LEAKAGE, BLOW_OFF_MODE,
    BLOW_OFF_TIME, COEFFICIENTS
};
enum { /* what a call computes only once, behind them */
    K_SUCTION = COEFFICIENTS, K_END, K_BLOW_OFF, K_FLATTER, K_THINNER, K_HEAT, K_PORT_HEAT, K_LINE_HEAT,
    K_PLACE, K_STRETCH, K_SOFT, K_CLOSED, K_OPENS, PREPARED
};
enum { /* the state of twin.model.kernel */
    S_PORT, S_PORT_MASS, S_LINE, S_LINE_MASS, S_VESSEL, S_VESSEL_MASS, S_NEAR, S_FAR, S_YIELDED,
    S_DRIVE, S_JET, S_BLOWING, S_DRAINED, S_SUPPLIED, S_FELT, S_SENSED,
    NOZZLE, NOZZLE_COMMAND, NOZZLE_AGE, BLOW, BLOW_COMMAND, BLOW_AGE,
    ROUGH, PHASE, OPEN, VALID, SIGNALS, STATE
};
enum { IDLE_PHASE, SUCTION_PHASE, HOLD_PHASE, BLOW_OFF_PHASE }; /* twin.signals.Phase */
#define JUST_OPEN (1.0 + 1e-9)
enum { PART_PRESENT_SIGNAL = 1, AIR_SAVING_SIGNAL = 2 }; /* twin.signals.Signal */

INLINED double max(double a, double b) { return a > b ? a : b; }
INLINED double min(double a, double b) { return a < b ? a : b; }

/* --- gas.py -------------------------------------------------------------------------------- */

#define R 287.05
#define GAMMA 1.4
#define CP (GAMMA * R / (GAMMA - 1.0))
#define CRITICAL_RATIO 0.528
#define LAMINAR_RATIO 0.999
#define PER_LAMINAR (1.0 / (1.0 - LAMINAR_RATIO))

typedef struct { double level, slope; } Tangent;

INLINED Tangent orifice(double ratio, double critical)
{
    double steep = 1.0 / (1.0 - critical);
    double below = max((min(ratio, LAMINAR_RATIO) - critical) * steep, 0.0);
    double share = sqrt(1.0 - below * below);
    int laminar = ratio > LAMINAR_RATIO;
    double slope = laminar ? -share * PER_LAMINAR : -steep * below / share;
    return (Tangent){laminar ? share * PER_LAMINAR * (1.0 - ratio) : share, slope};
}

INLINED Tangent opening(double p, double ambient, double critical)
{
    int inwards = p <= ambient;
    Tangent flow = orifice(inwards ? p / ambient : ambient / p, critical);
    double share = flow.level, slope = flow.slope;
    double out = share * p / ambient;
    double steeper = (share - slope * ambient / p) / ambient;
    return (Tangent){inwards ? share : -out, inwards ? slope / ambient : -steeper};
}

/* --- plant.py ------------------------------------------------------------------------------ */

#define LIGHTEST 1e-15
#define LOWEST 1.0
#define HIGHEST 1e7
#define COLDEST 60.0
#define HOTTEST 2000.0
#define PER_COLDEST (1.0 / (R * COLDEST))
#define PER_HOTTEST (1.0 / (R * HOTTEST))
#define TINY 1e-9
#define MOST 100.0
#define FAINTEST 1e-12
#define FREE_AT 10.0
#define ROUND 0.03
#define NOTHING_UNTIL 0.25
#define G 0.435866521508459
#define A21 ((1.0 - G) / 2.0 / G)
#define FURTHER ((1.0 + G) / 2.0 / G)
#define B1 (-(6.0 * G * G - 16.0 * G + 1.0) / 4.0 / G)
#define B2 ((6.0 * G * G - 20.0 * G + 5.0) / 4.0 / G)
#define PORT_COUNTS 0.1

typedef struct {
    double port, port_mass, line, line_mass, vessel, vessel_mass, near, far, yielded;
} Gas;
typedef struct { double drive, jet, valve, drained, supply, felt, sensed; } Lags;
typedef struct { double jet, suction, end, blow_off, open; } Driven;
typedef struct { double nozzle, blow, open; } Valves;
typedef struct { double suction, end, blow_off; } Supplied;
typedef struct { double out, out_slope, in, in_slope; } Port;
typedef struct { Gas gas; Lags lags; } Stage;
typedef struct { Gas gas; Lags lags; double off; } Advanced;

static void prepare(const double *theta, double *k)
{
    for (int j = 0; j < COEFFICIENTS; j++)
        K(j) = T(j);
    double ambient = T(AMBIENT), nominal = T(AMBIENT_NOMINAL);
    double off = T(SUPPLY_NOMINAL) / T(SUPPLY_OPTIMUM) - 1.0;
    double peak = max(1.0 - T(SUPPLY_CURVATURE) * off * off, 1e-3);
    K(K_SUCTION) = T(SUCTION) * (ambient / nominal) / peak;
    K(K_END) = T(END_RATIO) * ambient;
    K(K_THINNER) = nominal / ambient;
    K(K_BLOW_OFF) = T(BLOW_OFF) / (T(SUPPLY_NOMINAL) + nominal);
    K(K_FLATTER) = 1.0 / T(SUPPLY_OPTIMUM);
    K(K_HEAT) = T(FILM) * T(AREA) / CP;
    K(K_PORT_HEAT) = T(PORT_HEAT) / CP;
    K(K_LINE_HEAT) = T(LINE_HEAT) / CP;
    double most = ambient / (1.0 + T(STIFF_UNTIL) / ambient);
    K(K_STRETCH) = T(COMPLIANCE) * (1.0 + T(SOFTNESS)) / most;
    K(K_SOFT) = T(SOFTNESS) / most;
    double friction = T(NEAR_RESISTANCE) + T(RESISTANCE);
    double at = T(KINK_AT), away = 1.0 - at;
    K(K_CLOSED) = sqrt(at * at + ROUND * ROUND) - at;
    K(K_OPENS) = T(KINK) / (sqrt(away * away + ROUND * ROUND) + away - K(K_CLOSED));
    K(K_PLACE) = friction > 0.0 ? min(T(PLACE) / friction, 1.0) : 0.0;
}

INLINED Supplied at_supply(double supply, const double *k)
{
    double ambient = K(AMBIENT);
    double relative = supply * K(K_THINNER);
    double off = relative * K(K_FLATTER) - 1.0;
    double suction = K(K_SUCTION) * max(1.0 - K(SUPPLY_CURVATURE) * off * off, 0.0);
    double missing = K(SUPPLY_NOMINAL) - relative;
    double end = K(K_END) * (1.0 + K(END_SLOPE) * missing);
    double blow_off = K(K_BLOW_OFF) * (supply + ambient);
    return (Supplied){suction, min(max(end, 0.0), 0.98 * ambient), blow_off};
}

INLINED Tangent characteristic(double x, const double *k)
{
    double b0 = K(BULGE), b1 = K(SKEW), b2 = K(BEND_2), b3 = K(BEND_3);
    double above = max(x - 1.0, 0.0);
    x = min(max(x, 0.0), 1.0);
    double bend = b0 + x * (b1 + x * (b2 + x * b3));
    double slope = b1 + x * (2.0 * b2 + x * 3.0 * b3);
    double beyond = x - K(KINK_AT), first = 1.0 - K(KINK);
    double root = sqrt(beyond * beyond + ROUND * ROUND);
    double share = first * x * (1.0 + (1.0 - x) * bend) + K(K_OPENS) * (root + beyond - K(K_CLOSED));
    double rise = first * (1.0 + (1.0 - 2.0 * x) * bend + x * (1.0 - x) * slope);
    rise += K(K_OPENS) * (beyond / root + 1.0);
    rise = x > 0.0 ? max(rise, 0.0) : 0.0;
    return (Tangent){max(share, 0.0) + above * rise, rise};
}

INLINED Port at_port(double p, const Driven *driven, const double *k)
{
    double ambient = K(AMBIENT);
    double per_pa = 1.0 / (ambient - driven->end);
    double depth = driven->jet + (1.0 - K(JET_DEPTH)) * (1.0 - driven->jet) - K(MOVED) * per_pa;
    Tangent curve = characteristic(depth - (ambient - p) * per_pa, k);
    double out_slope = driven->jet * driven->suction * per_pa * curve.slope;
    double out = driven->jet * driven->suction * curve.level - out_slope * p;
    double opens = ambient + K(CRACKING_PRESSURE), relieves = ambient + K(RELIEF_PRESSURE);
    double relief = p > relieves ? K(RELIEF) : 0.0;
    Tangent flow = opening(p < ambient ? p : p - K(CRACKING_PRESSURE), ambient, CRITICAL_RATIO);
    double back = K(BACK_FLOW) * (1.0 - min(driven->jet, 1.0));
    back = p < ambient ? back : 0.0;
    double vent = p > opens ? K(EXHAUST) : 0.0;
    double fuller = driven->blow_off * K(BLOW_OFF_SHAPE);
    double blown = driven->blow_off + fuller * (1.0 - p / ambient) + back * flow.level + K(PORT_INFLOW);
    double blown_slope = min(back * flow.slope - fuller / ambient, 0.0);
    return (Port){
        out - relief * relieves - vent * (flow.level - flow.slope * p),
        out_slope + relief - vent * flow.slope,
        blown - blown_slope * p,
        blown_slope,
    };
}

INLINED Tangent at_vessel(double p, const Driven *driven, const double *k)
{
    double ambient = K(AMBIENT);
    double laminar = K(LAMINAR_LEAK) + driven->open * K(OPENING);
    double sonic = K(LEAK) + driven->open * K(HOLE);
    Tangent flow = opening(p, ambient, K(LEAK_CRITICAL));
    double slope = sonic * flow.slope - laminar;
    double level = sonic * (flow.level - flow.slope * p) + laminar * ambient;
    return (Tangent){level + K(INFLOW), slope};
}

INLINED double through(double rest, double fall, double before, double rise,
                             double quadratic, double linear, double pushed)
{
    double difference = rest * rest - before * before + pushed;
    double friction = difference >= 0.0 ? quadratic : -quadratic;
    double square = fall * fall - rise * rise - friction;
    double slope = 2.0 * (rest * fall + before * rise) + linear;
    double root = sqrt(max(slope * slope - 4.0 * square * difference, 0.0));
    return 2.0 * difference / (slope + root);
}

INLINED double choking(double port, double vessel, double critical)
{
    double high = max(port, vessel), low = min(port, vessel);
    double least = max(low, critical * high);
    double both = high + least, most = (1.0 - critical * critical) * high * high;
    double bent = (1.0 - critical) * both - critical * (high - least);
    return (1.0 - critical) * both * (most + (least * least - low * low)) / (bent * most);
}

INLINED double kept(double mass, double work)
{
    return min(max(mass, work * PER_HOTTEST), work * PER_COLDEST);
}

INLINED double per_joule(double mass)
{
    return 1.0 / (R * mass);
}

typedef struct { double shrunk, stretch; } Shrinkage;

INLINED Shrinkage shrinkage(double vessel, const double *k)
{
    double vacuum = K(AMBIENT) - vessel;
    double held = K(STIFF_UNTIL) / (fabs(vacuum) + K(STIFF_UNTIL) + TINY);
    double pull = vacuum * (1.0 - held);
    double left = 1.0 / (1.0 + K(K_SOFT) * fabs(pull)), stretch = K(K_STRETCH) * left;
    return (Shrinkage){stretch * pull, stretch * left * (1.0 - held * held)};
}

INLINED double room(double vessel, double yielded, const double *k)
{
    return K(VOLUME) - (1.0 - K(CREEP)) * shrinkage(vessel, k).shrunk - yielded;
}

INLINED double convection(const Gas *y, double warmer, const double *k)
{
    double free = sqrt(y->vessel / K(AMBIENT) * sqrt(fabs(warmer) * (1.0 / FREE_AT)));
    double forced = sqrt(K(FORCED_CONVECTION) * max(-y->far, 0.0));
    return 1.0 + K(FREE_CONVECTION) * (free - 1.0) + forced;
}

INLINED Gas solve(Gas y, const Gas *known, double step, const Driven *driven, const double *k)
{
    double ambient = K(AMBIENT), outside = K(TEMPERATURE);
    double per_s = 1.0 / step, per_pa = 1.0 / (GAMMA * R * step), per_k = 1.0 / outside;
    Port at = at_port(y.port, driven, k);
    double out = at.out, out_slope = at.out_slope, blown = at.in, blown_slope = at.in_slope;
    Tangent leaking = at_vessel(y.vessel, driven, k);
    double leak = leaking.level, leak_slope = leaking.slope;
    Shrinkage gives = shrinkage(y.vessel, k);
    double shrunk = gives.shrunk, stretch = gives.stretch;
    double creep = K(CREEP), follows = step / (K(CREEP_TIME) + step);
    double yields = follows * (creep * shrunk - known->yielded);
    double yielded = known->yielded + yields;
    double volume = K(VOLUME) - (1.0 - creep) * shrunk - yielded;
    double port_stored = K(PORT_VOLUME) * per_pa, line_stored = K(LINE_VOLUME) * per_pa;
    double vessel_stored = (volume + GAMMA * y.vessel * stretch * (1.0 - creep)) * per_pa;
    double creeping = GAMMA * y.vessel * stretch * creep * follows * per_pa;
    double port_warmth = K(K_PORT_HEAT), line_warmth = K(K_LINE_HEAT);

    /* Gas leaves a node at the node's temperature. */
    double vessel_t = y.vessel * volume * per_joule(y.vessel_mass);
    double entering = blown + blown_slope * y.port;
    double held = port_stored * known->port + (entering + port_warmth) * outside;
    double leaving =
        y.port_mass * R * per_pa + max(out + out_slope * y.port, 0.0) + port_warmth;
    double line_t = y.line * K(LINE_VOLUME) * per_joule(y.line_mass);
    double port_t = (held + max(y.near, 0.0) * line_t) / (leaving + max(-y.near, 0.0));
    held = line_stored * known->line + line_warmth * outside;
    held += max(y.far, 0.0) * vessel_t + max(-y.near, 0.0) * port_t;
    leaving = y.line_mass * R * per_pa + line_warmth;
    line_t = held / (leaving + max(y.near, 0.0) + max(-y.far, 0.0));
    double warmth = K(K_HEAT) * convection(&y, vessel_t - outside, k);
    double near_t = y.near >= 0.0 ? line_t : port_t;
    double far_t = y.far >= 0.0 ? vessel_t : line_t;
    double leak_t = y.vessel <= ambient ? outside : vessel_t;

    /* Pressures as rest and slope over the flows. */
    double weight = 1.0 / (port_stored + out_slope * port_t - blown_slope * outside);
    double gained = port_stored * known->port + blown * outside - out * port_t;
    gained += port_warmth * (outside - port_t);
    double port_rest = max(gained * weight, LOWEST), port_rise = near_t * weight;
    weight = 1.0 / line_stored;
    double line_rest = max(known->line + line_warmth * (outside - line_t) * weight, LOWEST);
    double line_fall = near_t * weight, line_rise = far_t * weight;
    double cooling = warmth * volume * per_joule(y.vessel_mass);
    weight = 1.0 / (vessel_stored - leak_slope * leak_t + cooling + creeping);
    gained = vessel_stored * known->vessel + leak * leak_t + warmth * outside;
    gained += creeping * y.vessel + GAMMA * y.vessel * yields * per_pa;
    double vessel_rest = gained * weight, vessel_fall = far_t * weight;

    double chokes = choking(y.port, y.vessel, K(LINE_CRITICAL));
    double inertia = K(NEAR_INERTANCE) * (y.line + y.port) * per_s;
    double warm = near_t * per_k;
    double quadratic = warm * K(NEAR_RESISTANCE) * chokes, linear = warm * K(NEAR_LAMINAR) + inertia;
    double pushed = inertia * known->near;
    double near = through(y.line, 0.0, port_rest, port_rise, quadratic, linear, pushed);
    double slope =
        2.0 * (port_rise * (port_rest + port_rise * near) + quadratic * fabs(near)) + linear;
    double near_slope = 2.0 * y.line / slope;
    near -= near_slope * y.line;
    weight = slope / (slope + 2.0 * y.line * line_fall);
    line_rest = (line_rest - line_fall * near) * weight;
    line_rise = line_rise * weight;

    inertia = K(INERTANCE) * (y.vessel + y.line) * per_s;
    warm = far_t * per_k;
    quadratic = warm * K(RESISTANCE) * chokes;
    linear = warm * K(LAMINAR) + inertia;
    pushed = inertia * known->far;
    double far = through(vessel_rest, vessel_fall, line_rest, line_rise, quadratic, linear, pushed);

    double line = min(max(line_rest + line_rise * far, LOWEST), HIGHEST);
    double vessel = min(max(vessel_rest - vessel_fall * far, LOWEST), HIGHEST);
    near += near_slope * line;
    double port = min(max(port_rest + port_rise * near, LOWEST), HIGHEST);
    double net = near - (out + out_slope * port) + blown + blown_slope * port;
    return (Gas){
        port,
        kept(known->port_mass + step * net, port * K(PORT_VOLUME)),
        line,
        kept(known->line_mass + step * (far - near), line * K(LINE_VOLUME)),
        vessel,
        kept(known->vessel_mass + step * (leak + leak_slope * vessel - far), vessel * volume),
        min(max(near, -MOST), MOST),
        min(max(far, -MOST), MOST),
        yielded,
    };
}

INLINED double lag(double known, double target, double step, double slow)
{
    return known + step / (slow + step) * (target - known);
}

INLINED double drawing(double opening, const double *k)
{
    double slow = K(SLOW_RAMP_UP) / (K(SLOW_RAMP_UP) + K(RAMP_UP));
    double full = 1.0 - slow * (1.0 - K(JET_FULL_AT));
    double from_there = NOTHING_UNTIL * full * (1.0 - full);
    double share = min(max((opening - from_there) / (full - from_there), 0.0), 1.0);
    return share * (full + (1.0 - full) * share * (3.0 - 2.0 * share));
}

INLINED Stage stage(const Gas *guess, const Gas *known, const Lags *lags, double step,
                   const Valves *valves, int far_off, const double *k)
{
    double rise = K(RAMP_UP), fall = K(RAMP_DOWN);
    double first = rise + K(SLOW_RAMP_UP);
    int rising = valves->nozzle > lags->drive;
    double drive = lag(lags->drive, valves->nozzle, step, rising ? first : fall);
    double jet = lag(lags->jet, rising ? drawing(drive, k) : drive, step, rising ? rise : fall);
    int opens = valves->blow > lags->valve;
    double valve = lag(lags->valve, valves->blow, step, K(opens ? BLOW_OFF_RAMP : BLOW_OFF_RAMP_DOWN));
    double rate = step * K(BLOW_OFF_DRAIN);
    double drained = (lags->drained + rate * valve) / (1.0 + rate * (valve + K(BLOW_OFF_REFILL)));
    double regulated = max(K(SUPPLY) - K(DROOP) * max(valves->nozzle, valves->blow), 0.0);
    double supply = lag(lags->supply, regulated, step, K(SUPPLY_LAG));
    Supplied at = at_supply(supply, k);
    Driven driven = {jet, at.suction, at.end, at.blow_off * valve * (1.0 - drained), valves->open};
    Gas gas = solve(*guess, known, step, &driven, k);
    gas = solve(gas, known, step, &driven, k);
    if (far_off)
        gas = solve(gas, known, step, &driven, k);
    double there = gas.port + K(K_PLACE) * (gas.vessel - gas.port);
    double slow = K(SENSOR_LAG);
    double felt = lag(lags->felt, there, step, slow);
    double sensed = lag(lags->sensed, felt, step, slow + K(SLOW_SENSOR));
    return (Stage){gas, {drive, jet, valve, drained, supply, felt, sensed}};
}

#define ON(of) start->of + share * (end->of - begin->of)

INLINED Gas gas_on(const Gas *start, const Gas *begin, const Gas *end, double share)
{
    return (Gas){
        ON(port), ON(port_mass), ON(line), ON(line_mass),
        ON(vessel), ON(vessel_mass), ON(near), ON(far), ON(yielded),
    };
}

INLINED Lags lags_on(const Lags *start, const Lags *begin, const Lags *end, double share)
{
    return (Lags){
        ON(drive), ON(jet), ON(valve), ON(drained), ON(supply), ON(felt), ON(sensed),
    };
}

INLINED Gas positive(Gas gas)
{
    return (Gas){
        max(gas.port, LOWEST), max(gas.port_mass, LIGHTEST),
        max(gas.line, LOWEST), max(gas.line_mass, LIGHTEST),
        max(gas.vessel, LOWEST), max(gas.vessel_mass, LIGHTEST),
        gas.near, gas.far, gas.yielded,
    };
}

INLINED double bent(double first, double second, double third)
{
    return fabs(first - 2.0 * second + third);
}

INLINED Lags ended(Lags lags)
{
    return (Lags){
        lags.drive > FAINTEST ? lags.drive : 0.0,
        lags.jet > FAINTEST ? lags.jet : 0.0,
        lags.valve > FAINTEST ? lags.valve : 0.0,
        lags.drained > FAINTEST ? lags.drained : 0.0,
        lags.supply, lags.felt, lags.sensed,
    };
}

INLINED Advanced advance_gas(const Gas *gas, const Lags *lags, double h, const Valves *valves,
                            const double *k)
{
    double step = G * h;
    Stage one = stage(gas, gas, lags, step, valves, 1, k);
    Gas known = gas_on(gas, gas, &one.gas, A21), guess = gas_on(gas, gas, &one.gas, FURTHER);
    Lags held = lags_on(lags, lags, &one.lags, A21);
    guess = positive(guess);
    Stage two = stage(&guess, &known, &held, step, valves, 0, k);
    Gas last = gas_on(gas, gas, &one.gas, B1);
    last = gas_on(&last, &known, &two.gas, B2);
    Lags late = lags_on(lags, lags, &one.lags, B1);
    late = lags_on(&late, &held, &two.lags, B2);
    guess = positive(gas_on(&one.gas, &one.gas, &two.gas, 2.0));
    Stage three = stage(&guess, &last, &late, step, valves, 0, k);
    double port = bent(one.gas.port - gas->port, two.gas.port - known.port,
                       three.gas.port - last.port);
    double vessel = bent(one.gas.vessel - gas->vessel, two.gas.vessel - known.vessel,
                         three.gas.vessel - last.vessel);
    double felt = bent(one.lags.felt - lags->felt, two.lags.felt - held.felt,
                       three.lags.felt - late.felt);
    double sensed = bent(one.lags.sensed - lags->sensed, two.lags.sensed - held.sensed,
                         three.lags.sensed - late.sensed);
    double off = max(max(PORT_COUNTS * port, vessel), max(felt, sensed));
    return (Advanced){three.gas, ended(three.lags), off};
}

static double reading(double sensed, const double *k)
{
    double vacuum = K(AMBIENT) - sensed;
    return sensed - (K(SENSOR_GAIN) - 1.0) * vacuum + K(SENSOR_OFFSET);
}

static double sensed_at(double value, const double *k)
{
    double gain = K(SENSOR_GAIN);
    return (value - K(SENSOR_OFFSET) + (gain - 1.0) * K(AMBIENT)) / gain;
}

/* --- kernel.py ----------------------------------------------------------------------------- */

#define LONGEST_STEP 0.01
#define LONGEST_BRIDGE 0.1
#define NEVER 1e9
#define FINEST 24
#define TOLERANCE 0.02

INLINED double valve_over(double *state, int position, double h, const double *k, int response)
{
    double before = S(position), command = S(position + 1), age = S(position + 2);
    double late = (command > 0.5 ? K(response) : K(response + 1)) - age;
    int acts = late < h;
    S(position) = acts ? command : before;
    S(position + 2) = age + h;
    return acts ? command + (before - command) * max(late, 0.0) / h : before;
}

static int release(const double *state, const double *k, double h)
{
    double filling = -GAMMA * S(S_FAR) * S(S_VESSEL) / S(S_VESSEL_MASS);
    double left = K(AMBIENT) - S(S_VESSEL) - K(RELEASE); /* NaN where nothing is let go */
    int soon = S(BLOW_COMMAND) > 0.0 && left < 1.5 * h * filling;
    return S(OPEN) == 0.0 ? soon : S(OPEN) > 1.0;
}

INLINED double until_met(const double *state, const double *k)
{
    return S(NOZZLE_COMMAND) > 0.5 ? K(CONTACT) - S(NOZZLE_AGE) : NEVER;
}

INLINED double opened(double before, const Gas *gas, double commanded, const double *k)
{
    double beyond = gas->vessel - (K(AMBIENT) - K(RELEASE));
    double missed = min(beyond / max(gas->vessel - before, 1e-9), 1.0);
    return beyond >= 0.0 && commanded > 0.0 ? 1.0 + missed : 0.0;
}

static int moves(const double *state, int position, double h, const double *k, int response)
{
    double command = S(position + 1);
    double late = K(command > 0.5 ? response : response + 1) - S(position + 2);
    return late < h && (S(position) != command || late > -h);
}

static int jumps(const double *state, const double *k, double h)
{
    return moves(state, NOZZLE, h, k, RESPONSE) || moves(state, BLOW, h, k, BLOW_OFF_RESPONSE) ||
           (K(CONTACT) > 0.0 && fabs(until_met(state, k)) < h) || release(state, k, h);
}

static int passes(const double *state, const double *k, double h)
{
    double moved = fabs(S(S_PORT) - S(S_FELT)) / K(SENSOR_LAG) * h;
    double above = S(S_PORT) - K(AMBIENT);
    double opens = min(fabs(above - K(CRACKING_PRESSURE)), fabs(above - K(RELIEF_PRESSURE)));
    return S(S_BLOWING) > 0.01 && opens < moved;
}

static int finer(const double *state, const double *k, double h)
{
    if (jumps(state, k, h) || passes(state, k, h))
        return FINEST;
    double steps = ceil(h * pow(max(0.0, S(ROUGH)) / TOLERANCE, 1.0 / 3.0));
    return (int)min(max(steps, 1.0), FINEST);
}

INLINED void substep(double *state, const double *k, double h)
{
    double until = until_met(state, k);
    double nozzle = valve_over(state, NOZZLE, h, k, RESPONSE);
    double blow = valve_over(state, BLOW, h, k, BLOW_OFF_RESPONSE);
    Gas gas = {
        S(S_PORT), S(S_PORT_MASS), S(S_LINE), S(S_LINE_MASS),
        S(S_VESSEL), S(S_VESSEL_MASS), S(S_NEAR), S(S_FAR), S(S_YIELDED),
    };
    Lags lags = {
        S(S_DRIVE), S(S_JET), S(S_BLOWING), S(S_DRAINED),
        S(S_SUPPLIED), S(S_FELT), S(S_SENSED),
    };
    double before = gas.vessel;
    double open_cup = until < h ? S(OPEN) * max(until, 0.0) / h : S(OPEN);
    Advanced next = advance_gas(&gas, &lags, h, &(Valves){nozzle, blow, open_cup}, k);
    S(S_PORT) = next.gas.port, S(S_PORT_MASS) = next.gas.port_mass;
    S(S_VESSEL) = next.gas.vessel, S(S_VESSEL_MASS) = next.gas.vessel_mass;
    S(S_LINE) = next.gas.line, S(S_LINE_MASS) = next.gas.line_mass;
    S(S_NEAR) = next.gas.near, S(S_FAR) = next.gas.far, S(S_YIELDED) = next.gas.yielded;
    S(S_DRIVE) = next.lags.drive, S(S_JET) = next.lags.jet;
    S(S_BLOWING) = next.lags.valve, S(S_DRAINED) = next.lags.drained;
    S(S_SUPPLIED) = next.lags.supply;
    S(S_FELT) = next.lags.felt, S(S_SENSED) = next.lags.sensed;
    double now = opened(before, &next.gas, S(BLOW_COMMAND), k);
    S(OPEN) = until < h ? 0.0 : open_cup > 0.0 ? min(open_cup, 1.0) : now;
    S(ROUGH) = next.off / (h * h * h);
}

static void step(double *restrict state, const double *restrict k, double dt)
{
    int count = (int)max(ceil(dt / LONGEST_STEP - 1e-6), 1);
    double h = dt / count;
    for (int i = 0; i < count; i++) {
        int steps = 1;
        for (int lane = 0; lane < LANES; lane++)
            steps = (int)max(steps, finer(state + lane, k + lane, h));
        for (int j = 0; j < steps; j++) {
#pragma omp simd
            for (int lane = 0; lane < LANES; lane++)
                substep(state + lane, k + lane, h / steps);
        }
    }
}

static void command(double *state, int position, double value)
{
    if (S(position + 1) != value) {
        S(position + 1) = value;
        S(position + 2) = 0.0;
    }
}

static void enter(double *state, int phase, const double *k)
{
    int before = (int)S(PHASE);
    if (phase == before)
        return;
    S(PHASE) = phase;
    command(state, NOZZLE, phase == SUCTION_PHASE);
    command(state, BLOW, phase == BLOW_OFF_PHASE);
    if ((before == HOLD_PHASE && phase == SUCTION_PHASE) ||
        (before == SUCTION_PHASE && phase == HOLD_PHASE))
        S(NOZZLE_AGE) = NEVER;
    if (phase == SUCTION_PHASE && before != HOLD_PHASE)
        S(OPEN) = K(CONTACT) > 0.0 && !isnan(K(RELEASE)) ? S(OPEN) : 0.0;
    if (phase == IDLE_PHASE && before == BLOW_OFF_PHASE && !isnan(K(RELEASE)))
        S(OPEN) = JUST_OPEN;
}

static void settle(double *state, const double *k, double pressure)
{
    double temperature = K(TEMPERATURE);
    S(S_YIELDED) = K(CREEP) * shrinkage(pressure, k).shrunk;
    double volume = room(pressure, S(S_YIELDED), k);
    S(S_PORT) = S(S_LINE) = S(S_VESSEL) = pressure;
    S(S_FELT) = S(S_SENSED) = pressure;
    S(S_PORT_MASS) = pressure * K(PORT_VOLUME) / (R * temperature);
    S(S_VESSEL_MASS) = pressure * volume / (R * temperature);
    S(S_LINE_MASS) = pressure * K(LINE_VOLUME) / (R * temperature);
    S(S_NEAR) = S(S_FAR) = 0.0;
    S(S_SUPPLIED) = K(SUPPLY);
}

static void shift_by(double *state, double shift)
{
    for (int node = S_PORT; node <= S_VESSEL; node += 2) {
        double moved = max(S(node) + shift, 100.0);
        S(node + 1) *= moved / S(node);
        S(node) = moved;
    }
    S(S_FELT) += shift;
    S(S_SENSED) += shift;
}

static void synchronise(double *state, double level, const double *k)
{
    int idle = S(PHASE) == IDLE_PHASE;
    if (!isnan(K(RELEASE)) && (idle || (S(OPEN) > 0.0 && S(PHASE) != SUCTION_PHASE))) {
        settle(state, k, K(AMBIENT));
        S(OPEN) = 1.0;
    } else if (S(VALID) > 0.0) {
        shift_by(state, sensed_at(level, k) - S(S_SENSED));
    } else {
        settle(state, k, sensed_at(level, k));
    }
    if (S(VALID) == 0.0) {
        S(S_DRIVE) = S(S_JET) = S(NOZZLE) = S(NOZZLE_COMMAND);
        S(S_BLOWING) = S(BLOW) = S(BLOW_COMMAND);
    }
    S(VALID) = 1.0;
}

/* control.py */
static int two_point(int before, double vacuum, double high, double low)
{
    return vacuum >= high ? 1 : vacuum < low ? 0 : before;
}

static void read_out(double *state, const double *k, double *expected, uint8_t *signals)
{
    *expected = S(VALID) > 0.0 ? reading(S(S_SENSED), k) : NAN;
    double vacuum = S(VALID) > 0.0 ? K(AMBIENT) - S(S_PORT) : 0.0;
    int before = (int)S(SIGNALS);
    int present = two_point((before & PART_PRESENT_SIGNAL) != 0, vacuum, K(H2), K(H2_LOW));
    int reached = two_point((before & AIR_SAVING_SIGNAL) != 0, vacuum, K(H1), K(H1_LOW));
    *signals = (uint8_t)(present * PART_PRESENT_SIGNAL + reached * AIR_SAVING_SIGNAL);
    S(SIGNALS) = *signals;
}

void advance(double *state, const double *theta, const double *dt, const uint8_t *phase,
             const double *level, double *expected, uint8_t *signals, int64_t rows)
{
    double k[PREPARED * LANES];
    for (int lane = 0; lane < LANES; lane++)
        prepare(theta + lane, k + lane);
    for (int64_t row = 0; row < rows; row++) {
        if (S(VALID) > 0.0 && dt[row] > 0.0 && dt[row] <= LONGEST_BRIDGE)
            step(state, k, dt[row]);
        for (int lane = 0; lane < LANES; lane++) {
            double *mine = state + lane;
            const double *its = k + lane;
            if (dt[row] < 0.0 || dt[row] > LONGEST_BRIDGE)
                mine[VALID * LANES] = 0.0;
            enter(mine, phase[row], its);
            if (!isnan(level[row]))
                synchronise(mine, level[row], its);
            read_out(mine, its, &expected[row * LANES + lane], &signals[row * LANES + lane]);
        }
    }
}
