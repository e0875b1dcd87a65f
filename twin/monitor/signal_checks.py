"""What an ejector reports and what surrounds it, checked against the pressure, cycle by cycle.

A signal that contradicts the pressure is a finding of its own: a wire, a tag or a valve is wrong,
whatever the model says. None is told of for a single cycle.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from twin.events import Event, Kind
from twin.model import theta as c
from twin.model.gas import R
from twin.model.theta import Theta
from twin.monitor.cycles import Cycle
from twin.monitor.phase_detector import Knees, PhaseFinder
from twin.signals import BREAK, MBAR, NS, SL_MIN, UNUSABLE, Command, Phase, Reported, Samples

PATIENCE = 2  # cycles running that contradict, or agree again
# Two sensors may differ by so much at rest: 1 % of a vacuum sensor's bar, as the data sheets of
# compact ejectors have it, and 3 mbar of a barometer.
APART = 13.0 * MBAR  # Pa
THRESHOLD = 15.0 * MBAR  # Pa, the same of a switching point, whose sensor is another
WEATHER = 25.0 * MBAR  # Pa, by which ambient pressure wanders about that of the data set
LATE_S = 0.025  # s, that a report may be late: a slow IO-Link cycle and a PLC's
FALLS = 0.03  # of the vacuum, that it still rises by though the nozzle is off
LEAST_FALL = 10.0 * MBAR  # Pa
REST_ROWS, FEWEST = 20, 5  # of an idle, at its end; readings of a flow
DEEP = 100.0 * MBAR  # Pa, that the pressure must fall by for its flow to be judged
# The gas that a flow carries off, over that which the pressure shows. It cools as it expands, so
# the pressure may show up to 1.4 times too much; through a leak more comes in.
FLOW_RATIO = 0.5, 3.0

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Contradiction:
    """A signal, by its tag, that the pressure contradicts: what differs, and what to do."""

    signal: str
    what: str
    action: str


@dataclass(frozen=True)
class _View:
    """A cycle as the checks see it."""

    samples: Samples
    pressure: Floats  # Pa, NaN where it cannot be used
    suction: Rows
    idle: Rows
    theta: Theta
    knees: Knees

    @cached_property
    def ambient(self) -> tuple[float, float]:
        """Pa, and by how much that is unsure: of a barometer, or of an opened system at rest."""
        barometer = self.samples["ambient"][self.samples["ambient"] > 0.0]
        if len(barometer):
            return float(np.median(barometer)), 0.0
        rest = self.at_rest(self.pressure) if np.isfinite(self.theta[c.RELEASE]) else np.nan
        return (rest, 0.0) if np.isfinite(rest) else (float(self.theta[c.AMBIENT]), WEATHER)

    @property
    def vacuum(self) -> Floats:
        """Pa below ambient."""
        below: Floats = self.ambient[0] - self.pressure
        return below

    def reported(self, bit: Reported) -> Rows:
        """Where it is set."""
        rows: Rows = (self.samples["reported"] & np.uint8(bit)) != 0
        return rows

    def at_rest(self, values: Floats) -> float:
        """Median of the last rows of idle; NaN where there are few."""
        rows = np.flatnonzero(self.idle)[-REST_ROWS:]
        found = values[rows][np.isfinite(values[rows])]
        return float(np.median(found)) if len(found) >= FEWEST else float("nan")


def check(cycle: Cycle, theta: Theta, knees: Knees) -> dict[str, Contradiction | None]:
    """What a whole cycle says to each signal that is there, by its tag; None where it agrees."""
    samples = cycle.samples
    if not _any(samples):
        return {}
    usable = (samples["quality"] & UNUSABLE) == 0
    pressure = np.where(usable, samples["pressure"], np.nan).astype(np.float64)
    commands = samples["commands"] & (Command.SUCTION | Command.BLOW_OFF)
    view = _View(samples, pressure, commands == Command.SUCTION, commands == 0, theta, knees)
    found: dict[str, Contradiction | None] = {}
    for one in (_nozzle, _part, _barometer, _second, _flow):
        found |= one(view)
    return found


def standing(cycles: Iterable[Cycle], theta: Theta, knees: Knees) -> list[Contradiction]:
    """The signals of a record that contradict in more than half of the cycles that show it."""
    found: dict[str, list[Contradiction | None]] = {}
    for cycle in cycles:
        for signal, one in check(cycle, theta, knees).items():
            found.setdefault(signal, []).append(one)
    told = ((some, [one for one in some if one is not None]) for some in found.values())
    return [against[len(against) // 2] for some, against in told if 2 * len(against) > len(some)]


def _any(samples: Samples) -> bool:
    there = samples["reported"].any() or samples["ambient"].any()
    return bool(there or samples["pressure_2"].any())


# --- one signal after the other -------------------------------------------------------------------


def _nozzle(view: _View) -> dict[str, Contradiction | None]:
    if not view.reported(Reported.NOZZLE_KNOWN).all():
        return {}
    on = view.reported(Reported.NOZZLE)
    if np.mean(on[view.idle]) > 0.5:
        what = "the ejector reports its nozzle on while nothing is commanded"
        return _says("nozzle", what, "check whether the bit of the tag means off, or saving air")
    return _unreported(view, on) or _goes_on(view, on) or {"nozzle": None}


def _unreported(view: _View, on: Rows) -> dict[str, Contradiction | None]:
    """The pressure shows that the nozzle went off, and it is reported on."""
    alone = view.samples.copy()
    alone["reported"], alone["quality"] = 0, alone["quality"] & ~np.uint8(BREAK)
    finder = PhaseFinder(view.knees)
    phase = np.concatenate([finder.push(alone)[1], finder.flush()[1]])
    went_off = (phase[1:] == Phase.HOLD) & (phase[:-1] == Phase.SUCTION)
    for row in (np.flatnonzero(went_off) + 1).tolist():
        about = slice(max(row - 2 * view.knees.about, 0), row + 2 * view.knees.about)
        if on[about].all():
            what = (
                "the pressure shows that the nozzle goes off at"
                f" {_mbar(float(view.vacuum[row]))} of vacuum, and the ejector reports it on"
            )
            return _says("nozzle", what, "check that the tag reads this ejector, and the right bit")
    return {}


def _goes_on(view: _View, on: Rows) -> dict[str, Contradiction | None]:
    """The nozzle is reported off, and the vacuum goes on rising."""
    off = np.flatnonzero(view.suction & ~on)
    if not len(off):
        return {}
    for part in np.split(off, np.flatnonzero(np.diff(off) > 1) + 1):
        begin = part[0] + view.knees.about
        if part[0] == np.flatnonzero(view.suction)[0] or part[-1] - begin < view.knees.about:
            continue  # it has not begun yet, or not for long
        first, last = (
            float(np.nanmean(view.pressure[one : one + FEWEST]))
            for one in (begin, part[-1] - FEWEST)
        )
        if first - last > max(FALLS * (view.ambient[0] - first), LEAST_FALL):
            what = (
                "the ejector reports its nozzle off, and the vacuum goes on rising by"
                f" {_mbar(first - last)}"
            )
            return _says(
                "nozzle", what, "check whether the nozzle's valve sticks, then what the tag reads"
            )
    return {}


def _part(view: _View) -> dict[str, Contradiction | None]:
    if not view.reported(Reported.PART_KNOWN).all():
        return {}
    told, h2 = view.reported(Reported.PART), float(view.theta[c.H2])
    if (at := part_at(view.samples, view.pressure)) is None:
        sure = view.suction & (view.vacuum > h2 + THRESHOLD + view.ambient[1])
        rows = round(2.0 * LATE_S / _period(view.samples))
        if told[view.suction].any() or np.count_nonzero(sure) <= rows:
            return {}
        what = f"the ejector reports no part, though the vacuum passes H2, {_mbar(h2)}"
        return _says("part_present", what, "check which bit the tag part_present reads")
    vacuum, unsure = view.ambient[0] - at[0], THRESHOLD + at[1] + view.ambient[1]
    if abs(vacuum - h2) <= unsure:
        return {"part_present": None}
    what = f"part present comes at {_mbar(vacuum)} of vacuum; H2 is {_mbar(h2)}"
    action = f"set [data.ejector] h2_mbar = {vacuum / MBAR:.0f}, or H2 of the ejector"
    return _says("part_present", what, action)


def part_at(samples: Samples, pressure: Floats) -> tuple[float, float] | None:
    """Pressure (Pa) at which the ejector first reports a part, and by how much that is unsure.

    Within so long as a report may be late the pressure falls on. None where suction shows no such
    moment.
    """
    suction = (samples["commands"] & (Command.SUCTION | Command.BLOW_OFF)) == Command.SUCTION
    told = (samples["reported"] & np.uint8(Reported.PART)) != 0
    begins = np.flatnonzero(told[1:] & ~told[:-1] & suction[1:] & suction[:-1]) + 1
    if not len(begins):
        return None
    row = int(begins[0])
    late = max(round(LATE_S / _period(samples)), 1)
    before = pressure[max(row - late, 0)]
    fell = float(before - pressure[row])
    return (float(pressure[row]), max(fell, 0.0)) if np.isfinite(fell) else None


def _barometer(view: _View) -> dict[str, Contradiction | None]:
    if not view.samples["ambient"].any() or not np.isfinite(view.theta[c.RELEASE]):
        return {}  # a closed system need not come to ambient pressure
    barometer = np.where(view.samples["ambient"] > 0.0, view.samples["ambient"], np.nan)
    return _apart(view, barometer.astype(np.float64), "ambient", "the barometer")


def _second(view: _View) -> dict[str, Contradiction | None]:
    second = np.where(view.samples["pressure_2"] > 0.0, view.samples["pressure_2"], np.nan)
    return _apart(view, second.astype(np.float64), "pressure_2", "the second pressure")


def _apart(view: _View, values: Floats, tag: str, name: str) -> dict[str, Contradiction | None]:
    """Whether another sensor reads what the pressure does while all is at rest."""
    apart = view.at_rest(values - view.pressure)
    if not np.isfinite(apart):
        return {}
    if abs(apart) <= APART:
        return {tag: None}
    more = "more" if apart > 0.0 else "less"
    what = f"at rest {name} reads {_mbar(abs(apart))} {more} than the pressure"
    return _says(tag, what, f"compare both with a third, then check the scale of the tag {tag}")


def _flow(view: _View) -> dict[str, Contradiction | None]:
    known = np.flatnonzero(view.reported(Reported.FLOW_KNOWN) & view.suction)
    first = int(np.flatnonzero(view.suction)[0]) if view.suction.any() else 0
    if len(known) < FEWEST:
        return {}
    lowest = int(np.nanargmin(np.where(view.suction, view.pressure, np.inf)))
    rows = known[known <= lowest]
    fell = float(np.nanmax(view.pressure[first : first + FEWEST]) - view.pressure[lowest])
    if len(rows) < FEWEST or not fell > DEEP:
        return {}
    seconds = view.samples["time_ns"] * NS
    carried = float(np.trapezoid(view.samples["flow"][rows].astype(np.float64), seconds[rows]))
    carried *= (seconds[lowest] - seconds[first]) / max(seconds[rows[-1]] - seconds[rows[0]], NS)
    theta = view.theta
    volume = theta[c.VOLUME] + theta[c.PORT_VOLUME] + theta[c.LINE_VOLUME]
    shown = float(volume * fell / (R * theta[c.TEMPERATURE]))
    if FLOW_RATIO[0] <= carried / shown <= FLOW_RATIO[1]:
        return {"flow": None}
    litres = SL_MIN * 60.0
    what = (
        f"by the flow {carried / litres:.2g} standard litres are drawn off until"
        f" {_mbar(float(view.vacuum[lowest]))} of vacuum; the pressure shows {shown / litres:.2g}"
    )
    action = "check unit, scale and direction of the tag flow, then volumes in [data.system.parts]"
    return _says("flow", what, action)


def _says(signal: str, what: str, action: str) -> dict[str, Contradiction | None]:
    return {signal: Contradiction(signal, what, action)}


def _mbar(pascal: float) -> str:
    return f"{pascal / MBAR:.0f} mbar"


def _period(samples: Samples) -> float:
    """Time (s) from row to row."""
    steps = np.diff(samples["time_ns"][:1000])
    return max(float(np.median(steps)) * NS, NS) if len(steps) else NS


# --- while it runs --------------------------------------------------------------------------------


@dataclass
class ReportWatch:
    """Takes cycles in, gives events out: when a signal contradicts, and when it agrees again."""

    theta: Theta
    knees: Knees
    _standing: dict[str, Contradiction] = field(default_factory=dict)  # told of
    _running: dict[str, int] = field(default_factory=dict)  # cycles that say otherwise

    def take(self, cycle: Cycle) -> Iterator[Event]:
        """Check a cycle; one that is not whole says nothing."""
        if not cycle.complete:
            return
        for signal, found in check(cycle, self.theta, self.knees).items():
            if (found is None) == (signal not in self._standing):
                self._running[signal] = 0
                continue
            self._running[signal] = self._running.get(signal, 0) + 1
            if self._running[signal] >= PATIENCE:
                self._running[signal] = 0
                yield self._turned(cycle, signal, found)

    def _turned(self, cycle: Cycle, signal: str, found: Contradiction | None) -> Event:
        data: Mapping[str, object]
        if found is None:
            del self._standing[signal]
            data = {"signal": signal, "standing": sorted(self._standing), "cycle": cycle.index}
            text = f"{signal} agrees with the pressure again"
            return Event(cycle.end_ns, Kind.SIGNAL_AGREES, text, data)
        self._standing[signal] = found
        data = {"signal": signal, "standing": sorted(self._standing), "cycle": cycle.index}
        data |= {"what": found.what, "action": found.action}
        text = f"{found.what}: {found.action}"
        return Event(cycle.end_ns, Kind.SIGNAL_CONTRADICTS, text, data)
