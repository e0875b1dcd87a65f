"""Limits that people may change during a run: which, in which range, and what is in force."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

from twin.alarms.database_url import open_chosen
from twin.alarms.requests import LimitChange
from twin.alarms.settings import AlarmSettings
from twin.assets.unit import Unit
from twin.config import Config
from twin.errors import ConfigError, SourceError, known_names
from twin.figures.settings import FigureSettings, Limits, limits
from twin.languages.texts import numeral, tr
from twin.model.dataset import DataSet
from twin.monitor.settings import MonitorSettings


@dataclass(frozen=True)
class AdjustableLimit:
    """One limit that people may change, with the range (in ``unit``) that makes sense for it."""

    key: str  # of the setting in [figures] or [monitor]
    title: str
    what: str
    unit: str
    lowest: float
    highest: float
    in_force: Callable[[Limits, MonitorSettings], float]
    figure: str = ""  # the key figure that it limits; the others are settings of the monitor


ADJUSTABLE = {
    limit.key: limit
    for limit in (
        AdjustableLimit(
            "permitted_t1_ms",
            "Longest t1",
            "Time from H2 to H1. A longer one raises the alarm on t1.",
            "ms",
            10.0,
            60_000.0,
            lambda figures, _: figures.t1,
            "t1",
        ),
        AdjustableLimit(
            "permitted_leakage_mbar_s",
            "Highest leakage",
            "Loss of vacuum while the nozzle is off. A higher one raises the alarm on leakage.",
            "mbar/s",
            1.0,
            1000.0,
            lambda figures, _: figures.leakage,
            "leakage",
        ),
        AdjustableLimit(
            "permitted_free_flow_mbar",
            "Highest free-flow vacuum",
            "Vacuum with open cups. A higher one raises the alarm on free flow.",
            "mbar",
            1.0,
            1000.0,
            lambda figures, _: figures.free_flow,
            "free_flow",
        ),
        AdjustableLimit(
            "supply_low_bar",
            "Lowest supply pressure",
            "Gauge pressure at the nozzle. A lower one raises the alarm on supply.",
            "bar",
            0.0,
            16.0,
            lambda figures, _: figures.supply[0],
            "lowest_supply",
        ),
        AdjustableLimit(
            "supply_high_bar",
            "Highest supply pressure",
            "Gauge pressure at the nozzle. A higher one raises the alarm on supply.",
            "bar",
            0.1,
            16.0,
            lambda figures, _: figures.supply[1],
            "highest_supply",
        ),
        AdjustableLimit(
            "false_alarm_days",
            "Time between false alarms",
            "The thresholds follow from it. A longer time means fewer false alarms, and faults"
            " are found later.",
            "d",
            1.0,
            3650.0,
            lambda _, watch: watch.false_alarm_days,
        ),
        AdjustableLimit(
            "smallest_mbar",
            "Smallest deviation",
            "A smaller deviation from the model is never an alarm.",
            "mbar",
            0.0,
            100.0,
            lambda _, watch: watch.smallest_mbar,
        ),
    )
}


def adjustable(key: str) -> AdjustableLimit:
    """The limit with a key; ConfigError if people cannot change one of that name."""
    if key not in ADJUSTABLE:
        raise ConfigError(f"no limit is called {key!r}", known_names(key, sorted(ADJUSTABLE)))
    return ADJUSTABLE[key]


def with_unit(value: float | None, unit: str) -> str:
    """A value for people, with about three digits; None is no limit."""
    if value is None:
        return tr("no limit")
    return f"{numeral(value, '.0f' if abs(value) >= 100.0 else '.3g')} {unit}"


@dataclass(frozen=True)
class UnitLimits:
    """The limits of one unit: as configured, and as people have changed them, by key."""

    data: DataSet
    figure_settings: FigureSettings
    monitor_settings: MonitorSettings
    changed: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, config: Config) -> Self:
        """The configured limits."""
        figure_settings = config.document.section(FigureSettings, "figures")
        return cls(config.data, figure_settings, config.monitor)

    @cached_property
    def watch(self) -> MonitorSettings:
        """The settings of the monitor in force."""
        return self.monitor_settings.model_copy(update=self._changed_of(of_figures=False))

    @cached_property
    def limits(self) -> Limits:
        """The limits of the key figures in force."""
        changed = self._changed_of(of_figures=True)
        in_force = limits(self.figure_settings.model_copy(update=changed), self.data, self.watch)
        return replace(in_force, changed=frozenset(ADJUSTABLE[key].figure for key in changed))

    def value(self, key: str) -> float | None:
        """The value of a limit in force, in its unit; None if nothing is limited."""
        value = ADJUSTABLE[key].in_force(self.limits, self.watch)
        return value if math.isfinite(value) else None

    def configured(self) -> "UnitLimits":
        """The limits without people's changes."""
        return replace(self, changed={})

    def changed_to(self, key: str, value: float | None) -> "UnitLimits":
        """The limits after a change, without ``value`` back to the configured one.

        ConfigError for an unknown limit, a value out of its range, and an empty supply range.
        """
        limit = adjustable(key)
        changed = {name: kept for name, kept in self.changed.items() if name != key}
        if value is not None:
            if not limit.lowest <= value <= limit.highest:
                raise ConfigError(
                    tr(
                        "{limit} must be {lowest} to {highest}",
                        limit=tr(limit.title),
                        lowest=with_unit(limit.lowest, limit.unit),
                        highest=with_unit(limit.highest, limit.unit),
                    )
                )
            changed[key] = value
        after = replace(self, changed=changed)
        low, high = after.limits.supply
        if low >= high:
            raise ConfigError(tr("the lowest supply pressure must be below the highest"))
        return after

    def after(self, changes: Iterable[LimitChange]) -> "UnitLimits":
        """The limits after applied changes in their order; those now invalid are left out."""
        in_force = self
        for change in changes:
            if change.is_applied:
                try:
                    in_force = in_force.changed_to(change.limit, change.value)
                except ConfigError:  # the configuration or the program is another one by now
                    continue
        return in_force

    def _changed_of(self, *, of_figures: bool) -> dict[str, float]:
        return {
            key: value
            for key, value in self.changed.items()
            if bool(ADJUSTABLE[key].figure) == of_figures
        }


def limits_in_force(config: Config) -> UnitLimits:
    """The limits of a configuration's unit, with people's changes where they can be read."""
    configured = UnitLimits.of(config)
    if not config.document.section(AlarmSettings, "alarms").keep:
        return configured
    try:
        with open_chosen("", config.document, create=False) as store:
            return configured.after(store.limit_changes(Unit(config.asset.type, config.asset.id)))
    except SourceError:  # before the first run there is no database
        return configured
