"""Alarms beside the loop: from events to episodes in the database, through restarts."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rigs
from rigs import Collect

from twin.alarms import writer as module
from twin.alarms.database import Store, open_store
from twin.alarms.loop import Alarms, Before, News
from twin.alarms.requests import Request
from twin.alarms.rules import Rule, by_cause, default_rules
from twin.alarms.settings import board_rules
from twin.alarms.state import AlarmAction, Kept, State
from twin.alarms.writer import AlarmWriter
from twin.assets.unit import Unit
from twin.cli.alarms import alarms_of
from twin.config import Config
from twin.errors import ConfigError, SourceError
from twin.events import Event, Kind
from twin.figures.cycle import KeyFigures
from twin.live import run
from twin.monitor.monitor import Monitor
from twin.quality import Quality
from twin.settings import Document
from twin.signals import SAMPLE, Samples

UNIT = Unit("compact-ejector-35", "gripper-01")
S = 1_000_000_000
APART = 10**18  # receipt minus PLC time
NONE = np.empty(0, SAMPLE)
LEAK = "deviation_leakage"


def rows(seconds: float) -> Samples:
    """One row at a PLC time."""
    row = np.zeros(1, SAMPLE)
    row["time_ns"], row["host_ns"] = round(seconds * S), APART + round(seconds * S)
    return row


def event(seconds: float, kind: Kind, **data: Any) -> Event:
    return Event(round(seconds * S), kind, kind.value, data)


def deviation(seconds: float, effect: str = "leakage", also: str = "") -> Event:
    return event(seconds, Kind.DEVIATION, effect=effect, also=also, cycle=int(seconds), sigma=9.0)


def cycle(seconds: float, *warnings: str, **data: Any) -> Event:
    return event(seconds, Kind.CYCLE, cycle=int(seconds), warnings=list(warnings), **data)


def diagnosis(seconds: float, of_s: float, *causes: str, verdict: str = "explained") -> Event:
    found = [{"effect": cause, "course": "step", "probability": 0.9} for cause in causes]
    answer = {"verdict": verdict, "causes": found}
    return event(seconds, Kind.DIAGNOSIS, alarm_ns=round(of_s * S), answer=answer)


class Desk:
    """A storage in memory."""

    def __init__(self) -> None:
        self.news, self.wishes = News(), list[Request]()
        self.fails = False

    def take(self, news: News) -> None:
        self.news.add(news)

    def asked(self) -> list[Request]:
        if self.fails:
            raise MemoryError
        asked, self.wishes = self.wishes, []
        return asked

    def close(self) -> None: ...

    def ask(self, alarm: str, deed: AlarmAction, seconds: float = 0.0, at: float = 0.0) -> None:
        asked = APART + round(at * S)
        self.wishes.append(Request(1, alarm, deed, "ann", asked, seconds))

    @property
    def before(self) -> Before:
        going_on = [episode for episode in self.news.episodes.values() if not episode.is_over]
        return Before(self.news.states, going_on)


class Stream:
    """Alarms over events, with a clock that follows them."""

    def __init__(self, before: Before | None = None, rules: Sequence[Rule] = ()) -> None:
        self.desk, self.now = Desk(), 0.0
        self.said: list[Event] = []
        chosen = by_cause(rules) if rules else board_rules(None)
        self.alarms = Alarms(chosen, lambda: APART + round(self.now * S), before, self.desk)

    def at(self, seconds: float, *events: Event) -> list[str]:
        """One row and what happened; gives what is said, in few words."""
        self.now = seconds
        return self._heard(self.alarms.follow(rows(seconds), events))

    def silent(self, seconds: float, *events: Event) -> list[str]:
        self.now = seconds
        return self._heard(self.alarms.follow(NONE, events))

    def state(self, alarm: str) -> State:
        return self.alarms.board[alarm].state

    def _heard(self, events: list[Event]) -> list[str]:
        self.said += events
        return [f"{event.data['alarm']} {event.data['deed']}" for event in events]


@pytest.mark.parametrize("step_s", [-3600, 3600])
@pytest.mark.parametrize("silent", [False, True])
def test_a_clock_that_is_set_shortens_no_delay(step_s: int, silent: bool) -> None:
    (leak,) = (rule for rule in board_rules(None) if rule.name == LEAK)
    rules = [leak.model_copy(update={"on_delay_s": 60.0, "suppressed_by": ()})]
    wall, steady = 0, 0
    alarms = Alarms(rules, lambda: APART + wall, steady=lambda: steady)

    def said(seconds: int, *events: Event) -> list[Event]:
        nonlocal wall, steady
        steady = seconds * S
        wall = (seconds + (step_s if seconds >= 10 else 0)) * S
        now = NONE if silent and not events else rows(seconds)
        now["host_ns"] = APART + wall
        return alarms.follow(now, events)

    assert not said(5, deviation(5))
    for seconds in (10, 30, 64):
        assert not said(seconds)
    assert [event.data["deed"] for event in said(66)] == ["raised"]


def test_rows_that_come_late_shorten_no_delay() -> None:
    (leak,) = (rule for rule in board_rules(None) if rule.name == LEAK)
    rules = [leak.model_copy(update={"on_delay_s": 60.0, "suppressed_by": ()})]
    now = 0.0
    alarms = Alarms(rules, lambda: APART + round(now * S), steady=lambda: round(now * S))
    assert not alarms.follow(rows(5), [deviation(5)])
    now = 50.0  # those of 6 to 50 s come now
    for seconds in range(6, 51):
        assert not alarms.follow(rows(seconds), [])
    now = 66.0
    assert [event.data["deed"] for event in alarms.follow(rows(66), [])] == ["raised"]


def test_what_was_found_out_before_a_failure_is_said_the_next_time() -> None:
    stream = Stream()
    stream.desk.fails = True
    with pytest.raises(MemoryError):
        stream.at(5, deviation(5))
    stream.desk.fails = False
    assert stream.at(5, deviation(5)) == [f"{LEAK} raised"]


def test_a_deviation_is_the_alarm_of_its_cause_with_what_to_do() -> None:
    stream = Stream()
    assert stream.at(5, deviation(5)) == [f"{LEAK} raised"]
    (said,) = stream.said
    assert (said.kind, said.time_ns) == (Kind.ALARM, 5 * S)
    assert said.text.startswith(f"{LEAK} raised (medium priority): deviation. The ejector does")
    assert "Look at hoses, fittings and cups" in said.text
    assert said.data["host_ns"] == APART + 5 * S
    assert said.data["evidence"]["sigma"] == 9.0
    assert stream.at(6, deviation(6)) == []
    assert stream.at(9, event(9, Kind.DEVIATION_CLEARED)) == [f"{LEAK} cleared"]
    assert stream.said[-1].kind is Kind.ALARM_CHANGED
    (episode,) = stream.desk.news.episodes.values()
    assert (episode.alarm, episode.seconds) == (LEAK, 4.0)
    assert stream.state(LEAK) is State.RETURNED


def test_a_cost_goes_with_its_cause_and_not_with_the_next() -> None:
    stream = Stream()
    stream.at(5, deviation(5))
    costly, later = (
        diagnosis(at, 5, cause) for at, cause in ((9, "leakage"), (11, "suction_loss"))
    )
    for found in (costly, later):
        found.data["answer"]["causes"][0]["parameters"] = {}
    costly.data["answer"]["causes"][0]["cost"] = {"currency": "€"}
    stream.at(9, costly)
    (episode,) = stream.desk.news.episodes.values()
    assert episode.evidence["cost"] == {"currency": "€"}
    stream.at(11, later)
    (episode,) = stream.desk.news.episodes.values()
    assert episode.alarm == "deviation_suction_loss"
    assert "cost" not in episode.evidence


def test_the_diagnosis_renames_it_and_other_causes_have_their_own() -> None:
    stream = Stream()
    stream.at(5, deviation(5), cycle(5))
    stream.at(8, cycle(8))
    found = stream.at(9, diagnosis(9, 5, "suction_loss", "sensor_offset"))
    assert found == ["deviation_suction_loss renamed", "deviation_sensor_offset raised"]
    assert "deviation_leakage is now deviation_suction_loss (medium" in stream.said[-2].text
    assert stream.at(11, deviation(11)) == ["deviation_sensor_offset cleared"]
    renamed, other = stream.desk.news.episodes.values()
    assert renamed.alarm == "deviation_suction_loss"
    assert (renamed.raised_ns, renamed.seconds) == (APART + 5 * S, None)
    evidence = dict(renamed.evidence)
    assert (evidence["first_cycle"], evidence["last_cycle"]) == (5, 11)
    assert (evidence["guess"], evidence["effect"]) == ("leakage", "suction_loss")
    assert (other.alarm, other.seconds) == ("deviation_sensor_offset", 2.0)


def test_an_alarm_without_a_name_gets_it_and_goes_on() -> None:
    stream = Stream()
    assert stream.at(5, deviation(5, "unknown")) == ["deviation_unknown raised"]
    assert stream.at(8, deviation(8)) == [f"{LEAK} renamed"]
    assert stream.said[-1].text.startswith("deviation_unknown is now deviation_leakage (medium")
    (episode,) = stream.desk.news.episodes.values()
    assert (episode.alarm, episode.raised_ns) == (LEAK, APART + 5 * S)
    assert (episode.evidence["first_cycle"], episode.evidence["guess"]) == (5, "leakage")
    assert stream.at(9, event(9, Kind.DEVIATION_CLEARED)) == [f"{LEAK} cleared"]


def test_what_begins_beside_a_cause_leaves_it_until_it_has_a_name() -> None:
    stream = Stream()
    stream.at(5, deviation(5))
    assert stream.at(8, deviation(8, "unknown")) == ["deviation_unknown raised"]
    assert stream.state(LEAK) is State.UNACKNOWLEDGED
    assert stream.at(11, deviation(11, "suction_loss")) == [
        "deviation_suction_loss renamed",
        f"{LEAK} cleared",
    ]


def test_what_stood_before_a_restart_is_not_raised_as_something_new() -> None:
    stream = Stream(acknowledged())
    assert stream.at(106, cycle(106), deviation(106, "unknown")) == []
    assert stream.at(109, cycle(109), deviation(109, "suction_loss")) == []
    assert stream.at(112, deviation(112, "unknown")) == ["deviation_unknown raised"]


def test_what_nobody_listed_has_an_alarm_too() -> None:
    stream = Stream()
    stream.at(5, deviation(5))
    found = stream.at(9, diagnosis(9, 5, verdict="unlisted"))
    assert found == ["deviation_unlisted renamed"]


@pytest.mark.parametrize(
    "answer",
    [
        diagnosis(9, 4, "suction_loss"),
        diagnosis(9, 5, verdict="consistent"),
        event(9, Kind.DIAGNOSIS),
    ],
    ids=["of another alarm", "consistent", "none"],
)
def test_an_answer_that_names_nothing_changes_nothing(answer: Event) -> None:
    stream = Stream()
    stream.at(5, deviation(5))
    assert stream.at(9, answer) == []
    assert stream.state(LEAK) is State.UNACKNOWLEDGED


def test_a_look_alike_is_not_another_alarm() -> None:
    stream = Stream()
    stream.at(5, deviation(5))
    assert stream.at(8, deviation(8, "suction_loss", also="added_volume,leakage")) == []
    assert stream.at(11, deviation(11, "sensor_gain")) == [
        f"{LEAK} cleared",
        "deviation_sensor_gain raised",
    ]


def test_warnings_of_figures_wait_for_their_delay_and_keep_their_cycles() -> None:
    stream = Stream()
    for second in (0, 3, 6, 9):
        words = {"leakage_over_limit": f"leakage over limit ({300 + second} of 250 mbar/s)"}
        told = cycle(second, "leakage_over_limit", leakage_measured=300.0 + second, warned=words)
        assert stream.at(second, told) == []
    assert stream.at(10) == ["leakage_over_limit raised"]
    assert "leakage over limit (309 of 250 mbar/s)" in stream.said[-1].text
    stream.at(12, cycle(12, "leakage_over_limit", leakage_measured=400.0, leakage_expected=20.0))
    (episode,) = stream.desk.news.episodes.values()
    assert (episode.evidence["first_cycle"], episode.evidence["last_cycle"]) == (0, 12)
    assert (episode.evidence["measured"], episode.evidence["expected"]) == (400.0, 20.0)


def test_while_the_plc_is_silent_one_alarm_speaks_and_time_goes_on() -> None:
    stream = Stream()
    stream.at(1)
    stream.desk.ask(LEAK, AlarmAction.SHELVED, 60.0, at=2)
    assert stream.silent(2, event(2, Kind.PLC_STALE)) == ["plc_stale raised", f"{LEAK} shelved"]
    assert stream.silent(61) == []
    assert stream.silent(62) == [f"{LEAK} unshelved"]
    assert stream.at(70, event(70, Kind.PLC_BACK)) == ["plc_stale cleared"]


def test_what_people_ask_is_done_or_refused() -> None:
    stream = Stream()
    stream.at(5, deviation(5))
    stream.desk.ask(LEAK, AlarmAction.ACKNOWLEDGED)
    assert stream.at(6) == [f"{LEAK} acknowledged"]
    assert stream.said[-1].text == f"{LEAK} acknowledged by ann"
    stream.desk.ask(LEAK, AlarmAction.SHELVED, 600.0, at=6)
    assert stream.at(6) == [f"{LEAK} shelved"]
    assert stream.said[-1].text == f"{LEAK} shelved by ann for 10 min"
    assert stream.desk.news.answers == {1: ""}
    stream.desk.ask(LEAK, AlarmAction.OUT_OF_SERVICE)
    assert stream.at(8) == [f"{LEAK} out_of_service"]
    stream.desk.ask(LEAK, AlarmAction.UNSHELVED)
    assert stream.at(9) == [f"{LEAK} unshelved"]
    stream.desk.ask(LEAK, AlarmAction.IN_SERVICE)
    assert stream.at(9) == [f"{LEAK} in_service"]
    assert stream.state(LEAK) is State.ACKNOWLEDGED
    for alarm, deed, why in (
        ("nobody", AlarmAction.ACKNOWLEDGED, "no alarm is called nobody"),
        (LEAK, AlarmAction.SHELVED, f"{LEAK}: the time to shelve it for is over already"),
        (LEAK, AlarmAction.RAISED, "raised is nothing that can be asked"),
    ):
        stream.desk.ask(alarm, deed, 5.0)
        assert stream.at(10) == []
        assert stream.desk.news.answers[1].startswith(why)


def test_in_a_log_time_stands_while_there_are_no_rows() -> None:
    alarms = Alarms(board_rules(None), None)
    told = cycle(5, "leakage_over_limit", leakage_measured=300.0)
    assert (
        alarms.follow(NONE, []) == alarms.follow(rows(5), [told]) == alarms.follow(NONE, []) == []
    )
    (raised,) = alarms.follow(rows(15), [])
    assert raised.data["host_ns"] == APART + 15 * S


# Restarts.


def acknowledged() -> Before:
    """A leak that was found, diagnosed as something else, and acknowledged, when the run ended."""
    stream = Stream()
    stream.at(5, deviation(5))
    stream.at(9, diagnosis(9, 5, "suction_loss"))
    stream.desk.ask("deviation_suction_loss", AlarmAction.ACKNOWLEDGED)
    stream.at(10)
    return stream.desk.before


def test_an_acknowledged_alarm_stays_so_when_the_same_is_found_again() -> None:
    stream = Stream(acknowledged())
    for second in (91, 94, 97, 100):
        assert stream.at(second, cycle(second)) == []
    assert stream.at(106, cycle(106), deviation(106)) == []
    for second in (109, 112, 115):
        assert stream.at(second, cycle(second)) == []
    assert stream.state("deviation_suction_loss") is State.ACKNOWLEDGED
    assert stream.at(118, diagnosis(118, 106, "suction_loss")) == []
    (episode,) = stream.desk.news.episodes.values()
    assert episode.raised_ns == APART + 5 * S


def test_what_is_gone_after_a_restart_is_cleared() -> None:
    stream = Stream(acknowledged())
    assert stream.at(100, cycle(100)) == stream.at(103, cycle(103, complete=False)) == []
    for second in (104, 105, 106):
        assert stream.at(second, cycle(second)) == []
    assert stream.at(109, cycle(109)) == ["deviation_suction_loss cleared"]
    (episode,) = stream.desk.news.episodes.values()
    assert (episode.is_over, episode.seconds) == (True, 104.0)
    assert stream.state("deviation_suction_loss") is State.NORMAL


def test_a_plc_that_is_there_after_a_restart_is_not_stale() -> None:
    before = Before({"plc_stale": Kept(active=True, acknowledged=False)})
    stream = Stream(before)
    stale = rows(100)
    stale["quality"] = Quality.STALE
    assert stream.alarms.follow(stale, []) == []
    assert stream.at(101) == ["plc_stale cleared"]
    again = Stream(before)
    assert again.at(100, event(100, Kind.PLC_STALE)) == []


def test_states_of_alarms_that_there_are_no_more_are_left() -> None:
    before = acknowledged()
    stream = Stream(before, default_rules()[:1])
    assert stream.at(100, cycle(100)) == []


# The database.


def kept(where: str | Path) -> AlarmWriter:
    return AlarmWriter(lambda: open_store(where), UNIT, pytest.fail)


def test_a_defect_does_not_end_what_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.alarms.writer.POLL_S", 0.001)
    monkeypatch.setattr("twin.alarms.writer.RETRY_S", 0.001)
    save, failures, said = Store.save, iter([MemoryError(), ValueError("a defect")]), list[str]()

    def flaky(store: Store, *what: Any) -> None:
        for error in failures:
            raise error
        save(store, *what)

    monkeypatch.setattr(Store, "save", flaky)
    alarm_writer = AlarmWriter(lambda: open_store(tmp_path / "a.sqlite"), UNIT, said.append)
    alarm_writer.begin()
    alarm_writer.take(News(answers={1: ""}))
    end = time.monotonic() + 20.0
    while len(said) < 2 and time.monotonic() < end:
        time.sleep(0.002)
    alarm_writer.close()
    assert said == ["alarms wait in memory: MemoryError: ", "alarms are stored again"]


@pytest.mark.slow
def test_the_loop_keeps_its_episodes_and_goes_on_after_a_restart(url: str) -> None:
    """The simulated rig with a leak, twice; between the runs somebody acknowledges it."""

    def one_run(fault: str) -> Collect:
        seen, alarm_writer = Collect(), kept(url)
        alarms = Alarms(board_rules(None), lambda: 0, alarm_writer.begin(), alarm_writer)
        theta, config = rigs.theta("gripper"), rigs.config("gripper")
        monitor = Monitor(config.monitor, theta, KeyFigures(config.data))
        blocks = rigs.cut(rigs.recorded("gripper", 20.0, (fault,))[0], 30)
        run(blocks, rigs.twin("gripper"), monitor, [seen], advisers=[alarms])
        return seen

    seen = one_run("leakage=2.0@8")
    begun, deviation = seen.of(Kind.DEVIATION)
    raised, renamed = seen.of(Kind.ALARM)
    assert (raised.data["alarm"], raised.time_ns) == ("deviation_unknown", begun.time_ns)
    name = renamed.data["alarm"]
    assert (name, renamed.time_ns) == (
        f"deviation_{deviation.data['effect']}",
        deviation.time_ns,
    )
    with open_store(url) as store:
        before = store.before(UNIT)
        (episode,) = [episode for episode in before.going_on if episode.alarm == name]
        assert before.states[name] == Kept(active=True, acknowledged=False)
        assert episode.evidence["sigma"] == deviation.data["sigma"]
        assert episode.evidence["last_cycle"] > episode.evidence["first_cycle"]
        number = store.ask(UNIT, name, AlarmAction.ACKNOWLEDGED, "ann")
        states = {**before.states, name: Kept(active=True)}
        store.save(UNIT, News(states, {}, {number: ""}))
    seen = one_run("leakage=2.0")
    assert seen.of(Kind.DEVIATION)
    assert name not in [event.data["alarm"] for event in seen.of(Kind.ALARM)]
    with open_store(url) as store:
        assert store.states(UNIT)[name] == Kept(active=True, acknowledged=True)
        assert len([episode for episode in store.episodes(UNIT) if episode.alarm == name]) == 1
        assert store.episodes(UNIT, episode.raised_ns + 1) == [
            later for later in store.episodes(UNIT) if later.raised_ns > episode.raised_ns
        ]


def test_a_database_that_is_away_is_said_once_and_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "POLL_S", 0.005)
    monkeypatch.setattr(module, "RETRY_S", 0.005)
    said: list[str] = []
    tries = 0

    def flaky() -> Store:
        nonlocal tries
        tries += 1
        if tries < 4:
            raise SourceError("server: connection refused")
        return open_store(tmp_path / "a.sqlite")

    alarm_writer = AlarmWriter(flaky, UNIT, said.append)
    assert alarm_writer.begin() == Before()
    alarm_writer.take(News({LEAK: Kept(active=True)}))
    while tries < 4:
        alarm_writer.take(News())
    alarm_writer.close()
    assert said == [
        "alarms begin anew, and wait in memory: server: connection refused",
        "alarms are stored again",
    ]
    with open_store(tmp_path / "a.sqlite") as store:
        assert store.states(UNIT) == {LEAK: Kept(active=True)}
        assert store.units() == [UNIT]


def test_what_cannot_be_stored_to_the_end_is_said() -> None:
    def away() -> Store:
        raise SourceError("gone")

    said: list[str] = []
    alarm_writer = AlarmWriter(away, UNIT, said.append)
    alarm_writer.begin()
    alarm_writer.take(News({LEAK: Kept()}))
    alarm_writer.close()
    assert said[1:] == ["0 episodes of alarms could not be stored"]


def configured(folder: Path, table: str) -> Config:
    path = folder / "cell.toml"
    path.write_text(table)
    return replace(rigs.config("gripper"), document=Document.read(path))


def test_only_a_run_that_is_asked_to_writes_a_database(tmp_path: Path) -> None:
    wanted = configured(tmp_path, "[alarms]\nkeep = true\n")
    for alarms in (alarms_of(wanted)(), alarms_of(configured(tmp_path, ""), print)()):
        alarms.follow(rows(5), [deviation(5)])
        alarms.close()
    assert not (tmp_path / "alarms.sqlite").exists()
    alarms = alarms_of(wanted, pytest.fail)()
    alarms.follow(rows(5), [deviation(5)])
    alarms.close()
    with open_store(tmp_path / "alarms.sqlite") as store:
        assert [episode.alarm for episode in store.episodes(UNIT)] == [LEAK]


def test_what_is_wrong_in_the_configuration_is_said_before_the_run(tmp_path: Path) -> None:
    wrong = configured(tmp_path, '[alarms]\nkeep = true\nurl = "mysql://host/name"\n')
    with pytest.raises(ConfigError, match="alarm databases of kind 'mysql'"):
        alarms_of(wrong, print)
    wrong = configured(tmp_path, "[alarms]\nkept = true\n")
    with pytest.raises(ConfigError, match=r"cell\.toml:2: alarms\.kept: unknown key"):
        alarms_of(wrong)
