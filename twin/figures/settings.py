"""The table ``[figures]``: permitted values, and where key figures are kept."""

import math
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
LEAST_T1_MS = 50.0  # least margin over the usual: less is scatter
LEAST_LEAKAGE = 10.0  # mbar/s, the same
LEAST_SUPPLY_BAR = 0.5  # the same
LIMITED = ("t1", "leakage", "free_flow", "lowest_supply", "highest_supply")
NOWHERE = math.inf, -math.inf
SHORTEST_CYCLE_S = 1.0  # cycle time for which false alarms are budgeted; longer ones give fewer


class FigureSettings(DatabaseSettings):
    """What is permitted in a cycle, the field's defaults; and whether figures are kept."""

    # Longest t1; by default the data set's, with the tolerance.
    permitted_t1_ms: Positive | None = None
    # Largest leakage; by default the data set's with the tolerance, at least what the ejector
    # permits.
    permitted_leakage_mbar_s: Positive | None = None
    permitted_free_flow_mbar: Positive | None = None  # where the ejector would report a part
    supply_low_bar: Annotated[float, Field(ge=0.0)] | None = None  # gauge, at the nozzle
    supply_high_bar: Positive | None = None  # both as the data set has it, and the tolerance
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
    """The limits of a unit: those not set follow from its data set.

    They keep such a distance that healthy cycles exceed them no more often than ``watch`` permits.
    """
    reach = dict.fromkeys(LIMITED, NOWHERE) | healthy_range(watch.healthy, watch.false_alarm_days)
    t1, leakage = settings.permitted_t1_ms, settings.permitted_leakage_mbar_s
    free_flow = settings.permitted_free_flow_mbar
    low, high = settings.supply_low_bar, settings.supply_high_bar
    chosen = {
        "t1": t1,
        "leakage": leakage,
        "free_flow": free_flow,
        "lowest_supply": low if high is None else high,
    }
    ejector, tolerance, nozzle_bar = (
        data.ejector,
        settings.autoset_tolerance,
        data.supply.nozzle_bar,
    )
    if t1 is None:
        t1 = max(permitted(t1_from_rest(data), tolerance, LEAST_T1_MS), reach["t1"][1])
    if leakage is None:
        usual = permitted(leakage_from_rest(data), tolerance, LEAST_LEAKAGE)
        leakage = max(usual, ejector.permitted_leakage_mbar_s, reach["leakage"][1])
    if free_flow is None:
        free_flow = max(ejector.h2_mbar - ejector.h2_hysteresis_mbar, reach["free_flow"][1])
    if low is None:
        low = nozzle_bar - max(tolerance * nozzle_bar, LEAST_SUPPLY_BAR)
        low = min(low, reach["lowest_supply"][0])
    if high is None:
        high = max(permitted(nozzle_bar, tolerance, LEAST_SUPPLY_BAR), reach["highest_supply"][1])
    configured = frozenset(name for name, value in chosen.items() if value is not None)
    return Limits(t1, leakage, free_flow, (low, high), configured)
