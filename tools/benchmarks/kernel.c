/* The model's step in C: twin/model gas.py, plant.py and kernel.py, the same scheme line for line.

   It is the floor for the compiled Python beside it, and follows it: whoever changes the physics
   there changes them here, or the benchmark says that the results differ. */
#include <math.h>
#include <stdint.h>

static const double R = 287.05, GAMMA = 1.4, CP = 1.4 * 287.05 / (1.4 - 1.0);
static const double CRITICAL_RATIO = 0.528, LAMINAR_RATIO = 0.999;
static const double OPEN_TIME = 2e-3, LONGEST_STEP = 1e-3, LONGEST_BRIDGE = 0.1, NEVER = 1e9;

enum { /* twin.model.dataset.COEFFICIENTS */
    AMBIENT, AMBIENT_NOMINAL, TEMPERATURE, SUPPLY, SUPPLY_NOMINAL, SUPPLY_OPTIMUM,
    SUPPLY_CURVATURE, END_SLOPE, SUCTION, END_RATIO, BULGE, SKEW, RESPONSE, RAMP_UP, RAMP_DOWN,
    RESISTANCE, BLOW_OFF, BLOW_OFF_RESPONSE, BLOW_OFF_RAMP, RELIEF, VOLUME, COMPLIANCE, FILM, AREA,
    LEAK, LAMINAR_LEAK, BACK_FLOW, SENSOR_LAG, SENSOR_OFFSET, SENSOR_GAIN, H1, H1_LOW, RELEASE
};
enum { /* the state of twin.model.kernel */
    Y_PRESSURE, Y_TEMPERATURE, Y_JET, Y_BLOWING, Y_SENSED, ORDER,
    NOZZLE = ORDER, NOZZLE_COMMAND, NOZZLE_AGE, BLOW, BLOW_COMMAND, BLOW_AGE, PHASE, OPEN, VALID
};
enum { IDLE_PHASE, SUCTION_PHASE, HOLD_PHASE, BLOW_OFF_PHASE }; /* twin.signals.Phase */

typedef struct { double suction, end, blow_off; } Supplied;

static inline double max(double a, double b) { return a > b ? a : b; }
static inline double min(double a, double b) { return a < b ? a : b; }
static inline double square(double a) { return a * a; }

static double orifice(double ratio)
{
    if (ratio <= CRITICAL_RATIO)
        return 1.0;
    if (ratio < LAMINAR_RATIO) {
        double below = (ratio - CRITICAL_RATIO) / (1.0 - CRITICAL_RATIO);
        return sqrt(1.0 - below * below);
    }
    double edge = (LAMINAR_RATIO - CRITICAL_RATIO) / (1.0 - CRITICAL_RATIO);
    return sqrt(1.0 - edge * edge) * (1.0 - ratio) / (1.0 - LAMINAR_RATIO);
}

static Supplied at_supply(const double *theta)
{
    double ambient = theta[AMBIENT], nominal = theta[AMBIENT_NOMINAL];
    double supply = max(theta[SUPPLY], 0.0), supply_nominal = theta[SUPPLY_NOMINAL];
    double optimum = theta[SUPPLY_OPTIMUM], curvature = theta[SUPPLY_CURVATURE];
    double peak = max(1.0 - curvature * square(supply / optimum - 1.0), 0.0);
    double peak_nominal = max(1.0 - curvature * square(supply_nominal / optimum - 1.0), 1e-3);
    double suction = theta[SUCTION] * (peak / peak_nominal) * (ambient / nominal);
    double end = theta[END_RATIO] * ambient * (1.0 + theta[END_SLOPE] * (supply_nominal - supply));
    double blow_off = theta[BLOW_OFF] * ((supply + ambient) / (supply_nominal + nominal));
    return (Supplied){suction, min(max(end, 0.0), 0.98 * ambient), blow_off};
}

static void characteristic(double x, double bulge, double skew, double *share, double *slope)
{
    if (x <= 0.0) {
        *share = *slope = 0.0;
        return;
    }
    double bend = bulge + skew * x;
    *share = max(x * (1.0 + (1.0 - x) * bend), 0.0);
    *slope = 1.0 + (1.0 - 2.0 * x) * bend + x * (1.0 - x) * skew;
}

static double port(double p, double jet, double flow_in, const double *theta, Supplied supplied,
                   double *through)
{
    double ambient = theta[AMBIENT], resistance = theta[RESISTANCE];
    double end = supplied.end, span = ambient - end;
    double p_port = p, a = 0.0, b = 0.0;
    double floor = min(p, end + 1e-6 * span);
    for (int pass = 0; pass < 4; pass++) {
        double share, slope;
        characteristic((p_port - end) / span, theta[BULGE], theta[SKEW], &share, &slope);
        b = max(jet * supplied.suction * slope / span, 0.0);
        a = jet * supplied.suction * share - b * p_port - flow_in;
        if (p_port > ambient) {
            a -= theta[RELIEF] * ambient;
            b += theta[RELIEF];
        }
        if (resistance == 0.0) {
            *through = a + b * p;
            return p;
        }
        double sign = a + b * p >= 0.0 ? resistance : -resistance;
        double root = sqrt(max(p * p + sign * (b * b * p * p - a * a), 1.0));
        p_port = max((p * p - sign * a * a) / (sign * a * b + root), floor);
    }
    *through = a + b * p_port;
    return p_port;
}

static void rates(const double *y, double open_cup, double nozzle, double blow, const double *theta,
                  Supplied supplied, double *dy)
{
    double p = y[0], temperature = y[1], jet = y[2], valve = y[3], sensed = y[4];
    double ambient = theta[AMBIENT], outside = theta[TEMPERATURE];

    double flow_back = 0.0, through;
    if (theta[BACK_FLOW] > 0.0 && p < ambient)
        flow_back = theta[BACK_FLOW] * (1.0 - min(jet, 1.0)) * orifice(p / ambient);
    double p_port =
        port(p, jet, supplied.blow_off * valve + flow_back, theta, supplied, &through);

    double flow_in = theta[LAMINAR_LEAK] * (ambient - p) + max(-through, 0.0);
    if (p < ambient)
        flow_in += theta[LEAK] * orifice(p / ambient);
    double flow_out = max(through, 0.0);

    double volume = theta[VOLUME] - theta[COMPLIANCE] * (1.0 - p / ambient);
    double stretch = theta[COMPLIANCE] / ambient;
    double heat = theta[FILM] * theta[AREA] * (outside - temperature);
    double enthalpy = CP * (flow_in * outside - flow_out * temperature);
    double dp = (GAMMA - 1.0) * (enthalpy + heat) / (volume + GAMMA * p * stretch);
    double mass = p * volume / (R * temperature);
    double dtemperature =
        temperature * (dp / p + stretch * dp / volume - (flow_in - flow_out) / mass);
    if (open_cup > 0.0) {
        dp = (ambient - p) / OPEN_TIME;
        dtemperature = (outside - temperature) / OPEN_TIME;
    }
    dy[0] = dp;
    dy[1] = dtemperature;
    dy[2] = (nozzle - jet) / (nozzle > jet ? theta[RAMP_UP] : theta[RAMP_DOWN]);
    dy[3] = (blow - valve) / theta[BLOW_OFF_RAMP];
    dy[4] = (p_port - sensed) / theta[SENSOR_LAG];
}

static double reading(double sensed, const double *theta)
{
    double vacuum = theta[AMBIENT] - sensed;
    return sensed - (theta[SENSOR_GAIN] - 1.0) * vacuum + theta[SENSOR_OFFSET];
}

static double sensed_at(double value, const double *theta)
{
    double gain = theta[SENSOR_GAIN];
    return (value - theta[SENSOR_OFFSET] + (gain - 1.0) * theta[AMBIENT]) / gain;
}

static void runge_kutta(double *y, double h, double open_cup, double nozzle, double blow,
                        const double *theta, Supplied supplied)
{
    double k1[ORDER], k2[ORDER], k3[ORDER], k4[ORDER], mid[ORDER];
    rates(y, open_cup, nozzle, blow, theta, supplied, k1);
    for (int i = 0; i < ORDER; i++)
        mid[i] = y[i] + 0.5 * h * k1[i];
    rates(mid, open_cup, nozzle, blow, theta, supplied, k2);
    for (int i = 0; i < ORDER; i++)
        mid[i] = y[i] + 0.5 * h * k2[i];
    rates(mid, open_cup, nozzle, blow, theta, supplied, k3);
    for (int i = 0; i < ORDER; i++)
        mid[i] = y[i] + h * k3[i];
    rates(mid, open_cup, nozzle, blow, theta, supplied, k4);
    for (int i = 0; i < ORDER; i++)
        y[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
    y[0] = max(y[0], 1.0);
    y[1] = min(max(y[1], 100.0), 1000.0);
}

static double valve_over(double *state, int position, double h, double response)
{
    double age = state[position + 2];
    state[position + 2] = age + h;
    double before = state[position], command = state[position + 1], late = response - age;
    if (before == command || late >= h)
        return before;
    state[position] = command;
    return command + (before - command) * max(late, 0.0) / h;
}

static void step(double *state, double dt, const double *theta, Supplied supplied)
{
    int count = (int)max(ceil(dt / LONGEST_STEP - 1e-6), 1);
    double h = dt / count;
    for (int i = 0; i < count; i++) {
        double nozzle = valve_over(state, NOZZLE, h, theta[RESPONSE]);
        double blow = valve_over(state, BLOW, h, theta[BLOW_OFF_RESPONSE]);
        runge_kutta(state, h, state[OPEN], nozzle, blow, theta, supplied);
        int released = theta[AMBIENT] - state[Y_PRESSURE] <= theta[RELEASE];
        if (released && state[BLOW_COMMAND] > 0.0)
            state[OPEN] = 1.0;
    }
}

static void command(double *state, int position, double value)
{
    if (state[position + 1] != value) {
        state[position + 1] = value;
        state[position + 2] = 0.0;
    }
}

static void enter(double *state, int phase)
{
    int before = (int)state[PHASE];
    if (phase == before)
        return;
    state[PHASE] = phase;
    command(state, NOZZLE, phase == SUCTION_PHASE);
    command(state, BLOW, phase == BLOW_OFF_PHASE);
    if ((before == HOLD_PHASE && phase == SUCTION_PHASE) ||
        (before == SUCTION_PHASE && phase == HOLD_PHASE))
        state[NOZZLE_AGE] = NEVER;
    if (phase == SUCTION_PHASE && before != HOLD_PHASE)
        state[OPEN] = 0.0;
}

static void synchronise(double *state, double level, const double *theta)
{
    int idle = state[PHASE] == IDLE_PHASE;
    if (theta[RELEASE] >= 0.0 && (idle || state[OPEN] > 0.0)) {
        state[Y_PRESSURE] = state[Y_SENSED] = theta[AMBIENT];
        state[Y_TEMPERATURE] = theta[TEMPERATURE];
        state[OPEN] = 1.0;
    } else if (state[VALID] > 0.0) {
        double shift = sensed_at(level, theta) - state[Y_SENSED];
        state[Y_PRESSURE] = max(state[Y_PRESSURE] + shift, 100.0);
        state[Y_SENSED] += shift;
    } else {
        state[Y_PRESSURE] = state[Y_SENSED] = sensed_at(level, theta);
        state[Y_TEMPERATURE] = theta[TEMPERATURE];
    }
    if (state[VALID] == 0.0) {
        state[Y_JET] = state[NOZZLE] = state[NOZZLE_COMMAND];
        state[Y_BLOWING] = state[BLOW] = state[BLOW_COMMAND];
    }
    state[VALID] = 1.0;
}

void advance(double *state, const double *theta, const double *dt, const uint8_t *phase,
             const double *level, double *expected, int64_t rows)
{
    Supplied supplied = at_supply(theta);
    for (int64_t row = 0; row < rows; row++) {
        if (dt[row] < 0.0 || dt[row] > LONGEST_BRIDGE)
            state[VALID] = 0.0;
        else if (state[VALID] > 0.0 && dt[row] > 0.0)
            step(state, dt[row], theta, supplied);
        enter(state, phase[row]);
        if (!isnan(level[row]))
            synchronise(state, level[row], theta);
        expected[row] = state[VALID] > 0.0 ? reading(state[Y_SENSED], theta) : NAN;
    }
}
