"""Alarms as ISA-18.2 has them: each state by itself, then any history, as a state machine."""

import math
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from tools.readme import filled
from twin.alarms.advice import action_of
from twin.alarms.board import Board, Diary, Episode
from twin.alarms.rules import Priority, Rule, default_rules, read_rules, write_rules
from twin.alarms.settings import board_rules
from twin.alarms.state import SECOND_NS, Alarm, AlarmAction, Change, State
from twin.alarms.statistics import statistics
from twin.alarms.watch import NAMES, deviating, values
from twin.errors import ConfigError
from twin.events import Event, Kind
from twin.model.effects import EFFECTS
from twin.settings import Document

S = SECOND_NS


def leak(**given: object) -> Rule:
    return Rule.model_validate({"name": "leak", "value": "leakage", "above": 250.0} | given)


def deeds(changes: list[Change]) -> list[AlarmAction]:
    return [change.action for change in changes]


def episodes(changes: Iterable[Change]) -> list[Episode]:
    """The episodes that changes in their order make, in the order they were raised."""
    diary, found = Diary(), dict[tuple[int, str], Episode]()
    for change in changes:
        found |= {(episode.raised_ns, episode.raised_as): episode for episode in diary.take(change)}
    return list(found.values())


def seen(alarm: Alarm, *values: tuple[float, float]) -> list[tuple[float, AlarmAction]]:
    """Show values at times (s); gives when what happened."""
    changes = [change for time, value in values for change in alarm.see(round(time * S), value)]
    return [(change.time_ns / S, change.action) for change in changes]


# One alarm.


def test_an_alarm_is_raised_acknowledged_and_cleared() -> None:
    alarm = Alarm(leak())
    assert alarm.state is State.NORMAL
    (raised,) = alarm.see(S, 251.0)
    assert raised == Change(S, "leak", AlarmAction.RAISED, "", announced=True)
    assert alarm.state is State.UNACKNOWLEDGED
    (acknowledged,) = alarm.acknowledge(2 * S, "ann")
    assert acknowledged == Change(2 * S, "leak", AlarmAction.ACKNOWLEDGED, "ann")
    assert alarm.state is State.ACKNOWLEDGED
    assert deeds(list(alarm.acknowledge(3 * S, "bob"))) == []
    assert seen(alarm, (4, 250.0)) == [(4, AlarmAction.CLEARED)]
    assert alarm.state is State.NORMAL


def test_what_has_gone_unseen_stands_until_it_is_acknowledged() -> None:
    alarm = Alarm(leak())
    seen(alarm, (1, 300.0), (2, 100.0))
    assert (alarm.active, alarm.state) == (False, State.RETURNED)
    seen(alarm, (3, 300.0))
    assert alarm.state is State.UNACKNOWLEDGED
    list(alarm.acknowledge(4 * S, "ann"))
    assert alarm.state is State.ACKNOWLEDGED


def test_a_limit_below() -> None:
    alarm = Alarm(Rule(name="supply_low", value="supply", below=3.0, dead_band=0.2))
    found = seen(alarm, (1, 3.0), (2, 2.9), (3, 3.1), (4, 3.2))
    assert found == [(2, AlarmAction.RAISED), (4, AlarmAction.CLEARED)]


def test_the_dead_band_holds_an_alarm() -> None:
    alarm = Alarm(leak(dead_band=20.0))
    found = seen(alarm, (1, 251.0), (2, 249.0), (3, 231.0), (4, 230.0), (5, 249.0), (6, 251.0))
    assert found == [(1, AlarmAction.RAISED), (4, AlarmAction.CLEARED), (6, AlarmAction.RAISED)]


def test_delays_need_the_value_to_stay() -> None:
    alarm = Alarm(leak(on_delay_s=3.0, off_delay_s=5.0))
    assert seen(alarm, (0, 300.0), (2, 300.0), (2.5, 100.0), (3, 300.0), (5.9, 300.0)) == []
    assert seen(alarm, (6, 300.0), (7, 100.0), (11, 100.0), (11.5, 300.0)) == [
        (6, AlarmAction.RAISED)
    ]
    assert seen(alarm, (12, 100.0), (16.9, 100.0), (17, math.nan)) == [(17, AlarmAction.CLEARED)]


def test_a_clock_set_back_begins_a_delay_anew() -> None:
    alarm = Alarm(leak(on_delay_s=3.0))
    assert seen(alarm, (100, 300.0), (10, 300.0), (12.9, 300.0)) == []
    assert seen(alarm, (13, 300.0)) == [(13, AlarmAction.RAISED)]


def test_a_latching_alarm_stands_until_it_is_acknowledged() -> None:
    alarm = Alarm(leak(latching=True))
    assert seen(alarm, (1, 300.0), (2, 100.0), (99, 100.0)) == [(1, AlarmAction.RAISED)]
    assert alarm.state is State.UNACKNOWLEDGED
    changes = list(alarm.acknowledge(100 * S, "ann"))
    assert deeds(changes) == [AlarmAction.ACKNOWLEDGED, AlarmAction.CLEARED]
    assert alarm.state is State.NORMAL


def test_a_latching_alarm_that_is_acknowledged_goes_when_its_cause_does() -> None:
    alarm = Alarm(leak(latching=True))
    seen(alarm, (1, 300.0))
    assert deeds(list(alarm.acknowledge(2 * S, "ann"))) == [AlarmAction.ACKNOWLEDGED]
    assert seen(alarm, (3, 100.0)) == [(3, AlarmAction.CLEARED)]


def test_shelving_ends_by_itself_and_what_stands_is_announced_then() -> None:
    alarm = Alarm(leak())
    list(alarm.shelve(0, 60.0, "ann"))
    (raised,) = alarm.see(10 * S, 300.0)
    assert (raised.announced, alarm.state) == (False, State.SHELVED)
    assert list(alarm.see(59 * S, 300.0)) == []
    (unshelved,) = alarm.see(60 * S, 300.0)
    assert (unshelved.action, unshelved.announced) == (AlarmAction.UNSHELVED, True)
    assert alarm.state is State.UNACKNOWLEDGED


def test_shelving_has_a_longest_time() -> None:
    alarm = Alarm(leak(longest_shelving_s=600.0))
    for seconds in (601.0, 0.0, -1.0, math.nan):
        with pytest.raises(ConfigError, match="leak cannot be shelved for"):
            list(alarm.shelve(0, seconds, "ann"))
    list(alarm.shelve(1000 * S, 600.0, "ann"))
    list(alarm.see(10 * S))  # the clock was set back
    assert deeds(list(alarm.see(610 * S))) == [AlarmAction.UNSHELVED]


def test_out_of_service_lasts_until_somebody_ends_it() -> None:
    alarm = Alarm(leak())
    assert deeds(list(alarm.serve(0, False, "ann"))) == [AlarmAction.OUT_OF_SERVICE]
    assert list(alarm.serve(1, False, "ann")) == []
    assert [change.announced for change in alarm.see(10 * S, 300.0)] == [False]
    assert alarm.state is State.OUT_OF_SERVICE
    (back,) = alarm.serve(10**6 * S, True, "bob")
    assert (back.action, back.who, back.announced) == (AlarmAction.IN_SERVICE, "bob", True)


def test_what_is_acknowledged_is_not_announced_again() -> None:
    alarm = Alarm(leak())
    seen(alarm, (1, 300.0))
    list(alarm.acknowledge(2 * S, "ann"))
    list(alarm.shelve(3 * S, 60.0, "ann"))
    assert [change.announced for change in alarm.unshelve(4 * S, "ann")] == [False]


# Several.

RULES = (
    Rule(name="stale", value="silence", above=0.5, priority=Priority.HIGH),
    leak(suppressed_by=("stale",), priority=Priority.MEDIUM),
    Rule(name="slow", value="t1", above=2000.0, suppressed_by=("stale",)),
)


def test_an_alarm_by_design_says_nothing_while_another_stands() -> None:
    board = Board(RULES)
    changes = board.see(S, {"silence": 1.0, "leakage": 300.0})
    assert [(change.alarm, change.action, change.announced) for change in changes] == [
        ("stale", AlarmAction.RAISED, True),
        ("leak", AlarmAction.RAISED, False),
        ("leak", AlarmAction.SUPPRESSED, False),
        ("slow", AlarmAction.SUPPRESSED, False),
    ]
    assert [alarm.rule.name for alarm in board.standing()] == ["stale"]
    changes = board.see(2 * S, {"silence": 0.0})
    assert [(change.alarm, change.action, change.announced) for change in changes] == [
        ("stale", AlarmAction.CLEARED, False),
        ("leak", AlarmAction.UNSUPPRESSED, True),
        ("slow", AlarmAction.UNSUPPRESSED, False),
    ]


def test_the_most_urgent_stand_first_and_of_these_the_unseen() -> None:
    rules = [
        Rule(name=name, value=name, above=0.0, priority=priority)
        for name, priority in (("a", "low"), ("b", "high"), ("c", "medium"), ("d", "high"))
    ]
    board = Board(rules)
    board.see(S, dict.fromkeys("abcd", 1.0))
    list(board["b"].acknowledge(2 * S, "ann"))
    assert [alarm.rule.name for alarm in board.standing()] == ["d", "b", "c", "a"]
    with pytest.raises(ConfigError, match="no alarm is called e"):
        board["e"]


def test_episodes_have_their_lengths_and_who_has_seen_them() -> None:
    alarm = Alarm(leak())
    changes: list[Change] = []
    for time, value in ((1, 300.0), (4, 100.0), (6, 300.0)):
        changes += alarm.see(time * S, value)
    changes += alarm.acknowledge(7 * S, "ann")
    changes += alarm.see(9 * S, 100.0)
    changes += alarm.see(20 * S, 300.0)
    found = episodes(changes)
    assert found == [
        Episode("leak", 1 * S, 4 * S, 7 * S, "ann"),
        Episode("leak", 6 * S, 9 * S, 7 * S, "ann"),
        Episode("leak", 20 * S),
    ]
    assert [cycle.seconds for cycle in found] == [3.0, 3.0, None]


# No chattering.


@settings(deadline=None)
@given(
    st.floats(200.0, 300.0),
    st.lists(st.floats(-9.9, 9.9), min_size=1, max_size=300),
)
def test_noise_within_the_dead_band_raises_an_alarm_once(level: float, noise: list[float]) -> None:
    alarm = Alarm(leak(dead_band=20.0))
    found = seen(alarm, *((number, level + value) for number, value in enumerate(noise)))
    assert len(found) <= 1


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.01, 20.0), st.floats(0.0, 500.0)), min_size=1, max_size=200),
    st.floats(0.5, 10.0),
    st.floats(0.5, 10.0),
)
def test_delays_bound_how_often_an_alarm_comes(
    values: list[tuple[float, float]], on_s: float, off_s: float
) -> None:
    alarm, time, found = Alarm(leak(on_delay_s=on_s, off_delay_s=off_s)), 0.0, []
    for pause, value in values:
        time += pause
        found += seen(alarm, (time, value))
    assert [deed for _, deed in found[::2]] == [AlarmAction.RAISED] * len(found[::2])
    assert [deed for _, deed in found[1::2]] == [AlarmAction.CLEARED] * len(found[1::2])
    raised = [when for when, deed in found if deed is AlarmAction.RAISED]
    gaps = [later - before for before, later in pairwise(raised)]
    assert all(gap >= on_s + off_s - 1e-6 for gap in gaps)


class AnyHistory(RuleBasedStateMachine):
    """Whatever happens in whatever order, an alarm keeps to what ISA-18.2 says of its states."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0
        self.board = Board(
            (
                Rule(name="stale", value="silence", above=0.5),
                leak(
                    dead_band=20.0,
                    on_delay_s=2.0,
                    off_delay_s=3.0,
                    latching=True,
                    suppressed_by=("stale",),
                    longest_shelving_s=60.0,
                ),
            )
        )
        self.alarm = self.board["leak"]
        self.history: list[Change] = []
        self.shelved_at = 0

    @rule(
        seconds=st.floats(0.001, 40.0),
        leakage=st.floats(0.0, 500.0) | st.just(math.nan),
        silence=st.sampled_from([0.0, 1.0, math.nan]),
    )
    def time_goes_on(self, seconds: float, leakage: float, silence: float) -> None:
        self.now += round(seconds * S)
        self.history += self.board.see(self.now, {"leakage": leakage, "silence": silence})

    @rule()
    def acknowledged(self) -> None:
        self.history += self.alarm.acknowledge(self.now, "ann")
        assert self.alarm.acknowledged

    @rule(seconds=st.floats(0.1, 60.0))
    def shelved(self, seconds: float) -> None:
        self.history += self.alarm.shelve(self.now, seconds, "ann")
        self.shelved_at = self.now

    @rule()
    def unshelved(self) -> None:
        self.history += self.alarm.unshelve(self.now, "ann")

    @rule(wanted=st.booleans())
    def served(self, wanted: bool) -> None:
        self.history += self.alarm.serve(self.now, wanted, "ann")

    @invariant()
    def raised_and_cleared_take_turns(self) -> None:
        turns = [
            change.action
            for change in self.history
            if change.alarm == "leak" and change.action in (AlarmAction.RAISED, AlarmAction.CLEARED)
        ]
        assert turns == [
            (AlarmAction.RAISED, AlarmAction.CLEARED)[n % 2] for n in range(len(turns))
        ]
        assert self.alarm.active == (len(turns) % 2 == 1)

    @invariant()
    def what_latches_stays_until_it_is_seen(self) -> None:
        for episode in episodes([change for change in self.history if change.alarm == "leak"]):
            if episode.cleared_ns is not None:
                assert episode.acknowledged_ns is not None
                assert episode.raised_ns <= episode.acknowledged_ns <= episode.cleared_ns
        assert self.alarm.state is not State.RETURNED

    @invariant()
    def nothing_quiet_is_announced(self) -> None:
        quiet: set[AlarmAction] = set()
        ends = {
            AlarmAction.UNSHELVED: AlarmAction.SHELVED,
            AlarmAction.UNSUPPRESSED: AlarmAction.SUPPRESSED,
            AlarmAction.IN_SERVICE: AlarmAction.OUT_OF_SERVICE,
        }
        for change in self.history:
            if change.alarm != "leak":
                continue
            if change.action in ends.values():
                quiet.add(change.action)
            quiet.discard(ends.get(change.action, AlarmAction.RAISED))
            assert not (change.announced and quiet)

    @invariant()
    def shelving_ends(self) -> None:
        if self.alarm.shelved_until is not None:
            assert self.now - self.shelved_at < 60 * S

    @invariant()
    def the_design_holds(self) -> None:
        assert self.alarm.suppressed == self.board["stale"].active

    @invariant()
    def an_alarm_that_stands_was_announced(self) -> None:
        if self.alarm.state is State.UNACKNOWLEDGED:
            raised = [
                n
                for n, change in enumerate(self.history)
                if change.alarm == "leak" and change.action is AlarmAction.RAISED
            ][-1]
            assert any(
                change.announced and change.alarm == "leak" for change in self.history[raised:]
            )


TestAnyHistory = AnyHistory.TestCase
TestAnyHistory.settings = settings(max_examples=40, stateful_step_count=40, deadline=None)


# Rules as a file.

TEXT = """
[[alarm]]
name = "stale"
value = "silence_s"
above = 0.5
priority = "high"

[[alarm]]
name = "leak"
value = "leakage"
above = 250.0
dead_band = 20.0
on_delay_s = 10.0
latching = true
consequence = "the part may be lost"
action = "look for a worn cup"
suppressed_by = ["stale"]
"""


def document(text: str) -> Document:
    return Document.parse(text, "alarms.toml")


def test_rules_survive_their_file() -> None:
    rules = read_rules(document(TEXT))
    assert [rule.name for rule in rules] == ["stale", "leak"]
    assert rules[1].suppressed_by == ("stale",)
    assert read_rules(document(write_rules(rules))) == rules


@given(
    st.builds(
        Rule,
        name=st.just("a"),
        value=st.text(min_size=1),
        above=st.floats(-1e6, 1e6),
        dead_band=st.floats(0, 1e3),
        on_delay_s=st.floats(0, 1e3),
        latching=st.booleans(),
        priority=st.sampled_from(Priority),
        consequence=st.text(),
        action=st.text(),
    )
)
def test_any_rule_survives_its_file(any_rule: Rule) -> None:
    assert read_rules(document(write_rules([any_rule]))) == (any_rule,)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("above = 250.0", "", r"alarms\.toml:8: alarm, 2nd entry: .*needs one limit"),
        ("above = 250.0", "above = 250.0\nbelow = 3.0", "needs one limit: above or below"),
        ("dead_band", "dead_bend", r"alarms\.toml:12: alarm, 2nd entry, dead_bend: unknown key"),
        ('"stale"]', '"nobody"]', "leak is suppressed by nobody: no such alarm"),
        ('"stale"]', '"leak"]', "leak suppresses itself"),
        ('name = "leak"', 'name = "stale"', "several alarms are called stale"),
        (
            "on_delay_s = 10.0",
            "on_delay_s = -1.0",
            r"alarms\.toml:13: alarm, 2nd entry, on_delay",
        ),
    ],
)
def test_a_rule_that_cannot_be_is_refused_with_its_place(old: str, new: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        read_rules(document(TEXT.replace(old, new, 1)))


def test_the_rules_that_come_with_the_program_watch_what_there_is() -> None:
    rules = default_rules()
    assert {rule.value for rule in rules} == NAMES
    assert all(rule.consequence and rule.action for rule in rules)
    assert read_rules(document(write_rules(rules))) == rules


def event(kind: Kind, **data: object) -> Event:
    return Event(0, kind, "", data)


def test_events_become_values() -> None:
    assert values(event(Kind.PLC_STALE)) == {"plc_stale": 1.0}
    assert values(event(Kind.PLC_BACK)) == {"plc_stale": 0.0}
    assert values(event(Kind.DEVIATION_CLEARED)) == deviating()
    assert values(event(Kind.DEVIATION, effect="leakage")) == deviating("leakage")
    assert values(event(Kind.DEVIATION, effect="nobody")) == deviating("unlisted")
    assert sorted(deviating("leakage").values()) == [0.0] * (len(EFFECTS) + 1) + [1.0]
    assert values(event(Kind.GAP)) == {}
    assert values(event(Kind.CYCLE, cycle=3)) == {}


def test_a_warning_that_could_not_be_judged_keeps_its_alarm() -> None:
    board = Board([leak(value="leakage_over_limit", above=0.5)])
    over = event(Kind.CYCLE, warnings=["leakage_over_limit"], leakage_measured=300.0)
    unknown = event(Kind.CYCLE, warnings=["h1_not_reached"], h1_not_reached_measured=1.0)
    good = event(Kind.CYCLE, warnings=[], leakage_measured=30.0)
    found = [
        deeds(board.see(n * S, values(value))) for n, value in enumerate((over, unknown, good))
    ]
    assert found == [[AlarmAction.RAISED], [], [AlarmAction.CLEARED]]


def test_a_file_without_alarms_is_none(tmp_path: Path) -> None:
    path = tmp_path / "alarms.toml"
    path.write_text("")
    with pytest.raises(ConfigError, match="no alarm in it"):
        read_rules(Document.read(path))


# By cause.


def test_a_rule_on_the_deviation_is_one_for_each_cause() -> None:
    made = {rule.name: rule for rule in board_rules(None)}
    assert {f"deviation_{cause}" for cause in (*EFFECTS, "unlisted", "unknown")} < set(made)
    assert "deviation" not in made
    leakage = made["deviation_leakage"]
    assert leakage.value == "deviation.leakage"
    assert action_of(leakage, {}).startswith(f"Look at {EFFECTS['leakage'].look_at}. ")


def test_what_the_deviation_suppresses_every_cause_does(tmp_path: Path) -> None:
    text = write_rules(default_rules()).replace(
        'name = "valve_protection"', 'name = "valve_protection"\nlatching = true', 1
    )
    old = 'suppressed_by = [\n    "plc_stale",\n    "deviation_supply_pressure_drop",\n]'
    assert old in text
    text = text.replace(old, 'suppressed_by = ["deviation"]')
    (tmp_path / "alarms.toml").write_text(text)
    (tmp_path / "cell.toml").write_text('[alarms]\nrules = "alarms.toml"\n')
    made = {rule.name: rule for rule in board_rules(Document.read(tmp_path / "cell.toml"))}
    assert made["valve_protection"].latching
    by = made["supply_out_of_range"].suppressed_by
    assert by == tuple(f"deviation_{cause}" for cause in (*EFFECTS, "unlisted", "unknown"))


def test_an_alarm_may_be_suppressed_by_one_cause_alone() -> None:
    made = {rule.name: rule for rule in board_rules(None)}
    assert made["supply_out_of_range"].suppressed_by == (
        "plc_stale",
        "deviation_supply_pressure_drop",
    )
    assert "deviation_unknown" in made["h1_not_reached"].suppressed_by


def quiet_figure() -> tuple[Board, list[Change]]:
    """A figure's alarm that was raised while the deviation that explains it stood."""
    rules = (
        Rule(name="fault", value="fault", above=0.5),
        leak(off_delay_s=30.0, suppressed_by=("fault",)),
    )
    board = Board(rules)
    changes = board.see(S, {"fault": 1.0, "leakage": 30.0})
    return board, changes + board.see(2 * S, {"leakage": 300.0})


def test_what_nobody_was_told_of_is_over_with_what_suppressed_it() -> None:
    board, changes = quiet_figure()
    changes += board.see(5 * S, {"leakage": 30.0})
    changes += board.see(9 * S, {"fault": 0.0})  # long before its own delay has passed
    assert not any(change.announced for change in changes if change.alarm == "leak")
    assert board["leak"].state is State.NORMAL
    diary = Diary()
    *_, over = [
        episode for change in changes for episode in diary.take(change) if episode.alarm == "leak"
    ]
    assert (over.is_over, over.acknowledged_by) == (True, "suppression")


def test_what_still_stands_is_announced_with_the_end_of_what_suppressed_it() -> None:
    board, _ = quiet_figure()
    changes = board.see(9 * S, {"fault": 0.0})
    assert [change.action for change in changes if change.announced] == [AlarmAction.UNSUPPRESSED]
    assert board["leak"].state is State.UNACKNOWLEDGED


def test_what_suppression_keeps_from_people_does_not_load_them_yet() -> None:
    board, changes = quiet_figure()

    def load() -> int:
        named = [("rig", episode) for episode in episodes(changes) if episode.alarm == "leak"]
        return statistics(named, 0, 10 * S).count

    assert board["leak"].active
    assert load() == 0
    changes += board.see(9 * S, {"fault": 0.0})  # now it is announced
    assert load() == 1


def test_of_two_raised_at_once_the_suppressed_one_does_not_load_people() -> None:
    board = Board([Rule(name="fault", value="fault", above=0.5), leak(suppressed_by=("fault",))])
    both = episodes(board.see(S, {"fault": 1.0, "leakage": 300.0}))
    assert [episode.alarm for episode in both] == ["fault", "leak"]
    assert statistics([("rig", episode) for episode in both], 0, 10 * S).count == 1


def test_who_acknowledged_what_was_suppressed_stays_known() -> None:
    board, changes = quiet_figure()
    changes += board["leak"].acknowledge(3 * S, "ann")
    changes += board.see(5 * S, {"leakage": 30.0}) + board.see(9 * S, {"fault": 0.0})
    diary = Diary()
    *_, over = [
        episode for change in changes for episode in diary.take(change) if episode.alarm == "leak"
    ]
    assert (over.is_over, over.acknowledged_by) == (True, "ann")


def test_a_rule_on_what_nobody_says_is_refused(tmp_path: Path) -> None:
    (tmp_path / "alarms.toml").write_text(TEXT)
    (tmp_path / "cell.toml").write_text('[alarms]\nrules = "alarms.toml"\n')
    with pytest.raises(ConfigError, match=r"alarms\.toml: stale watches silence_s"):
        board_rules(Document.read(tmp_path / "cell.toml"))


def test_an_alarm_goes_on_under_another_name() -> None:
    board, diary = Board(board_rules(None)), Diary()
    changes = board.see(S, deviating("leakage"))
    changes = [change for change in changes if change.action is not AlarmAction.SUPPRESSED]
    changes += board["deviation_leakage"].acknowledge(2 * S, "ann")
    changes += board.rename(3 * S, "deviation.leakage", "deviation.porous_leakage")
    assert board["deviation_leakage"].state is State.NORMAL
    assert board["deviation_porous_leakage"].state is State.ACKNOWLEDGED
    assert deeds(changes) == [AlarmAction.RAISED, AlarmAction.ACKNOWLEDGED, AlarmAction.RENAMED]
    assert not changes[-1].announced  # somebody takes care already
    assert board.see(4 * S, {}) == []
    changes += [
        change for change in board.see(5 * S, deviating()) if change.action is AlarmAction.CLEARED
    ]
    assert [len(diary.take(change)) for change in changes] == [1, 1, 1, 1]
    assert episodes(changes) == [Episode("deviation_porous_leakage", S, 5 * S, 2 * S, "ann")]


def test_what_keeps_a_name_quiet_does_not_follow_to_the_other() -> None:
    board = Board(board_rules(None))
    list(board["deviation_leakage"].shelve(0, 3600.0, "ann"))
    assert not any(change.announced for change in board.see(S, deviating("leakage")))
    (renamed,) = board.rename(2 * S, "deviation.leakage", "deviation.suction_loss")
    assert renamed.announced
    assert board["deviation_suction_loss"].state is State.UNACKNOWLEDGED
    assert board["deviation_leakage"].state is State.SHELVED


def test_an_alarm_resumes_where_another_run_ended() -> None:
    before, after = Alarm(leak(off_delay_s=5.0)), Alarm(leak(off_delay_s=5.0))
    seen(before, (1, 300.0))
    list(before.acknowledge(2 * S, "ann"))
    list(before.shelve(2 * S, 60.0, "ann"))
    after.resume(before.keep())
    assert after.state is State.SHELVED
    assert seen(after, (10, 300.0), (11, 100.0)) == []
    assert seen(after, (16, 100.0)) == [(16, AlarmAction.CLEARED)]
    assert deeds(list(after.see(62 * S))) == [AlarmAction.UNSHELVED]
    assert after.state is State.NORMAL


def test_the_page_on_alarms_has_the_tables_of_the_code() -> None:
    page = (Path(__file__).parents[1] / "docs" / "alarms.md").read_text(encoding="utf-8")
    assert filled(page) == page, "run: python tools/readme.py"
    assert all(f"`{state}`" in page for state in State)
