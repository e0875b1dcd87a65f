"""From changes of alarms to an outbox that loses nothing, and out of it in order."""

import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_alarms_cli import begun, run  # noqa: F401 - a fixture
from test_alarms_loop import APART, LEAK, NONE, UNIT, S, Stream, deviation, diagnosis, event

from twin.alarms.state import AlarmAction
from twin.assets.unit import Unit
from twin.backoff import Backoff
from twin.errors import SourceError
from twin.events import Event, Kind
from twin.files import json_text
from twin.notifications import dispatch, sender
from twin.notifications.dispatch import Outlets
from twin.notifications.message import Message, again, of_event, restated
from twin.notifications.outbox import Outbox, open_outbox
from twin.notifications.sender import LostError, Sender, Sent
from twin.notifications.settings import Outlet
from twin.signals import TICK

DAY_NS = 86_400 * S
NO_TICKS = np.empty(0, TICK)


def told(events: Sequence[Event]) -> list[dict[str, Any]]:
    return [json.loads(message.body) for happened in events for message in of_event(UNIT, happened)]


# --- what is told -------------------------------------------------------------------------------


def test_a_change_is_told_with_the_whole_alarm() -> None:
    stream = Stream()
    stream.at(5, deviation(5))
    (body,) = told(stream.said)
    assert body["format"] == "ejector-twin-alarm/1"
    assert body["asset"] == {"type": UNIT.type, "id": UNIT.id}
    assert (body["alarm"], body["deed"], body["announced"]) == (LEAK, "raised", True)
    assert (body["state"], body["active"], body["acknowledged"]) == ("unacknowledged", True, False)
    assert body["time"] == body["since"] == "2001-09-09T01:46:45.000000Z"
    assert body["episode"] == f"{APART + 5 * S}.{LEAK}"
    assert body["priority"] == "medium"
    assert body["action"].startswith("Look at hoses")
    assert body["evidence"]["sigma"] == 9.0
    assert body["text"].startswith(f"{LEAK} raised (medium priority)")
    assert body["shelved_until"] is None


def test_every_change_has_an_id_of_its_own_and_an_episode_keeps_its() -> None:
    stream = Stream()
    stream.at(5, deviation(5))
    stream.desk.ask(LEAK, AlarmAction.ACKNOWLEDGED)
    stream.at(6)
    stream.desk.ask(LEAK, AlarmAction.SHELVED, 60.0, at=7)
    stream.at(7)
    stream.at(9, event(9, Kind.DEVIATION_CLEARED))
    bodies = told(stream.said)
    assert [body["deed"] for body in bodies] == ["raised", "acknowledged", "shelved", "cleared"]
    assert len({body["id"] for body in bodies}) == 4
    assert {body["episode"] for body in bodies} == {f"{APART + 5 * S}.{LEAK}"}
    assert {body["since"] for body in bodies} == {"2001-09-09T01:46:45.000000Z"}
    assert bodies[1]["who"] == "ann"
    assert bodies[2]["shelved_until"] == "2001-09-09T01:47:47.000000Z"


def test_of_a_renamed_alarm_both_are_told() -> None:
    stream = Stream()
    stream.at(5, deviation(5))
    stream.at(9, diagnosis(9, 5, "suction_loss"))
    left, now = told(stream.said)[1:]
    assert (left["alarm"], left["state"], left["active"]) == (LEAK, "normal", False)
    assert (left["renamed_to"], left["announced"]) == ("deviation_suction_loss", False)
    assert (now["alarm"], now["state"]) == ("deviation_suction_loss", "unacknowledged")
    assert (now["renamed_from"], now["announced"]) == (LEAK, True)
    assert now["episode"] == f"{APART + 5 * S}.{LEAK}"


def test_a_suppression_that_keeps_nothing_quiet_is_not_told() -> None:
    """It would not be told either that it has ended."""
    stream = Stream()
    stream.at(5, deviation(5))
    stream.desk.ask(LEAK, AlarmAction.ACKNOWLEDGED)
    stream.at(6)
    stream.at(7, event(7, Kind.PLC_STALE))
    stream.at(8, event(8, Kind.DEVIATION_CLEARED))
    stream.at(9, event(9, Kind.PLC_BACK))
    states = [body["state"] for body in told(stream.said) if body["alarm"] == LEAK]
    assert states == ["unacknowledged", "acknowledged", "suppressed", "normal"]


def test_what_is_no_number_is_null() -> None:
    assert json_text({"a": math.nan, "b": [np.float64("inf"), np.int64(3)], "c": None}) == (
        '{"a": null, "b": [null, 3], "c": null}'
    )


def test_alarms_that_stand_when_a_run_begins_are_told_as_they_are() -> None:
    stream = Stream()
    stream.at(5, deviation(5))
    stream.at(9, diagnosis(9, 5, "suction_loss"))
    later = Stream(stream.desk.before)
    bodies = [json.loads(restated(UNIT, alarm, 0).body) for alarm in later.alarms.standing()]
    states = {body["alarm"]: (body["state"], body["since"]) for body in bodies}
    assert states == {
        LEAK: ("normal", None),
        "deviation_suction_loss": ("unacknowledged", "2001-09-09T01:46:45.000000Z"),
    }
    assert {body["deed"] for body in bodies} == {"restated"}
    assert {body["evidence"].get("effect") for body in bodies} == {None, "suction_loss"}


def test_what_is_told_again_has_its_own_id_and_is_not_announced() -> None:
    stream = Stream()
    stream.at(5, deviation(5))
    (first,) = of_event(UNIT, stream.said[0])
    body = json.loads(again(first, 0).body)
    assert body["id"] != first.id
    assert (body["deed"], body["announced"], body["state"]) == ("restated", False, "unacknowledged")


# --- the outbox ---------------------------------------------------------------------------------


class Clock:
    def __init__(self) -> None:
        self.ns = 100 * DAY_NS

    def __call__(self) -> int:
        return self.ns


def message(number: int, alarm: str = LEAK) -> Message:
    return Message(str(number), alarm, f'{{"number": {number}}}')


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def outbox(url: str, clock: Clock) -> Iterator[Outbox]:
    with open_outbox(url, UNIT, clock=clock) as opened:
        yield opened


def test_messages_wait_for_each_destination_in_order(outbox: Outbox) -> None:
    outbox.put([(to, message(n)) for n in (3, 1, 2) for to in ("mqtt", "webhook")])
    assert [message.id for message in outbox.next("mqtt", 2)] == ["3", "1"]
    outbox.delivered("mqtt", ["3", "1"])
    assert outbox.next("mqtt", 5) == [message(2)]
    assert (outbox.count("mqtt"), outbox.count("webhook")) == (1, 3)


def test_units_do_not_see_each_others(outbox: Outbox, url: str) -> None:
    outbox.put([("mqtt", message(1))])
    with open_outbox(url, Unit(UNIT.type, "other")) as other:
        assert other.next("mqtt", 5) == []
        other.delivered("mqtt", ["1"])
    assert outbox.count("mqtt") == 1


def test_what_is_refused_is_set_aside_with_why(outbox: Outbox) -> None:
    outbox.put([("webhook", message(n)) for n in (1, 2)])
    outbox.refuse("webhook", "1", "status 400")
    assert outbox.next("webhook", 5) == [message(2)]
    assert outbox.refused("webhook") == [(message(1), "status 400")]
    assert outbox.destinations() == ["webhook"]
    assert outbox.again() == 1
    assert outbox.next("webhook", 5) == [message(1), message(2)]


def test_people_see_what_waits_and_send_again_what_was_refused(run: Any, tmp_path: Path) -> None:  # noqa: F811
    begun(tmp_path / "alarms.sqlite").close()
    assert run("outbox") == "the outbox is empty\n"
    with open_outbox(tmp_path / "alarms.sqlite", UNIT) as outbox:
        outbox.put([("webhook", message(n)) for n in (1, 2)])
        outbox.refuse("webhook", "1", "status 400")
    refused = f"        {LEAK}  1  status 400\n"
    assert run("outbox") == f"webhook: 1 wait, 1 were refused\n{refused}"
    assert run("outbox", "--again").splitlines() == [
        "1 that were refused wait again",
        "webhook: 2 wait, 0 were refused",
    ]


def test_it_holds_a_number_of_messages_for_a_time(outbox: Outbox, clock: Clock) -> None:
    outbox.put([("mqtt", message(n)) for n in range(5)])
    assert outbox.give_up("mqtt", 5, 0) == []
    assert [message.id for message in outbox.give_up("mqtt", 3, 0)] == ["0", "1"]
    outbox.refuse("mqtt", "2", "no")
    clock.ns += 10
    outbox.put([("mqtt", message(9))])
    assert [message.id for message in outbox.give_up("mqtt", 3, clock.ns)] == ["3", "4"]
    assert outbox.refused("mqtt") == []
    assert outbox.next("mqtt", 5) == [message(9)]


# --- a sender -----------------------------------------------------------------------------------


class Fake:
    """A channel that takes what a test lets it, and remembers."""

    def __init__(self) -> None:
        self.taken: list[Message] = []
        self.topics: list[str] = []  # of each batch
        self.tries = 0
        self.down = False
        self.forgets = False
        self.take: Callable[[Message], str] = lambda _message: ""
        self.most = 10**9  # of a batch, then it is lost
        self.idle_now = threading.Event()
        self.closed = False
        self._connected = False

    def open(self) -> bool:
        self.tries += 1
        if self.down:
            raise LostError("it is away")
        forgotten, self._connected = self.forgets and not self._connected, True
        return forgotten

    def send(self, messages: Sequence[Message], topic: str = sender.ALARM) -> Sent:
        sent = Sent()
        self.topics.append(topic)
        for message in messages[: self.most]:
            if why := self.take(message):
                sent.refused[message.id] = why
            else:
                self.taken.append(message)
                sent.delivered.append(message)
        if len(messages) > self.most:
            sent.lost, self.most = LostError("it went away"), 10**9
        return sent

    def idle(self, wake: threading.Event) -> None:
        self.idle_now.set()
        wake.wait(0.01)

    def hang_up(self) -> None:
        self._connected = False

    def close(self) -> None:
        self.closed = True


class Bench:
    """A sender over an outbox in a file, with a fake channel."""

    def __init__(self, path: Path, limits: Outlet | None = None) -> None:
        self.channel, self.said = Fake(), list[str]()
        self.path, self.limits = path, limits or Outlet()
        self.outbox = open_outbox(path, UNIT)
        self.sender = Sender(
            "mqtt", self.channel, lambda: open_outbox(path, UNIT), self.limits, self.said.append
        )

    def put(self, *messages: Message) -> None:
        self.outbox.put([("mqtt", message) for message in messages])
        self.sender.wake()

    def settled(self) -> list[str]:
        """Once there is nothing to do: the IDs that were taken."""
        wait_until(lambda: self.outbox.count("mqtt") == 0)
        self.channel.idle_now.clear()
        assert self.channel.idle_now.wait(10.0)
        return [message.id for message in self.channel.taken]

    def end(self) -> None:
        self.sender.end()
        self.sender.join()
        self.outbox.close()


def wait_until(is_so: Callable[[], bool]) -> None:
    end = time.monotonic() + 20.0
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.005)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setattr(sender, "FIRST_PAUSE_S", 0.001)
    monkeypatch.setattr(sender, "LONGEST_PAUSE_S", 0.01)
    made = Bench(tmp_path / "a.sqlite")
    yield made
    made.end()


def test_it_delivers_in_order_and_only_once(bench: Bench) -> None:
    bench.put(*(message(n) for n in range(45)))
    bench.sender.start()
    assert bench.settled() == [str(n) for n in range(45)]
    bench.put(message(45))
    assert bench.settled() == [str(n) for n in range(46)]
    assert bench.said == []


def test_what_is_lost_on_the_way_goes_on_where_it_was(bench: Bench) -> None:
    bench.channel.most = 3
    bench.put(*(message(n) for n in range(6)))
    bench.sender.start()
    assert bench.settled() == [str(n) for n in range(6)]
    assert bench.said == [
        "alarms wait in the outbox: mqtt: it went away",
        "alarms go to mqtt again",
    ]


def test_while_it_is_away_that_is_said_once(bench: Bench) -> None:
    bench.channel.down = True
    bench.put(message(1))
    bench.sender.start()
    wait_until(lambda: bench.channel.tries > 5)
    assert bench.said == ["alarms wait in the outbox: mqtt: it is away"]
    bench.channel.down = False
    assert bench.settled() == ["1"]
    assert bench.said[1:] == ["alarms go to mqtt again"]


def test_pauses_grow_and_begin_anew(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    paused: list[float] = []
    ending = bench.sender._ending
    monkeypatch.setattr(ending, "wait", paused.append)
    bench.channel.down = True
    bench.sender._backoff = Backoff(0.001, 0.008)
    bench.sender.start()
    wait_until(lambda: len(paused) >= 5)
    bench.channel.down = False
    assert bench.channel.idle_now.wait(10.0)
    assert paused[:5] == [0.001, 0.002, 0.004, 0.008, 0.008]
    assert bench.sender._backoff.next_s() == 0.001


def test_what_is_refused_does_not_hold_up_others(bench: Bench) -> None:
    bench.channel.take = lambda message: "status 400" if message.id in ("1", "3") else ""
    bench.put(*(message(n) for n in range(5)))
    bench.sender.start()
    assert bench.settled() == ["0", "2", "4"]
    assert [message.id for message, _ in bench.outbox.refused("mqtt")] == ["1", "3"]
    assert bench.said == ["mqtt refuses alarms, which are set aside: status 400"]


def test_who_has_forgotten_everything_is_told_the_newest_of_each(bench: Bench) -> None:
    bench.put(message(1), message(2, "plc_stale"), message(3))
    bench.sender.start()
    bench.settled()
    bench.channel.forgets = True
    bench.channel.most = 0
    bench.put(message(4))
    bench.settled()
    wait_until(lambda: len(bench.channel.taken) == 6)
    assert [message.id for message in bench.channel.taken[:4]] == ["1", "2", "3", "4"]
    told_again = [json.loads(message.body) for message in bench.channel.taken[4:]]
    assert [body["number"] for body in told_again] == [4, 2]
    assert len({body["id"] for body in told_again} | {"1", "2", "3", "4"}) == 6


def test_beyond_its_bounds_the_oldest_are_given_up_and_that_is_said(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.limits = Outlet(most_waiting=100)
    bench.sender._limits = bench.limits
    bench.put(message(0, "plc_stale"), *(message(n) for n in range(1, 111)))
    bench.sender.start()
    assert bench.settled()[:100] == [str(n) for n in range(11, 111)]
    (said,) = bench.said
    assert said.startswith("11 changes of alarms were never delivered to mqtt")
    wait_until(lambda: len(bench.channel.taken) == 102)  # what it would not know else
    again_ = {
        message.alarm: json.loads(message.body)["number"] for message in bench.channel.taken[100:]
    }
    assert again_ == {"plc_stale": 0, LEAK: 110}


def test_another_program_goes_on_with_what_is_left(tmp_path: Path, bench: Bench) -> None:
    bench.channel.down = True
    bench.put(message(1), message(2))
    bench.sender.start()
    wait_until(lambda: bool(bench.said))
    bench.sender.end()
    bench.sender.join()
    assert bench.said[1] == "2 messages to mqtt wait for the next run: it is away"
    later = Bench(bench.path)
    later.sender.start()
    assert later.settled() == ["1", "2"]
    later.end()
    assert later.channel.closed


def test_at_the_end_what_is_there_is_delivered(bench: Bench) -> None:
    bench.sender.start()
    assert bench.channel.idle_now.wait(10.0)
    bench.outbox.put([("mqtt", message(n)) for n in range(50)])
    bench.sender.end()
    bench.sender.join()
    assert len(bench.channel.taken) == 50
    assert bench.channel.closed


def test_an_outbox_that_is_away_is_waited_for(bench: Bench) -> None:
    gone = {"is": True}

    def opened() -> Outbox:
        if gone["is"]:
            raise SourceError("no database")
        return open_outbox(bench.path, UNIT)

    bench.sender._open_outbox = opened
    bench.put(message(1))
    bench.sender.start()
    wait_until(lambda: bool(bench.said))
    gone["is"] = False
    assert bench.settled() == ["1"]


def test_a_sender_goes_on_after_a_defect(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench.sender, "_backoff", Backoff(0.001, 0.001))
    take, failures = bench.channel.take, iter([ValueError("a defect"), MemoryError()])

    def fall(message: Message) -> str:
        for error in failures:
            raise error
        return take(message)

    bench.channel.take = fall
    bench.put(message(1))
    bench.sender.start()
    assert bench.settled() == ["1"]
    assert bench.said[0] == "alarms wait in the outbox: mqtt: ValueError: a defect"
    assert bench.said[1:] == ["alarms go to mqtt again"]


# --- beside the loop ----------------------------------------------------------------------------


def test_changes_are_in_the_outbox_before_they_are_delivered(tmp_path: Path) -> None:
    path, said = tmp_path / "a.sqlite", list[str]()
    stream = Stream()
    stream.at(5, deviation(5))
    channel = Fake()
    seen: list[int] = []
    with open_outbox(path, UNIT) as outbox:
        channel.take = lambda _one: seen.append(outbox.count("mqtt")) or ""  # type: ignore[func-returns-value]
        opened = lambda: open_outbox(path, UNIT)  # noqa: E731
        to = Sender("mqtt", channel, opened, Outlet(), said.append)
        outlets = Outlets(UNIT, opened, [to], said.append, restating=["mqtt"])
        outlets.begin(Stream(stream.desk.before).alarms.standing())
        outlets.write(NONE, NO_TICKS, stream.said)
        outlets.close()
    bodies = [json.loads(message.body) for message in channel.taken]
    assert [(body["alarm"], body["deed"]) for body in bodies] == [
        (LEAK, "restated"),
        (LEAK, "raised"),
    ]
    assert min(seen) >= 1
    assert said == []


def test_without_a_database_changes_wait_in_memory_and_the_loop_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dispatch, "RETRY_S", 0.01)
    said, gone = list[str](), {"is": True}

    def opened() -> Outbox:
        if gone["is"]:
            raise SourceError("no database")
        return open_outbox(tmp_path / "a.sqlite", UNIT)

    stream = Stream()
    stream.at(5, deviation(5))
    channel = Fake()
    to = Sender("mqtt", channel, opened, Outlet(), lambda _what: None)
    outlets = Outlets(UNIT, opened, [to], said.append)
    outlets.begin([])
    outlets.write(NONE, NO_TICKS, stream.said)
    wait_until(lambda: bool(said))
    assert said == ["changes of alarms wait in memory, not in the outbox: no database"]
    gone["is"] = False
    wait_until(lambda: len(said) == 2)
    outlets.close()
    assert len(channel.taken) == 1


def test_what_there_is_no_room_for_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch, "MOST_IN_MEMORY", 2)
    monkeypatch.setattr(dispatch, "RETRY_S", 0.01)
    said = list[str]()

    def opened() -> Outbox:
        raise SourceError("no database")

    stream = Stream()
    stream.at(5, deviation(5))
    outlets = Outlets(
        UNIT, opened, [Sender("mqtt", Fake(), opened, Outlet(), said.append)], said.append
    )
    outlets.write(NONE, NO_TICKS, stream.said * 5)
    for worker in outlets._senders:
        worker.start()
    outlets._thread.start()
    outlets.close()
    assert "5 messages could not be put into the outbox" in said


def test_the_end_does_not_wait_for_who_does_not_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dispatch, "CLOSE_S", 0.05)
    said, answers, channel = list[str](), threading.Event(), Fake()
    channel.take = lambda _one: "" if answers.wait(20.0) else "never"
    opened = lambda: open_outbox(tmp_path / "a.sqlite", UNIT)  # noqa: E731
    with opened() as outbox:
        outbox.put([("mqtt", message(1))])
    to = Sender("mqtt", channel, opened, Outlet(), print)
    outlets = Outlets(UNIT, opened, [to], said.append)
    outlets.begin([])
    outlets.close()
    assert "mqtt does not answer: the rest waits for the next run" in said
    assert channel.taken == []
    answers.set()
    assert to.join(20.0)


def test_the_outbox_is_written_after_a_defect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dispatch, "RETRY_S", 0.001)
    said, failures = list[str](), iter([ValueError("a defect"), MemoryError()])

    def opened() -> Outbox:
        for error in failures:
            raise error
        return open_outbox(tmp_path / "a.sqlite", UNIT)

    outlets = Outlets(UNIT, opened, [], said.append)
    outlets.begin([])
    outlets.tell("mqtt", message(1))
    wait_until(lambda: len(said) == 2)
    outlets.close()
    assert said == [
        "changes of alarms wait in memory, not in the outbox: ValueError: a defect",
        "changes of alarms are in the outbox again",
    ]
    with open_outbox(tmp_path / "a.sqlite", UNIT) as outbox:
        assert outbox.count("mqtt") == 1
