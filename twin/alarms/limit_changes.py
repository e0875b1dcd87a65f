"""Applies people's changes of limits to the monitor of a run (``twin.live.EventEnricher``)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

from twin.alarms.limits import ADJUSTABLE, UnitLimits, with_unit
from twin.alarms.loop import News
from twin.alarms.requests import LimitChange
from twin.errors import ConfigError
from twin.events import Event, Kind
from twin.figures.cycle import KeyFigures
from twin.instants import dated
from twin.monitor.monitor import Monitor
from twin.signals import Samples


class LimitStorage(Protocol):
    """Delivers changes, and stores what became of them. The loop never waits for it."""

    def take(self, news: News) -> None:
        """Store what became of changes."""

    def limit_changes(self) -> list[LimitChange]:
        """Changes since the last call, first those of all earlier runs."""


class LimitChanges:
    """The limits of one run: the configured ones, with changes that people make meanwhile.

    A change of an earlier run holds again, and the log says so. ``clock`` returns UTC in ns.
    """

    def __init__(
        self, configured: UnitLimits, storage: LimitStorage, clock: Callable[[], int]
    ) -> None:
        self._limits, self._storage, self._clock = configured, storage, clock
        self._monitor: Monitor | None = None
        self._plc_ns = 0  # of the last row
        self._untold: list[tuple[str, dict[str, Any]]] = []  # text and data of events to come

    def attach(self, monitor: Monitor) -> None:
        """Take the monitor of the run, and apply what people have changed before."""
        self._monitor = monitor
        self._look()

    def follow(self, samples: Samples, _events: Sequence[Event]) -> list[Event]:
        """Apply changes; returns each as an event."""
        if len(samples):
            self._plc_ns = int(samples["time_ns"][-1])
        self._look()
        if not self._plc_ns:  # no row yet, so no time for an event
            return []
        untold, self._untold = self._untold, []
        return [Event(self._plc_ns, Kind.LIMIT_CHANGED, text, data) for text, data in untold]

    def finish(self) -> list[Event]:
        """Return no events: none are held back."""
        return []

    def close(self) -> None:
        """Nothing to release: the alarms close the storage."""

    def _look(self) -> None:
        """Apply all changes that have come."""
        changes = self._storage.limit_changes()
        if not changes:
            return
        earlier = [change for change in changes if change.is_applied]
        self._limits = self._limits.after(earlier)
        newest = {change.limit: change for change in earlier}
        for key, change in newest.items():
            if key in self._limits.changed:
                self._untold.append((_resumed_words(change), _plain(change)))
        for change in changes:
            if change.is_waiting:
                self._change(change)
        self._apply()

    def _change(self, change: LimitChange) -> None:
        """Apply a new change, or refuse it."""
        now = self._clock()
        try:
            after = self._limits.changed_to(change.limit, change.value)
        except ConfigError as error:
            self._answer(replace(change, answered_ns=now, refusal=str(error)))
            return
        old, new = (limits.value(change.limit) for limits in (self._limits, after))
        self._limits = after
        applied = replace(change, answered_ns=now, old=old, new=new)
        self._answer(applied)
        self._untold.append((change_words(applied), _plain(applied)))

    def _answer(self, change: LimitChange) -> None:
        self._storage.take(News(limits={change.id: change}))

    def _apply(self) -> None:
        if self._monitor is None:
            return
        self._monitor.adjust(self._limits.watch)
        if isinstance(self._monitor.key_figure_source, KeyFigures):
            self._monitor.key_figure_source.limits = self._limits.limits


def change_words(change: LimitChange) -> str:
    """An applied change in a sentence, in English as all events are."""
    limit = ADJUSTABLE[change.limit]
    old, new = (with_unit(value, limit.unit) for value in (change.old, change.new))
    back = ", as configured," if change.value is None else ""
    return (
        f'limit "{limit.title}" changed from {old} to {new}{back} by {change.who}: {change.reason}'
    )


def _resumed_words(change: LimitChange) -> str:
    limit = ADJUSTABLE[change.limit]
    since = "" if change.answered_ns is None else f" since {dated(change.answered_ns)}"
    value = with_unit(change.new, limit.unit)
    return f'limit "{limit.title}" is {value}{since}, changed by {change.who}: {change.reason}'


def _plain(change: LimitChange) -> dict[str, Any]:
    """The change as a JSON document; values are in the limit's unit, null is no limit."""
    return {
        "limit": change.limit,
        "unit": ADJUSTABLE[change.limit].unit,
        "old": change.old,
        "new": change.new,
        "configured": change.value is None,
        "who": change.who,
        "reason": change.reason,
        "host_ns": change.answered_ns,
    }
