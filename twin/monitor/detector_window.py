"""How the knees of a system will look: how wide a window they need, how late they are seen."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients, swing
from twin.model.gas import GAMMA, R
from twin.model.plant import suction_at
from twin.model.theta import Theta
from twin.monitor.phase_detector import SHORTEST_WINDOW, SIGNIFICANT, Knees, PhaseFinder
from twin.monitor.simulated_switching import seen
from twin.signals import MBAR, MS, Phase, Samples

SHARP, ROUNDED = 2.5, 2.0  # times SIGNIFICANT, which is to show of a knee; lags round it
ROUNDS = 8  # until the window's rows are known
LONGEST_WINDOW = 240  # rows
NEVER = 2**31  # rows into a suction: no knee is looked for
SETTLED = 20e-3  # s after the valve's response before a knee can be one
AGAIN = 30e-3  # s after a knee, in which lines ring, before the next can be one
AT_ONCE = 2  # rows: so few would follow the lag that calibration finds, and that lag them
HELD = 2.0  # s for which the nozzle is off in the free run
LONGEST_RUN = 60_000  # rows of it
TOLD_LATE = 20e-3  # s, that what an ejector reports may be late: a slow IO-Link cycle and a PLC's
RINGS = 1.5  # times as high as in the free run a line may ring
MOST_APART = 2.0 / 3.0  # of H1's hysteresis: thresholds drift


def knees_of(data: DataSet, sampling_ms: float | None = None) -> Knees:
    """How knees will look in rows of a data set's unit, or in those of a record."""
    period = (sampling_ms or data.sensor.sampling_ms) * MS
    return expected_knees(coefficients(data), data.sensor.noise_mbar * MBAR, period)


def expected_knees(theta: Theta, noise: float, period: float = MS) -> Knees:
    """Derive the knees' window from how sharply the slope breaks at H1 in this system.

    ``noise`` in Pa; rows come each ``period`` (s).
    The slope of a straight line over n rows of noise s has the deviation s √(12/n³); the window is
    chosen so that the break is SIGNIFICANT against the difference of two such slopes. A lag of the
    sensor leaves 1 / (1 + lag / n) of that difference. Where no air is saved there are no knees
    but those that the ejector reports.
    """
    h1 = theta[c.AMBIENT] - theta[c.H1]
    suction = suction_at(theta, h1) * R * theta[c.TEMPERATURE]
    bend = max(
        GAMMA * suction / (theta[c.VOLUME] + theta[c.PORT_VOLUME]) * period, 1e-3
    )  # Pa per row
    sharp = rows = (24.0 * (SHARP * SIGNIFICANT * noise / bend) ** 2) ** (1.0 / 3.0)
    lag = math.hypot(theta[c.SENSOR_LAG], theta[c.SENSOR_LAG] + theta[c.SLOW_SENSOR]) / period
    for _ in range(ROUNDS):
        rows = max(sharp, sharp * (ROUNDED / SHARP * (1.0 + lag / rows)) ** (2.0 / 3.0))
    window = int(min(max(math.ceil(rows), SHORTEST_WINDOW), LONGEST_WINDOW))
    to_the_end = (h1 - theta[c.END_RATIO] * theta[c.AMBIENT]) / bend  # if it went on like this
    at_once = Knees(
        window=window,
        longest=int(min(max(to_the_end, window), LONGEST_WINDOW)),
        noise=noise,
        off_shift=0,
        on_shift=round((2.0 * theta[c.RAMP_UP] + 2.0 * theta[c.SENSOR_LAG]) / period),
        settled=NEVER
        if theta[c.AIR_SAVING] == c.OFF
        else round((theta[c.RESPONSE] + SETTLED) / period),
        again=round(AGAIN / period),
        blow_off=(float(theta[c.BLOW_OFF_MODE]), float(theta[c.BLOW_OFF_TIME])),
        about=round((max(theta[c.RESPONSE], theta[c.RESPONSE_OFF]) + TOLD_LATE + SETTLED) / period),
        acts=(round(theta[c.RESPONSE_OFF] / period), round(theta[c.RESPONSE] / period)),
        period=period,
    )
    return _as_seen(at_once, theta, GAMMA * theta[c.H1] / bend)


def _as_seen(knees: Knees, theta: Theta, most: float) -> Knees:
    """The same, seen as in a free run, which reaches H1 by ``most`` rows: as late, as far apart.

    Jet and sensor delay a knee; the step at the port pulls it forward. As that step swings in the
    line, the slope breaks as at a knee, but near the last one's level. Where the free run does not
    show how high, the window is as long as the swing, over which it is level, or as it may last. A
    flow back into another run lets the pressure come down to where the nozzle goes on.
    """
    gas = (theta[c.VOLUME] + theta[c.PORT_VOLUME]) / (R * theta[c.TEMPERATURE])
    leaky = theta.copy()
    leaky[c.BACK_FLOW] += gas * (theta[c.H1] - theta[c.H1_LOW]) / HELD
    leaky[c.AIR_SAVING] = c.WITHOUT_CONTINUOUS
    rows = min(int(most + HELD / knees.period) + 2 * LONGEST_WINDOW, LONGEST_RUN)
    tight, leaking = seen([theta, leaky], rows, replace(knees, on_shift=0))
    swings = round(swing(theta, float(theta[c.NEAR_INERTANCE] + theta[c.INERTANCE])) / knees.period)
    wide = min(swings, knees.again)
    if tight.rings == 0.0 and knees.settled != NEVER and wide > knees.window:
        knees = replace(knees, window=wide, longest=max(knees.longest, wide))
        tight, leaking = seen([theta, leaky], rows, replace(knees, on_shift=0))
    most_rows = knees.on_shift + knees.window  # more: it is another knee
    if AT_ONCE < tight.off_rows <= most_rows:
        knees = replace(knees, off_shift=tight.off_rows)
    if 0 < leaking.on_rows <= most_rows:
        knees = replace(knees, on_shift=leaking.on_rows)
    apart = min(RINGS * tight.rings, MOST_APART * float(theta[c.H1] - theta[c.H1_LOW]))
    again = max(knees.again, knees.on_shift, knees.off_shift)
    return replace(knees, again=again, apart=apart)


def as_wide_as_needed(knees: Knees, blocks: Sequence[Samples]) -> Knees:
    """The same with the window in which most suctions of a whole record show the nozzle go off.

    The narrowest of these: a wider one finds out more where a sensor, slower than anybody knew, has
    rounded the knees, but is further behind and needs longer stretches.
    """
    if knees.settled == NEVER:
        return knees
    best, (most, suctions) = knees, _nozzle_off(knees, blocks)
    window = knees.window
    while most < suctions and window < knees.longest:
        window = min(2 * window, knees.longest)
        wider = replace(knees, window=window)
        if (found := _nozzle_off(wider, blocks)[0]) > most:
            best, most = wider, found
    return best


def _nozzle_off(knees: Knees, blocks: Sequence[Samples]) -> tuple[int, int]:
    """In how many suctions the nozzle is seen to go off, and of how many."""
    finder = PhaseFinder(knees)
    phase = np.concatenate([*(finder.push(block)[1] for block in blocks), finder.flush()[1]])
    inside = np.isin(phase, (Phase.SUCTION, Phase.HOLD))
    number = np.cumsum(np.diff(inside, prepend=False) & inside)
    return len(np.unique(number[phase == Phase.HOLD])), int(number[-1]) if len(number) else 0
