"""Alarms as tables for other programs: all episodes, or the standing alarms."""

from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa

from twin.alarms.advice import action_of
from twin.alarms.board import Episode
from twin.alarms.rules import Rule
from twin.alarms.state import Alarm
from twin.assets.unit import Unit

_TIME = pa.timestamp("ns", "UTC")
_TEXT, _CYCLE = pa.string(), pa.int64()
_IDENTITY_COLUMNS = (("asset_type", _TEXT, ""), ("asset_id", _TEXT, ""), ("alarm", _TEXT, ""))
_EPISODE_COLUMNS = (
    ("raised", _TIME, ""),
    ("cleared", _TIME, ""),
    ("active", pa.float64(), "s"),
    ("acknowledged", _TIME, ""),
    ("acknowledged_by", _TEXT, ""),
    ("first_cycle", _CYCLE, ""),
    ("last_cycle", _CYCLE, ""),
    ("evidence", _TEXT, ""),
)
_RULE_COLUMNS = (("priority", _TEXT, ""), ("consequence", _TEXT, ""), ("action", _TEXT, ""))
_STATE_COLUMNS = (("state", _TEXT, ""), ("shelved_until", _TIME, ""))


def history_table(episodes: Sequence[Episode], rules: Mapping[str, Rule], unit: Unit) -> pa.Table:
    """A row for each episode; a time that has not come yet is null."""
    rows = [
        {
            **_identity(unit, episode.alarm),
            **_of_episode(episode),
            **_of_rule(rules.get(episode.alarm), episode),
        }
        for episode in episodes
    ]
    return _table(rows, (*_IDENTITY_COLUMNS, *_EPISODE_COLUMNS, *_RULE_COLUMNS))


def standing_table(
    alarms: Sequence[Alarm], episodes: Mapping[str, Episode], unit: Unit
) -> pa.Table:
    """A row for each standing alarm, with its present episode."""
    rows = []
    for alarm in alarms:
        name, episode = alarm.rule.name, episodes.get(alarm.rule.name)
        state = {"state": alarm.state.value, "shelved_until": alarm.shelved_until}
        since = _of_episode(episode) if episode else {}
        rows.append({**_identity(unit, name), **state, **since, **_of_rule(alarm.rule, episode)})
    return _table(rows, (*_IDENTITY_COLUMNS, *_STATE_COLUMNS, *_EPISODE_COLUMNS, *_RULE_COLUMNS))


def _identity(unit: Unit, alarm: str) -> dict[str, Any]:
    return {"asset_type": unit.type, "asset_id": unit.id, "alarm": alarm}


def _of_episode(episode: Episode) -> dict[str, Any]:
    evidence = episode.evidence
    return {
        "raised": episode.raised_ns,
        "cleared": episode.cleared_ns,
        "active": episode.seconds,
        "acknowledged": episode.acknowledged_ns,
        "acknowledged_by": episode.acknowledged_by or None,
        "first_cycle": evidence.get("first_cycle"),
        "last_cycle": evidence.get("last_cycle"),
        "evidence": evidence.get("words"),
    }


def _of_rule(rule: Rule | None, episode: Episode | None) -> dict[str, Any]:
    """What the rules say about an alarm; empty if they no longer contain it."""
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
    arrays = [pa.array([row.get(field.name) for row in rows], field.type) for field in fields]
    return pa.table(arrays, pa.schema(fields))
