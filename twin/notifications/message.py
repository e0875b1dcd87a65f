"""What is told: one JSON document for each change of an alarm, the same wherever it goes."""

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
    """A change of one alarm on its way; the ID stays the same however often it is sent."""

    id: str
    alarm: str  # empty of what is told beside alarms
    body: str  # JSON


def of_event(unit: Unit, event: Event) -> Iterator[Message]:
    """What an event says of alarms: of one that is renamed, that the other is no more as well."""
    if event.kind not in (Kind.ALARM, Kind.ALARM_CHANGED):
        return
    data = event.data
    change = {
        "time": moment(data["host_ns"]),
        "deed": data["deed"],
        "who": data["who"],
        "announced": event.kind is Kind.ALARM,
        "text": event.text,
    }
    if left := data.get("left"):
        yield _message(unit, left, change | {"renamed_to": data["alarm"], "announced": False})
    was = {"renamed_from": data["was"]} if "was" in data else {}
    yield _message(unit, data, change | was)


def restated(unit: Unit, plain: Mapping[str, Any], now_ns: int) -> Message:
    """An alarm as it is, without anything having happened to it."""
    change = {"time": moment(now_ns), "deed": "restated", "who": "", "announced": False}
    return _message(unit, plain, change)


def again(message: Message, now_ns: int) -> Message:
    """The state that a message told, told once more under an ID of its own."""
    number = new_id()
    later = {"id": number, "time": moment(now_ns), "deed": "restated", "announced": False}
    return Message(number, message.alarm, json_text({**json.loads(message.body), **later}))


def of_status(asset: Asset, status: str, since_ns: int | None, program: str) -> str:
    """Whether the twin is there, since when; who dies cannot say when."""
    since = None if since_ns is None else moment(since_ns)
    told = {"asset": asset, "status": status, "since": since, "program": program}
    return json_text({"format": STATUS_FORMAT, **told})


def beside(form: str, asset: Asset, time_ns: int, told: Mapping[str, Any]) -> Message:
    """What is told beside alarms; ``time_ns`` is by the clock here."""
    number = new_id()
    head = {"format": form, "id": number, "asset": asset}
    at = {"time": moment(time_ns), "time_ns": time_ns}
    return Message(number, "", json_text({**head, **at, **told}))


def asset_of(unit: Unit, batch: str) -> Asset:
    """Whose it is, as messages beside alarms have it; the batch where it is known."""
    return unit._asdict() | ({"batch": batch} if batch else {})


def moment(ns: int) -> str:
    """A time as ISO 8601 has it, in UTC, to the microsecond."""
    at = EPOCH + timedelta(microseconds=ns // 1000)
    return at.isoformat(timespec="microseconds").replace("+00:00", "Z")


def new_id() -> str:
    """An ID that nothing else has."""
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
    """Its state; that an alarm with nothing to say is suppressed concerns nobody, and is not told
    when it ends either.
    """
    quiet = plain["state"] == "suppressed" and plain["acknowledged"] and not plain["active"]
    if not quiet:
        return str(plain["state"])
    return "normal" if plain["shelved_until_ns"] is None else "shelved"


def _episode(plain: Mapping[str, Any]) -> str | None:
    """What tells one time of being active from others, also after it is renamed."""
    raised_ns = plain["raised_ns"]
    return None if raised_ns is None else f"{raised_ns}.{plain['raised_as']}"


def _moment(ns: int | None) -> str | None:
    return None if ns is None else moment(ns)
