"""Who is told when: duty, steps, repetition, and a restart; all on a clock that is passed in."""

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from pydantic import ValidationError
from test_alarms_loop import LEAK, UNIT, Stream, deviation, diagnosis, event

from twin.alarms.state import AlarmAction
from twin.events import Kind
from twin.notifications.call_store import open_calls
from twin.notifications.email import EMAIL, MAIL
from twin.notifications.escalation import Escalation
from twin.notifications.message import Message, of_event, restated
from twin.notifications.people import Person
from twin.notifications.sender import box_of
from twin.notifications.settings import NotificationSettings

MINUTE_NS = 60 * 1_000_000_000
SERVER = {"host": "127.0.0.1", "sender": "twin@plant.example"}
BEGIN = datetime(2026, 11, 23, 10, 0, tzinfo=UTC)  # a Monday


def at(*when: int, zone: str = "UTC") -> int:
    """The ns of a time of November 2026: day, hour, minute."""
    return round(datetime(2026, 11, *when, tzinfo=ZoneInfo(zone)).timestamp()) * 1_000_000_000


def person(name: str, **values: Any) -> dict[str, Any]:
    return {"name": name, "address": f"{name}@plant.example", "time_zone": "UTC", **values}


class Desk:
    """A loop's alarms, the escalation behind them, and a clock in minutes."""

    def __init__(self, path: Path | str, *people: Mapping[str, Any], **email: Any) -> None:
        table = {"email": {**SERVER, **email}, "people": people, "escalate_after_min": 10}
        self.settings = NotificationSettings.model_validate(table)
        self.path, self.stream, self.minute = path, Stream(), 0.0
        self.heard = 0
        self._open()

    def _open(self) -> None:
        with open_calls(self.path, UNIT) as store:
            self.escalation = Escalation(self.settings, store.calls())

    def restart(self) -> None:
        self._open()

    @property
    def now_ns(self) -> int:
        return round(BEGIN.timestamp() * 1e9 + self.minute * MINUTE_NS)

    def then(self) -> list[str]:
        """What the changes since the last call, and the time, make people be told."""
        news = self.stream.said[self.heard :]
        self.heard = len(self.stream.said)
        messages = [message for happened in news for message in of_event(UNIT, happened)]
        return [*self._kept(messages), *self._kept()]

    def at(self, minute: float) -> list[str]:
        self.minute = minute
        return self.then()

    def _kept(self, messages: list[Message] | None = None) -> list[str]:
        documents = [json.loads(message.body) for message in messages or ()]
        outcome = (
            self.escalation.due(self.now_ns)
            if messages is None
            else self.escalation.take(documents, self.now_ns)
        )
        with open_calls(self.path, UNIT) as store:
            store.store(
                outcome, box_of(EMAIL, MAIL), EMAIL, [message.id for message in messages or ()]
            )
        self.escalation.accept(outcome)
        bodies = [json.loads(mail.body) for mail in outcome.mails]
        return [f"{body['name']} {body['reason']} {body['count']}" for body in bodies]

    # --- what happens ---

    def raised(self) -> list[str]:
        self.stream.at(self.minute * 60 + 5, deviation(round(self.minute * 60 + 5)))
        return self.then()

    def cleared(self) -> list[str]:
        seconds = round(self.minute * 60 + 6)
        self.stream.at(seconds, event(seconds, Kind.DEVIATION_CLEARED))
        return self.then()

    def asked(self, deed: AlarmAction, seconds: float = 0.0) -> list[str]:
        self.stream.desk.ask(LEAK, deed, seconds, at=self.minute * 60 + 7)
        self.stream.at(self.minute * 60 + 7)
        return self.then()


STEPS = person("ann"), person("bob", step=2), person("cem", step=2), person("dee", step=3)


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path / "a.sqlite", *STEPS)


def test_each_step_is_told_once_after_its_time(desk: Desk) -> None:
    assert desk.raised() == ["ann raised 1"]
    assert desk.at(9.9) == []
    assert desk.at(10) == ["bob escalated 1", "cem escalated 1"]
    assert desk.at(19.9) == []
    assert desk.at(20) == ["dee escalated 1"]
    assert desk.at(600) == []


@pytest.mark.parametrize(
    "deed", [AlarmAction.ACKNOWLEDGED, AlarmAction.SHELVED, AlarmAction.OUT_OF_SERVICE]
)
def test_what_a_person_does_ends_escalation(desk: Desk, deed: AlarmAction) -> None:
    desk.raised()
    desk.minute = 5
    assert desk.asked(deed, 3600.0) == []
    assert desk.at(40) == []


def test_an_alarm_that_is_cleared_is_told_to_no_further_step(desk: Desk) -> None:
    desk.raised()
    desk.minute = 5
    assert desk.cleared() == []
    assert desk.at(40) == []


def test_an_alarm_whose_shelving_ends_is_told_anew(desk: Desk) -> None:
    desk.raised()
    desk.asked(AlarmAction.SHELVED, 1800.0)
    desk.at(20)
    desk.minute = 31
    desk.stream.at(31 * 60)
    assert desk.then() == ["ann raised 1"]
    assert desk.at(41) == ["bob escalated 1", "cem escalated 1"]


def test_a_restart_tells_nobody_twice_and_forgets_nobody(desk: Desk) -> None:
    desk.raised()
    desk.restart()
    assert desk.at(9) == []
    assert desk.at(10) == ["bob escalated 1", "cem escalated 1"]
    desk.restart()
    assert desk.at(11) == []
    assert desk.at(25) == ["dee escalated 1"]


def test_what_is_not_stored_is_decided_again(desk: Desk) -> None:
    desk.raised()
    desk.minute = 10
    lost = desk.escalation.due(desk.now_ns)
    assert len(lost.mails) == 2
    assert desk.then() == ["bob escalated 1", "cem escalated 1"]


def test_an_alarm_that_ended_while_no_mail_was_configured_is_not_escalated(desk: Desk) -> None:
    desk.raised()
    desk.stream.desk.ask(LEAK, AlarmAction.ACKNOWLEDGED)
    desk.stream.at(60)  # of which this escalation hears nothing
    standing = Stream(desk.stream.desk.before).alarms.standing()
    stated = [json.loads(restated(UNIT, alarm, 0).body) for alarm in standing]
    assert [body["state"] for body in stated] == ["acknowledged"]
    desk.escalation.accept(desk.escalation.take(stated, desk.now_ns))
    desk.heard = len(desk.stream.said)
    assert desk.at(40) == []


def test_what_stands_when_a_run_begins_is_not_told_anew(desk: Desk) -> None:
    desk.raised()
    standing = Stream(desk.stream.desk.before).alarms.standing()
    stated = [json.loads(restated(UNIT, alarm, 0).body) for alarm in standing]
    assert desk.escalation.take(stated, desk.now_ns).mails == []
    desk.escalation.accept(desk.escalation.take(stated, desk.now_ns))
    assert desk.at(10) == ["bob escalated 1", "cem escalated 1"]


def test_mails_and_calls_are_stored_together(desk: Desk) -> None:
    desk.raised()
    with open_calls(desk.path, UNIT) as store:
        assert store.count(box_of(EMAIL, MAIL)) == 1
        assert store.calls()[LEAK].told.keys() == {"ann@plant.example"}
        assert store.calls() == desk.escalation._calls


def test_a_chattering_alarm_is_one_mail_with_a_count(desk: Desk) -> None:
    assert desk.raised() == ["ann raised 1"]
    said = []
    for minute in range(1, 15):
        desk.minute = minute
        said += [*desk.cleared(), *desk.raised()]
    assert said == ["bob escalated 11", "cem escalated 11"]
    desk.cleared()
    assert desk.at(15) == ["ann repeated 15"]
    assert desk.at(24) == []
    assert desk.at(25) == ["bob repeated 15", "cem repeated 15"]
    assert desk.at(60) == []
    with open_calls(desk.path, UNIT) as store:
        assert store.calls() == {}


def test_chattering_does_not_hold_up_escalation(desk: Desk) -> None:
    desk.raised()
    desk.minute = 6
    desk.cleared()
    desk.raised()
    assert desk.at(10) == ["bob escalated 2", "cem escalated 2"]


def test_after_the_pause_an_alarm_is_told_at_once_again(desk: Desk) -> None:
    desk.raised()
    desk.cleared()
    desk.at(16)
    assert desk.raised() == ["ann raised 1"]


def test_another_cause_is_told_and_escalation_goes_on(desk: Desk) -> None:
    desk.raised()
    desk.minute = 5
    desk.stream.at(9, diagnosis(9, 5, "suction_loss"))
    assert desk.then() == ["ann raised 1"]
    assert desk.at(10) == ["bob escalated 1", "cem escalated 1"]


def test_a_clock_that_was_set_back_does_not_stop_escalation(desk: Desk) -> None:
    desk.raised()
    assert desk.at(-600) == []
    assert desk.at(-590) == ["bob escalated 1", "cem escalated 1"]


def test_every_kind_of_database_keeps_who_was_told(url: str) -> None:
    desk = Desk(url, *STEPS)
    desk.raised()
    desk.restart()
    assert desk.at(10) == ["bob escalated 1", "cem escalated 1"]
    desk.minute = 12
    desk.asked(AlarmAction.ACKNOWLEDGED)
    desk.restart()
    assert desk.at(40) == []


# --- duty ---------------------------------------------------------------------------------------


def test_nobody_is_told_off_duty_and_everybody_when_duty_begins(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "a.sqlite", person("ann", hours="12:00-20:00"))
    assert desk.raised() == []
    assert desk.at(119) == []
    assert desk.at(120) == ["ann on_duty 1"]


def test_a_step_with_nobody_on_duty_passes_at_once(tmp_path: Path) -> None:
    late = person("ann", hours="12:00-20:00")
    desk = Desk(tmp_path / "a.sqlite", late, person("bob", step=2), person("cem", step=3))
    assert desk.raised() == ["bob raised 1"]
    assert desk.at(10) == ["cem escalated 1"]
    assert desk.at(120) == ["ann on_duty 1"]


def test_who_was_told_and_goes_home_still_has_the_time_of_the_step(tmp_path: Path) -> None:
    early = person("ann", hours="06:00-10:05")
    desk = Desk(tmp_path / "a.sqlite", early, person("bob", step=2))
    assert desk.raised() == ["ann raised 1"]
    assert desk.at(6) == []
    assert desk.at(10) == ["bob escalated 1"]


def test_who_asks_for_urgent_alarms_gets_no_others(tmp_path: Path) -> None:
    people = person("ann", from_priority="high"), person("bob", from_priority="medium")
    assert Desk(tmp_path / "a.sqlite", *people).raised() == ["bob raised 1"]


def test_recipients_get_everything_at_once(tmp_path: Path) -> None:
    desk = Desk(tmp_path / "a.sqlite", person("bob", step=2), recipients=["all@plant.example"])
    assert desk.raised() == ["all@plant.example raised 1"]
    assert desk.at(10) == ["bob escalated 1"]


@pytest.mark.parametrize(
    ("values", "when", "is_on_duty"),
    [
        ({}, at(23, 3, 0), True),
        ({"hours": "06:00-14:00"}, at(23, 6, 0), True),
        ({"hours": "06:00-14:00"}, at(23, 14, 0), False),
        ({"hours": "06:00-24:00"}, at(23, 23, 59), True),
        ({"hours": "22:00-06:00"}, at(23, 23, 0), True),
        ({"hours": "22:00-06:00", "weekdays": ["fri"]}, at(28, 5, 59), True),
        ({"hours": "22:00-06:00", "weekdays": ["fri"]}, at(27, 5, 59), False),
        ({"hours": "22:00-06:00", "weekdays": ["sun"]}, at(23, 5, 0), True),
        ({"weekdays": ["mon", "tue"]}, at(25, 12, 0), False),
        ({"hours": "06:00-14:00", "time_zone": "Europe/Berlin"}, at(23, 5, 30), True),
        ({"hours": "06:00-14:00", "time_zone": "America/New_York"}, at(23, 10, 0), False),
        ({"hours": "06:00-14:00", "time_zone": "Europe/Berlin"}, at(23, 13, 30), False),
    ],
)
def test_duty(values: dict[str, Any], when: int, is_on_duty: bool) -> None:
    assert Person.model_validate(person("ann", **values)).is_on_duty(when) is is_on_duty


def test_duty_follows_summer_time() -> None:
    berlin = Person.model_validate(person("ann", hours="06:00-14:00", time_zone="Europe/Berlin"))
    in_utc = datetime(2026, 7, 6, 4, 30, tzinfo=UTC)
    assert berlin.is_on_duty(round(in_utc.timestamp()) * 1_000_000_000)


@pytest.mark.parametrize(
    ("values", "advice"),
    [
        ({"hours": "6-14"}, '"06:00-14:00"'),
        ({"hours": "06:00-06:00"}, "two times of the day"),
        ({"hours": "06:00-25:00"}, "two times of the day"),
        ({"time_zone": "Europe/Atlantis"}, "Europe/Berlin"),
        ({"time_zone": "../../etc/passwd"}, "Europe/Berlin"),
        ({"weekdays": []}, "weekdays"),
        ({"name": "Ann\r\nBcc: all@elsewhere.example"}, "line break"),
        ({"address": "ann@plant.example\nBcc: x@y.example"}, "NAME@HOST"),
        ({"address": "ann@a..example"}, "NAME@HOST"),
        ({"address": "Ann <ann@plant.example>"}, "NAME@HOST"),
    ],
)
def test_a_person_that_cannot_be_told_is_refused(values: dict[str, Any], advice: str) -> None:
    with pytest.raises(ValidationError, match=advice):
        Person.model_validate({**person("ann"), **values})
