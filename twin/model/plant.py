"""The physics of ejector, line and vessel: one right-hand side for everything that simulates.

Three nodes store gas, each with mass and energy balance and wall heat: the port, where the ejector
draws and blows, the line half-way, and the vessel with what hangs on it. The gas between them has
friction and inertia. A node may be far smaller than the next, or a line far too short, for explicit
steps; so a step is implicit, and what is not linear in it is solved as quadratics.

Functions work on one hypothesis and have no branches; ``k`` holds prepared coefficients row by row
and hypothesis by hypothesis, ``i`` picks one. Pressures are absolute, units SI.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.model import theta as c
from twin.model.compiled import compiled, inlined
from twin.model.gas import CP, CRITICAL_RATIO, GAMMA, R, opening
from twin.model.mechanism import ALSO_ON, ON, SLOTS, WIDTH
from twin.model.theta import Theta

# What a step needs and a call computes only once, in rows behind the coefficients.
(
    _SUCTION,
    _END,
    _BLOW_OFF,
    _FLATTER,
    _HEAT,
    _PORT_HEAT,
    _LINE_HEAT,
    _PLACE,
    _STRETCH,
    _SOFT,
    _CLOSED,
    _OPENS,
    _THINNER,
) = range(len(c.COEFFICIENTS), len(c.COEFFICIENTS) + 13)
Floats = npt.NDArray[np.float64]
Prepared = npt.NDArray[np.float64]  # PREPARED rows: coefficients, and what follows from them

UNMOVED = len(c.COEFFICIENTS) + 13  # what each mechanism changes, as it is without it: two a slot
PREPARED = UNMOVED + 2 * SLOTS

# A runaway hypothesis stays a number; a node that is flushed many times in a step keeps its gas.
LIGHTEST = 1e-15  # kg
LOWEST, HIGHEST = 1.0, 1e7  # Pa
COLDEST, HOTTEST = 60.0, 2000.0  # K
_PER_COLDEST, _PER_HOTTEST = 1.0 / (R * COLDEST), 1.0 / (R * HOTTEST)  # kg/J
MOST = 100.0  # kg/s
NOTHING_UNTIL = 0.25  # of the opening at which a jet is full: as a nozzle draws over its pressure
FAINTEST = 1e-12  # of a jet that fades; less is none, and slow to calculate with

TINY = 1e-9  # Pa, beside what may be nothing

FREE_AT = 10.0  # K between gas and wall at ambient pressure, where the film coefficient holds

# Alexander's SDIRK of third order: L-stable, each stage implicit in itself by the same G, the last
# stage is the step's result (R. Alexander, SIAM J. Numer. Anal. 14, 1977). In multiples of G.
# The stages stand at G, half-way from there to 1, and 1; _FURTHER leads from the first to the next.
G = 0.435866521508459
_A21 = (1.0 - G) / 2.0 / G
_FURTHER = (1.0 + G) / 2.0 / G
_B1 = -(6.0 * G * G - 16.0 * G + 1.0) / 4.0 / G
_B2 = (6.0 * G * G - 20.0 * G + 5.0) / 4.0 / G
# A port is so small that nearly all of what its stages are off by is gone at the end of the step.
PORT_COUNTS = 0.1
# What a pass leaves unsolved is the less of what it moved (Pa) the shorter the stage (s) is.
CLOSE = 5e-5  # Pa s


class Gas(NamedTuple):
    """What the three nodes store, and the flows between them."""

    port: float  # Pa
    port_mass: float  # kg
    line: float  # Pa
    line_mass: float  # kg
    vessel: float  # Pa
    vessel_mass: float  # kg
    near: float  # kg/s, line to port
    far: float  # kg/s, vessel to line
    yielded: float  # m³, by which the vessel has shrunk of what comes later


class Lags(NamedTuple):
    """What follows the valves, the supply and the pressure a little later."""

    drive: float  # 0 to 1, first stage of the jet
    jet: float  # 0 to 1
    valve: float  # 0 to 1, of the blow-off
    drained: float  # 0 to 1, of the reservoir that it comes from
    supply: float  # Pa gauge, at the nozzle
    felt: float  # Pa, first stage of the sensor
    sensed: float  # Pa, at the sensor


class Driven(NamedTuple):
    """What acts on the gas during a stage."""

    jet: float  # 0 to 1
    suction: float  # kg/s at ambient pressure in the port
    end: float  # Pa, end pressure
    blow_off: float  # kg/s
    open: float  # 1 while the cup stands open


class Valves(NamedTuple):
    """Positions of the valves and of the cup during a step."""

    nozzle: float  # 0 to 1
    blow_off: float  # 0 to 1
    open_cup: float  # 1 while the cup stands open


ORDER = len(Gas._fields) + len(Lags._fields)


@compiled
def prepare_one(k: Prepared, i: int) -> None:
    """Write what follows from the coefficients of hypothesis ``i`` below them.

    And what a coefficient is without the mechanism that changes it.
    """
    for slot in range(SLOTS):
        first, unmoved = c.MECHANISMS + slot * WIDTH, UNMOVED + 2 * slot
        k[unmoved, i] = k[int(k[first + ON, i]), i]
        k[unmoved + 1, i] = k[int(k[first + ALSO_ON, i]), i]
    derive(k, i)


@compiled
def derive(k: Prepared, i: int) -> None:
    """Write what follows from the coefficients of hypothesis ``i`` as they are now."""
    ambient, nominal = k[c.AMBIENT, i], k[c.AMBIENT_NOMINAL, i]
    off = k[c.SUPPLY_NOMINAL, i] / k[c.SUPPLY_OPTIMUM, i] - 1.0
    peak = max(1.0 - k[c.SUPPLY_CURVATURE, i] * off * off, 1e-3)
    k[_SUCTION, i] = k[c.SUCTION, i] * (ambient / nominal) / peak
    k[_END, i] = k[c.END_RATIO, i] * ambient
    k[_THINNER, i] = nominal / ambient
    k[_BLOW_OFF, i] = k[c.BLOW_OFF, i] / (k[c.SUPPLY_NOMINAL, i] + nominal)
    k[_FLATTER, i] = 1.0 / k[c.SUPPLY_OPTIMUM, i]
    k[_HEAT, i] = k[c.FILM, i] * k[c.AREA, i] / CP
    k[_PORT_HEAT, i] = k[c.PORT_HEAT, i] / CP
    k[_LINE_HEAT, i] = k[c.LINE_HEAT, i] / CP
    most = ambient / (1.0 + k[c.STIFF_UNTIL, i] / ambient)  # that pulls at the cups
    k[_STRETCH, i] = k[c.COMPLIANCE, i] * (1.0 + k[c.SOFTNESS, i]) / most
    k[_SOFT, i] = k[c.SOFTNESS, i] / most
    at = k[c.KINK_AT, i]
    k[_CLOSED, i] = math.sqrt(at * at + c.KINK_WIDTH * c.KINK_WIDTH) - at
    open_by = math.sqrt((1.0 - at) * (1.0 - at) + c.KINK_WIDTH * c.KINK_WIDTH) + 1.0 - at
    k[_OPENS, i] = k[c.KINK, i] / (open_by - k[_CLOSED, i])
    friction = k[c.NEAR_RESISTANCE, i] + k[c.RESISTANCE, i]
    k[_PLACE, i] = min(k[c.PLACE, i] / friction, 1.0) if friction > 0.0 else 0.0


@compiled
def put(to: Floats, i: int, source: Floats, j: int) -> None:
    """Copy column ``j`` of ``source`` into column ``i``: the rows that both have.

    In a loop: for slices, numba compiles seconds' worth of what to say where they do not fit.
    """
    for row in range(min(to.shape[0], source.shape[0])):
        to[row, i] = source[row, j]


@compiled
def prepare(theta: Theta) -> Prepared:
    """Coefficients, one column per hypothesis, with what follows from them alone below."""
    k = np.empty((PREPARED, theta.shape[1]))
    for i in range(theta.shape[1]):
        put(k, i, theta, i)
        prepare_one(k, i)
    return k


@inlined
def at_supply(supply: float, k: Prepared, i: int) -> tuple[float, float, float]:
    """Suction at ambient (kg/s), end pressure (Pa) and blow-off (kg/s) at a supply (Pa gauge).

    Suction capacity peaks at the optimum supply; end pressure rises as supply falls. Over ambient
    pressure both depend on the supply over ambient pressure alone: what drives a jet are ratios of
    pressures (dimensional analysis, at high Reynolds numbers). Blow-off is sonic, hence
    proportional to absolute supply pressure.
    """
    ambient = k[c.AMBIENT, i]
    relative = supply * k[_THINNER, i]  # that drives the jet alike at nominal ambient pressure
    off = relative * k[_FLATTER, i] - 1.0
    suction = k[_SUCTION, i] * max(1.0 - k[c.SUPPLY_CURVATURE, i] * off * off, 0.0)
    missing = k[c.SUPPLY_NOMINAL, i] - relative
    end = k[_END, i] * (1.0 + k[c.END_SLOPE, i] * missing)
    blow_off = k[_BLOW_OFF, i] * (supply + ambient)
    return suction, min(max(end, 0.0), 0.98 * ambient), blow_off


@inlined
def characteristic(x: float, k: Prepared, i: int) -> tuple[float, float]:
    """Suction flow as a share of its value at ambient, and its slope, over ``x``.

    ``x`` runs from 0 at end pressure to 1 at ambient. Straight (the founding paper's shape) where
    all bends are zero. A second stage opens where the first is moved enough by itself, a KINK.
    Below end pressure the check valve closes: no flow back. Above ambient it goes on straight:
    bends are fitted below it, and say nothing of a vessel that blow-off has filled.
    """
    b0, b1, b2, b3 = k[c.BULGE, i], k[c.SKEW, i], k[c.BEND_2, i], k[c.BEND_3, i]
    above = max(x - 1.0, 0.0)
    x = min(max(x, 0.0), 1.0)
    bend = b0 + x * (b1 + x * (b2 + x * b3))
    slope = b1 + x * (2.0 * b2 + x * 3.0 * b3)
    beyond, first = x - k[c.KINK_AT, i], 1.0 - k[c.KINK, i]
    root = math.sqrt(beyond * beyond + c.KINK_WIDTH * c.KINK_WIDTH)
    share = first * x * (1.0 + (1.0 - x) * bend) + k[_OPENS, i] * (root + beyond - k[_CLOSED, i])
    rise = first * (1.0 + (1.0 - 2.0 * x) * bend + x * (1.0 - x) * slope)
    rise += k[_OPENS, i] * (beyond / root + 1.0)
    rise = max(rise, 0.0) if x > 0.0 else 0.0
    return max(share, 0.0) + above * rise, rise


def suction_at(theta: Theta, p: float) -> float:
    """Suction flow (kg/s) at port pressure ``p`` (Pa), nominal supply and full jet."""
    return float(_suction_at(prepare(theta.reshape(-1, 1)), p))


@compiled
def _suction_at(k: Prepared, p: float) -> float:
    suction, end, _ = at_supply(k[c.SUPPLY_NOMINAL, 0], k, 0)
    share, _ = characteristic((p - end) / (k[c.AMBIENT, 0] - end), k, 0)
    return suction * share


@inlined
def at_port(p: float, driven: Driven, k: Prepared, i: int) -> tuple[float, float, float, float]:
    """Flows out of and into the port (kg/s) at ``p``, as tangents: two each, level and slope.

    Out: the ejector's suction, and the exhaust where the port is far enough above ambient for the
    check valve to open; that pressure is lost to the flow. A jet that is still building up draws
    neither as much nor as deep. In: blow-off, and back-flow through a leaking check valve while the
    nozzle is off.
    """
    ambient = k[c.AMBIENT, i]
    per_pa = 1.0 / (ambient - driven.end)
    depth = driven.jet + (1.0 - k[c.JET_DEPTH, i]) * (1.0 - driven.jet)
    share, rise = characteristic(depth - (ambient - p) * per_pa, k, i)
    out_slope = driven.jet * driven.suction * per_pa * rise
    out = driven.jet * driven.suction * share - out_slope * p
    opens, relieves = ambient + k[c.CRACKING_PRESSURE, i], ambient + k[c.RELIEF_PRESSURE, i]
    relief = k[c.RELIEF, i]
    relief = relief if p > relieves else 0.0
    forward = p if p < ambient else p - k[c.CRACKING_PRESSURE, i]
    share, rise = opening(forward, ambient, CRITICAL_RATIO)
    back = k[c.BACK_FLOW, i] * (1.0 - min(driven.jet, 1.0))
    back = back if p < ambient else 0.0
    vent = k[c.EXHAUST, i]
    vent = vent if p > opens else 0.0
    fuller = driven.blow_off * k[c.BLOW_OFF_SHAPE, i]
    return (
        out - relief * relieves - vent * (share - rise * p),
        out_slope + relief - vent * rise,
        driven.blow_off + fuller + back * (share - rise * p),
        back * rise - fuller / ambient,
    )


@inlined
def at_vessel(p: float, driven: Driven, k: Prepared, i: int) -> tuple[float, float]:
    """Flow from ambient into the vessel (kg/s) at ``p``, as a tangent: level and slope.

    An opening, a porous part, the rim of a cup without a part, and what else flows in.
    """
    ambient = k[c.AMBIENT, i]
    laminar = k[c.LAMINAR_LEAK, i] + driven.open * k[c.OPENING, i]
    sonic = k[c.LEAK, i] + driven.open * k[c.HOLE, i]
    share, rise = opening(p, ambient, k[c.LEAK_CRITICAL, i])
    slope = sonic * rise - laminar
    level = sonic * (share - rise * p) + laminar * ambient
    return level + k[c.INFLOW, i], slope


@inlined
def through(
    rest: float,
    fall: float,
    before: float,
    rise: float,
    quadratic: float,
    linear: float,
    pushed: float,
) -> float:
    """Flow w (kg/s) through a line between two pressures that are linear in it.

    From ``rest − fall w`` to ``before + rise w``, against friction and inertia; isothermal pipe
    flow, p₁² − p₂² = K w |w| + L w − pushed, where inertia adds (p₁ + p₂) I / step to L and, times
    the flow before, is what ``pushed``. Gas that is warm is thin: K and L grow with temperature.
    """
    difference = rest * rest - before * before + pushed
    friction = quadratic if difference >= 0.0 else -quadratic
    square = fall * fall - rise * rise - friction
    slope = 2.0 * (rest * fall + before * rise) + linear
    root = math.sqrt(max(slope * slope - 4.0 * square * difference, 0.0))
    return 2.0 * difference / (slope + root)


@inlined
def kept(mass: float, work: float) -> float:
    """Mass (kg) within what pressure times volume (J) allows for."""
    return min(max(mass, work * _PER_HOTTEST), work * _PER_COLDEST)


@inlined
def per_joule(mass: float) -> float:
    """How warm (K) gas of a mass is for each joule of pressure times volume."""
    return 1.0 / (R * mass)


@inlined
def shrinkage(vessel: float, k: Prepared, i: int) -> tuple[float, float]:
    """By how much a vessel shrinks in the end at its vacuum (m³), and how much less so per Pa."""
    vacuum = k[c.AMBIENT, i] - vessel
    held = k[c.STIFF_UNTIL, i] / (abs(vacuum) + k[c.STIFF_UNTIL, i] + TINY)
    pull = vacuum * (1.0 - held)
    left = 1.0 / (1.0 + k[_SOFT, i] * abs(pull))
    stretch = k[_STRETCH, i] * left
    return stretch * pull, stretch * left * (1.0 - held * held)


@inlined
def room(vessel: float, yielded: float, k: Prepared, i: int) -> float:
    """Volume (m³) of a vessel that shrinks with vacuum, a share of it at once, the rest later."""
    shrunk, _ = shrinkage(vessel, k, i)
    return k[c.VOLUME, i] - (1.0 - k[c.CREEP, i]) * shrunk - yielded


@inlined
def walls(
    vessel: float, before: float, step: float, k: Prepared, i: int
) -> tuple[float, float, float, float, float]:
    """A vessel after ``step`` in which what comes later goes on from what had yielded ``before``.

    Its volume, what has yielded by then (m³), γ p dV/dp (m³) at once and of what comes later, and
    γ p times by how much that yields (J).
    """
    shrunk, stretch = shrinkage(vessel, k, i)
    creep, follows = k[c.CREEP, i], step / (k[c.CREEP_TIME, i] + step)
    yields = follows * (creep * shrunk - before)
    yielded, rise = before + yields, GAMMA * vessel * stretch
    volume = k[c.VOLUME, i] - (1.0 - creep) * shrunk - yielded
    at_once, later = rise * (1.0 - creep), rise * creep * follows
    return volume, yielded, at_once, later, GAMMA * vessel * yields


@inlined
def temperatures(
    y: Gas,
    volume: float,
    known: Gas,
    step: float,
    entering: float,
    drawn: float,
    k: Prepared,
    i: int,
) -> tuple[float, float, float]:
    """Gas temperatures (K) of port, line and vessel of a ``volume`` (m³), at which it leaves them.

    Port's and line's follow from their balances, the port's with what is ``entering`` and ``drawn``
    (kg/s): a small node is flushed many times in a step, and p V / (m R) would swing from pass to
    pass.
    """
    outside, per_pa = k[c.TEMPERATURE, i], 1.0 / (GAMMA * R * step)
    vessel_t = y.vessel * volume * per_joule(y.vessel_mass)
    line_t = y.line * k[c.LINE_VOLUME, i] * per_joule(y.line_mass)
    held = k[c.PORT_VOLUME, i] * per_pa * known.port + (entering + k[_PORT_HEAT, i]) * outside
    leaving = y.port_mass * R * per_pa + drawn + k[_PORT_HEAT, i]
    port_t = (held + max(y.near, 0.0) * line_t) / (leaving + max(-y.near, 0.0))
    held = k[c.LINE_VOLUME, i] * per_pa * known.line + k[_LINE_HEAT, i] * outside
    held += max(y.far, 0.0) * vessel_t + max(-y.near, 0.0) * port_t
    leaving = y.line_mass * R * per_pa + k[_LINE_HEAT, i]
    return port_t, held / (leaving + max(y.near, 0.0) + max(-y.far, 0.0)), vessel_t


@inlined
def convection(y: Gas, warmer: float, k: Prepared, i: int) -> float:
    """Film coefficient in the vessel, over that of the data set; its gas is ``warmer`` (K).

    Free convection along a wall is laminar in vessels of some litres: Nu in proportion to Ra^¼, so
    to (p² ΔT)^¼. A jet that enters stirs: Nu in proportion to about the root of its flow.
    """
    free = math.sqrt(y.vessel / k[c.AMBIENT, i] * math.sqrt(abs(warmer) * (1.0 / FREE_AT)))
    forced = math.sqrt(k[c.FORCED_CONVECTION, i] * max(-y.far, 0.0))
    return 1.0 + k[c.FREE_CONVECTION, i] * (free - 1.0) + forced


@inlined
def solve(y: Gas, known: Gas, step: float, driven: Driven, k: Prepared, i: int) -> Gas:
    """One pass over the balances of all nodes: ``y`` is the guess, ``known`` what came before.

    Mass and energy of an ideal gas: V dp/dt = γ R Σ w T + (γ − 1) Q, and with a volume that shrinks
    with vacuum (V + γ p dV/dp) in place of V. So each pressure is linear in the flows;
    the near flow is made a tangent over the line's pressure, the far one is solved for.
    """
    ambient, outside = k[c.AMBIENT, i], k[c.TEMPERATURE, i]
    per_s, per_pa, per_k = 1.0 / step, 1.0 / (GAMMA * R * step), 1.0 / outside
    out, out_slope, blown, blown_slope = at_port(y.port, driven, k, i)
    leak, leak_slope = at_vessel(y.vessel, driven, k, i)
    volume, yielded, at_once, later, yields = walls(y.vessel, known.yielded, step, k, i)
    port_stored, line_stored = k[c.PORT_VOLUME, i] * per_pa, k[c.LINE_VOLUME, i] * per_pa
    vessel_stored, creeping = (volume + at_once) * per_pa, later * per_pa
    port_warmth, line_warmth = k[_PORT_HEAT, i], k[_LINE_HEAT, i]

    entering, drawn = blown + blown_slope * y.port, max(out + out_slope * y.port, 0.0)
    port_t, line_t, vessel_t = temperatures(y, volume, known, step, entering, drawn, k, i)
    warmth = k[_HEAT, i] * convection(y, vessel_t - outside, k, i)
    near_t = line_t if y.near >= 0.0 else port_t
    far_t = vessel_t if y.far >= 0.0 else line_t
    leak_t = outside if y.vessel <= ambient else vessel_t

    # Pressures as rest and slope over the flows.
    cooling = port_warmth * k[c.PORT_VOLUME, i] * per_joule(y.port_mass)
    weight = 1.0 / (port_stored + out_slope * port_t - blown_slope * outside + cooling)
    gained = port_stored * known.port + (blown + port_warmth) * outside - out * port_t
    port_rest, port_rise = gained * weight, near_t * weight
    cooling = line_warmth * k[c.LINE_VOLUME, i] * per_joule(y.line_mass)
    weight = 1.0 / (line_stored + cooling)
    line_rest = (line_stored * known.line + line_warmth * outside) * weight
    line_fall, line_rise = near_t * weight, far_t * weight
    cooling = warmth * volume * per_joule(y.vessel_mass)
    weight = 1.0 / (vessel_stored - leak_slope * leak_t + cooling + creeping)
    gained = vessel_stored * known.vessel + leak * leak_t + warmth * outside
    gained += creeping * y.vessel + yields * per_pa
    vessel_rest, vessel_fall = gained * weight, far_t * weight

    inertia = k[c.NEAR_INERTANCE, i] * (y.line + y.port) * per_s
    warm = near_t * per_k
    quadratic, linear = warm * k[c.NEAR_RESISTANCE, i], warm * k[c.NEAR_LAMINAR, i] + inertia
    pushed = inertia * known.near
    near = through(y.line, 0.0, port_rest, port_rise, quadratic, linear, pushed)
    slope = 2.0 * (port_rise * (port_rest + port_rise * near) + quadratic * abs(near)) + linear
    near_slope = 2.0 * y.line / slope
    near -= near_slope * y.line
    weight = slope / (slope + 2.0 * y.line * line_fall)
    line_rest, line_rise = (line_rest - line_fall * near) * weight, line_rise * weight

    inertia = k[c.INERTANCE, i] * (y.vessel + y.line) * per_s
    warm = far_t * per_k
    quadratic, linear = warm * k[c.RESISTANCE, i], warm * k[c.LAMINAR, i] + inertia
    pushed = inertia * known.far
    far = through(vessel_rest, vessel_fall, line_rest, line_rise, quadratic, linear, pushed)

    line = min(max(line_rest + line_rise * far, LOWEST), HIGHEST)
    vessel = min(max(vessel_rest - vessel_fall * far, LOWEST), HIGHEST)
    near += near_slope * line
    port = min(max(port_rest + port_rise * near, LOWEST), HIGHEST)
    net = near - (out + out_slope * port) + blown + blown_slope * port
    return Gas(
        port,
        kept(known.port_mass + step * net, port * k[c.PORT_VOLUME, i]),
        line,
        kept(known.line_mass + step * (far - near), line * k[c.LINE_VOLUME, i]),
        vessel,
        kept(known.vessel_mass + step * (leak + leak_slope * vessel - far), vessel * volume),
        min(max(near, -MOST), MOST),
        min(max(far, -MOST), MOST),
        yielded,
    )


@inlined
def lag(known: float, target: float, step: float, slow: float) -> float:
    """Implicit stage of a first-order lag with the time constant ``slow`` (s)."""
    return known + step / (slow + step) * (target - known)


@inlined
def drain(drained: float, valve: float, step: float, k: Prepared, i: int) -> float:
    """Implicit stage of the reservoir that a blow-off comes from: sonic out, and filled again."""
    rate = step * k[c.BLOW_OFF_DRAIN, i]
    return (drained + rate * valve) / (1.0 + rate * (valve + k[c.BLOW_OFF_REFILL, i]))


@inlined
def drawing(opening: float, k: Prepared, i: int) -> float:
    """Strength of the jet, 0 to 1, that a valve which opens slowly lets through at its opening.

    Valves are wider than the nozzle behind them, and a nozzle at half its pressure draws nearly as
    much as at all of it, but at a tenth nothing: so the jet is at full strength long before a slow
    valve is open. A valve that opens as fast as it should leaves no time to see that.
    """
    slow = k[c.SLOW_RAMP_UP, i] / (k[c.SLOW_RAMP_UP, i] + k[c.RAMP_UP, i])
    full = 1.0 - slow * (1.0 - k[c.JET_FULL_AT, i])
    from_there = NOTHING_UNTIL * full * (1.0 - full)
    share = min(max((opening - from_there) / (full - from_there), 0.0), 1.0)
    return share * (full + (1.0 - full) * share * (3.0 - 2.0 * share))


@inlined
def at_sensor(port: float, vessel: float, k: Prepared, i: int) -> float:
    """Pressure (Pa) where the sensor sits, between port and vessel."""
    return port + k[_PLACE, i] * (vessel - port)


@inlined
def stage(
    guess: Gas,
    known: Gas,
    lags: Lags,
    step: float,
    valves: Valves,
    passes: int,
    k: Prepared,
    i: int,
) -> tuple[Gas, Lags]:
    """Solve one implicit stage of ``step`` seconds from ``known`` gas and ``lags``.

    A pass brings the guess nearer by about one order in the step. So for a scheme of third order
    one that is no more than where the step began takes three ``passes``, others two; or one, and
    another only where that moved a pressure by more than is ``CLOSE``.
    The jet builds up in two stages: the valve opens, then the jet gathers strength.
    """
    nozzle, blow = valves.nozzle, valves.blow_off
    rise, fall = k[c.RAMP_UP, i], k[c.RAMP_DOWN, i]
    first = rise + k[c.SLOW_RAMP_UP, i]
    rising = nozzle > lags.drive
    drive = lag(lags.drive, nozzle, step, first if rising else fall)
    jet = lag(lags.jet, drawing(drive, k, i) if rising else drive, step, rise if rising else fall)
    valve = lag(lags.valve, blow, step, k[c.BLOW_OFF_RAMP, i])
    drained = drain(lags.drained, valve, step, k, i)
    regulated = max(k[c.SUPPLY, i] - k[c.DROOP, i] * max(nozzle, blow), 0.0)
    supply = lag(lags.supply, regulated, step, k[c.SUPPLY_LAG, i])
    suction, end, blow_off = at_supply(supply, k, i)
    driven = Driven(jet, suction, end, blow_off * valve * (1.0 - drained), valves.open_cup)
    gas = solve(guess, known, step, driven, k, i)
    moved = max(abs(gas.port - guess.port), abs(gas.vessel - guess.vessel))
    if passes > 1 or moved * step > CLOSE:
        gas = solve(gas, known, step, driven, k, i)
    if passes > 2:
        gas = solve(gas, known, step, driven, k, i)
    slow = k[c.SENSOR_LAG, i]
    felt = lag(lags.felt, at_sensor(gas.port, gas.vessel, k, i), step, slow)
    sensed = lag(lags.sensed, felt, step, slow + k[c.SLOW_SENSOR, i])
    return gas, Lags(drive, jet, valve, drained, supply, felt, sensed)


@inlined
def gas_on(start: Gas, begin: Gas, end: Gas, share: float) -> Gas:
    """Go on from ``start`` by a ``share`` of the way from ``begin`` to ``end``."""
    return Gas(
        start.port + share * (end.port - begin.port),
        start.port_mass + share * (end.port_mass - begin.port_mass),
        start.line + share * (end.line - begin.line),
        start.line_mass + share * (end.line_mass - begin.line_mass),
        start.vessel + share * (end.vessel - begin.vessel),
        start.vessel_mass + share * (end.vessel_mass - begin.vessel_mass),
        start.near + share * (end.near - begin.near),
        start.far + share * (end.far - begin.far),
        start.yielded + share * (end.yielded - begin.yielded),
    )


@inlined
def lags_on(start: Lags, begin: Lags, end: Lags, share: float) -> Lags:
    """As ``gas_on``."""
    return Lags(
        start.drive + share * (end.drive - begin.drive),
        start.jet + share * (end.jet - begin.jet),
        start.valve + share * (end.valve - begin.valve),
        start.drained + share * (end.drained - begin.drained),
        start.supply + share * (end.supply - begin.supply),
        start.felt + share * (end.felt - begin.felt),
        start.sensed + share * (end.sensed - begin.sensed),
    )


@inlined
def positive(gas: Gas) -> Gas:
    """Gas that went on too far, brought back to where there is a pressure and a mass."""
    return Gas(
        max(gas.port, LOWEST),
        max(gas.port_mass, LIGHTEST),
        max(gas.line, LOWEST),
        max(gas.line_mass, LIGHTEST),
        max(gas.vessel, LOWEST),
        max(gas.vessel_mass, LIGHTEST),
        gas.near,
        gas.far,
        gas.yielded,
    )


@inlined
def advance(
    gas: Gas, lags: Lags, guess: Gas, passes: int, h: float, valves: Valves, k: Prepared, i: int
) -> tuple[Gas, Lags, float]:
    """Gas and lags after ``h`` seconds, and how far (Pa) a scheme of second order is from them.

    The stages stand at equal distances, so that is the second difference of what each adds.
    ``guess`` is of the gas at the first stage, which takes ``passes``; the others two at most.
    """
    step = G * h
    gas_1, lags_1 = stage(positive(guess), gas, lags, step, valves, passes, k, i)
    known, held = gas_on(gas, gas, gas_1, _A21), lags_on(lags, lags, lags_1, _A21)
    guess = positive(gas_on(gas, gas, gas_1, _FURTHER))
    gas_2, lags_2 = stage(guess, known, held, step, valves, min(passes, 2), k, i)
    last = gas_on(gas_on(gas, gas, gas_1, _B1), known, gas_2, _B2)
    late = lags_on(lags_on(lags, lags, lags_1, _B1), held, lags_2, _B2)
    guess = positive(gas_on(gas_1, gas_1, gas_2, 2.0))
    gas_3, lags_3 = stage(guess, last, late, step, valves, min(passes, 2), k, i)
    port = bent(gas_1.port - gas.port, gas_2.port - known.port, gas_3.port - last.port)
    off = (
        bent(gas_1.vessel - gas.vessel, gas_2.vessel - known.vessel, gas_3.vessel - last.vessel),
        bent(lags_1.felt - lags.felt, lags_2.felt - held.felt, lags_3.felt - late.felt),
        bent(lags_1.sensed - lags.sensed, lags_2.sensed - held.sensed, lags_3.sensed - late.sensed),
    )
    return gas_3, ended(lags_3), max(PORT_COUNTS * port, off[0], off[1], off[2])


@inlined
def ended(lags: Lags) -> Lags:
    """What has faded away, or a little beyond by the scheme's doing, is gone."""
    return Lags(
        lags.drive if lags.drive > FAINTEST else 0.0,
        lags.jet if lags.jet > FAINTEST else 0.0,
        lags.valve if lags.valve > FAINTEST else 0.0,
        lags.drained if lags.drained > FAINTEST else 0.0,
        lags.supply,
        lags.felt,
        lags.sensed,
    )


@inlined
def bent(first: float, second: float, third: float) -> float:
    """Size of the second difference."""
    return abs(first - 2.0 * second + third)


@inlined
def reading(sensed: float, theta: Theta, i: int) -> float:
    """Absolute pressure the PLC reads (Pa); span and offset errors act on what is sensed."""
    vacuum = theta[c.AMBIENT, i] - sensed
    return sensed - (theta[c.SENSOR_GAIN, i] - 1.0) * vacuum + theta[c.SENSOR_OFFSET, i]


@inlined
def sensed_at(value: float, theta: Theta, i: int) -> float:
    """Pressure (Pa) at the sensor when it reads ``value``: the inverse of ``reading``."""
    gain = theta[c.SENSOR_GAIN, i]
    return (value - theta[c.SENSOR_OFFSET, i] + (gain - 1.0) * theta[c.AMBIENT, i]) / gain


def reading_of(sensed: float, theta: Theta) -> float:
    """``reading`` for one hypothesis from Python, where nothing has to be compiled for it."""
    return reading.py_func(sensed, theta.reshape(-1, 1), 0)


def sensed_of(value: float, theta: Theta) -> float:
    """As ``reading_of``."""
    return sensed_at.py_func(value, theta.reshape(-1, 1), 0)
