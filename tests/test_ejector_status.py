"""The traffic light: red for what nobody has taken care of, green only where nothing is."""

import pytest

from twin.alarms.advice import action_of
from twin.alarms.board import Board, Episode
from twin.alarms.rules import Priority, Rule
from twin.alarms.state import Kept
from twin.instants import instant
from twin.languages.choice import language_of
from twin.languages.texts import speaking
from twin.page.ejector_status import (
    S_NS,
    Light,
    alarm_cards,
    episode_details,
    facts,
    light_of,
)

STATES = {
    "normal": (Kept(), Light.GREEN, Light.GREEN),
    "unacknowledged": (Kept(True, False), Light.RED, Light.YELLOW),
    "acknowledged": (Kept(True, True), Light.YELLOW, Light.YELLOW),
    "returned": (Kept(False, False), Light.YELLOW, Light.YELLOW),
    "shelved, active": (Kept(True, False, 9), Light.YELLOW, Light.YELLOW),
    "shelved, active, acknowledged": (Kept(True, True, 9), Light.YELLOW, Light.YELLOW),
    "shelved, nothing to say": (Kept(False, True, 9), Light.GREEN, Light.GREEN),
    "out of service": (Kept(False, True, None, True), Light.YELLOW, Light.YELLOW),
    "out of service, active": (Kept(True, False, None, True), Light.YELLOW, Light.YELLOW),
}


def board(**priorities: Priority) -> Board:
    return Board([Rule(name=n, value=n, above=0.5, priority=p) for n, p in priorities.items()])


@pytest.mark.parametrize("priority", list(Priority))
@pytest.mark.parametrize("state", STATES)
def test_the_light_of_each_state(state: str, priority: Priority) -> None:
    kept, urgent, low = STATES[state]
    one = board(a=priority, other=Priority.HIGH)
    one.resume({"a": kept})
    assert light_of(one, running=True) is (low if priority is Priority.LOW else urgent)
    assert light_of(one, running=False) is Light.GREY


def test_the_worst_alarm_counts() -> None:
    one = board(a=Priority.LOW, b=Priority.MEDIUM, c=Priority.HIGH)
    one.resume({"a": Kept(True, False), "b": Kept(True, False), "c": Kept(True, True)})
    assert light_of(one, running=True) is Light.RED


def test_what_is_active_and_unseen_is_listed_first() -> None:
    one = board(seen=Priority.HIGH, gone=Priority.HIGH, low=Priority.LOW, quiet=Priority.HIGH)
    one.resume(
        {
            "seen": Kept(True, True),
            "gone": Kept(False, False),
            "low": Kept(True, False),
            "quiet": Kept(True, False, 9),
        }
    )
    assert [alarm["alarm"] for alarm in alarm_cards(one, [], [], 0)] == [
        "low",
        "seen",
        "gone",
        "quiet",
    ]


def test_an_effect_that_was_taken_in_is_told_in_the_words_of_who_did() -> None:
    words = {"name": "lifting_lip", "sentence": "A lip lifts off", "look_at": "the lips: worn"}
    episode = Episode("deviation_unlisted", 10, None, None, "", evidence={"taken_in": words})
    said = episode_details(episode, "deviation.unlisted", 20)
    assert (said["what"], said["sentence"]) == ("Lifting lip", "A lip lifts off.")
    assert said["where"] == "the lips"
    rule = Rule(name="deviation_unlisted", value="deviation.unlisted", above=0.5)
    assert action_of(rule, episode.evidence).startswith("Look at the lips: worn.")


def test_instants_are_worded_as_everywhere() -> None:
    begin = 1_790_000_000 * S_NS  # 2026-09-21 14:13:20 UTC
    now = begin + 480 * S_NS
    episode = Episode("plc_stale", begin, begin + 60 * S_NS, begin + 120 * S_NS, "ann")
    assert episode_details(episode, "plc_stale", now)["times"] == {
        "raised": "14:13:20, 8 min ago",
        "cleared": "14:14:20, 7 min ago",
        "seen": "14:15:20, 6 min ago",
        "lasted": "60 s",
    }
    assert episode_details(episode, "plc_stale", now)["times"]["raised"] == instant(begin, now)
    one = board(quiet=Priority.HIGH)
    one.resume({"quiet": Kept(True, False, now + 1200 * S_NS)})
    (alarm,) = alarm_cards(one, [], [], now)
    assert alarm["quiet_until"] == "14:41:20, in 20 min"


DIAGNOSED = {
    "words": "leakage (1.98 sl/min), since 2026-11-28 05:11:09; how sure: 83 %; look at cups",
    "effect": "leakage",
    "course": "step",
    "parameters": {
        "sonic_flow": {"value": 1.982, "unit": "sl/min", "low95": 1.925, "high95": 2.038}
    },
    "probability": 0.83,
    "not_separable_from": ["porous_leakage"],
    "onset_s": 10.0,
    "onset_low95_s": 9.91,
    "onset_high95_s": 10.07,
    "begin_s": 0.0,
    "log_begin_ns": 1_000_000_000 * S_NS,
}


def test_evidence_of_a_diagnosis_is_told_in_the_readers_language() -> None:
    with speaking(language_of("de", "language")):
        told = dict(facts(DIAGNOSED))
    assert told["Größe"] == "1,98 sl/min (95 %: 1,93 bis 2,04)"
    assert ".09.2001 " in told["Zeitraum"]
    assert "10,0 s nach Beginn der Aufzeichnung (95 %: 9,9 s bis 10,1 s)" in told["Zeitraum"]
    assert "leakage" not in " ".join(told.values())
    assert dict(facts(DIAGNOSED))["evidence"] == DIAGNOSED["words"]


@pytest.mark.parametrize(
    ("words", "label", "text"),
    [
        (
            "H1 not reached (highest 612.5 mbar)",
            "Befund",
            "H1 nicht erreicht (höchstens 612,5 mbar)",
        ),
        ("mqtt: refused 1.5", "Befund (englisch)", "mqtt: refused 1.5"),
    ],
)
def test_evidence_that_is_english_says_so(words: str, label: str, text: str) -> None:
    with speaking(language_of("de", "language")):
        assert list(facts({"words": words})) == [(label, text)]


COSTLY = DIAGNOSED | {
    "cost": {
        "air_nl_per_cycle": {"value": 0.5, "low95": 0.4, "high95": 0.6},
        "money_per_year": {"value": 145.2, "low95": 110.0, "high95": 1180.0},
        "currency": "€",
        "cycles_per_year": 4_000_000,
        "operating_hours": 4000.0,
        "differs_from_zero": True,
    }
}


@pytest.mark.parametrize(
    ("code", "label", "text"),
    [
        ("en", "cost", "this leakage costs about 145 € a year (95 %: 110 to 1180), 4000 h of"),
        ("de", "Kosten", "Leckage kostet etwa 145 € im Jahr (95 %: 110 bis 1180), 4000"),
    ],
)
def test_the_card_and_the_history_say_what_the_cause_costs(
    code: str, label: str, text: str
) -> None:
    one = board(a=Priority.HIGH)
    one.resume({"a": Kept(True, False)})
    episode = Episode("a", 10, evidence=COSTLY)
    with speaking(language_of(code, "language")):
        (card,) = alarm_cards(one, [episode], [], 20)
        history = episode_details(episode, "a", 20)
        assert dict(card["facts"])[label].startswith(text)
        assert history["facts"] == card["facts"]
        assert label not in dict(facts(DIAGNOSED))
