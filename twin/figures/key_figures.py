"""The table of key figures: name, unit, description, and the function that computes each.

Names and definitions are the field's, as condition monitoring of compact ejectors reports them. An
unknown figure is NaN; none is guessed.
"""

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from twin.model.dataset import DataSet
from twin.signals import BAR, MBAR

if TYPE_CHECKING:  # it loads the compiler, and a configuration needs only the names of figures
    from twin.figures.cycle_view import CycleFindings, Rows

BANDS = (67.0, 133.0, 200.0)  # mbar/s, of leakage
WORST_LEAKAGE = 500.0  # mbar/s: quality 0
FREE_SUCTION_S = 1.0  # at least, for a free-flow vacuum
STEADY = 10.0  # mbar/s: a free-flow vacuum moves by less at the end of suction
LEAST_FREE_FLOW = 5.0  # mbar: less cannot be told from zero
UNKNOWN = math.nan
NO_DASH = {"-": "", "0 or 1": "", "0 to 3": ""}  # units that no text states


@dataclass(frozen=True)
class Unit:
    """Properties of the ejector that figures need besides the cycle."""

    data: DataSet
    energy_kwh_m3: float

    @property
    def h1(self) -> float:
        """Vacuum at which the air saving switches the nozzle off (mbar)."""
        return self.data.ejector.h1_mbar

    @property
    def h2(self) -> float:
        """Vacuum from which a part is present (mbar)."""
        return self.data.ejector.h2_mbar


Of = Callable[["CycleFindings", Unit], float]


@dataclass(frozen=True)
class Figure:
    """One key figure."""

    name: str
    unit: str
    what: str
    of: Of

    @property
    def title(self) -> str:
        """The name for people. H1 keeps its capital: h1 is the hysteresis."""
        return self.name.replace("_", " ").replace("h1", "H1")


def t0(findings: "CycleFindings", _unit: Unit) -> float:
    """Evacuation time to H2 (ms)."""
    return findings.vacuum.h2_s * 1e3


def t1(findings: "CycleFindings", _unit: Unit) -> float:
    """Evacuation time from H2 to H1 (ms), or to the air saving's switching if there is one."""
    if not findings.vacuum.seamless:
        return UNKNOWN
    h1 = findings.nozzle.off_s if findings.nozzle.went_off else findings.vacuum.h1_s
    passed = h1 - findings.vacuum.h2_s
    return passed * 1e3 if passed > 0.0 else UNKNOWN  # the sensor is too slow to tell


def leakage(findings: "CycleFindings", _unit: Unit) -> float:
    """Vacuum lost per time (mbar/s): slope of a line through the first stretch of hold."""
    return findings.vacuum.leakage


def leakage_band(findings: "CycleFindings", unit: Unit) -> float:
    """Band of the leakage, as the field has them: 0 is good, 3 is beyond the last."""
    lost = leakage(findings, unit)
    return UNKNOWN if math.isnan(lost) else float(bisect_right(BANDS, lost))


def quality(findings: "CycleFindings", unit: Unit) -> float:
    """Quality (%) from the leakage: 100 without any."""
    return _percent(1.0 - leakage(findings, unit) / WORST_LEAKAGE)


def free_flow(findings: "CycleFindings", unit: Unit) -> float:
    """Vacuum (mbar) at which suction settles below H1, as with the cup open."""
    if not findings.is_even or (findings.is_whole and findings.nozzle.went_off):
        return UNKNOWN
    if findings.suction_s < FREE_SUCTION_S or abs(findings.vacuum.last_slope) > STEADY:
        return UNKNOWN
    free = findings.vacuum.last >= LEAST_FREE_FLOW and findings.vacuum.highest < unit.h1
    return findings.vacuum.last if free else UNKNOWN


def performance(findings: "CycleFindings", unit: Unit) -> float:
    """Performance (%) from the free-flow vacuum: 100 without any restriction, 0 at H1."""
    return _percent(1.0 - free_flow(findings, unit) / unit.h1)


def max_vacuum(findings: "CycleFindings", _unit: Unit) -> float:
    """Highest vacuum (mbar)."""
    return findings.vacuum.highest if findings.is_even else UNKNOWN


def h1_not_reached(findings: "CycleFindings", unit: Unit) -> float:
    """1 if suction ended before H1 was reached, else 0."""
    if findings.vacuum.seamless and findings.nozzle.went_off:
        return 0.0
    highest = max_vacuum(findings, unit)
    return UNKNOWN if math.isnan(highest) else float(highest < unit.h1)


def nozzle_share(findings: "CycleFindings", _unit: Unit) -> float:
    """Share of the suction time in which the nozzle was on (%)."""
    return 100.0 * _nozzle_s(findings) / findings.suction_s if findings.suction_s else UNKNOWN


def air(findings: "CycleFindings", unit: Unit) -> float:
    """Compressed air (Nl) through nozzle and blow-off."""
    if not findings.blown:
        return UNKNOWN
    ejector = unit.data.ejector
    nominal = _nozzle_s(findings) * ejector.air_consumption_sl_min
    nominal += findings.blow_off_s * ejector.blow_off_sl_min
    return nominal * _pressed(findings, unit) / 60.0


def energy(findings: "CycleFindings", unit: Unit) -> float:
    """Electric energy (Wh) to compress that air."""
    return air(findings, unit) * unit.energy_kwh_m3


def switchings(findings: "CycleFindings", _unit: Unit) -> float:
    """Number of times the nozzle was switched on."""
    return float(findings.nozzle.switchings) if findings.is_whole else UNKNOWN


def quick_switchings(findings: "CycleFindings", _unit: Unit) -> float:
    """Most switchings of the air saving, on or off, within the time of valve protection."""
    return float(findings.nozzle.quick_switchings) if findings.is_whole else UNKNOWN


def supply(findings: "CycleFindings", _unit: Unit) -> float:
    """Mean operating pressure while the nozzle was on (bar)."""
    return findings.supply.mean


def lowest_supply(findings: "CycleFindings", _unit: Unit) -> float:
    """Lowest operating pressure while the nozzle was on (bar)."""
    return findings.supply.lowest


def highest_supply(findings: "CycleFindings", _unit: Unit) -> float:
    """Highest operating pressure while the nozzle was on (bar)."""
    return findings.supply.highest


def _nozzle_s(findings: "CycleFindings") -> float:
    """Time that the nozzle was on (s); unknown if a switching may have been missed."""
    return findings.nozzle.on_s if findings.is_whole else UNKNOWN


def _pressed(findings: "CycleFindings", unit: Unit) -> float:
    """Absolute operating pressure over that of the data set: a sonic nozzle's flow follows it."""
    ambient, nominal = unit.data.ambient.pressure_mbar * MBAR / BAR, unit.data.supply.nozzle_bar
    measured_bar = supply(findings, unit)
    return 1.0 if math.isnan(measured_bar) else (measured_bar + ambient) / (nominal + ambient)


def _percent(share: float) -> float:
    return 100.0 * min(max(share, 0.0), 1.0) if math.isfinite(share) else UNKNOWN


FIGURES = {
    figure.name: figure
    for figure in (
        Figure("t0", "ms", "evacuation time: suction on until H2", t0),
        Figure("t1", "ms", "evacuation time: H2 until H1", t1),
        Figure(
            "leakage",
            "mbar/s",
            "vacuum lost per time after the air saving switched the nozzle off at H1",
            leakage,
        ),
        Figure(
            "leakage_band",
            "0 to 3",
            "band of the leakage: below 67, 133, 200 mbar/s, or beyond",
            leakage_band,
        ),
        Figure("quality", "%", "from the leakage: 100 % without any, 0 % at 500 mbar/s", quality),
        Figure(
            "free_flow",
            "mbar",
            "free-flow vacuum: where a second of suction stands still, from 5 mbar to H1",
            free_flow,
        ),
        Figure(
            "performance", "%", "from the free-flow vacuum: 100 % at 0 mbar, 0 % at H1", performance
        ),
        Figure("max_vacuum", "mbar", "highest vacuum in the cycle", max_vacuum),
        Figure("h1_not_reached", "0 or 1", "suction ended without H1", h1_not_reached),
        Figure(
            "nozzle_share",
            "%",
            "valve-on time: share of the suction time with the nozzle on",
            nozzle_share,
        ),
        Figure("air", "Nl", "compressed air through nozzle and blow-off", air),
        Figure("energy", "Wh", "electric energy to compress that air", energy),
        Figure("switchings", "-", "how often the nozzle was switched on", switchings),
        Figure(
            "quick_switchings",
            "-",
            "most switchings of the air saving within 3 s; valve protection begins at 6",
            quick_switchings,
        ),
        Figure("supply", "bar", "mean operating pressure while the nozzle was on", supply),
        Figure("lowest_supply", "bar", "the lowest of it (1 %)", lowest_supply),
        Figure("highest_supply", "bar", "the highest of it (99 %)", highest_supply),
    )
}


def figures(rows: "Rows", unit: Unit) -> dict[str, float]:
    """All key figures of one side of a cycle; NaN if unknown."""
    from twin.figures.cycle_view import find_in_cycle  # noqa: PLC0415 - as above

    findings = find_in_cycle(rows, unit.h2, unit.h1)
    return {name: figure.of(findings, unit) for name, figure in FIGURES.items()}


def table() -> str:
    """The figures as a table for people."""
    rows = [f"| `{figure.name}` | {figure.unit} | {figure.what} |" for figure in FIGURES.values()]
    return "\n".join(["| figure | unit | what |", "| --- | --- | --- |", *rows])
