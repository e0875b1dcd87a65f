"""The model's equations once more, plainly, for SciPy's Radau: what the kernel must meet."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from twin.model import theta as c
from twin.model.theta import Theta

R, GAMMA = 287.05, 1.4
CP = GAMMA * R / (GAMMA - 1.0)
CRITICAL, LAMINAR = 0.528, 0.999

Floats = npt.NDArray[np.float64]


def psi(ratio: float, critical: float) -> float:
    """ISO 6358 flow function, straight near 1."""
    if ratio <= critical:
        return 1.0
    bent = (min(ratio, LAMINAR) - critical) / (1.0 - critical)
    root = float(np.sqrt(1.0 - bent**2))
    return root if ratio <= LAMINAR else root * (1.0 - ratio) / (1.0 - LAMINAR)


def through_hole(sonic: float, p: float, ambient: float, critical: float = CRITICAL) -> float:
    """Flow inwards (kg/s)."""
    if p <= ambient:
        return sonic * psi(p / ambient, critical)
    return -sonic * p / ambient * psi(ambient / p, critical)


@dataclass(frozen=True)
class Valves:
    """Positions of nozzle and blow-off valve from a time on, and whether the cup stands open.

    The cup is as before where ``open`` is None; while blow-off is on it opens by itself at the
    vacuum that lets the part go.
    """

    time: float
    nozzle: float
    blow: float
    open: float | None = None


def driving(p: float, behind: float, critical: float) -> float:
    """The square of a flow from ``p`` to ``behind`` times its friction (Pa²), by ISO 6358."""
    ratio = max(behind / p - critical, 0.0) / (1.0 - critical)
    return float((1.0 - critical) * p**2 * (1.0 - ratio**2))


def choking(port: float, vessel: float, critical: float) -> float:
    """How many times the friction counts with which isothermal pipe flow is that of ISO 6358."""
    low, high = sorted((port, vessel))
    nearly = high * (1.0 - 1e-9)  # without a drop it is 1
    low = min(low, nearly)
    return (high**2 - low**2) / driving(high, low, critical)


def suction_flow(theta: Theta, p: float, jet: float, supply: float) -> float:
    def peak(at: float) -> float:
        off = at / theta[c.SUPPLY_OPTIMUM] - 1.0
        return max(1.0 - theta[c.SUPPLY_CURVATURE] * off**2, 0.0)

    ambient = theta[c.AMBIENT]
    supply *= theta[c.AMBIENT_NOMINAL] / ambient  # ratios of pressures drive a jet
    capacity = theta[c.SUCTION] * peak(supply) / peak(theta[c.SUPPLY_NOMINAL])
    capacity *= ambient / theta[c.AMBIENT_NOMINAL]
    missing = theta[c.SUPPLY_NOMINAL] - supply
    end = theta[c.END_RATIO] * ambient * (1.0 + theta[c.END_SLOPE] * missing)
    end = min(max(end, 0.0), 0.98 * ambient)
    deep = 1.0 - theta[c.JET_DEPTH] * (1.0 - jet) - theta[c.MOVED] / (ambient - end)
    x = max(deep - (ambient - p) / (ambient - end), 0.0)
    share = max(characteristic(theta, min(x, 1.0)), 0.0)
    if x > 1.0:  # above ambient it goes on straight
        rise = (characteristic(theta, 1.0) - characteristic(theta, 1.0 - 1e-6)) / 1e-6
        share += (x - 1.0) * max(rise, 0.0)
    return float(jet * capacity * share)


def characteristic(theta: Theta, x: float) -> float:
    bend = np.polyval(theta[[c.BEND_3, c.BEND_2, c.SKEW, c.BULGE]], x)
    first = x * (1.0 + (1.0 - x) * bend)
    return float((1.0 - theta[c.KINK]) * first + theta[c.KINK] * second_stage(x, theta[c.KINK_AT]))


def second_stage(x: float, closes: float) -> float:
    """Share of its suction at ambient: straight from where it closes, that corner rounded."""

    def rounded(u: float) -> float:
        return float(np.hypot(u, 0.03) + u) / 2.0

    least = rounded(-closes)
    return (rounded(x - closes) - least) / (rounded(1.0 - closes) - least)


def shrinkage(theta: Theta, vessel: float) -> tuple[float, float]:
    """By how much a vessel shrinks with vacuum in the end (m³), and its slope (m³/Pa)."""
    early, ambient, stiff = theta[c.SOFTNESS], theta[c.AMBIENT], theta[c.STIFF_UNTIL]

    def shrunk(vacuum: float) -> float:
        pull = vacuum * abs(vacuum) / (abs(vacuum) + stiff) if vacuum else 0.0
        most = ambient**2 / (ambient + stiff)
        return float(theta[c.COMPLIANCE] * (1.0 + early) * pull / (most + early * abs(pull)))

    vacuum, by = ambient - vessel, 1e-3 * ambient
    return shrunk(vacuum), (shrunk(vacuum + by) - shrunk(vacuum - by)) / (2.0 * by)


def film(theta: Theta, vessel: float, vessel_t: float, far: float) -> float:
    rayleigh = (vessel / theta[c.AMBIENT]) ** 2 * abs(vessel_t - theta[c.TEMPERATURE]) / 10.0
    free, entering = theta[c.FREE_CONVECTION], max(-far, 0.0)
    times = 1.0 - free + free * rayleigh**0.25 + np.sqrt(theta[c.FORCED_CONVECTION] * entering)
    return float(theta[c.FILM] * times)


def rates(_t: float, y: Floats, theta: Theta, valves: Valves) -> Floats:
    """d/dt of three pressures, three masses, two flows, and of what a row has behind these."""
    port, line, vessel, port_mass, line_mass, vessel_mass, near, far = y[:8]
    yielded, drive, jet, valve, drained, supply, felt, sensed = y[8:]
    ambient, outside, critical = theta[[c.AMBIENT, c.TEMPERATURE, c.LINE_CRITICAL]]
    chokes = choking(port, vessel, critical)
    shrunk, stretch = shrinkage(theta, vessel)
    at_once = 1.0 - theta[c.CREEP]
    volume = theta[c.VOLUME] - at_once * shrunk - yielded
    yielding = (theta[c.CREEP] * shrunk - yielded) / theta[c.CREEP_TIME]
    port_t = port * theta[c.PORT_VOLUME] / (R * port_mass)
    line_t = line * theta[c.LINE_VOLUME] / (R * line_mass)
    vessel_t = vessel * volume / (R * vessel_mass)

    stiff = theta[c.NEAR_INERTANCE] == 0.0  # then port and line are one node, and far is friction
    if stiff:
        difference = vessel**2 - port**2
        warm = (vessel_t if difference >= 0.0 else line_t) / outside
        linear, quadratic = warm * theta[c.LAMINAR], warm * theta[c.RESISTANCE] * chokes
        root = np.sqrt(linear**2 + 4.0 * quadratic * abs(difference))
        far = 2.0 * difference / (linear + root)

    forward = port - theta[c.CRACKING_PRESSURE]  # behind a check valve that is open
    relief = theta[c.RELIEF] * max(port - ambient - theta[c.RELIEF_PRESSURE], 0.0)
    out = suction_flow(theta, port, jet, supply) + relief
    out += max(-through_hole(theta[c.EXHAUST], forward, ambient), 0.0)
    blown = (
        valve
        * (1.0 - drained)
        * theta[c.BLOW_OFF]
        * (1.0 + theta[c.BLOW_OFF_SHAPE] * (1.0 - port / ambient))
        * (supply + ambient)
        / (theta[c.SUPPLY_NOMINAL] + theta[c.AMBIENT_NOMINAL])
        + theta[c.PORT_INFLOW]
    )
    if port < ambient:
        blown += through_hole(theta[c.BACK_FLOW] * (1.0 - min(jet, 1.0)), port, ambient)
    hole, pore = theta[[c.LEAK, c.LAMINAR_LEAK]] + (valves.open or 0.0) * theta[[c.HOLE, c.OPENING]]
    leak = through_hole(hole, vessel, ambient, theta[c.LEAK_CRITICAL]) + pore * (ambient - vessel)

    far_t = vessel_t if far >= 0.0 else line_t
    leak_t = outside if vessel <= ambient else vessel_t
    port_gain = CP * (blown * outside - out * port_t) + theta[c.PORT_HEAT] * (outside - port_t)
    line_gain = CP * far * far_t + theta[c.LINE_HEAT] * (outside - line_t)
    if stiff:
        near = _that_keeps_them_equal(theta, port_gain, line_gain, line_t, port_t)
    near_t = line_t if near >= 0.0 else port_t
    port_gain += CP * near * near_t
    line_gain -= CP * near * near_t
    into_vessel = CP * (leak * leak_t - far * far_t)
    into_vessel += film(theta, vessel, vessel_t, far) * theta[c.AREA] * (outside - vessel_t)

    regulated = theta[c.SUPPLY] - theta[c.DROOP] * max(valves.nozzle, valves.blow)
    friction = theta[c.NEAR_RESISTANCE] + theta[c.RESISTANCE]
    place = min(theta[c.PLACE] / friction, 1.0) if friction > 0.0 else 0.0
    there = port + place * (vessel - port)
    pushes = (0.0, 0.0)
    if not stiff:
        rub = (theta[c.NEAR_RESISTANCE] * chokes * abs(near) + theta[c.NEAR_LAMINAR]) * near
        rub *= near_t / outside
        near_push = (line**2 - port**2 - rub) / (theta[c.NEAR_INERTANCE] * (line + port))
        rub = (theta[c.RESISTANCE] * chokes * abs(far) + theta[c.LAMINAR]) * far * far_t / outside
        pushes = near_push, (vessel**2 - line**2 - rub) / (theta[c.INERTANCE] * (vessel + line))
    return np.array(
        [
            (GAMMA - 1.0) * port_gain / theta[c.PORT_VOLUME],
            (GAMMA - 1.0) * line_gain / theta[c.LINE_VOLUME],
            ((GAMMA - 1.0) * into_vessel + GAMMA * vessel * yielding)
            / (volume + GAMMA * vessel * at_once * stretch),
            near - out + blown,
            far - near,
            leak - far,
            *pushes,
            yielding,
            *jet_rates(theta, valves.nozzle, drive, jet),
            (valves.blow - valve)
            / theta[c.BLOW_OFF_RAMP if valves.blow > valve else c.BLOW_OFF_RAMP_DOWN],
            theta[c.BLOW_OFF_DRAIN]
            * (valve * (1.0 - drained) - theta[c.BLOW_OFF_REFILL] * drained),
            (regulated - supply) / theta[c.SUPPLY_LAG],
            (there - felt) / theta[c.SENSOR_LAG],
            (felt - sensed) / (theta[c.SENSOR_LAG] + theta[c.SLOW_SENSOR]),
        ]
    )


def jet_rates(theta: Theta, nozzle: float, drive: float, jet: float) -> tuple[float, float]:
    """d/dt of the two stages in which the jet comes and goes."""
    rise, fall = theta[c.RAMP_UP], theta[c.RAMP_DOWN]
    if nozzle <= drive:
        return (nozzle - drive) / fall, (drive - jet) / fall
    first = rise + theta[c.SLOW_RAMP_UP]
    return (nozzle - drive) / first, (strength_of_jet(theta, drive) - jet) / rise


def strength_of_jet(theta: Theta, opening: float) -> float:
    """Of a slow valve: nothing until a quarter of where it is full, then straight to S-shaped."""
    whole = theta[c.SLOW_RAMP_UP] + theta[c.RAMP_UP]
    full = 1.0 - (1.0 - theta[c.JET_FULL_AT]) * theta[c.SLOW_RAMP_UP] / whole
    begins = 0.25 * full * (1.0 - full)
    share = np.clip((opening - begins) / (full - begins), 0.0, 1.0)
    return float(full * share + (1.0 - full) * (3.0 * share**2 - 2.0 * share**3))


def _that_keeps_them_equal(
    theta: Theta, port_gain: float, line_gain: float, line_t: float, port_t: float
) -> float:
    """Flow from line to port that lets both pressures change alike: nothing resists it."""
    port, line = theta[c.PORT_VOLUME], theta[c.LINE_VOLUME]
    heat = (line_gain * port - port_gain * line) / (port + line)
    return heat / (CP * (line_t if heat >= 0.0 else port_t))


# How large each state becomes, in the order of `rates`: tolerances are shares of these.
SIZES = np.array([*[1e5] * 3, 1e-6, 1e-6, 1e-4, *[1e-3] * 2, 1e-4, *[1.0] * 4, *[1e5] * 3])


def at_rest(theta: Theta) -> Floats:
    ambient, gas = theta[c.AMBIENT], R * theta[c.TEMPERATURE]
    masses = ambient * theta[[c.PORT_VOLUME, c.LINE_VOLUME, c.VOLUME]] / gas
    return np.array([*[ambient] * 3, *masses, *[0.0] * 7, theta[c.SUPPLY], *[ambient] * 2])


def reference(theta: Theta, moves: Sequence[Valves], times: Floats) -> Floats:
    """Run from rest through the moves (the first at the beginning); rows of states at ``times``.

    A cup that blow-off opens (``RELEASE`` is not NaN) stands open from the very crossing on.
    """

    def closed(_t: float, y: Floats, *_: object) -> float:
        return float(theta[c.AMBIENT] - y[2] - theta[c.RELEASE])

    closed.terminal = True  # type: ignore[attr-defined]
    y, rows, is_open = at_rest(theta), [], 0.0
    for move, end in zip(moves, [*(move.time for move in moves[1:]), times[-1]], strict=True):
        begin = move.time
        is_open = is_open if move.open is None else move.open
        while begin < end:
            lets_go = move.blow > 0.0 and is_open == 0.0 and not np.isnan(theta[c.RELEASE])
            found = solve_ivp(
                rates,
                (begin, end),
                y,
                "Radau",
                np.unique(np.append(times[(times > begin) & (times <= end)], end)),
                events=closed if lets_go else None,
                rtol=1e-10,
                atol=1e-10 * SIZES,
                args=(theta, replace(move, open=is_open)),
                max_step=5e-3,
            )
            assert found.success
            rows += [y for t, y in zip(found.t, found.y.T, strict=True) if t in times]
            y, begin = found.y[:, -1], end
            if found.status == 1:
                y, begin, is_open = found.y_events[0][0], found.t_events[0][0], 1.0
    return np.array(rows)
