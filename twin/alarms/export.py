"""Alarms as tables for other programs: every time that one was active, or what stands now."""

from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa

from twin.alarms.board import Episode
from twin.alarms.rules import Rule
from twin.alarms.state import Alarm
from twin.alarms.text import action_of
from twin.assets.unit import Unit

_TIME = pa.timestamp("ns", "UTC")
_TEXT, _CYCLE = pa.string(), pa.int64()
_WHOSE = (("asset_type", _TEXT, ""), ("asset_id", _TEXT, ""), ("alarm", _TEXT, ""))
_EPISODE = (
    ("raised", _TIME, ""),
    ("cleared", _TIME, ""),
    ("active", pa.float64(), "s"),
    ("acknowledged", _TIME, ""),
    ("acknowledged_by", _TEXT, ""),
    ("first_cycle", _CYCLE, ""),
    ("last_cycle", _CYCLE, ""),
    ("evidence", _TEXT, ""),
)
_RULE = (("priority", _TEXT, ""), ("consequence", _TEXT, ""), ("action", _TEXT, ""))
_STATE = (("state", _TEXT, ""), ("shelved_until", _TIME, ""))


def history_table(episodes: Sequence[Episode], rules: Mapping[str, Rule], unit: Unit) -> pa.Table:
    """Every time that an alarm was active; what has not happened yet is null."""
    rows = [
        {**_whose(unit, one.alarm), **_of_episode(one), **_of_rule(rules.get(one.alarm), one)}
        for one in episodes
    ]
    return _table(rows, (*_WHOSE, *_EPISODE, *_RULE))


def standing_table(
    alarms: Sequence[Alarm], episodes: Mapping[str, Episode], unit: Unit
) -> pa.Table:
    """What a person is to look at, with the episode that goes on."""
    rows = []
    for alarm in alarms:
        name, episode = alarm.rule.name, episodes.get(alarm.rule.name)
        state = {"state": alarm.state.value, "shelved_until": alarm.shelved_until}
        since = _of_episode(episode) if episode else {}
        rows.append({**_whose(unit, name), **state, **since, **_of_rule(alarm.rule, episode)})
    return _table(rows, (*_WHOSE, *_STATE, *_EPISODE, *_RULE))


def _whose(unit: Unit, alarm: str) -> dict[str, Any]:
    return {"asset_type": unit.type, "asset_id": unit.id, "alarm": alarm}


def _of_episode(episode: Episode) -> dict[str, Any]:
    told = episode.evidence
    return {
        "raised": episode.raised_ns,
        "cleared": episode.cleared_ns,
        "active": episode.seconds,
        "acknowledged": episode.acknowledged_ns,
        "acknowledged_by": episode.acknowledged_by or None,
        "first_cycle": told.get("first_cycle"),
        "last_cycle": told.get("last_cycle"),
        "evidence": told.get("words"),
    }


def _of_rule(rule: Rule | None, episode: Episode | None) -> dict[str, Any]:
    """What the rules in use say of an alarm; nothing of one that they do not know any more."""
    if rule is None:
        return {}
    return {
        "priority": rule.priority.value,
        "consequence": rule.consequence,
        "action": action_of(rule, episode.evidence if episode else {}),
    }


def _table(
    rows: Sequence[Mapping[str, Any]], columns: Sequence[tuple[str, pa.DataType, str]]
) -> pa.Table:
    fields = [
        pa.field(name, kind, metadata={"unit": unit} if unit else None)
        for name, kind, unit in columns
    ]
    plain = [pa.array([row.get(field.name) for row in rows], field.type) for field in fields]
    return pa.table(plain, pa.schema(fields))
