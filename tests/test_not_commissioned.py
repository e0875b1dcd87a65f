"""A unit that is not commissioned: that something differs is told, and no cause is named."""

from dataclasses import replace
from functools import cache

import pytest
import rigs
from rigs import Collect

from twin.alarms.advice import COMMISSION
from twin.alarms.loop import Alarms
from twin.alarms.settings import board_rules
from twin.cli.setup import pair_of
from twin.config import Config
from twin.diagnosis.answer import diagnose
from twin.diagnosis.process import LiveDiagnosis
from twin.events import Kind
from twin.live import run
from twin.model.effects import UNKNOWN
from twin.monitor.healthy import NOT_COMMISSIONED, Healthy
from twin.page.ejector_status import facts

SECONDS, LEAK = 60.0, "leakage=4@30"


@cache
def uncalibrated() -> Config:
    """The gripper as a person describes it, with what its healthy cycles are like unknown."""
    config = rigs.config("gripper")
    ejector = config.data.ejector.model_copy(update={"suction_capacity_sl_min": 30.0})
    return replace(
        config,
        data=config.data.model_copy(update={"ejector": ejector}),
        monitor=config.monitor.model_copy(update={"healthy": Healthy()}),
    )


def live() -> LiveDiagnosis:
    return LiveDiagnosis(uncalibrated(), "live", lambda: False, pytest.fail)


@cache
def watched() -> Collect:
    seen = Collect()
    blocks = rigs.cut(rigs.recorded("gripper", SECONDS, (LEAK,), 3)[0], 2000)
    advisers = [live(), Alarms(board_rules(None), None)]
    run(blocks, *pair_of(uncalibrated()), [seen], advisers=advisers)
    return seen


def test_that_something_differs_is_told_and_no_cause_is_named() -> None:
    raised = watched().of(Kind.DEVIATION)
    assert raised
    for event in raised:
        assert event.data["effect"] == UNKNOWN
        assert event.data["also"] == ""
        assert "size" not in event.data
        assert event.text.endswith(NOT_COMMISSIONED)


def test_alarm_log_and_page_say_that_it_is_not_commissioned() -> None:
    (alarm,) = (
        event for event in watched().of(Kind.ALARM) if event.data["alarm"].startswith("deviation")
    )
    assert alarm.data["alarm"] == "deviation_unknown"
    assert NOT_COMMISSIONED in alarm.text
    evidence = alarm.data["evidence"]
    assert NOT_COMMISSIONED in evidence["words"]  # which the alarm list prints
    assert ("how sure", NOT_COMMISSIONED) in list(facts(evidence))
    assert alarm.data["action"] == COMMISSION  # a diagnosis would say nothing more
    assert alarm.text.endswith(COMMISSION)


def test_no_cause_is_named_anywhere() -> None:
    for event in watched().events:
        likely = event.data.get("probabilities", {})
        assert set(likely) <= {"none", UNKNOWN}
        alarm = str(event.data.get("alarm", ""))
        assert alarm == "deviation_unknown" or not alarm.startswith("deviation")
        assert event.data.get("effect") in (None, UNKNOWN)


def test_it_is_not_diagnosed_while_it_runs() -> None:
    assert watched().of(Kind.DIAGNOSIS) == []


def test_a_diagnosis_says_what_to_do_first() -> None:
    samples = rigs.recorded("gripper", SECONDS, (LEAK,), 3)[0]
    answer = diagnose(uncalibrated(), [samples], "day.mcap", lambda _what: None).json
    assert (answer["verdict"], answer["causes"], answer["runners_up"]) == ("insufficient", [], [])
    assert answer["next_experiment"].startswith(NOT_COMMISSIONED)
    assert "twin commission HEALTHY.mcap --id gripper-01" in answer["next_experiment"]
