"""Messages: one JSON document for each change of an alarm, the same for every destination."""

import json
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from twin.assets.unit import Unit
from twin.events import Event, Kind
from twin.files import json_text

ALARM_FORMAT = "ejector-twin-alarm/1"
STATUS_FORMAT = "ejector-twin-status/1"
Asset = Mapping[str, str]  # type, id and batch
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Message:
    """A change of one alarm to be sent; the ID stays the same however often it is sent."""

    id: str
    alarm: str  # empty for other data
    body: str  # JSON


def of_event(unit: Unit, event: Event) -> Iterator[Message]:
    """The messages of an alarm's event; a renamed alarm also ends under its old name."""
    if event.kind not in (Kind.ALARM, Kind.ALARM_CHANGED):
        return
    data = event.data
    change = {
        "time": iso_time(data["host_ns"]),
        "deed": data["deed"],
        "who": data["who"],
        "announced": event.kind is Kind.ALARM,
        "text": event.text,
    }
    if old_alarm := data.get("left"):
        yield _message(unit, old_alarm, change | {"renamed_to": data["alarm"], "announced": False})
    former = {"renamed_from": data["was"]} if "was" in data else {}
    yield _message(unit, data, change | former)


def restated(unit: Unit, plain: Mapping[str, Any], now_ns: int) -> Message:
    """The present state of an alarm, without any change to it."""
    change = {"time": iso_time(now_ns), "deed": "restated", "who": "", "announced": False}
    return _message(unit, plain, change)


def again(message: Message, now_ns: int) -> Message:
    """The state of an earlier message, restated under a new ID."""
    number = new_id()
    changes = {"id": number, "time": iso_time(now_ns), "deed": "restated", "announced": False}
    return Message(number, message.alarm, json_text({**json.loads(message.body), **changes}))


def of_status(asset: Asset, status: str, since_ns: int | None, program: str) -> str:
    """The twin's status and since when; a last will has no time, since it is written before."""
    since = None if since_ns is None else iso_time(since_ns)
    content = {"asset": asset, "status": status, "since": since, "program": program}
    return json_text({"format": STATUS_FORMAT, **content})


def beside(form: str, asset: Asset, time_ns: int, content: Mapping[str, Any]) -> Message:
    """A message with other data than alarms; ``time_ns`` is host time."""
    number = new_id()
    head = {"format": form, "id": number, "asset": asset}
    times = {"time": iso_time(time_ns), "time_ns": time_ns}
    return Message(number, "", json_text({**head, **times, **content}))


def asset_of(unit: Unit, batch: str) -> Asset:
    """The unit, as messages that are no alarms name it; with its batch if known."""
    return unit._asdict() | ({"batch": batch} if batch else {})


def iso_time(ns: int) -> str:
    """A time in ISO 8601, in UTC, to the microsecond."""
    instant = EPOCH + timedelta(microseconds=ns // 1000)
    return instant.isoformat(timespec="microseconds").replace("+00:00", "Z")


def ns_of(time: str) -> int:
    """The ns of a time that ``iso_time`` has written."""
    return (datetime.fromisoformat(time) - EPOCH) // timedelta(microseconds=1) * 1000


def new_id() -> str:
    """A new unique ID."""
    return str(uuid.uuid4())


def _message(unit: Unit, plain: Mapping[str, Any], change: Mapping[str, Any]) -> Message:
    number = new_id()
    body = {
        "format": ALARM_FORMAT,
        "id": number,
        "asset": unit._asdict(),
        "alarm": plain["alarm"],
        **change,
        "state": _state(plain),
        "active": plain["active"],
        "acknowledged": plain["acknowledged"],
        "episode": _episode(plain),
        "since": _moment(plain["raised_ns"]),
        "shelved_until": _moment(plain["shelved_until_ns"]),
        **{key: plain[key] for key in ("priority", "consequence", "action", "evidence")},
    }
    return Message(number, str(plain["alarm"]), json_text(body))


def _state(plain: Mapping[str, Any]) -> str:
    """Its state; suppression of an alarm that is inactive and acknowledged is not reported."""
    is_silent = plain["state"] == "suppressed" and plain["acknowledged"] and not plain["active"]
    if not is_silent:
        return str(plain["state"])
    return "normal" if plain["shelved_until_ns"] is None else "shelved"


def _episode(plain: Mapping[str, Any]) -> str | None:
    """An ID of the episode, which stays the same after the alarm is renamed."""
    raised_ns = plain["raised_ns"]
    return None if raised_ns is None else f"{raised_ns}.{plain['raised_as']}"


def _moment(ns: int | None) -> str | None:
    return None if ns is None else iso_time(ns)
