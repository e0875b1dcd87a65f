"""Figures of each suction without a model: read off the curve, at any sampling rate.

Vacuum counts from the record's own idle, so an unknown ambient pressure or an offset of the sensor
changes nothing. Each figure has half of its 95 % interval, or the reason why it is missing.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from twin.config import Config
from twin.inference.levels import MAD_TO_SIGMA, SIGMAS_95
from twin.model.air import GAMMA, R
from twin.model.parts import volume
from twin.model.safeguards import LEAK_SETTLE_S
from twin.quality import UNUSABLE, Quality
from twin.signals import MBAR, ML, NS, SAMPLE, SL_MIN, Command, Samples, joined
from twin.tables.derive import shortest_half

Floats = npt.NDArray[np.float64]

LEVEL_S = 0.5  # longest time over which a level is read
LEAST_LEVEL_S = 0.1  # shortest stay of an open cup's vacuum; a decay takes twice as long
DECAY_S = 1.0  # longest time over which a decay is read
FEWEST = 5  # rows of a level or a line
CLEAR = 5.0  # sigmas of a reading
LEAST_VACUUM = 5.0  # mbar
SWING = 3.0  # mbar rms beside a line; beyond, the vacuum does not follow a line
CURVED = 0.15  # the same as a share of the move: gas that warms up loses vacuum along a curve
LONGEST_HOLE = 5.0  # usual steps without a reading
KELVIN, ROUGH = 293.15, 0.2  # gas temperature that turns a rate into a flow; its relative error


@dataclass(frozen=True)
class Reading:
    """A figure and half of its 95 % interval; NaN, with the reason ``why``, if it is missing."""

    value: float
    half: float = math.nan
    why: str = ""


@dataclass(frozen=True)
class Stretch:
    """One suction and the rows until the next; vacuum in mbar, time in s since suction begins.

    The first ``before`` rows come before suction, ``end`` is the first row after it.
    """

    begin_ns: int
    time: Floats
    pressure: Floats  # mbar
    before: int
    end: int
    begun: bool  # the record has the beginning of suction
    ended: bool  # and its end
    volume: float  # m³, of all that is evacuated; NaN if unknown

    @cached_property
    def step(self) -> float:
        """Usual time (s) between readings."""
        return float(np.median(np.diff(self.time)))

    @cached_property
    def noise(self) -> float:
        """One standard deviation of a reading (mbar), from second differences."""
        second = np.diff(self.pressure, 2)
        return float(np.median(np.abs(second))) * MAD_TO_SIGMA / math.sqrt(6.0)

    @cached_property
    def idle(self) -> float:
        """Pressure (mbar) without a command: before suction, or at the end of the rows after it."""
        before, after = self.pressure[: self.before], self.pressure[self.end :]
        pressures = before if self.begun and len(before) >= 3 else after
        return float(np.median(pressures[-self.rows(LEVEL_S) :])) if len(pressures) else math.nan

    @cached_property
    def vacuum(self) -> Floats:
        """Vacuum below idle (mbar), median of three readings."""
        vacuum = self.idle - self.pressure
        three = np.stack([vacuum[:-2], vacuum[1:-1], vacuum[2:]])
        return np.concatenate([vacuum[:1], np.median(three, axis=0), vacuum[-1:]])

    @cached_property
    def suction(self) -> slice:
        """Rows of suction."""
        return slice(self.before, self.end)

    @cached_property
    def deepest(self) -> int:
        """Row of the highest vacuum."""
        return self.before + int(self.vacuum[self.suction].argmax())

    @cached_property
    def top(self) -> float:
        """Highest vacuum (mbar)."""
        return float(self.vacuum[self.deepest])

    @cached_property
    def half(self) -> int:
        """First row of suction with half of the highest vacuum."""
        return self.before + int((self.vacuum[self.suction] >= 0.5 * self.top).argmax())

    @cached_property
    def start(self) -> float:
        """Vacuum (mbar) at which the evacuation begins: 0, or that of an open cup."""
        cup = open_cup(self)
        return 0.0 if cup.why else cup.value

    def rows(self, seconds: float) -> int:
        """Number of rows in so many seconds, at least three."""
        return max(round(seconds / self.step), 3)

    @property
    def origin(self) -> float:
        """Time (s) at which suction begins, or the evacuation if the record begins in suction."""
        if self.begun or self.half == self.before:
            return 0.0
        rows = slice(self.before, self.half + 1)
        begins = self.crossing(self.level(0.1), rows, up=True)
        return begins if math.isfinite(begins) else float(self.time[self.half])

    def level(self, share: float) -> float:
        """Vacuum (mbar) at a share of the evacuation."""
        return self.start + share * (self.top - self.start)

    def crossing(self, level: float, rows: slice, *, up: bool) -> float:
        """Time (s) at which the vacuum first passes a level in some rows; NaN if it is not seen."""
        vacuum = self.vacuum[rows]
        beyond = np.flatnonzero(vacuum >= level if up else vacuum <= level)
        if not len(beyond) or beyond[0] == 0:
            return math.nan
        row = rows.start + int(beyond[0]) - 1
        (t, u), (p, q) = self.time[row : row + 2], self.vacuum[row : row + 2]
        return (
            float(t + (u - t) * (level - p) / (q - p))
            if u - t <= LONGEST_HOLE * self.step
            else math.nan
        )


NO_IDLE = "the record has no idle, from which vacuum counts"
NO_VACUUM = "there is no vacuum"
NO_END = "the record ends before"
HOLE = "readings are missing there"
IN_VACUUM = "the record begins in the vacuum"


def highest(stretch: Stretch) -> Reading:
    """Highest vacuum (mbar); a peak between two readings may exceed it by their difference."""
    if not stretch.ended:
        return Reading(math.nan, why=NO_END)
    near = stretch.vacuum[
        max(stretch.deepest - 1, stretch.before) : min(stretch.deepest + 2, stretch.end)
    ]
    return Reading(stretch.top, max(SIGMAS_95 * stretch.noise, stretch.top - float(near.min())))


def open_cup(stretch: Stretch) -> Reading:
    """Vacuum (mbar) of an open cup before the evacuation."""
    if stretch.half == stretch.before:
        return Reading(math.nan, why=IN_VACUUM)
    ahead = stretch.vacuum[stretch.before : stretch.half]
    if len(ahead) < 2 * max(FEWEST, stretch.rows(LEAST_LEVEL_S)):
        return Reading(math.nan, why="the evacuation begins at once")
    level, width = shortest_half(ahead)
    if width > max(CLEAR * stretch.noise, SWING):
        return Reading(math.nan, why="no vacuum stands still before the evacuation")
    if level < max(LEAST_VACUUM, CLEAR * stretch.noise):
        return Reading(math.nan, why="the vacuum before the evacuation cannot be told from zero")
    return Reading(level, max(width, SIGMAS_95 * stretch.noise))


def evacuation(stretch: Stretch) -> Reading:
    """Time (ms) of the evacuation from 10 % to 90 %."""
    if stretch.top < max(LEAST_VACUUM, CLEAR * stretch.noise):
        return Reading(math.nan, why=NO_VACUUM)
    if stretch.half == stretch.before:
        return Reading(math.nan, why=IN_VACUUM)
    first = max(stretch.before - 1, 0)
    early = stretch.crossing(stretch.level(0.1), slice(first, stretch.half + 1), up=True)
    late = stretch.crossing(
        stretch.level(0.9), slice(stretch.half - 1, stretch.deepest + 1), up=True
    )
    if not math.isfinite(late - early):
        return Reading(math.nan, why=HOLE)
    return Reading(1e3 * (late - early), 1e3 * stretch.step)


def rate(stretch: Stretch) -> Reading:
    """−dp/dt over p (1/s) between 10 % and 33 % of the evacuation."""
    if stretch.half == stretch.before:
        return Reading(math.nan, why=IN_VACUUM)
    vacuum = stretch.vacuum[: stretch.half + 1]
    rows = np.flatnonzero((vacuum >= stretch.level(0.1)) & (vacuum <= stretch.level(0.33)))
    rows = rows[rows >= stretch.before]
    if len(rows) < FEWEST:
        return Reading(math.nan, why=f"too few readings in the evacuation ({len(rows)} for it)")
    slope, error, _ = _line(stretch.time[rows], np.log(stretch.pressure[rows]))
    return Reading(-slope, SIGMAS_95 * error)


def flow(stretch: Stretch) -> Reading:
    """Flow (sl/min) at ambient pressure that evacuates the volume at ``rate``."""
    evacuation_rate = rate(stretch)
    if evacuation_rate.why:
        return evacuation_rate
    if math.isnan(stretch.volume):
        return Reading(math.nan, why="the volume is not known: list it under [data.system.parts]")
    flow_per_rate = flow_behind(1.0, stretch.volume, stretch.idle * MBAR, KELVIN) / SL_MIN
    half = math.hypot(evacuation_rate.half, ROUGH * evacuation_rate.value)
    return Reading(evacuation_rate.value * flow_per_rate, half * flow_per_rate)


def decay(stretch: Stretch) -> Reading:
    """Vacuum lost per time (mbar/s) in the second after the highest."""
    elapsed = stretch.time - stretch.time[stretch.deepest]
    rows = np.flatnonzero((elapsed >= LEAK_SETTLE_S) & (elapsed <= LEAK_SETTLE_S + DECAY_S))
    rows = rows[rows < stretch.end - 1]
    if len(rows) < FEWEST or stretch.time[rows[-1]] - stretch.time[rows[0]] < 2.0 * LEAST_LEVEL_S:
        return Reading(math.nan, why="suction ends at the highest vacuum")
    slope, error, rms = _line(stretch.time[rows], stretch.vacuum[rows])
    lost = abs(slope) * float(stretch.time[rows[-1]] - stretch.time[rows[0]])
    if rms > max(CLEAR * stretch.noise, SWING, CURVED * lost):
        return Reading(math.nan, why="the vacuum swings, as an air saving lets it")
    return Reading(-slope, SIGMAS_95 * error)


def last(stretch: Stretch) -> Reading:
    """Vacuum (mbar) at the end of suction; it is below the highest after the loss of a part."""
    if not stretch.ended:
        return Reading(math.nan, why=NO_END)
    vacuum = stretch.vacuum[
        max(stretch.end - 1 - FEWEST, stretch.before) : max(stretch.end - 1, stretch.before + 1)
    ]
    return Reading(float(np.median(vacuum)), SIGMAS_95 * stretch.noise)


def release(stretch: Stretch) -> Reading:
    """Time (ms) in which the vacuum falls from 90 % to 10 % of its last value."""
    last_vacuum = last(stretch)
    if last_vacuum.why:
        return last_vacuum
    if last_vacuum.value < max(LEAST_VACUUM, CLEAR * stretch.noise):
        return Reading(math.nan, why=NO_VACUUM)
    first = max(stretch.end - 3, 0)
    released = np.flatnonzero(stretch.vacuum[first:] <= 0.1 * last_vacuum.value)
    if not len(released):
        return Reading(math.nan, why=NO_END)
    rows = slice(first, first + int(released[0]) + 1)
    early, late = (
        stretch.crossing(share * last_vacuum.value, rows, up=False) for share in (0.9, 0.1)
    )
    if not math.isfinite(late - early):
        return Reading(math.nan, why=HOLE)
    return Reading(1e3 * (late - early), 1e3 * stretch.step)


def flow_behind(rate: float, volume: float, ambient: float, temperature: float) -> float:
    """Flow (kg/s) that causes a relative change of pressure (1/s), to within a fifth.

    ``volume`` in m³, ``ambient`` in Pa, ``temperature`` in K. The mean of an isothermal and an
    adiabatic vessel.
    """
    between = (1.0 + 1.0 / GAMMA) / 2.0
    return rate * volume * ambient / (R * temperature) * between


def _line(time: Floats, values: Floats) -> tuple[float, float, float]:
    """Slope (per s) of a straight line, its standard error, and the rms of its residuals.

    The error allows for correlation of neighbouring residuals.
    """
    centred = time - time.mean()
    squares = float((centred**2).sum())
    slope = float((centred * values).sum()) / squares
    residuals = values - values.mean() - slope * centred
    rms = float(np.sqrt((residuals**2).sum() / max(len(residuals) - 2, 1)))
    correlation = float((residuals[1:] * residuals[:-1]).sum() / max((residuals**2).sum(), 1e-30))
    correlation = min(max(correlation, 0.0), 0.95)
    return slope, rms * math.sqrt((1.0 + correlation) / (1.0 - correlation) / squares), rms


@dataclass(frozen=True)
class CurveFigure:
    """One figure that needs no model."""

    name: str
    unit: str
    what: str
    of: Callable[[Stretch], Reading]


CURVE = {
    figure.name: figure
    for figure in (
        CurveFigure("highest", "mbar", "highest vacuum, below the record's own idle", highest),
        CurveFigure("open_cup", "mbar", "vacuum of an open cup before the evacuation", open_cup),
        CurveFigure("evacuation", "ms", "time from 10 % to 90 % of the highest vacuum", evacuation),
        CurveFigure("rate", "1/s", "−dp/dt over p between 10 % and 33 % of it", rate),
        CurveFigure("flow", "sl/min", "free flow: that rate times the volume", flow),
        CurveFigure("decay", "mbar/s", "vacuum lost per time in the second after it", decay),
        CurveFigure("last", "mbar", "vacuum at the end of suction", last),
        CurveFigure("release", "ms", "time from 90 % to 10 % of that", release),
    )
}


def readings(stretch: Stretch) -> dict[str, Reading]:
    """All figures of one suction."""
    if math.isnan(stretch.idle):
        return {name: Reading(math.nan, why=NO_IDLE) for name in CURVE}
    return {name: figure.of(stretch) for name, figure in CURVE.items()}


def stretches(blocks: Iterable[Samples], evacuated: float = math.nan) -> Iterator[Stretch]:
    """The suctions of a record, complete or not; volume ``evacuated`` in m³."""
    samples = joined(np.empty(0, SAMPLE), *blocks)
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(samples["pressure"])
    anew = (samples["quality"] & (Quality.RESTART | Quality.CLOCK)) != 0
    bounds = [0, *np.flatnonzero(anew[1:]) + 1, len(samples)]
    for first, last in pairwise(bounds):
        yield from _suctions(samples[first:last][usable[first:last]], evacuated)


def _suctions(rows: Samples, evacuated: float) -> Iterator[Stretch]:
    on = (rows["commands"] & Command.SUCTION.value) != 0
    edges = np.flatnonzero(np.diff(on.astype(np.int8), prepend=0, append=0))
    begins, ends = edges[::2].tolist(), edges[1::2].tolist()
    after_before = zip([0, *ends], begins, ends, [*begins[1:], len(rows)], strict=False)
    for before, begin, end, next_begin in after_before:
        section = rows[before:next_begin]
        if next_begin - before < FEWEST:
            continue
        yield Stretch(
            begin_ns=int(rows["time_ns"][begin]),
            time=(section["time_ns"] - rows["time_ns"][begin]) * NS,
            pressure=section["pressure"].astype(np.float64) / MBAR,
            before=begin - before,
            end=end - before,
            begun=begin > 0,
            ended=end < len(rows),
            volume=evacuated,
        )


def volume_of(config: Config) -> float:
    """Volume (m³) of all that is evacuated; NaN if the configuration does not list it."""
    if "parts" not in config.document.tables.get("data", {}).get("system", {}):
        return math.nan
    data = config.data
    return sum(volume(part) for part in data.system.parts) + data.ejector.port_volume_ml * ML


def table() -> str:
    """The figures as a table for people."""
    rows = [f"| `{figure.name}` | {figure.unit} | {figure.what} |" for figure in CURVE.values()]
    return "\n".join(["| figure | unit | what |", "| --- | --- | --- |", *rows])
