"""The table ``[figures]``: permitted values, and where key figures are kept."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Self

from pydantic import Field, model_validator

from twin.assets.configured import DatabaseSettings
from twin.config import Config
from twin.model.dataset import DataSet
from twin.monitor.false_alarm_budget import LIMITS, cycles_between, student_limit
from twin.monitor.healthy import Healthy
from twin.monitor.settings import MonitorSettings

Positive = Annotated[float, Field(gt=0.0)]
LOWEST = "lowest_supply"  # the figure whose limit is a lower one
HIGHEST = "highest_supply"
# Least margin to the usual, in the figure's unit: less is not worth a warning. Chosen.
LEAST = {"t1": 50.0, "leakage": 10.0, "free_flow": 50.0, LOWEST: 0.5, HIGHEST: 0.5}
LIMITED = ("t1", "leakage", "free_flow", LOWEST, HIGHEST)
TOLERANCE = 0.25  # share of the usual by which a limit is beyond it, unless set. Chosen
SHORTEST_CYCLE_S = 1.0  # cycle time for which false alarms are budgeted; longer ones give fewer


class FigureSettings(DatabaseSettings):
    """What is permitted in a cycle, the field's defaults; and whether figures are kept."""

    # Longest t1; by default the commissioned unit's, else the data set's, with the tolerance.
    permitted_t1_ms: Positive | None = None
    # Largest leakage; by default the commissioned unit's with the tolerance. Else the data set's,
    # at least what the ejector permits.
    permitted_leakage_mbar_s: Positive | None = None
    permitted_free_flow_mbar: Positive | None = None  # where the ejector would report a part
    supply_low_bar: Annotated[float, Field(ge=0.0)] | None = None  # gauge, at the nozzle
    # Both by default the commissioned unit's, else the data set's, with the tolerance.
    supply_high_bar: Positive | None = None
    energy_kwh_m3: Positive = 0.12  # to compress a standard cubic metre, whole compressor station
    # Price of electric energy in the currency; or set price_per_m3.
    price_per_kwh: Positive | None = None
    # Price of 1000 Nl of compressed air (ISO 8778); or set price_per_kwh.
    price_per_m3: Positive | None = None
    currency: Annotated[str, Field(min_length=1, max_length=8)] = "€"  # symbol of the currency
    # Hours a year for yearly costs. Chosen: two shifts of 8 h on 250 days; a year has 8760.
    operating_hours: Annotated[float, Field(gt=0.0, le=8784.0)] = 4000.0
    autoset_tolerance: Annotated[float, Field(ge=0.0, le=10.0)] = TOLERANCE  # over what is usual
    keep: bool = False  # twin run adds its cycles to the database
    # Cycles older than this are deleted, and stay counted; by default all are kept.
    keep_days: Positive | None = None

    @model_validator(mode="after")
    def _range_is_one(self) -> Self:
        low, high = self.supply_low_bar, self.supply_high_bar
        if low is not None and high is not None and low >= high:
            raise ValueError("supply_low_bar must be below supply_high_bar")
        return self

    @model_validator(mode="after")
    def _price_is_one(self) -> Self:
        if self.price_per_kwh is not None and self.price_per_m3 is not None:
            raise ValueError("set price_per_kwh or price_per_m3, not both")
        return self


def permitted(usual: float, tolerance: float, least: float) -> float:
    """The limit of a figure: ``usual`` plus a share of it, but at least ``least`` for scatter."""
    return usual + max(tolerance * usual, least)


def _limit_about(name: str, usual: float, tolerance: float, least: float) -> float:
    """The limit of a figure that is usually ``usual``; that of the lowest supply is a lower one."""
    upper = permitted(usual, tolerance, least)
    return 2.0 * usual - upper if name == LOWEST else upper


@dataclass(frozen=True)
class Limits:
    """The permitted values of one unit, all known, in the figures' units.

    ``configured`` names the figures whose limit is set, ``commissioned`` those whose limit comes
    from the commissioned cycles. All others follow from the data set. ``margins`` are the least
    distances of a limit from the usual, by figure: healthy cycles scatter by less.
    """

    t1: float  # ms; infinite if no suction of the data set reaches H1
    leakage: float  # mbar/s
    free_flow: float  # mbar
    supply: tuple[float, float]  # bar gauge
    configured: frozenset[str] = frozenset()
    commissioned: frozenset[str] = frozenset()
    changed: frozenset[str] = frozenset()  # figures whose limit a person has changed
    tolerance: float = TOLERANCE
    margins: Mapping[str, float] = field(default_factory=lambda: dict(LEAST))

    def source(self, figure: str) -> str:
        """Where the limit of a figure comes from, for people."""
        if figure in self.changed:
            return "changed by a person"
        if figure in self.configured:
            return "set in [figures]"
        return (
            "from its commissioning" if figure in self.commissioned else "from the unit's data set"
        )

    def given(self, expected: Mapping[str, float]) -> "Limits":
        """The limits in a cycle of which the model expects these figures.

        Where the model itself is beyond a limit that is not set, the limit is about its figure.
        """
        return replace(
            self,
            t1=self._given("t1", self.t1, expected),
            leakage=self._given("leakage", self.leakage, expected),
            free_flow=self._given("free_flow", self.free_flow, expected),
            supply=(
                self._given(LOWEST, self.supply[0], expected),
                self._given(HIGHEST, self.supply[1], expected),
            ),
        )

    def _given(self, name: str, limit: float, expected: Mapping[str, float]) -> float:
        usual = expected[name]
        is_beyond = usual < limit if name == LOWEST else usual > limit
        if name in self.configured or not is_beyond:
            return limit
        return _limit_about(name, usual, self.tolerance, self.margins[name])


def limits_of(config: Config) -> Limits:
    """The limits of the unit of a configuration."""
    settings = config.document.section(FigureSettings, "figures")
    return limits(settings, config.data, config.monitor)


def limits(settings: FigureSettings, data: DataSet, watch: MonitorSettings) -> Limits:
    """The limits of a unit: those not set follow from its commissioning, else from its data set.

    They keep such a distance that healthy cycles exceed them no more often than ``watch`` permits.
    """
    tolerance = settings.autoset_tolerance
    reach = healthy_reach(watch.healthy, watch.false_alarm_days)
    margins = {name: max(least, reach.get(name, 0.0)) for name, least in LEAST.items()}
    configured = _set_in(settings)
    commissioned = {
        name: _limit_about(name, watch.healthy.key_figures[name].mean, tolerance, margins[name])
        for name in LEAST.keys() & reach.keys() - {"free_flow"}
    }
    if "free_flow" in reach:  # far below H2, as a rule: then H2 limits it
        highest = watch.healthy.key_figures["free_flow"].mean + reach["free_flow"]
        if highest > _of_data_set("free_flow", data, tolerance):
            commissioned["free_flow"] = highest
    known = commissioned | configured

    def limit(name: str) -> float:
        return known[name] if name in known else _of_data_set(name, data, tolerance)

    return Limits(
        limit("t1"),
        limit("leakage"),
        limit("free_flow"),
        (limit(LOWEST), limit(HIGHEST)),
        configured=frozenset(configured),
        commissioned=frozenset(commissioned.keys() - configured.keys()),
        tolerance=tolerance,
        margins=margins,
    )


def _set_in(settings: FigureSettings) -> dict[str, float]:
    """The limits that are set, by figure."""
    values = {
        "t1": settings.permitted_t1_ms,
        "leakage": settings.permitted_leakage_mbar_s,
        "free_flow": settings.permitted_free_flow_mbar,
        LOWEST: settings.supply_low_bar,
        HIGHEST: settings.supply_high_bar,
    }
    return {name: value for name, value in values.items() if value is not None}


def healthy_reach(healthy: Healthy, days: float) -> dict[str, float]:
    """How far healthy cycles come from the mean of the commissioning's, by limited figure.

    They come farther so seldom that ``days`` lie between all false alarms. Figures that the
    commissioning did not see are left out.
    """
    cycles = cycles_between(days, LIMITS, SHORTEST_CYCLE_S)
    return {
        name: figure.estimate * student_limit(cycles, len(LIMITED), figure.cycles)
        for name, figure in healthy.key_figures.items()
        if name in LIMITED
    }


def _of_data_set(name: str, data: DataSet, tolerance: float) -> float:
    """The limit of a figure that no cycle showed: what the data set expects, and the tolerance.

    Leakage may be at least what the ejector permits, and a free-flow vacuum is below H2. Those of
    t1 and leakage simulate a suction, which takes time: only where they are needed.
    """
    from twin.figures import expected  # noqa: PLC0415 - with the compiler

    ejector = data.ejector
    if name == "free_flow":
        return ejector.h2_mbar - ejector.h2_hysteresis_mbar
    if name == "t1":
        return permitted(expected.t1_from_rest(data), tolerance, LEAST[name])
    if name == "leakage":
        leakage = permitted(expected.leakage_from_rest(data), tolerance, LEAST[name])
        return max(leakage, ejector.permitted_leakage_mbar_s)
    return _limit_about(name, data.supply.nozzle_bar, tolerance, LEAST[name])
