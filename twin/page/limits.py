"""The limits of an ejector for its page, as plain dictionaries in the reader's language."""

from collections.abc import Sequence
from typing import Any

from twin.alarms.limits import ADJUSTABLE, AdjustableLimit, UnitLimits, with_unit
from twin.alarms.requests import LimitChange
from twin.instants import instant
from twin.languages.texts import tr

MOST_CHANGES = 200  # listed changes


def limits_document(
    configured: UnitLimits, changes: Sequence[LimitChange], now_ns: int
) -> dict[str, Any]:
    """All limits with their values and newest changes, and the changes, the newest first."""
    in_force = configured.after(changes)
    listed = [change for change in reversed(changes) if change.limit in ADJUSTABLE]
    return {
        "limits": [
            _limit(limit, configured, in_force, listed, now_ns) for limit in ADJUSTABLE.values()
        ],
        "changes": [_change(change, now_ns) for change in listed[:MOST_CHANGES]],
    }


def _limit(
    limit: AdjustableLimit,
    configured: UnitLimits,
    in_force: UnitLimits,
    newest_first: Sequence[LimitChange],
    now_ns: int,
) -> dict[str, Any]:
    own = [change for change in newest_first if change.limit == limit.key]
    applied = next((change for change in own if change.is_applied), None)
    value, configured_value = in_force.value(limit.key), configured.value(limit.key)
    return {
        "key": limit.key,
        "title": tr(limit.title),
        "what": tr(limit.what),
        "unit": limit.unit,
        "lowest": limit.lowest,
        "highest": limit.highest,
        "value": value,
        "value_words": with_unit(value, limit.unit),
        "configured_words": with_unit(configured_value, limit.unit),
        "range_words": tr(
            "{a} to {b}",
            a=with_unit(limit.lowest, limit.unit),
            b=with_unit(limit.highest, limit.unit),
        ),
        "is_changed": limit.key in in_force.changed,
        "newest": applied and _change(applied, now_ns),
        "asked": [_change(change, now_ns) for change in own if change.is_waiting],
    }


def _change(change: LimitChange, now_ns: int) -> dict[str, Any]:
    limit = ADJUSTABLE[change.limit]
    when = change.asked_ns if change.answered_ns is None else change.answered_ns
    return {
        "title": tr(limit.title),
        "words": _words(change, limit),
        "who": change.who,
        "when": instant(when, now_ns),
        "reason": change.reason,
        "refusal": change.refusal,
    }


def _words(change: LimitChange, limit: AdjustableLimit) -> str:
    """The change in words: from and to once applied, before that the requested value."""
    if change.is_applied:
        return tr(
            "changed from {old} to {new}",
            old=with_unit(change.old, limit.unit),
            new=with_unit(change.new, limit.unit),
        )
    if change.value is None:
        return tr("back to the configured value")
    return tr("to {new}", new=with_unit(change.value, limit.unit))
