"""Faults that begin in the middle of a cycle: what alarms say of them, and when."""

from functools import cache

import numpy as np
import pytest
import rigs
from rigs import Collect

from twin.alarms.loop import Alarms
from twin.alarms.settings import board_rules
from twin.cli.console import Console
from twin.events import Kind
from twin.figures.cycle import KeyFigures
from twin.live import run
from twin.model.effects import EFFECTS, UNKNOWN

CYCLE_S = {"test_rig": 3.2, "gripper": 2.0}
FIRST_S, CYCLES = 0.5, 5  # when the first cycle begins, and whole ones before a fault
FAULTS = {  # the drawn size lies in between
    "leakage": (1.0, 2.5),
    "porous_leakage": (1.0, 2.5),
    "check_valve_leak": (1.0, 3.0),
    "suction_loss": (6.0, 15.0),
    "sensor_offset": (8.0, 20.0),
    "weak_blow_off": (25.0, 35.0),
    "added_volume": (25.0, 50.0),
}


@cache
def watched(name: str, fault: str, seconds: float, seed: int, size: int = 2000) -> Collect:
    """The loop over a rig with a fault, with its bank of hypotheses, key figures and alarms."""
    monitor, seen = rigs.isolating(name), Collect()
    monitor.key_figure_source = KeyFigures(rigs.config(name).data)
    blocks = rigs.cut(rigs.recorded(name, seconds, (fault,), seed)[0], size)
    run(blocks, rigs.twin(name), monitor, [seen], advisers=[Alarms(board_rules(None), None)])
    return seen


def drawn(seed: int) -> tuple[str, str, str, float]:
    """System, effect, fault and when it begins (s), at any moment of a cycle."""
    rng = np.random.default_rng([24, seed])
    name = rigs.NAMES[seed % len(rigs.NAMES)]
    effect = str(rng.choice(list(FAULTS)))
    begins_s = FIRST_S + CYCLE_S[name] * (CYCLES + rng.uniform())
    return name, effect, f"{effect}={rng.uniform(*FAULTS[effect]):.2f}@{begins_s:.3f}", begins_s


def begun_ns(seen: Collect, begins_s: float) -> int:
    return int(seen.samples[0]["time_ns"][0]) + round(begins_s * 1e9)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_no_cause_is_named_from_the_cycle_in_which_a_fault_began(seed: int) -> None:
    name, effect, fault, begins_s = drawn(seed)
    seen = watched(name, fault, begins_s + 5.0 * CYCLE_S[name], seed)
    since = begun_ns(seen, begins_s)
    mixed, whole, *_ = sorted(
        {event.time_ns for event in seen.of(Kind.CYCLE) if event.time_ns >= since}
    )
    begun, *named = seen.of(Kind.DEVIATION)
    assert begun.data["effect"] == UNKNOWN
    assert begun.data["phase"] in ("idle", "suction", "hold", "blow_off")
    assert mixed <= begun.time_ns <= whole  # it may be too little of it that is in the first one
    assert named, f"{fault} was not named"
    for event in named:
        assert event.time_ns > max(mixed, begun.time_ns)
        assert effect in (event.data["effect"], *str(event.data["also"]).split(",")), event.text
    raised = [event for event in seen.of(Kind.ALARM) if event.data["deed"] == "raised"]
    assert [event.data["alarm"] for event in raised] == ["deviation_unknown"]
    first = next(event for event in seen.of(Kind.ALARM) if event.data["deed"] == "renamed")
    assert first.data["alarm"] == f"deviation_{named[0].data['effect']}"


def leaking() -> Collect:
    """A leak so large that H1 is not reached any more, for longer than the delays of figures."""
    return watched("gripper", "leakage=8@10.9", 45.0, 1, 60_000)


def test_one_fault_is_one_alarm() -> None:
    seen = leaking()
    assert any("h1_not_reached" in event.data["warnings"] for event in seen.of(Kind.CYCLE))
    announced = {event.data["alarm"] for event in seen.of(Kind.ALARM)}
    assert all(alarm.startswith("deviation_") for alarm in announced)
    (quiet,) = [
        event
        for event in seen.of(Kind.ALARM_CHANGED)
        if event.data["alarm"] == "h1_not_reached" and event.data["deed"] == "raised"
    ]
    assert quiet.data["state"] == "suppressed"
    words = quiet.data["evidence"]["words"]
    assert words.startswith("H1 not reached (highest ")
    assert "0 or 1" not in words


def test_what_happens_comes_in_the_order_of_time() -> None:
    times = [event.time_ns for event in leaking().events]
    assert times == sorted(times)


def test_no_sentence_is_printed_twice(capsys: pytest.CaptureFixture[str]) -> None:
    seen = leaking()
    Console().write(seen.samples[0][:0], seen.ticks[0][:0], seen.events)
    alarms = [line for line in capsys.readouterr().out.splitlines() if "deviation" in line]
    assert len(alarms) >= 4
    sentences = [
        sentence
        for line in alarms
        for sentence in line.split("  ", 3)[-1].replace("; ", ". ").split(". ")
        if "mbar from healthy" in sentence or sentence.startswith("The ejector does not")
    ]
    assert len(sentences) == len(set(sentences))


def test_a_figure_that_is_back_is_not_announced_when_its_cause_is_gone() -> None:
    """Its own delay is longer than the deviation takes to be cleared."""
    seen = watched("gripper", "leakage=8@c5/every:2", 30.0, 1)
    assert all(str(event.data["alarm"]).startswith("deviation_") for event in seen.of(Kind.ALARM))


@pytest.mark.parametrize(
    "fault",
    ["suction_loss=85", "supply_pressure_drop=3.5", "weak_blow_off=94", "sensor_gain=-19"],
)
def test_no_size_is_told_that_the_effect_cannot_have(fault: str) -> None:
    seen = watched("gripper", f"{fault}@c5", 20.0, 1)
    for event in seen.of(Kind.DEVIATION):
        first = EFFECTS.get(str(event.data["effect"]))
        if first and "size" in event.data:
            (most,) = {
                max(abs(parameter.low), abs(parameter.high)) for parameter in first.parameters
            }
            assert abs(float(event.data["size"])) < most, event.text
