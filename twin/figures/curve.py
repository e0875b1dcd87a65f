"""What a record shows of each suction without a model: figures read off the curve, at any cadence.

Vacuum counts from the record's own idle, so an unknown ambient pressure or an offset of the sensor
changes nothing. Each figure has the half of its 95 % interval, or the reason why it is not told.
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
from twin.model.control import LEAK_SETTLE_S
from twin.model.gas import GAMMA, R
from twin.model.system import volume
from twin.signals import (
    MBAR,
    ML,
    NS,
    SAMPLE,
    SL_MIN,
    UNUSABLE,
    Command,
    Quality,
    Samples,
    joined,
)
from twin.tables.derive import shortest_half

Floats = npt.NDArray[np.float64]

LEVEL_S = 0.5  # at most, over which a level is read
LEAST_LEVEL_S = 0.1  # that an open cup stands, and twice of it that a decay takes
DECAY_S = 1.0  # at most, over which a decay is read
FEWEST = 5  # rows of a level or a line
CLEAR = 5.0  # sigmas of a reading
LEAST_VACUUM = 5.0  # mbar
SWING = 3.0  # mbar beside a line, beyond which the vacuum does not follow one
CURVED = 0.15  # of what it moves by: gas that warms up loses vacuum along a curve
LONGEST_HOLE = 5.0  # usual steps without a reading
KELVIN, ROUGH = 293.15, 0.2  # of the gas, to turn a rate into a flow; and the share it may be off


@dataclass(frozen=True)
class Reading:
    """A figure and the half of its 95 % interval; NaN, and ``why``, where it is not told."""

    value: float
    half: float = math.nan
    why: str = ""


@dataclass(frozen=True)
class Stretch:
    """One suction and what follows until the next; vacuum in mbar, time in s since its first row.

    ``before`` rows are idle before it, ``end`` is the first row without suction.
    """

    begin_ns: int
    time: Floats
    pressure: Floats  # mbar
    before: int
    end: int
    begun: bool  # the record has the beginning of suction
    ended: bool  # and its end
    volume: float  # m³, of all that is evacuated; NaN where nobody said

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
        """Pressure (mbar) at which nothing is commanded: before suction, or at the end after it."""
        before, after = self.pressure[: self.before], self.pressure[self.end :]
        rest = before if self.begun and len(before) >= 3 else after
        return float(np.median(rest[-self.rows(LEVEL_S) :])) if len(rest) else math.nan

    @cached_property
    def vacuum(self) -> Floats:
        """Below idle (mbar), median of three."""
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
        """First row of suction with half of it: the evacuation is under way."""
        return self.before + int((self.vacuum[self.suction] >= 0.5 * self.top).argmax())

    @cached_property
    def start(self) -> float:
        """Vacuum (mbar) from which the evacuation begins: none, or that of an open cup."""
        found = open_cup(self)
        return 0.0 if found.why else found.value

    def rows(self, seconds: float) -> int:
        """Rows in so many seconds, three at least."""
        return max(round(seconds / self.step), 3)

    @property
    def origin(self) -> float:
        """When (s) suction begins; where the record begins in it, when the evacuation does."""
        if self.begun or self.half == self.before:
            return 0.0
        rows = slice(self.before, self.half + 1)
        begins = self.crossing(self.level(0.1), rows, up=True)
        return begins if math.isfinite(begins) else float(self.time[self.half])

    def level(self, share: float) -> float:
        """Vacuum (mbar) at a share of the evacuation's way."""
        return self.start + share * (self.top - self.start)

    def crossing(self, level: float, rows: slice, *, up: bool) -> float:
        """When (s) the vacuum passes a level for the first time in some rows; NaN if unseen."""
        part = self.vacuum[rows]
        beyond = np.flatnonzero(part >= level if up else part <= level)
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


def highest(one: Stretch) -> Reading:
    """Highest vacuum (mbar); a peak between two readings may be higher by what they differ by."""
    if not one.ended:
        return Reading(math.nan, why=NO_END)
    near = one.vacuum[max(one.deepest - 1, one.before) : min(one.deepest + 2, one.end)]
    return Reading(one.top, max(SIGMAS_95 * one.noise, one.top - float(near.min())))


def open_cup(one: Stretch) -> Reading:
    """Vacuum (mbar) at which an open cup stands before the evacuation."""
    if one.half == one.before:
        return Reading(math.nan, why=IN_VACUUM)
    ahead = one.vacuum[one.before : one.half]
    if len(ahead) < 2 * max(FEWEST, one.rows(LEAST_LEVEL_S)):
        return Reading(math.nan, why="the evacuation begins at once")
    level, apart = shortest_half(ahead)
    if apart > max(CLEAR * one.noise, SWING):
        return Reading(math.nan, why="no vacuum stands still before the evacuation")
    if level < max(LEAST_VACUUM, CLEAR * one.noise):
        return Reading(math.nan, why="the vacuum before the evacuation is not told from none")
    return Reading(level, max(apart, SIGMAS_95 * one.noise))


def evacuation(one: Stretch) -> Reading:
    """Time (ms) from a tenth to nine tenths of the way to the highest vacuum."""
    if one.top < max(LEAST_VACUUM, CLEAR * one.noise):
        return Reading(math.nan, why=NO_VACUUM)
    if one.half == one.before:
        return Reading(math.nan, why=IN_VACUUM)
    first = max(one.before - 1, 0)
    early = one.crossing(one.level(0.1), slice(first, one.half + 1), up=True)
    late = one.crossing(one.level(0.9), slice(one.half - 1, one.deepest + 1), up=True)
    if not math.isfinite(late - early):
        return Reading(math.nan, why=HOLE)
    return Reading(1e3 * (late - early), 1e3 * one.step)


def rate(one: Stretch) -> Reading:
    """−dp/dt over p (1/s) between a tenth and a third of the way to the highest vacuum."""
    if one.half == one.before:
        return Reading(math.nan, why=IN_VACUUM)
    part = one.vacuum[: one.half + 1]
    rows = np.flatnonzero((part >= one.level(0.1)) & (part <= one.level(0.33)))
    rows = rows[rows >= one.before]
    if len(rows) < FEWEST:
        return Reading(math.nan, why=f"too few readings in the evacuation ({len(rows)} for it)")
    slope, error, _ = _line(one.time[rows], np.log(one.pressure[rows]))
    return Reading(-slope, SIGMAS_95 * error)


def flow(one: Stretch) -> Reading:
    """Flow (sl/min) at ambient pressure that evacuates the volume at that rate."""
    found = rate(one)
    if found.why:
        return found
    if math.isnan(one.volume):
        return Reading(math.nan, why="the volume is not known: list it under [data.system.parts]")
    each = flow_behind(1.0, one.volume, one.idle * MBAR, KELVIN) / SL_MIN
    half = math.hypot(found.half, ROUGH * found.value)
    return Reading(found.value * each, half * each)


def decay(one: Stretch) -> Reading:
    """Vacuum lost per time (mbar/s) in the second after the highest."""
    since = one.time - one.time[one.deepest]
    rows = np.flatnonzero((since >= LEAK_SETTLE_S) & (since <= LEAK_SETTLE_S + DECAY_S))
    rows = rows[rows < one.end - 1]
    if len(rows) < FEWEST or one.time[rows[-1]] - one.time[rows[0]] < 2.0 * LEAST_LEVEL_S:
        return Reading(math.nan, why="suction ends at the highest vacuum")
    slope, error, left = _line(one.time[rows], one.vacuum[rows])
    moved = abs(slope) * float(one.time[rows[-1]] - one.time[rows[0]])
    if left > max(CLEAR * one.noise, SWING, CURVED * moved):
        return Reading(math.nan, why="the vacuum swings, as an air saving lets it")
    return Reading(-slope, SIGMAS_95 * error)


def last(one: Stretch) -> Reading:
    """Vacuum (mbar) at the end of suction: below the highest where a part was lost."""
    if not one.ended:
        return Reading(math.nan, why=NO_END)
    part = one.vacuum[max(one.end - 1 - FEWEST, one.before) : max(one.end - 1, one.before + 1)]
    return Reading(float(np.median(part)), SIGMAS_95 * one.noise)


def release(one: Stretch) -> Reading:
    """Time (ms) in which the vacuum falls from nine tenths of its last to one."""
    at_last = last(one)
    if at_last.why:
        return at_last
    if at_last.value < max(LEAST_VACUUM, CLEAR * one.noise):
        return Reading(math.nan, why=NO_VACUUM)
    first = max(one.end - 3, 0)
    gone = np.flatnonzero(one.vacuum[first:] <= 0.1 * at_last.value)
    if not len(gone):
        return Reading(math.nan, why=NO_END)
    rows = slice(first, first + int(gone[0]) + 1)
    early, late = (one.crossing(share * at_last.value, rows, up=False) for share in (0.9, 0.1))
    if not math.isfinite(late - early):
        return Reading(math.nan, why=HOLE)
    return Reading(1e3 * (late - early), 1e3 * one.step)


def flow_behind(rate: float, volume: float, ambient: float, temperature: float) -> float:
    """Flow (kg/s) behind a relative change of pressure (1/s), within a fifth.

    ``volume`` in m³, ``ambient`` in Pa, ``temperature`` in K. Half-way between a vessel that stays
    as warm as its wall and one without any heat from it.
    """
    between = (1.0 + 1.0 / GAMMA) / 2.0
    return rate * volume * ambient / (R * temperature) * between


def _line(time: Floats, values: Floats) -> tuple[float, float, float]:
    """Slope (per s) of a straight line, its standard error, and the rms beside the line.

    The error counts neighbouring residuals that are alike.
    """
    since = time - time.mean()
    squares = float((since**2).sum())
    slope = float((since * values).sum()) / squares
    left = values - values.mean() - slope * since
    rms = float(np.sqrt((left**2).sum() / max(len(left) - 2, 1)))
    alike = float((left[1:] * left[:-1]).sum() / max((left**2).sum(), 1e-30))
    alike = min(max(alike, 0.0), 0.95)
    return slope, rms * math.sqrt((1.0 + alike) / (1.0 - alike) / squares), rms


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


def readings(one: Stretch) -> dict[str, Reading]:
    """All figures of one suction."""
    if math.isnan(one.idle):
        return {name: Reading(math.nan, why=NO_IDLE) for name in CURVE}
    return {name: figure.of(one) for name, figure in CURVE.items()}


def stretches(blocks: Iterable[Samples], evacuated: float = math.nan) -> Iterator[Stretch]:
    """The suctions of a record, whole or in part; volume ``evacuated`` in m³."""
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
    for before, begin, end, behind in after_before:
        part = rows[before:behind]
        if behind - before < FEWEST:
            continue
        yield Stretch(
            begin_ns=int(rows["time_ns"][begin]),
            time=(part["time_ns"] - rows["time_ns"][begin]) * NS,
            pressure=part["pressure"].astype(np.float64) / MBAR,
            before=begin - before,
            end=end - before,
            begun=begin > 0,
            ended=end < len(rows),
            volume=evacuated,
        )


def volume_of(config: Config) -> float:
    """Volume (m³) of all that is evacuated; NaN where the configuration does not list it."""
    if "parts" not in config.document.tables.get("data", {}).get("system", {}):
        return math.nan
    data = config.data
    return sum(volume(part) for part in data.system.parts) + data.ejector.port_volume_ml * ML


def table() -> str:
    """The figures as a table for people."""
    rows = [f"| `{one.name}` | {one.unit} | {one.what} |" for one in CURVE.values()]
    return "\n".join(["| figure | unit | what |", "| --- | --- | --- |", *rows])
