"""The table ``[figures]``: permitted values, and where key figures are kept."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Self

from pydantic import Field, model_validator

from twin.assets.configured import DatabaseSettings
from twin.config import Config
from twin.figures.expected import leakage_from_rest, t1_from_rest
from twin.model.dataset import DataSet
from twin.monitor.false_alarm_budget import LIMITS, cycles_between, student_limit
from twin.monitor.healthy import Healthy
from twin.monitor.monitor import MonitorSettings

Positive = Annotated[float, Field(gt=0.0)]
LOWEST = "lowest_supply"  # the figure whose limit is a lower one
# Least margin to the usual, in the figure's unit: less is not worth a warning. Chosen.
LEAST = {"t1": 50.0, "leakage": 10.0, LOWEST: 0.5, "highest_supply": 0.5}
LIMITED = ("t1", "leakage", "free_flow", LOWEST, "highest_supply")
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
    autoset_tolerance: Annotated[float, Field(ge=0.0, le=10.0)] = 0.25  # over the last good cycles
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


@dataclass(frozen=True)
class Limits:
    """The permitted values of one unit, all known, in the figures' units.

    ``configured`` names the figures whose limit is set, and does not follow from the data set.
    """

    t1: float  # ms; infinite if no suction of the data set reaches H1
    leakage: float  # mbar/s
    free_flow: float  # mbar
    supply: tuple[float, float]  # bar gauge
    configured: frozenset[str] = frozenset()
    changed: frozenset[str] = frozenset()  # figures whose limit a person has changed

    def source(self, figure: str) -> str:
        """Where the limit of a figure comes from, for people."""
        if figure in self.changed:
            return "changed by a person"
        return "set in [figures]" if figure in self.configured else "from the unit's data set"


def permitted(usual: float, tolerance: float, least: float) -> float:
    """The limit of a figure: ``usual`` plus a share of it, but at least ``least`` for scatter."""
    return usual + max(tolerance * usual, least)


def healthy_range(healthy: Healthy, days: float) -> dict[str, tuple[float, float]]:
    """Lowest and highest values of key figures in healthy cycles, from the commissioning.

    Healthy cycles exceed them so seldom that ``days`` lie between all false alarms. Figures that
    the commissioning did not see are left out.
    """
    cycles = cycles_between(days, LIMITS, SHORTEST_CYCLE_S)
    ranges = {}
    for name, figure in healthy.key_figures.items():
        reach = figure.estimate * student_limit(cycles, len(LIMITED), figure.cycles)
        ranges[name] = figure.mean - reach, figure.mean + reach
    return ranges


def limits_of(config: Config) -> Limits:
    """The limits of the unit of a configuration."""
    settings = config.document.section(FigureSettings, "figures")
    return limits(settings, config.data, config.monitor)


def limits(settings: FigureSettings, data: DataSet, watch: MonitorSettings) -> Limits:
    """The limits of a unit: those not set follow from its commissioning, else from its data set.

    They keep such a distance that healthy cycles exceed them no more often than ``watch`` permits.
    """
    reach = healthy_range(watch.healthy, watch.false_alarm_days)
    own = _of_commissioning(watch.healthy, reach, settings.autoset_tolerance)
    t1, leakage = settings.permitted_t1_ms, settings.permitted_leakage_mbar_s
    free_flow = settings.permitted_free_flow_mbar
    low, high = settings.supply_low_bar, settings.supply_high_bar
    chosen = {
        "t1": t1,
        "leakage": leakage,
        "free_flow": free_flow,
        LOWEST: low if high is None else high,
    }
    usual = _of_data_set(data, settings.autoset_tolerance)
    if t1 is None:
        t1 = own.get("t1", usual.t1)
    if leakage is None:
        leakage = own.get("leakage", usual.leakage)
    if free_flow is None:
        free_flow = max(usual.free_flow, *reach.get("free_flow", (-math.inf, -math.inf)))
    if low is None:
        low = own.get(LOWEST, usual.supply[0])
    if high is None:
        high = own.get("highest_supply", usual.supply[1])
    configured = frozenset(name for name, value in chosen.items() if value is not None)
    return Limits(t1, leakage, free_flow, (low, high), configured)


def _of_commissioning(
    healthy: Healthy, reach: Mapping[str, tuple[float, float]], tolerance: float
) -> dict[str, float]:
    """Limits of the key figures that the commissioning's cycles showed.

    A limit is the mean of these cycles and the tolerance, or ``reach`` where healthy cycles scatter
    more. That of the lowest supply is a lower one.
    """
    own = {}
    for name in LEAST.keys() & reach.keys():
        usual, (low, high) = healthy.key_figures[name].mean, reach[name]
        beyond = permitted(usual, tolerance, LEAST[name])
        own[name] = min(low, 2.0 * usual - beyond) if name == LOWEST else max(high, beyond)
    return own


def _of_data_set(data: DataSet, tolerance: float) -> Limits:
    """Limits of a unit whose cycles nobody has seen: what its data set expects, and the tolerance.

    Leakage may be at least what the ejector permits, and a free-flow vacuum is below H2.
    """
    ejector, nozzle_bar = data.ejector, data.supply.nozzle_bar
    leakage = permitted(leakage_from_rest(data), tolerance, LEAST["leakage"])
    highest = permitted(nozzle_bar, tolerance, LEAST[LOWEST])
    return Limits(
        permitted(t1_from_rest(data), tolerance, LEAST["t1"]),
        max(leakage, ejector.permitted_leakage_mbar_s),
        ejector.h2_mbar - ejector.h2_hysteresis_mbar,
        (2.0 * nozzle_bar - highest, highest),
    )
