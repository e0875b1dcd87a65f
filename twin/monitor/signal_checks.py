"""Check reported and ambient signals against the pressure, cycle by cycle.

A signal that contradicts the pressure is a finding of its own: a wire, a tag or a valve is wrong,
whatever the model says. A single cycle never raises one.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from twin.events import Event, Kind
from twin.inference.priors import FARTHEST, GAUGE
from twin.model import kernel
from twin.model import theta as c
from twin.model.air import R
from twin.model.theta import Theta
from twin.monitor.cycles import Cycle
from twin.monitor.measured_supply import LEAST, MOST, is_gauge, is_possible, with_nozzle_on
from twin.monitor.rows import time_steps
from twin.monitor.switching_detector import DetectorSettings, PhaseFinder
from twin.quality import BREAK, UNUSABLE
from twin.signals import BAR, MBAR, NS, SL_MIN, Command, Phase, Reported, Samples, Ticks

PATIENCE = 2  # successive cycles that must contradict, or agree again
# Permitted difference of two sensors at rest: 1 % of a vacuum sensor's bar, as in the data sheets
# of compact ejectors, and 3 mbar of a barometer.
APART = 13.0 * MBAR  # Pa
THRESHOLD = 15.0 * MBAR  # Pa, permitted difference of a switching point, which has its own sensor
WEATHER = 25.0 * MBAR  # Pa, permitted difference of ambient pressure from the data set's
LATE_S = 0.025  # s, longest delay of a report: a slow IO-Link cycle and a PLC cycle
FALLS = 0.03  # share of the vacuum; a larger rise contradicts a nozzle that is off
LEAST_FALL = 10.0 * MBAR  # Pa, least such rise
REST_ROWS, FEWEST = 20, 5  # last rows of an idle; fewest usable readings
DEEP = 100.0 * MBAR  # Pa, least fall of the pressure for which the flow is checked
# Bounds of the ratio of gas drawn off by the meter to that by the pressure. Expanding gas cools,
# so the pressure may show up to 1.4 times too much; a leak adds gas to the meter.
FLOW_RATIO = 0.5, 3.0
# A supply that reads farther from the data set's is a fault of the supply, or of its gauge: it is
# where a diagnosis listens to the gauge no more.
SUPPLY_APART = FARTHEST * GAUGE  # bar
SHOWS = 5.0 * MBAR  # Pa rms, by which another supply must move the pressure to be looked for in it
# Of that move, the least that the pressure has to show. Another ejector's law may have a third.
FOLLOWED = 0.3

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Contradiction:
    """A signal, by its tag, that the pressure contradicts: the difference, and the action."""

    signal: str
    what: str
    action: str


@dataclass(frozen=True)
class _View:
    """A cycle, prepared for the checks."""

    samples: Samples
    ticks: Ticks
    pressure: Floats  # Pa, NaN if unusable
    suction: Rows
    idle: Rows
    theta: Theta
    detector: DetectorSettings
    gauged: bool  # the data set's supply is one that was measured

    @cached_property
    def ambient(self) -> tuple[float, float]:
        """Ambient pressure and its error (Pa): of a barometer, or of an opened system at rest."""
        barometer = self.samples["ambient"][self.samples["ambient"] > 0.0]
        if len(barometer):
            return float(np.median(barometer)), 0.0
        rest = self.at_rest(self.pressure) if np.isfinite(self.theta[c.RELEASE]) else np.nan
        return (rest, 0.0) if np.isfinite(rest) else (float(self.theta[c.AMBIENT]), WEATHER)

    @property
    def vacuum(self) -> Floats:
        """Vacuum (Pa) below ambient."""
        vacuum: Floats = self.ambient[0] - self.pressure
        return vacuum

    def reported(self, bit: Reported) -> Rows:
        """Rows in which ``bit`` is set."""
        rows: Rows = (self.samples["reported"] & np.uint8(bit)) != 0
        return rows

    def at_rest(self, values: Floats) -> float:
        """Median of the last rows of idle; NaN if there are too few."""
        rows = np.flatnonzero(self.idle)[-REST_ROWS:]
        readings = values[rows][np.isfinite(values[rows])]
        return float(np.median(readings)) if len(readings) >= FEWEST else float("nan")


def check(
    cycle: Cycle, theta: Theta, detector: DetectorSettings, *, gauged: bool = False
) -> dict[str, Contradiction | None]:
    """Outcome of a whole cycle for each present signal, by its tag; None if it agrees.

    With ``gauged`` the supply of ``theta`` was measured, so a gauge is compared with it.
    """
    samples = cycle.samples
    if not _has_reports(samples):
        return {}
    usable = (samples["quality"] & UNUSABLE) == 0
    pressure = np.where(usable, samples["pressure"], np.nan).astype(np.float64)
    commands = samples["commands"] & (Command.SUCTION | Command.BLOW_OFF)
    suction, idle = commands == Command.SUCTION, commands == 0
    view = _View(samples, cycle.ticks, pressure, suction, idle, theta, detector, gauged)
    outcomes: dict[str, Contradiction | None] = {}
    for check_signal in (_nozzle, _part, _barometer, _second_pressure, _flow, _supply):
        outcomes |= check_signal(view)
    return outcomes


def standing(
    cycles: Iterable[Cycle], theta: Theta, detector: DetectorSettings, *, gauged: bool = False
) -> list[Contradiction]:
    """Contradictions of a record that occur in more than half of the cycles with an outcome.

    ``gauged`` as in ``check``.
    """
    outcomes_by_signal: dict[str, list[Contradiction | None]] = {}
    for cycle in cycles:
        for signal, contradiction in check(cycle, theta, detector, gauged=gauged).items():
            outcomes_by_signal.setdefault(signal, []).append(contradiction)
    grouped = (
        (outcomes, [contradiction for contradiction in outcomes if contradiction is not None])
        for outcomes in outcomes_by_signal.values()
    )
    return [
        contradictions[len(contradictions) // 2]
        for outcomes, contradictions in grouped
        if 2 * len(contradictions) > len(outcomes)
    ]


def _has_reports(samples: Samples) -> bool:
    has_report = samples["reported"].any() or samples["ambient"].any()
    has_report = has_report or samples["pressure_2"].any()
    return bool(has_report or np.isfinite(samples["supply"]).any())


# --- one signal after the other -------------------------------------------------------------------


def _nozzle(view: _View) -> dict[str, Contradiction | None]:
    if not view.reported(Reported.NOZZLE_KNOWN).all():
        return {}
    on = view.reported(Reported.NOZZLE)
    if np.mean(on[view.idle]) > 0.5:
        finding = "the ejector reports its nozzle on while nothing is commanded"
        return _contradicts(
            "nozzle", finding, "check whether the bit of the tag means off, or saving air"
        )
    return _unreported(view, on) or _keeps_evacuating(view, on) or {"nozzle": None}


def _unreported(view: _View, on: Rows) -> dict[str, Contradiction | None]:
    """Check for a nozzle that is reported on although the pressure shows it off."""
    unreported = view.samples.copy()
    unreported["reported"], unreported["quality"] = 0, unreported["quality"] & ~np.uint8(BREAK)
    finder = PhaseFinder(view.detector)
    phase = np.concatenate([finder.push(unreported)[1], finder.flush()[1]])
    went_off = (phase[1:] == Phase.HOLD) & (phase[:-1] == Phase.SUCTION)
    for row in (np.flatnonzero(went_off) + 1).tolist():
        window = slice(max(row - 2 * view.detector.about, 0), row + 2 * view.detector.about)
        if on[window].all():
            finding = (
                "the pressure shows that the nozzle goes off at"
                f" {_mbar(float(view.vacuum[row]))} of vacuum, and the ejector reports it on"
            )
            return _contradicts(
                "nozzle", finding, "check that the tag reads this ejector, and the right bit"
            )
    return {}


def _keeps_evacuating(view: _View, on: Rows) -> dict[str, Contradiction | None]:
    """Check for a vacuum that keeps rising although the nozzle is reported off."""
    off = np.flatnonzero(view.suction & ~on)
    if not len(off):
        return {}
    for part in np.split(off, np.flatnonzero(np.diff(off) > 1) + 1):
        begin = part[0] + view.detector.about
        if part[0] == np.flatnonzero(view.suction)[0] or part[-1] - begin < view.detector.about:
            continue  # the nozzle has not gone on yet, or was off too briefly
        first, last = (
            float(np.nanmean(view.pressure[row : row + FEWEST]))
            for row in (begin, part[-1] - FEWEST)
        )
        if first - last > max(FALLS * (view.ambient[0] - first), LEAST_FALL):
            finding = (
                "the ejector reports its nozzle off, and the vacuum goes on rising by"
                f" {_mbar(first - last)}"
            )
            return _contradicts(
                "nozzle",
                finding,
                "check whether the nozzle's valve sticks, then what the tag reads",
            )
    return {}


def _part(view: _View) -> dict[str, Contradiction | None]:
    if not view.reported(Reported.PART_KNOWN).all():
        return {}
    reported, h2 = view.reported(Reported.PART), float(view.theta[c.H2])
    if (first_report := part_at(view.samples, view.pressure)) is None:
        clearly_past = view.suction & (view.vacuum > h2 + THRESHOLD + view.ambient[1])
        rows = round(2.0 * LATE_S / _period(view.samples))
        if reported[view.suction].any() or np.count_nonzero(clearly_past) <= rows:
            return {}
        finding = f"the ejector reports no part, though the vacuum passes H2, {_mbar(h2)}"
        return _contradicts("part_present", finding, "check which bit the tag part_present reads")
    vacuum, unsure = (
        view.ambient[0] - first_report[0],
        THRESHOLD + first_report[1] + view.ambient[1],
    )
    if abs(vacuum - h2) <= unsure:
        return {"part_present": None}
    finding = f"part present comes at {_mbar(vacuum)} of vacuum; H2 is {_mbar(h2)}"
    action = f"set [data.ejector] h2_mbar = {vacuum / MBAR:.0f}, or H2 of the ejector"
    return _contradicts("part_present", finding, action)


def part_at(samples: Samples, pressure: Floats) -> tuple[float, float] | None:
    """Pressure (Pa) at which the ejector first reports a part in suction, and its error.

    The error is the fall of the pressure within the longest delay of a report. None without such a
    report.
    """
    suction = (samples["commands"] & (Command.SUCTION | Command.BLOW_OFF)) == Command.SUCTION
    reported = (samples["reported"] & np.uint8(Reported.PART)) != 0
    begins = np.flatnonzero(reported[1:] & ~reported[:-1] & suction[1:] & suction[:-1]) + 1
    if not len(begins):
        return None
    row = int(begins[0])
    late = max(round(LATE_S / _period(samples)), 1)
    before = pressure[max(row - late, 0)]
    fell = float(before - pressure[row])
    return (float(pressure[row]), max(fell, 0.0)) if np.isfinite(fell) else None


def _barometer(view: _View) -> dict[str, Contradiction | None]:
    if not view.samples["ambient"].any() or not np.isfinite(view.theta[c.RELEASE]):
        return {}  # a closed system may never reach ambient pressure
    barometer = np.where(view.samples["ambient"] > 0.0, view.samples["ambient"], np.nan)
    return _compare_at_rest(view, barometer.astype(np.float64), "ambient", "the barometer")


def _second_pressure(view: _View) -> dict[str, Contradiction | None]:
    second = np.where(view.samples["pressure_2"] > 0.0, view.samples["pressure_2"], np.nan)
    return _compare_at_rest(view, second.astype(np.float64), "pressure_2", "the second pressure")


def _compare_at_rest(
    view: _View, values: Floats, tag: str, name: str
) -> dict[str, Contradiction | None]:
    """Check that another sensor agrees with the pressure at rest."""
    difference = view.at_rest(values - view.pressure)
    if not np.isfinite(difference):
        return {}
    if abs(difference) <= APART:
        return {tag: None}
    sense = "more" if difference > 0.0 else "less"
    finding = f"at rest {name} reads {_mbar(abs(difference))} {sense} than the pressure"
    return _contradicts(
        tag, finding, f"compare both with a third, then check the scale of the tag {tag}"
    )


def _flow(view: _View) -> dict[str, Contradiction | None]:
    metered = np.flatnonzero(view.reported(Reported.FLOW_KNOWN) & view.suction)
    first = int(np.flatnonzero(view.suction)[0]) if view.suction.any() else 0
    if len(metered) < FEWEST:
        return {}
    lowest = int(np.nanargmin(np.where(view.suction, view.pressure, np.inf)))
    rows = metered[metered <= lowest]
    fell = float(np.nanmax(view.pressure[first : first + FEWEST]) - view.pressure[lowest])
    if len(rows) < FEWEST or not fell > DEEP:
        return {}
    seconds = view.samples["time_ns"] * NS
    drawn = float(np.trapezoid(view.samples["flow"][rows].astype(np.float64), seconds[rows]))
    drawn *= (seconds[lowest] - seconds[first]) / max(seconds[rows[-1]] - seconds[rows[0]], NS)
    theta = view.theta
    volume = theta[c.VOLUME] + theta[c.PORT_VOLUME] + theta[c.LINE_VOLUME]
    shown = float(volume * fell / (R * theta[c.TEMPERATURE]))
    if FLOW_RATIO[0] <= drawn / shown <= FLOW_RATIO[1]:
        return {"flow": None}
    litres = SL_MIN * 60.0
    finding = (
        f"by the flow {drawn / litres:.2g} standard litres are drawn off until"
        f" {_mbar(float(view.vacuum[lowest]))} of vacuum; the pressure shows {shown / litres:.2g}"
    )
    action = "check unit, scale and direction of the tag flow, then volumes in [data.system.parts]"
    return _contradicts("flow", finding, action)


def _supply(view: _View) -> dict[str, Contradiction | None]:
    measured = view.at_rest(view.samples["supply"].astype(np.float64) / BAR)
    usual = float(view.theta[c.SUPPLY]) / BAR
    if not is_gauge(view.samples) or not np.isfinite(measured):
        return {}
    if not is_possible(measured):
        return _impossible_at_rest(view, measured)
    if not view.gauged or abs(measured - usual) <= SUPPLY_APART:
        return {"supply": None}
    moved, share = _moved_by_supply(view, measured)
    if not moved >= SHOWS:
        return {}
    if share >= FOLLOWED:
        return {"supply": None}
    finding = (
        f"the supply reads {measured:.1f} bar; the data set has {usual:.1f}, and the pressure is as"
        " with that"
    )
    action = "check the gauge, then unit and scale of the tag supply"
    return _contradicts("supply", finding, action)


def _impossible_at_rest(view: _View, measured: float) -> dict[str, Contradiction | None]:
    """Check a gauge that reads no possible supply at rest: behind the valve it does so rightly."""
    readings = with_nozzle_on(view.samples, view.ticks)
    if not len(readings) or not _evacuates(view):
        return {}
    if is_possible(float(np.median(readings))):
        return {"supply": None}
    finding = f"the supply reads {measured:.1f} bar, and the ejector evacuates"
    action = f"check unit and scale of the tag supply: ejectors need {LEAST:g} to {MOST:g} bar"
    return _contradicts("supply", finding, action)


def _evacuates(view: _View) -> bool:
    pressure = view.pressure[np.isfinite(view.pressure)]
    return bool(len(pressure) and np.ptp(pressure) > DEEP)


def _moved_by_supply(view: _View, supply: float) -> tuple[float, float]:
    """By how much another ``supply`` (bar) moves the pressure (Pa rms), and the share it shows."""
    theta = np.stack([view.theta, view.theta], axis=1)
    theta[c.SUPPLY, 1] = supply * BAR
    dt = time_steps(view.samples)
    phase, level = view.ticks["phase"].copy(), view.ticks["level"].astype(np.float64)
    expected = np.empty((len(dt), 2))
    state, tolerance = kernel.new_state(2), kernel.COARSE_TOLERANCE
    kernel.advance(state, theta, dt, phase, level, expected, tolerance=tolerance)
    moves = expected[:, 1] - expected[:, 0]
    off = view.pressure - view.ticks["expected"]
    usable = np.isfinite(moves) & np.isfinite(off)
    power = float(moves[usable] @ moves[usable])
    if not power > 0.0:
        return 0.0, 0.0
    return float(np.sqrt(power / np.count_nonzero(usable))), float(
        moves[usable] @ off[usable]
    ) / power


def _contradicts(signal: str, finding: str, action: str) -> dict[str, Contradiction | None]:
    return {signal: Contradiction(signal, finding, action)}


def _mbar(pascal: float) -> str:
    return f"{pascal / MBAR:.0f} mbar"


def _period(samples: Samples) -> float:
    """Median time (s) from row to row."""
    steps = np.diff(samples["time_ns"][:1000])
    return max(float(np.median(steps)) * NS, NS) if len(steps) else NS


# --- while it runs --------------------------------------------------------------------------------


@dataclass
class ReportWatch:
    """Turns cycles into events: a signal contradicts the pressure, or agrees again."""

    theta: Theta
    detector: DetectorSettings
    gauged: bool = False  # as in ``check``
    _standing: dict[str, Contradiction] = field(default_factory=dict)  # reported contradictions
    _opposing: dict[str, int] = field(default_factory=dict)  # successive cycles against the report

    def take(self, cycle: Cycle) -> Iterator[Event]:
        """Check a cycle; an incomplete one is ignored."""
        if not cycle.complete:
            return
        outcomes = check(cycle, self.theta, self.detector, gauged=self.gauged)
        for signal, contradiction in outcomes.items():
            if (contradiction is None) == (signal not in self._standing):
                self._opposing[signal] = 0
                continue
            self._opposing[signal] = self._opposing.get(signal, 0) + 1
            if self._opposing[signal] >= PATIENCE:
                self._opposing[signal] = 0
                yield self._change(cycle, signal, contradiction)

    def _change(self, cycle: Cycle, signal: str, contradiction: Contradiction | None) -> Event:
        data: Mapping[str, object]
        if contradiction is None:
            del self._standing[signal]
            data = {"signal": signal, "standing": sorted(self._standing), "cycle": cycle.index}
            text = f"{signal} agrees with the pressure again"
            return Event(cycle.end_ns, Kind.SIGNAL_AGREES, text, data)
        self._standing[signal] = contradiction
        data = {"signal": signal, "standing": sorted(self._standing), "cycle": cycle.index}
        data |= {"what": contradiction.what, "action": contradiction.action}
        text = f"{contradiction.what}: {contradiction.action}"
        return Event(cycle.end_ns, Kind.SIGNAL_CONTRADICTS, text, data)
