"""Key figures of every cycle and values at a slower pace: what is told, and through outages."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rigs
from mosquitto import Broker, Listener, broker
from test_alarms_loop import NONE, UNIT
from test_notifications import NO_TICKS, Bench, Clock, message, wait_until

from twin.events import Event, Kind
from twin.notifications import dispatch, mqtt, sender
from twin.notifications.data import CYCLE, VALUES, Cycles, Values
from twin.notifications.dispatch import Outlets
from twin.notifications.message import Message
from twin.notifications.mqtt import Mqtt
from twin.notifications.outbox import Outbox, open_outbox
from twin.notifications.sender import HOUR_NS, Lane, Sender, box_of
from twin.notifications.settings import MqttSettings, Outlet
from twin.quality import UNUSABLE, Quality
from twin.signals import MBAR, Phase

ASSET = {"type": UNIT.type, "id": UNIT.id, "batch": "2026-07"}
AMBIENT = 101_300.0
LANES = (Lane(CYCLE, "key figures", 72.0), Lane(VALUES, "values", 72.0))


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sender, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(sender, "LONGEST_PAUSE_S", 0.05)
    monkeypatch.setattr(mqtt, "LISTEN_S", 0.01)


def cycle(number: int, **more: Any) -> Event:
    return Event(number, Kind.CYCLE, "", {"cycle": number, "t0_measured": 189.0, **more})


def bodies(messages: Sequence[Message]) -> list[dict[str, Any]]:
    return [json.loads(message.body) for message in messages]


# --- what is told -------------------------------------------------------------------------------


def test_every_cycle_is_told_with_its_asset_and_both_clocks() -> None:
    source = Cycles(ASSET, lambda: 77)
    events = [cycle(5, answer="long", leakage_measured=float("nan")), cycle(6, host_ns=10**18)]
    first, second = bodies(source.tell(NONE, NO_TICKS, [*events, Event(7, Kind.GAP, "")]))
    assert first["format"] == "ejector-twin-cycle/1"
    assert first["asset"] == ASSET
    assert (first["cycle"], first["t0_measured"], first["leakage_measured"]) == (5, 189.0, None)
    assert (first["time_ns"], first["plc_time_ns"]) == (77, 5)
    assert (second["time"], second["time_ns"]) == ("2001-09-09T01:46:40.000000Z", 10**18)
    assert "answer" not in first
    assert "host_ns" not in second
    assert first["id"] != second["id"]


@pytest.mark.parametrize("size", [30, 999, 100_000])
@pytest.mark.parametrize("period_s", [0.1, 1.0])
def test_a_row_has_what_its_period_had_however_blocks_are_cut(size: int, period_s: float) -> None:
    samples, _ = rigs.recorded("gripper", 7.0)
    samples = samples.copy()
    samples["quality"][2500:2510], samples["pressure"][2500:2510] = Quality.BAD, 9e9
    samples, ticks = rigs.expectation(rigs.twin("gripper"), [samples])
    source, told = Values(ASSET, period_s, AMBIENT), list[Message]()
    for begin in range(0, len(samples), size):
        told += source.tell(samples[begin : begin + size], ticks[begin : begin + size], [])
    told += source.rest()
    rows = [row for body in bodies(told) for row in body["rows"]]
    stretch = samples["time_ns"] // round(period_s * 1e9)
    assert len(rows) == len(np.unique(stretch))
    for row, number in zip(rows, np.unique(stretch), strict=True):
        mine = stretch == number
        good = mine & ((samples["quality"] & UNUSABLE) == 0)
        vacuum = (AMBIENT - samples["pressure"][good].astype(float)) / MBAR
        wanted = {"low": vacuum.min(), "mean": vacuum.mean(), "high": vacuum.max()}
        assert row["measured_mbar"] == pytest.approx(wanted, abs=0.006)
        expected = (AMBIENT - ticks["expected"][mine].astype(float)) / MBAR
        assert row["expected_mbar"]["mean"] == pytest.approx(np.nanmean(expected), abs=0.006)
        phases = np.bincount(ticks["phase"][mine], minlength=4)
        assert phases[Phase[row["phase"].upper()]] == phases.max()
        assert row["commands"] == np.bitwise_or.reduce(samples["commands"][mine])
        assert row["quality"] == np.bitwise_or.reduce(samples["quality"][mine])
        assert row["samples"] == mine.sum()
        assert row["plc_time_ns"] == samples["time_ns"][mine][-1]
        assert row["time_ns"] == samples["host_ns"][mine][-1]
    assert {body["period_s"] for body in bodies(told)} == {period_s}
    assert [len(body["rows"]) for body in bodies(told)[:-1]] == [round(5 / period_s)] * (
        len(told) - 1
    )


def test_what_nothing_usable_is_known_of_is_null() -> None:
    samples, ticks = rigs.expectation(rigs.twin("gripper"), [rigs.recorded("gripper", 7.0)[0]])
    samples, ticks = samples[:1500].copy(), ticks[:1500].copy()
    samples["quality"], ticks["expected"] = Quality.STALE, np.nan
    source = Values(ASSET, 600.0, AMBIENT)
    assert source.tell(samples, ticks, []) == []
    ((row,),) = [body["rows"] for body in bodies(source.rest())]
    assert row["measured_mbar"] == row["expected_mbar"] == {"low": None, "mean": None, "high": None}
    assert row["quality"] == Quality.STALE
    assert source.rest() == []


# --- what waits ---------------------------------------------------------------------------------


@pytest.fixture
def outbox(url: str) -> Iterator[Outbox]:
    clock = Clock()
    with open_outbox(url, UNIT, clock=clock) as opened:
        opened.clock = clock  # type: ignore[attr-defined]
        yield opened


def test_what_waits_beside_alarms_is_bounded_by_time_and_number(outbox: Outbox) -> None:
    clock: Clock = outbox.clock  # type: ignore[attr-defined]
    outbox.put([("mqtt values", message(n)) for n in range(3)] + [("mqtt", message(99))])
    outbox.refuse("mqtt values", "0", "no")
    assert outbox.forget("mqtt values", 10, clock.ns) == 0
    clock.ns += 10
    outbox.put([("mqtt values", message(n)) for n in range(3, 7)])
    assert outbox.forget("mqtt values", 5, 0) == 1, "of two that go one was refused"
    assert outbox.refused("mqtt values") == []
    assert outbox.forget("mqtt values", 10, clock.ns) == 1
    assert [message.id for message in outbox.next("mqtt values", 9)] == ["3", "4", "5", "6"]
    assert outbox.count("mqtt") == 1


def test_an_outbox_from_before_gets_its_index(url: str) -> None:
    with open_outbox(url, UNIT) as old, old._writing() as connection:
        connection.exec_driver_sql("DROP INDEX alarm_outbox_order")
    with open_outbox(url, UNIT) as again, again._writing() as connection:
        connection.exec_driver_sql("DROP INDEX alarm_outbox_order")  # it is there


class Laned(Bench):
    """A bench whose sender has lanes, by a clock of the test."""

    def __init__(self, path: Path, clock: Clock) -> None:
        super().__init__(path)
        self.outbox.close()
        self.outbox = open_outbox(path, UNIT, clock=clock)
        self.sender = Sender(
            "mqtt",
            self.channel,
            lambda: open_outbox(path, UNIT),
            Outlet(),
            self.said.append,
            clock,
            LANES,
        )

    def put_data(self, topic: str, *messages: Message) -> None:
        self.outbox.put([(box_of("mqtt", topic), message) for message in messages])


def test_alarms_pass_what_waits_beside_them(tmp_path: Path) -> None:
    bench = Laned(tmp_path / "a.sqlite", Clock())
    bench.put_data(VALUES, *(message(n, "") for n in range(100, 130)))
    bench.put_data(CYCLE, message(50, ""))
    bench.put(message(1))
    bench.sender.start()
    wait_until(lambda: len(bench.channel.taken) == 32)
    assert bench.channel.topics == ["alarm", CYCLE, VALUES, VALUES]
    assert [message.id for message in bench.channel.taken[:3]] == ["1", "50", "100"]
    bench.end()


def test_while_nobody_takes_it_the_newest_hours_are_kept_and_the_rest_is_counted(
    tmp_path: Path,
) -> None:
    clock = Clock()
    bench = Laned(tmp_path / "a.sqlite", clock)
    bench.channel.down = True
    for hour in range(100):
        bench.put_data(VALUES, message(hour, ""))
        clock.ns += HOUR_NS
    bench.sender.start()
    wait_until(lambda: bench.outbox.count("mqtt values") == 72)
    clock.ns += HOUR_NS
    wait_until(lambda: bench.outbox.count("mqtt values") == 71)
    told = "values wait for mqtt for longer than 72 hours: the oldest are given up"
    assert bench.said.count(told) == 1
    bench.channel.down = False
    wait_until(lambda: len(bench.channel.taken) == 71)
    assert [message.id for message in bench.channel.taken] == [str(n) for n in range(29, 100)]
    lost = "29 messages with values were never delivered to mqtt and are given up"
    wait_until(lambda: lost in bench.said)
    bench.end()


# --- at a broker --------------------------------------------------------------------------------


@pytest.mark.needs("mosquitto")
def test_no_cycle_is_lost_while_the_broker_is_away(tmp_path: Path) -> None:
    path, said = tmp_path / "a.sqlite", list[str]()
    away = Broker(tmp_path)
    settings = MqttSettings(host="127.0.0.1", port=away.port, cycles=True)

    def opened() -> Outbox:
        return open_outbox(path, UNIT)

    def begun() -> Outlets:
        channel = Mqtt(settings, UNIT, Path(), pytest.fail, batch="2026-07")
        to = Sender("mqtt", channel, opened, settings, said.append, lanes=LANES)
        message_sources = [Cycles(ASSET), Values(ASSET, 1.0, AMBIENT)]
        outlets = Outlets(
            UNIT, opened, [to], said.append, message_sources={"mqtt": message_sources}
        )
        outlets.begin([])
        return outlets

    first = begun()
    first.write(NONE, NO_TICKS, [cycle(n) for n in range(300)])
    first.write(*rigs.expectation(rigs.twin("gripper"), [rigs.recorded("gripper", 7.0)[0]]), [])
    first.close()
    assert any(line.startswith("302 messages to mqtt wait for the next run") for line in said)
    with away, Listener(away.port) as listener:
        second = begun()
        second.write(NONE, NO_TICKS, [cycle(n) for n in range(300, 310)])
        listener.until("/cycle", cycle=309)
        second.close()
        online = listener.until("/status", status="offline")
        assert [document["cycle"] for document in listener.on("/cycle")] == list(range(310))
        rows = [row for body in listener.on("/values") for row in body["rows"]]
        assert sum(row["samples"] for row in rows) == len(rigs.recorded("gripper", 7.0)[0])
    assert online["asset"] == ASSET


def test_data_leaves_room_for_alarms_where_the_database_is_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dispatch, "MOST_IN_MEMORY", 10)
    outlets = Outlets(UNIT, pytest.fail, [], pytest.fail, message_sources={"mqtt": [Cycles(ASSET)]})  # type: ignore[arg-type]
    outlets.write(NONE, NO_TICKS, [cycle(n) for n in range(9)])
    assert outlets._queue.qsize() == 5
    assert outlets._lost == 4


@pytest.mark.needs("mosquitto")
def test_the_packets_of_a_lane_have_its_topic(tmp_path: Path) -> None:
    with broker(tmp_path) as running, Listener(running.port) as listener:
        ours = Mqtt(MqttSettings(host="127.0.0.1", port=running.port), UNIT, Path(), pytest.fail)
        ours.open()
        ours.send([message(1, "")], VALUES)
        ours.close()
        listener.until("/status", status="offline")
    assert f"ejector-twin/{UNIT.type}/{UNIT.id}/values" in [topic for topic, _, _ in listener.all]
