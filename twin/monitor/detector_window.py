"""Settings of the switching detector: the width of its window, and the delay of breakpoints."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from twin.model import theta as c
from twin.model.air import GAMMA, R
from twin.model.dataset import DataSet, coefficients, swing
from twin.model.plant import suction_at
from twin.model.theta import Theta
from twin.monitor.simulated_switching import (
    bend_in_free_run,
    detected_switching,
    shortest_interval,
)
from twin.monitor.switching_detector import (
    SHORTEST_WINDOW,
    SIGNIFICANT,
    DetectorSettings,
    PhaseFinder,
)
from twin.signals import MBAR, MS, Phase, Samples

SHARP, ROUNDED = 2.5, 2.0  # wanted significance over SIGNIFICANT, for a sharp and a rounded break
ROUNDS = 8  # iterations of the window's rows
LONGEST_WINDOW = 240  # rows
NEVER = 2**31  # rows from the start of a suction: no breakpoint is searched
SETTLED = 20e-3  # s after the valve's response before the first breakpoint
AGAIN = 30e-3  # s from a breakpoint to the next search: lines ring in that time
# Of the shortest time between switchings in a free run: a quick ejector is searched again sooner.
SOONER = 0.5
AT_ONCE = 2  # rows: smaller shifts are ignored; calibrated lag and shift would chase each other
HELD = 2.0  # s that the nozzle stays off in the free run
LONGEST_RUN = 60_000  # rows of a free run
LEAST_BEND = 1e-3  # Pa per row
LEAST_SUCTION = 0.02  # suction at H1 over that at half of H1: less counts as none
TOLD_LATE = 20e-3  # s, longest delay of an ejector's report: a slow IO-Link and PLC cycle
RINGS = 1.5  # highest ringing of a line over that of the free run
MOST_APART = 2.0 / 3.0  # of H1's hysteresis: thresholds drift


def detector_of(data: DataSet, sampling_ms: float | None = None) -> DetectorSettings:
    """Detector settings for a data set's unit, at its sampling or at ``sampling_ms``."""
    period = (sampling_ms or data.sensor.sampling_ms) * MS
    noise = data.sensor.noise_in_means(sampling_ms) * MBAR
    return expected_detector(coefficients(data), noise, period)


def expected_detector(theta: Theta, noise: float, period: float = MS) -> DetectorSettings:
    """Derive the detector's window from the change of the slope at H1 in this system.

    ``noise`` in Pa; rows come each ``period`` (s).
    The slope of a straight line over n rows of noise s has the standard deviation s √(12/n³). The
    window is chosen so that the break is SIGNIFICANT against the difference of two such slopes. A
    lag of the sensor leaves 1 / (1 + lag / n) of that difference. Without air saving there are
    only the breakpoints that the ejector reports.
    """
    bend = _bend(theta, period)
    sharp = rows = (24.0 * (SHARP * SIGNIFICANT * noise / bend) ** 2) ** (1.0 / 3.0)
    lag = math.hypot(theta[c.SENSOR_LAG], theta[c.SENSOR_LAG] + theta[c.SLOW_SENSOR]) / period
    for _ in range(ROUNDS):
        rows = max(sharp, sharp * (ROUNDED / SHARP * (1.0 + lag / rows)) ** (2.0 / 3.0))
    window = int(min(max(math.ceil(rows), SHORTEST_WINDOW), LONGEST_WINDOW))
    end = theta[c.END_RATIO] * theta[c.AMBIENT] + theta[c.MOVED]
    above_the_end = theta[c.AMBIENT] - theta[c.H1] - end
    to_the_end = above_the_end / bend  # at this slope
    at_once = DetectorSettings(
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
    return _as_in_free_run(at_once, theta)


def _bend(theta: Theta, period: float) -> float:
    """Change of the slope (Pa per row) as the nozzle goes off at H1.

    If suction is nearly zero with the whole line at H1, only the sensor's end of the line reaches
    H1. Then a free run shows the change.
    """
    bend, half = (_slope(theta, share * float(theta[c.H1]), period) for share in (1.0, 0.5))
    if bend > LEAST_SUCTION * half:
        return bend
    rows_to_h1 = 4.0 * GAMMA * theta[c.H1] / max(half, LEAST_BEND)
    rows = min(int(rows_to_h1 + HELD / period), LONGEST_RUN)
    return max(bend, bend_in_free_run(theta, rows, period), LEAST_BEND)


def _slope(theta: Theta, vacuum: float, period: float) -> float:
    """Fall of the pressure (Pa per row) by suction, with the whole line at a vacuum (Pa)."""
    suction = suction_at(theta, theta[c.AMBIENT] - vacuum) * R * theta[c.TEMPERATURE]
    return float(GAMMA * suction / (theta[c.VOLUME] + theta[c.PORT_VOLUME]) * period)


def free_runs(theta: Theta, period: float) -> tuple[Theta, int]:
    """Coefficients for a free run in which the nozzle goes on again, and its number of rows.

    A return flow lets the vacuum fall to where the nozzle goes on.
    """
    gas = (theta[c.VOLUME] + theta[c.PORT_VOLUME]) / (R * theta[c.TEMPERATURE])
    leaky = theta.copy()
    leaky[c.BACK_FLOW] += gas * (theta[c.H1] - theta[c.H1_LOW]) / HELD
    leaky[c.AIR_SAVING] = c.WITHOUT_CONTINUOUS
    rows_to_h1 = GAMMA * theta[c.H1] / max(_slope(theta, float(theta[c.H1]), period), LEAST_BEND)
    rows = min(int(rows_to_h1 + HELD / period) + 2 * LONGEST_WINDOW, LONGEST_RUN)
    return leaky, rows


def _as_in_free_run(detector: DetectorSettings, theta: Theta) -> DetectorSettings:
    """``detector`` with the delays and the least distance of free runs.

    Jet and sensor delay a breakpoint; the step at the port advances it. While that step oscillates
    in the line, the slope breaks again, but near the level of the last breakpoint. If the free run
    does not show how high, the window covers the oscillation, over which it averages out.
    """
    leaky, rows = free_runs(theta, detector.period)
    tight, leaking = detected_switching([theta, leaky], rows, replace(detector, on_shift=0))
    if math.isnan(tight.off) and detector.settled != NEVER:
        detector = _that_sees(detector, theta, rows)
        tight, leaking = detected_switching([theta, leaky], rows, replace(detector, on_shift=0))
    swing_period_rows = round(
        swing(theta, float(theta[c.NEAR_INERTANCE] + theta[c.INERTANCE])) / detector.period
    )
    swing_rows = min(swing_period_rows, detector.again)
    if tight.rings == 0.0 and detector.settled != NEVER and swing_rows > detector.window:
        detector = replace(detector, window=swing_rows, longest=max(detector.longest, swing_rows))
        tight, leaking = detected_switching([theta, leaky], rows, replace(detector, on_shift=0))
    most_rows = detector.on_shift + detector.window  # later, it is another breakpoint
    if AT_ONCE < tight.off_rows <= most_rows:
        detector = replace(detector, off_shift=tight.off_rows)
    if 0 < leaking.on_rows <= most_rows:
        detector = replace(detector, on_shift=leaking.on_rows)
    apart = min(RINGS * tight.rings, MOST_APART * float(theta[c.H1] - theta[c.H1_LOW]))
    sooner = SOONER * shortest_interval(theta, rows, detector.period) / detector.period
    again = max(int(min(detector.again, sooner)), detector.on_shift, detector.off_shift)
    goes_off = float(theta[c.AMBIENT_NOMINAL]) - tight.off * MBAR
    return replace(detector, again=again, apart=apart, goes_off=goes_off)


def _that_sees(detector: DetectorSettings, theta: Theta, rows: int) -> DetectorSettings:
    """A blind ``detector`` with its window doubled until it sees a free run's nozzle go off.

    While a line rings as suction begins, a narrow window takes that for the nozzle, and is blind
    to the nozzle itself. Unchanged where no window up to the longest sees it, or it never goes off.
    """
    if bend_in_free_run(theta, rows, detector.period) == 0.0:
        return detector
    for window in _doubled(detector):
        wider = replace(detector, window=window)
        (tight,) = detected_switching([theta], rows, replace(wider, on_shift=0))
        if math.isfinite(tight.off):
            return wider
    return detector


def _doubled(detector: DetectorSettings) -> Iterator[int]:
    """Wider windows, up to the longest."""
    window = detector.window
    while window < detector.longest:
        yield (window := min(2 * window, detector.longest))


def select_window(detector: DetectorSettings, blocks: Iterable[Samples]) -> DetectorSettings:
    """Settings with the narrowest window that sees the nozzle go off in most suctions of a record.

    A wider window finds breakpoints that an unexpectedly slow sensor has rounded. But it lags more
    and needs longer stretches. ``blocks`` are read again for each window.
    """
    if detector.settled == NEVER:
        return detector
    best, (best_count, suctions) = detector, _count_nozzle_off(detector, blocks)
    for window in _doubled(detector):
        if best_count == suctions:
            break
        wider = replace(detector, window=window)
        if (count := _count_nozzle_off(wider, blocks)[0]) > best_count:
            best, best_count = wider, count
    return best


def _count_nozzle_off(detector: DetectorSettings, blocks: Iterable[Samples]) -> tuple[int, int]:
    """Number of suctions in which the detector sees the nozzle go off, and of all suctions."""
    suctions, nozzle_off, last_off, was_inside = 0, 0, 0, False
    for phase in _phases(PhaseFinder(detector), blocks):
        inside = np.isin(phase, (Phase.SUCTION, Phase.HOLD))
        number = suctions + np.cumsum(np.diff(inside, prepend=was_inside) & inside)
        with_hold = np.unique(number[phase == Phase.HOLD])
        if len(with_hold):  # a suction may continue from the block before
            nozzle_off += len(with_hold) - int(with_hold[0] == last_off)
            last_off = int(with_hold[-1])
        if len(phase):
            suctions, was_inside = int(number[-1]), bool(inside[-1])
    return nozzle_off, suctions


def _phases(finder: PhaseFinder, blocks: Iterable[Samples]) -> Iterator[npt.NDArray[np.uint8]]:
    """Phases of a stream, block by block."""
    for block in blocks:
        yield finder.push(block)[1]
    yield finder.flush()[1]
