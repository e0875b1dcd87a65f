"""The physics of ejector, line and vessel: one right-hand side for everything that simulates.

Three nodes store gas, each with a mass balance, an energy balance and heat from its wall. They are
the port, where the ejector draws and blows, the middle of the line, and the vessel. The gas between
them has friction and inertia. Small nodes and short lines make the equations stiff, so the steps
are implicit; the nonlinear flow between two nodes is the root of a quadratic.

Functions work on one hypothesis. They have no branches, so that a loop over hypotheses is
vectorised. ``k`` holds the prepared coefficients, a row for each and a column for each hypothesis;
``i`` is the column. Pressures are absolute, units SI.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.model import theta as c
from twin.model.air import CP, CRITICAL_RATIO, GAMMA, R
from twin.model.compiled import compiled, inlined
from twin.model.gas import opening
from twin.model.mechanism import ALSO_ON, ON, SLOTS, WIDTH
from twin.model.theta import Theta

# Rows of derived values behind the coefficients; they are computed once a call.
(
    _SUCTION,
    _END,
    _BLOW_OFF,
    _PER_OPTIMUM,
    _HEAT,
    _PORT_HEAT,
    _LINE_HEAT,
    _SENSOR_PLACE,
    _STRETCH,
    _SOFTNESS_PER_PA,
    _KINK_CLOSED,
    _KINK_SLOPE,
    _AMBIENT_RATIO,
) = range(len(c.COEFFICIENTS), len(c.COEFFICIENTS) + 13)
UNMOVED = len(c.COEFFICIENTS) + 13  # coefficients without their mechanisms' changes, two per slot
PREPARED = UNMOVED + 2 * SLOTS

Floats = npt.NDArray[np.float64]
Prepared = npt.NDArray[np.float64]  # (PREPARED, hypotheses)

# Limits that keep a divergent hypothesis finite, and gas in a node that is flushed within a step.
LIGHTEST = 1e-15  # kg
LOWEST, HIGHEST = 1.0, 1e7  # Pa
COLDEST, HOTTEST = 60.0, 2000.0  # K
_PER_COLDEST, _PER_HOTTEST = 1.0 / (R * COLDEST), 1.0 / (R * HOTTEST)  # kg/J
MOST_FLOW = 100.0  # kg/s
NO_JET_BELOW = 0.25  # share of the opening of a full jet, below which there is no jet
FAINTEST_JET = 1e-12  # a weaker jet counts as none: denormal numbers are slow

TINY = 1e-9  # Pa, added to divisors that may be zero

FREE_CONVECTION_AT = 10.0  # K between gas and wall, where the film coefficient holds at ambient

# Alexander's SDIRK method of third order (R. Alexander, SIAM J. Numer. Anal. 14, 1977). It is
# L-stable, every stage has the same diagonal coefficient G, and the last stage is the result. The
# coefficients are in multiples of G. The stages stand at G, half-way from G to 1, and at 1;
# _NEXT_STAGE extrapolates from the first stage to the second.
G = 0.435866521508459
_A21 = (1.0 - G) / 2.0 / G
_NEXT_STAGE = (1.0 + G) / 2.0 / G
_B1 = -(6.0 * G * G - 16.0 * G + 1.0) / 4.0 / G
_B2 = (6.0 * G * G - 20.0 * G + 5.0) / 4.0 / G
# The port is so small that nearly all of its error has decayed by the end of the step.
PORT_WEIGHT = 0.1
# The iteration error left after a pass scales with pressure change (Pa) × stage length (s).
CONVERGED = 5e-5  # Pa s


class Gas(NamedTuple):
    """State of the three nodes, and the flows between them."""

    port: float  # Pa
    port_mass: float  # kg
    line: float  # Pa
    line_mass: float  # kg
    vessel: float  # Pa
    vessel_mass: float  # kg
    near: float  # kg/s, line to port
    far: float  # kg/s, vessel to line
    yielded: float  # m³, shrinkage of the vessel by creep


class Lags(NamedTuple):
    """First-order lags behind valves, supply and pressure."""

    drive: float  # 0 to 1, first stage of the jet
    jet: float  # 0 to 1
    valve: float  # 0 to 1, of the blow-off
    drained: float  # 0 to 1, drained share of the blow-off reservoir
    supply: float  # Pa gauge, at the nozzle
    sensor_stage: float  # Pa, first stage of the sensor
    sensed: float  # Pa, at the sensor


class Driven(NamedTuple):
    """Boundary conditions of the gas during a stage."""

    jet: float  # 0 to 1
    suction: float  # kg/s at ambient pressure in the port
    end: float  # Pa, end pressure
    blow_off: float  # kg/s
    open: float  # 1 while the cup is open


class Valves(NamedTuple):
    """Positions of the valves and of the cup during a step."""

    nozzle: float  # 0 to 1
    blow_off: float  # 0 to 1
    open_cup: float  # 1 while the cup is open


ORDER = len(Gas._fields) + len(Lags._fields)


@compiled
def prepare_one(k: Prepared, i: int) -> None:
    """Write the derived values of hypothesis ``i`` into the rows below its coefficients.

    Also store the coefficients without the mechanisms that change them.
    """
    for slot in range(SLOTS):
        first, unmoved = c.MECHANISMS + slot * WIDTH, UNMOVED + 2 * slot
        k[unmoved, i] = k[int(k[first + ON, i]), i]
        k[unmoved + 1, i] = k[int(k[first + ALSO_ON, i]), i]
    derive(k, i)


@compiled
def derive(k: Prepared, i: int) -> None:
    """Write the values derived from the present coefficients of hypothesis ``i``."""
    ambient, nominal = k[c.AMBIENT, i], k[c.AMBIENT_NOMINAL, i]
    deviation = k[c.SUPPLY_NOMINAL, i] / k[c.SUPPLY_OPTIMUM, i] - 1.0
    peak = max(1.0 - k[c.SUPPLY_CURVATURE, i] * deviation * deviation, 1e-3)
    k[_SUCTION, i] = k[c.SUCTION, i] * (ambient / nominal) / peak
    k[_END, i] = k[c.END_RATIO, i] * ambient
    k[_AMBIENT_RATIO, i] = nominal / ambient
    k[_BLOW_OFF, i] = k[c.BLOW_OFF, i] / (k[c.SUPPLY_NOMINAL, i] + nominal)
    k[_PER_OPTIMUM, i] = 1.0 / k[c.SUPPLY_OPTIMUM, i]
    k[_HEAT, i] = k[c.FILM, i] * k[c.AREA, i] / CP
    k[_PORT_HEAT, i] = k[c.PORT_HEAT, i] / CP
    k[_LINE_HEAT, i] = k[c.LINE_HEAT, i] / CP
    full_pull = ambient / (1.0 + k[c.STIFF_UNTIL, i] / ambient)  # Pa, pull at the cups
    k[_STRETCH, i] = k[c.COMPLIANCE, i] * (1.0 + k[c.SOFTNESS, i]) / full_pull
    k[_SOFTNESS_PER_PA, i] = k[c.SOFTNESS, i] / full_pull
    kink_at = k[c.KINK_AT, i]
    k[_KINK_CLOSED, i] = math.sqrt(kink_at * kink_at + c.KINK_WIDTH * c.KINK_WIDTH) - kink_at
    open_by = (
        math.sqrt((1.0 - kink_at) * (1.0 - kink_at) + c.KINK_WIDTH * c.KINK_WIDTH) + 1.0 - kink_at
    )
    k[_KINK_SLOPE, i] = k[c.KINK, i] / (open_by - k[_KINK_CLOSED, i])
    friction = k[c.NEAR_RESISTANCE, i] + k[c.RESISTANCE, i]
    k[_SENSOR_PLACE, i] = min(k[c.PLACE, i] / friction, 1.0) if friction > 0.0 else 0.0


@compiled
def copy_column(to: Floats, i: int, source: Floats, j: int) -> None:
    """Copy column ``j`` of ``source`` into column ``i`` of ``to``, for the rows that both have.

    A loop, since numba takes seconds to compile the error messages of slices.
    """
    for row in range(min(to.shape[0], source.shape[0])):
        to[row, i] = source[row, j]


@compiled
def prepare(theta: Theta) -> Prepared:
    """Coefficients (a column for each hypothesis), with their derived values in the rows below."""
    k = np.empty((PREPARED, theta.shape[1]))
    for i in range(theta.shape[1]):
        copy_column(k, i, theta, i)
        prepare_one(k, i)
    return k


@inlined
def at_supply(supply: float, k: Prepared, i: int) -> tuple[float, float, float]:
    """Suction at ambient (kg/s), end pressure (Pa) and blow-off (kg/s) at a supply (Pa gauge).

    Suction capacity peaks at the optimum supply; end pressure rises as supply falls. Relative to
    ambient pressure, both depend only on the ratio of supply to ambient: pressure ratios drive a
    jet (dimensional analysis at high Reynolds numbers). Blow-off is sonic, hence proportional to
    the absolute supply pressure.
    """
    ambient = k[c.AMBIENT, i]
    relative = (
        supply * k[_AMBIENT_RATIO, i]
    )  # Pa, the equivalent supply at nominal ambient pressure
    deviation = relative * k[_PER_OPTIMUM, i] - 1.0
    suction = k[_SUCTION, i] * max(1.0 - k[c.SUPPLY_CURVATURE, i] * deviation * deviation, 0.0)
    missing = k[c.SUPPLY_NOMINAL, i] - relative
    end = k[_END, i] * (1.0 + k[c.END_SLOPE, i] * missing)
    blow_off = k[_BLOW_OFF, i] * (supply + ambient)
    return suction, min(max(end, 0.0), 0.98 * ambient), blow_off


@inlined
def characteristic(x: float, k: Prepared, i: int) -> tuple[float, float]:
    """Suction flow as a share of its value at ambient, and its slope, over ``x``.

    ``x`` runs from 0 at end pressure to 1 at ambient. With all bends zero the characteristic is a
    straight line, as in the founding paper. KINK is the share of a second stage, which closes at
    KINK_AT. Below end pressure the check valve closes, and nothing flows back. Above ambient the
    line continues straight: the bends were fitted below ambient and do not hold for a vessel that
    blow-off has filled.
    """
    b0, b1, b2, b3 = k[c.BULGE, i], k[c.SKEW, i], k[c.BEND_2, i], k[c.BEND_3, i]
    above = max(x - 1.0, 0.0)
    x = min(max(x, 0.0), 1.0)
    bend = b0 + x * (b1 + x * (b2 + x * b3))
    slope = b1 + x * (2.0 * b2 + x * 3.0 * b3)
    beyond, first = x - k[c.KINK_AT, i], 1.0 - k[c.KINK, i]
    root = math.sqrt(beyond * beyond + c.KINK_WIDTH * c.KINK_WIDTH)
    share = first * x * (1.0 + (1.0 - x) * bend) + k[_KINK_SLOPE, i] * (
        root + beyond - k[_KINK_CLOSED, i]
    )
    rise = first * (1.0 + (1.0 - 2.0 * x) * bend + x * (1.0 - x) * slope)
    rise += k[_KINK_SLOPE, i] * (beyond / root + 1.0)
    rise = max(rise, 0.0) if x > 0.0 else 0.0
    return max(share, 0.0) + above * rise, rise


def suction_at(theta: Theta, p: float) -> float:
    """Suction flow (kg/s) at port pressure ``p`` (Pa), nominal supply and full jet."""
    return float(_suction_at(prepare(theta.reshape(-1, 1)), p))


@compiled
def _suction_at(k: Prepared, p: float) -> float:
    suction, end, _ = at_supply(k[c.SUPPLY_NOMINAL, 0], k, 0)
    share, _ = characteristic((p - end - k[c.MOVED, 0]) / (k[c.AMBIENT, 0] - end), k, 0)
    return suction * share


@inlined
def port_flows(p: float, driven: Driven, k: Prepared, i: int) -> tuple[float, float, float, float]:
    """Flows out of and into the port (kg/s) at ``p`` (Pa), each as level and slope of a tangent.

    Out: the suction of the ejector, and the exhaust if the port is far enough above ambient to open
    the check valve; its opening pressure is lost to the flow. A jet that is still building up has
    less flow and a higher end pressure. In: blow-off, what a valve lets in that does not close, and
    back-flow through a leaking check valve while the nozzle is off.
    """
    ambient = k[c.AMBIENT, i]
    per_pa = 1.0 / (ambient - driven.end)
    depth = driven.jet + (1.0 - k[c.JET_DEPTH, i]) * (1.0 - driven.jet) - k[c.MOVED, i] * per_pa
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
    blown = driven.blow_off + fuller * (1.0 - p / ambient) + back * share + k[c.PORT_INFLOW, i]
    # A positive slope could make the port's balance negative: then the flow is constant.
    blown_slope = min(back * rise - fuller / ambient, 0.0)
    return (
        out - relief * relieves - vent * (share - rise * p),
        out_slope + relief - vent * rise,
        blown - blown_slope * p,
        blown_slope,
    )


@inlined
def leak_flow(p: float, driven: Driven, k: Prepared, i: int) -> tuple[float, float]:
    """Flow from ambient into the vessel (kg/s) at ``p`` (Pa): level and slope of a tangent.

    It is the sum of an opening, a porous part, the rims of open cups, and a constant inflow.
    """
    ambient = k[c.AMBIENT, i]
    laminar = k[c.LAMINAR_LEAK, i] + driven.open * k[c.OPENING, i]
    sonic = k[c.LEAK, i] + driven.open * k[c.HOLE, i]
    share, rise = opening(p, ambient, k[c.LEAK_CRITICAL, i])
    slope = sonic * rise - laminar
    level = sonic * (share - rise * p) + laminar * ambient
    return level + k[c.INFLOW, i], slope


@inlined
def line_flow(
    rest: float,
    fall: float,
    before: float,
    rise: float,
    quadratic: float,
    linear: float,
    pushed: float,
) -> float:
    """Flow w (kg/s) through a line between two pressures that are linear in w.

    The pressures are ``rest − fall w`` and ``before + rise w``. Isothermal pipe flow with inertia:
    p₁² − p₂² = K w |w| + L w − pushed. K is ``quadratic`` and L is ``linear``; both grow with
    temperature. Inertia adds (p₁ + p₂) I / step to L; the same times the flow before is ``pushed``.
    """
    difference = rest * rest - before * before + pushed
    friction = quadratic if difference >= 0.0 else -quadratic
    square = fall * fall - rise * rise - friction
    slope = 2.0 * (rest * fall + before * rise) + linear
    root = math.sqrt(max(slope * slope - 4.0 * square * difference, 0.0))
    return 2.0 * difference / (slope + root)


@inlined
def choking(port: float, vessel: float, critical: float) -> float:
    """How many times the quadratic friction of the line counts between these pressures (Pa).

    With it, isothermal pipe flow p₁² − p₂² = K w² becomes ISO 6358 with the ``critical`` pressure
    ratio b (0 to below 1) and the sonic conductance √((1 − b)/K). It is 1 where the pressures are
    equal, 1 + b where the line begins to choke, and at most 1/(1 − b); with b = 0 it is 1.
    """
    high, low = max(port, vessel), min(port, vessel)
    least = max(low, critical * high)  # what lies below does not move the flow
    both, most = high + least, (1.0 - critical * critical) * high * high
    bent = (1.0 - critical) * both - critical * (high - least)
    return (1.0 - critical) * both * (most + (least * least - low * low)) / (bent * most)


@inlined
def clamped_mass(mass: float, work: float) -> float:
    """Mass (kg), limited so that gas with p V = ``work`` (J) is between COLDEST and HOTTEST."""
    return min(max(mass, work * _PER_HOTTEST), work * _PER_COLDEST)


@inlined
def per_joule(mass: float) -> float:
    """Temperature (K) of a mass of gas per joule of pressure times volume."""
    return 1.0 / (R * mass)


@inlined
def shrinkage(vessel: float, k: Prepared, i: int) -> tuple[float, float]:
    """Final shrinkage of a vessel at its vacuum (m³), and its fall with pressure (m³/Pa)."""
    vacuum = k[c.AMBIENT, i] - vessel
    held = k[c.STIFF_UNTIL, i] / (abs(vacuum) + k[c.STIFF_UNTIL, i] + TINY)
    pull = vacuum * (1.0 - held)
    softening = 1.0 / (1.0 + k[_SOFTNESS_PER_PA, i] * abs(pull))
    stretch = k[_STRETCH, i] * softening
    return stretch * pull, stretch * softening * (1.0 - held * held)


@inlined
def vessel_volume(vessel: float, yielded: float, k: Prepared, i: int) -> float:
    """Volume (m³) of a vessel that shrinks with vacuum, partly at once and partly by creep."""
    shrunk, _ = shrinkage(vessel, k, i)
    return k[c.VOLUME, i] - (1.0 - k[c.CREEP, i]) * shrunk - yielded


@inlined
def vessel_walls(
    vessel: float, yielded_before: float, step: float, k: Prepared, i: int
) -> tuple[float, float, float, float, float]:
    """Walls of a vessel after a step, with the creep ``yielded_before`` (m³) at its start.

    Returns the volume (m³), the creep by then (m³), γ p dV/dp of the immediate share and of the
    creep (m³), and γ p times the creep of this step (J).
    """
    shrunk, stretch = shrinkage(vessel, k, i)
    creep, follows = k[c.CREEP, i], step / (k[c.CREEP_TIME, i] + step)
    yields = follows * (creep * shrunk - yielded_before)
    yielded, rise = yielded_before + yields, GAMMA * vessel * stretch
    volume = k[c.VOLUME, i] - (1.0 - creep) * shrunk - yielded
    at_once, later = rise * (1.0 - creep), rise * creep * follows
    return volume, yielded, at_once, later, GAMMA * vessel * yields


@inlined
def temperatures(
    y: Gas,
    volume: float,
    base: Gas,
    step: float,
    entering: float,
    drawn: float,
    k: Prepared,
    i: int,
) -> tuple[float, float, float]:
    """Temperatures (K) of the gas that leaves port, line and vessel (of ``volume``, m³).

    Those of port and line follow from their energy balances; ``entering`` and ``drawn`` (kg/s) are
    the flows of the port. A small node is flushed many times in a step, so that p V / (m R) would
    oscillate from pass to pass.
    """
    outside, per_pa = k[c.TEMPERATURE, i], 1.0 / (GAMMA * R * step)
    vessel_t = y.vessel * volume * per_joule(y.vessel_mass)
    line_t = y.line * k[c.LINE_VOLUME, i] * per_joule(y.line_mass)
    gained = k[c.PORT_VOLUME, i] * per_pa * base.port + (entering + k[_PORT_HEAT, i]) * outside
    lost = y.port_mass * R * per_pa + drawn + k[_PORT_HEAT, i]
    port_t = (gained + max(y.near, 0.0) * line_t) / (lost + max(-y.near, 0.0))
    gained = k[c.LINE_VOLUME, i] * per_pa * base.line + k[_LINE_HEAT, i] * outside
    gained += max(y.far, 0.0) * vessel_t + max(-y.near, 0.0) * port_t
    lost = y.line_mass * R * per_pa + k[_LINE_HEAT, i]
    return port_t, gained / (lost + max(y.near, 0.0) + max(-y.far, 0.0)), vessel_t


@inlined
def convection(y: Gas, warmer: float, k: Prepared, i: int) -> float:
    """Film coefficient in the vessel relative to the data set; the gas is ``warmer`` (K) than it.

    Free convection along the wall is laminar in vessels of some litres: Nu is proportional to Ra^¼,
    thus to (p² ΔT)^¼. A jet that enters stirs the gas: Nu grows about with the root of its flow.
    """
    free = math.sqrt(
        y.vessel / k[c.AMBIENT, i] * math.sqrt(abs(warmer) * (1.0 / FREE_CONVECTION_AT))
    )
    forced = math.sqrt(k[c.FORCED_CONVECTION, i] * max(-y.far, 0.0))
    return 1.0 + k[c.FREE_CONVECTION, i] * (free - 1.0) + forced


@inlined
def solve(y: Gas, base: Gas, step: float, driven: Driven, k: Prepared, i: int) -> Gas:
    """One pass over the balances of all nodes, from the guess ``y``; ``base`` is the stage's start.

    Mass and energy of an ideal gas: V dp/dt = γ R Σ w T + (γ − 1) Q. A volume that shrinks with
    vacuum has (V + γ p dV/dp) in place of V. So each pressure is linear in the flows. The near flow
    is linearised over the pressure of the line; then the far flow is solved for.
    """
    ambient, outside = k[c.AMBIENT, i], k[c.TEMPERATURE, i]
    per_s, per_pa, per_k = 1.0 / step, 1.0 / (GAMMA * R * step), 1.0 / outside
    out, out_slope, blown, blown_slope = port_flows(y.port, driven, k, i)
    leak, leak_slope = leak_flow(y.vessel, driven, k, i)
    volume, yielded, at_once, later, yields = vessel_walls(y.vessel, base.yielded, step, k, i)
    port_stored, line_stored = k[c.PORT_VOLUME, i] * per_pa, k[c.LINE_VOLUME, i] * per_pa
    vessel_stored, creeping = (volume + at_once) * per_pa, later * per_pa
    port_warmth, line_warmth = k[_PORT_HEAT, i], k[_LINE_HEAT, i]

    entering, drawn = blown + blown_slope * y.port, max(out + out_slope * y.port, 0.0)
    port_t, line_t, vessel_t = temperatures(y, volume, base, step, entering, drawn, k, i)
    warmth = k[_HEAT, i] * convection(y, vessel_t - outside, k, i)
    near_t = line_t if y.near >= 0.0 else port_t
    far_t = vessel_t if y.far >= 0.0 else line_t
    leak_t = outside if y.vessel <= ambient else vessel_t

    # Pressures as value without flow, and slope over the flow.
    # Heat follows from temperatures of the energy balance. With pressure over mass of a pass,
    # passes would diverge if a small node exchanges its heat with the wall within a step.
    weight = 1.0 / (port_stored + out_slope * port_t - blown_slope * outside)
    gained = port_stored * base.port + blown * outside - out * port_t
    gained += port_warmth * (outside - port_t)
    port_rest, port_rise = max(gained * weight, LOWEST), near_t * weight
    weight = 1.0 / line_stored
    line_rest = max(base.line + line_warmth * (outside - line_t) * weight, LOWEST)
    line_fall, line_rise = near_t * weight, far_t * weight
    cooling = warmth * volume * per_joule(y.vessel_mass)
    weight = 1.0 / (vessel_stored - leak_slope * leak_t + cooling + creeping)
    gained = vessel_stored * base.vessel + leak * leak_t + warmth * outside
    gained += creeping * y.vessel + yields * per_pa
    vessel_rest, vessel_fall = gained * weight, far_t * weight

    chokes = choking(y.port, y.vessel, k[c.LINE_CRITICAL, i])
    inertia = k[c.NEAR_INERTANCE, i] * (y.line + y.port) * per_s
    warm = near_t * per_k
    quadratic = warm * k[c.NEAR_RESISTANCE, i] * chokes
    linear = warm * k[c.NEAR_LAMINAR, i] + inertia
    pushed = inertia * base.near
    near = line_flow(y.line, 0.0, port_rest, port_rise, quadratic, linear, pushed)
    slope = 2.0 * (port_rise * (port_rest + port_rise * near) + quadratic * abs(near)) + linear
    near_slope = 2.0 * y.line / slope
    near -= near_slope * y.line
    weight = slope / (slope + 2.0 * y.line * line_fall)
    line_rest, line_rise = (line_rest - line_fall * near) * weight, line_rise * weight

    inertia = k[c.INERTANCE, i] * (y.vessel + y.line) * per_s
    warm = far_t * per_k
    quadratic = warm * k[c.RESISTANCE, i] * chokes
    linear = warm * k[c.LAMINAR, i] + inertia
    pushed = inertia * base.far
    far = line_flow(vessel_rest, vessel_fall, line_rest, line_rise, quadratic, linear, pushed)

    line = min(max(line_rest + line_rise * far, LOWEST), HIGHEST)
    vessel = min(max(vessel_rest - vessel_fall * far, LOWEST), HIGHEST)
    near += near_slope * line
    port = min(max(port_rest + port_rise * near, LOWEST), HIGHEST)
    net = near - (out + out_slope * port) + blown + blown_slope * port
    return Gas(
        port,
        clamped_mass(base.port_mass + step * net, port * k[c.PORT_VOLUME, i]),
        line,
        clamped_mass(base.line_mass + step * (far - near), line * k[c.LINE_VOLUME, i]),
        vessel,
        clamped_mass(base.vessel_mass + step * (leak + leak_slope * vessel - far), vessel * volume),
        min(max(near, -MOST_FLOW), MOST_FLOW),
        min(max(far, -MOST_FLOW), MOST_FLOW),
        yielded,
    )


@inlined
def lag_stage(base: float, target: float, step: float, time_constant: float) -> float:
    """Implicit stage of a first-order lag with a time constant (s)."""
    return base + step / (time_constant + step) * (target - base)


@inlined
def drain_stage(drained: float, valve: float, step: float, k: Prepared, i: int) -> float:
    """Implicit stage of the reservoir of blow-off: sonic flow drains it, the supply refills it."""
    rate = step * k[c.BLOW_OFF_DRAIN, i]
    return (drained + rate * valve) / (1.0 + rate * (valve + k[c.BLOW_OFF_REFILL, i]))


@inlined
def jet_strength(opening: float, k: Prepared, i: int) -> float:
    """Strength of the jet (0 to 1) behind a valve that is opening slowly.

    A valve is wider than the nozzle behind it. A nozzle draws nearly its full flow at half its
    pressure, and nothing at a tenth. So the jet has full strength long before a slow valve is open.
    A valve of normal speed is open too soon for that to show.
    """
    slow = k[c.SLOW_RAMP_UP, i] / (k[c.SLOW_RAMP_UP, i] + k[c.RAMP_UP, i])
    full = 1.0 - slow * (1.0 - k[c.JET_FULL_AT, i])
    threshold = NO_JET_BELOW * full * (1.0 - full)
    share = min(max((opening - threshold) / (full - threshold), 0.0), 1.0)
    return share * (full + (1.0 - full) * share * (3.0 - 2.0 * share))


@inlined
def sensor_pressure(port: float, vessel: float, k: Prepared, i: int) -> float:
    """Pressure (Pa) where the sensor sits, between port and vessel."""
    return port + k[_SENSOR_PLACE, i] * (vessel - port)


@inlined
def stage(
    guess: Gas,
    base: Gas,
    lags: Lags,
    step: float,
    valves: Valves,
    passes: int,
    k: Prepared,
    i: int,
) -> tuple[Gas, Lags]:
    """Solve one implicit stage of ``step`` seconds from the gas ``base`` and from ``lags``.

    Each pass improves the guess by about one order in the step. So a method of third order needs
    three ``passes`` from the start of the step, and two from a better guess. With one pass, a
    second follows only if the first moved the pressures by more than ``CONVERGED`` allows.
    The jet builds up in two stages: the valve opens, then the jet gathers strength.
    """
    nozzle, blow = valves.nozzle, valves.blow_off
    rise, fall = k[c.RAMP_UP, i], k[c.RAMP_DOWN, i]
    first = rise + k[c.SLOW_RAMP_UP, i]
    rising = nozzle > lags.drive
    drive = lag_stage(lags.drive, nozzle, step, first if rising else fall)
    jet = lag_stage(
        lags.jet, jet_strength(drive, k, i) if rising else drive, step, rise if rising else fall
    )
    opening, closing = k[c.BLOW_OFF_RAMP, i], k[c.BLOW_OFF_RAMP_DOWN, i]
    valve = lag_stage(lags.valve, blow, step, opening if blow > lags.valve else closing)
    drained = drain_stage(lags.drained, valve, step, k, i)
    regulated = max(k[c.SUPPLY, i] - k[c.DROOP, i] * max(nozzle, blow), 0.0)
    supply = lag_stage(lags.supply, regulated, step, k[c.SUPPLY_LAG, i])
    suction, end, blow_off = at_supply(supply, k, i)
    driven = Driven(jet, suction, end, blow_off * valve * (1.0 - drained), valves.open_cup)
    gas = solve(guess, base, step, driven, k, i)
    moved = max(abs(gas.port - guess.port), abs(gas.vessel - guess.vessel))
    if passes > 1 or moved * step > CONVERGED:
        gas = solve(gas, base, step, driven, k, i)
    if passes > 2:
        gas = solve(gas, base, step, driven, k, i)
    time_constant = k[c.SENSOR_LAG, i]
    sensor_stage = lag_stage(
        lags.sensor_stage, sensor_pressure(gas.port, gas.vessel, k, i), step, time_constant
    )
    sensed = lag_stage(lags.sensed, sensor_stage, step, time_constant + k[c.SLOW_SENSOR, i])
    return gas, Lags(drive, jet, valve, drained, supply, sensor_stage, sensed)


@inlined
def extrapolated_gas(start: Gas, begin: Gas, end: Gas, share: float) -> Gas:
    """``start`` plus ``share`` times the difference from ``begin`` to ``end``."""
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
def extrapolated_lags(start: Lags, begin: Lags, end: Lags, share: float) -> Lags:
    """As ``extrapolated_gas``."""
    return Lags(
        start.drive + share * (end.drive - begin.drive),
        start.jet + share * (end.jet - begin.jet),
        start.valve + share * (end.valve - begin.valve),
        start.drained + share * (end.drained - begin.drained),
        start.supply + share * (end.supply - begin.supply),
        start.sensor_stage + share * (end.sensor_stage - begin.sensor_stage),
        start.sensed + share * (end.sensed - begin.sensed),
    )


@inlined
def clamped_gas(gas: Gas) -> Gas:
    """Extrapolated gas, limited to positive pressures and masses."""
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
    """Gas and lags after ``h`` seconds, and the error (Pa) that a second-order method would have.

    The stages are equally spaced, so the error is the second difference of their increments.
    ``guess`` is the guessed gas at the first stage, which takes ``passes``; the others take at most
    two.
    """
    step = G * h
    gas_1, lags_1 = stage(clamped_gas(guess), gas, lags, step, valves, passes, k, i)
    base_2, lag_base_2 = (
        extrapolated_gas(gas, gas, gas_1, _A21),
        extrapolated_lags(lags, lags, lags_1, _A21),
    )
    guess = clamped_gas(extrapolated_gas(gas, gas, gas_1, _NEXT_STAGE))
    gas_2, lags_2 = stage(guess, base_2, lag_base_2, step, valves, min(passes, 2), k, i)
    base_3 = extrapolated_gas(extrapolated_gas(gas, gas, gas_1, _B1), base_2, gas_2, _B2)
    lag_base_3 = extrapolated_lags(
        extrapolated_lags(lags, lags, lags_1, _B1), lag_base_2, lags_2, _B2
    )
    guess = clamped_gas(extrapolated_gas(gas_1, gas_1, gas_2, 2.0))
    gas_3, lags_3 = stage(guess, base_3, lag_base_3, step, valves, min(passes, 2), k, i)
    port_error = second_difference(
        gas_1.port - gas.port, gas_2.port - base_2.port, gas_3.port - base_3.port
    )
    errors = (
        second_difference(
            gas_1.vessel - gas.vessel, gas_2.vessel - base_2.vessel, gas_3.vessel - base_3.vessel
        ),
        second_difference(
            lags_1.sensor_stage - lags.sensor_stage,
            lags_2.sensor_stage - lag_base_2.sensor_stage,
            lags_3.sensor_stage - lag_base_3.sensor_stage,
        ),
        second_difference(
            lags_1.sensed - lags.sensed,
            lags_2.sensed - lag_base_2.sensed,
            lags_3.sensed - lag_base_3.sensed,
        ),
    )
    return (
        gas_3,
        without_faded(lags_3),
        max(PORT_WEIGHT * port_error, errors[0], errors[1], errors[2]),
    )


@inlined
def without_faded(lags: Lags) -> Lags:
    """Lags, with faded ones and those that the method made negative set to zero."""
    return Lags(
        lags.drive if lags.drive > FAINTEST_JET else 0.0,
        lags.jet if lags.jet > FAINTEST_JET else 0.0,
        lags.valve if lags.valve > FAINTEST_JET else 0.0,
        lags.drained if lags.drained > FAINTEST_JET else 0.0,
        lags.supply,
        lags.sensor_stage,
        lags.sensed,
    )


@inlined
def second_difference(first: float, second: float, third: float) -> float:
    """Absolute second difference of three equally spaced values."""
    return abs(first - 2.0 * second + third)


@inlined
def reading(sensed: float, theta: Theta, i: int) -> float:
    """Absolute pressure that the PLC reads (Pa): the sensed one with errors of span and offset."""
    vacuum = theta[c.AMBIENT, i] - sensed
    return sensed - (theta[c.SENSOR_GAIN, i] - 1.0) * vacuum + theta[c.SENSOR_OFFSET, i]


@inlined
def sensed_at(value: float, theta: Theta, i: int) -> float:
    """Pressure at the sensor (Pa) when it reads ``value`` (Pa): the inverse of ``reading``."""
    gain = theta[c.SENSOR_GAIN, i]
    return (value - theta[c.SENSOR_OFFSET, i] + (gain - 1.0) * theta[c.AMBIENT, i]) / gain


def reading_of(sensed: float, theta: Theta) -> float:
    """``reading`` for one hypothesis, in Python: it needs no compiling."""
    return reading.py_func(sensed, theta.reshape(-1, 1), 0)


def sensed_of(value: float, theta: Theta) -> float:
    """``sensed_at`` for one hypothesis, in Python."""
    return sensed_at.py_func(value, theta.reshape(-1, 1), 0)
