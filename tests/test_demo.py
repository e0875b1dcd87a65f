"""What the demo takes for shown, and what it fails for."""

from collections.abc import Callable
from typing import Any

import pytest

from tools.demo import judged
from twin.events import Event, Kind
from twin.model.effects import UNKNOWN

S = 1_000_000_000
BEGAN_NS = 100 * S  # of the log
OPENED_NS = 113 * S  # when the leak did
LIVE_NS = 104 * S  # from which the live twin counts


def cause(effect: str, onset_s: float | None) -> dict[str, Any]:
    return {"effect": effect, "onset_s": onset_s}


class Shown:
    """What a demo leaves that showed everything; each test spoils one thing."""

    def __init__(self) -> None:
        self.stream: list[Event] = []
        self.alarms = [(115.0, UNKNOWN), (118.0, "leakage")]  # s of PLC time
        self.live: dict[str, Any] | None = {"causes": [cause("leakage", 9.1)]}
        self.answer: dict[str, Any] = {"causes": [cause("leakage", 12.9)]}
        self.opened_ns: int | None = OPENED_NS

    def judged(self) -> int:
        events = list(self.stream)
        for second, effect in self.alarms:
            data = {"effect": effect}
            events.append(Event(round(second * S), Kind.DEVIATION, "it deviates", data))
        data = {"alarm_ns": 118 * S, "begin_ns": LIVE_NS}
        data |= {} if self.live is None else {"answer": self.live}
        events.append(Event(130 * S, Kind.DIAGNOSIS, "what it is", data))
        return judged(events, self.answer, BEGAN_NS, self.opened_ns)


def test_a_leak_that_was_named_each_time_with_its_onset_is_shown() -> None:
    assert Shown().judged() == 0


@pytest.mark.parametrize(
    ("spoil", "failure"),
    [
        (
            lambda it: it.stream.append(Event(101 * S, Kind.PLC_STALE, "no fresh sample")),
            "the PLC was called stale, and it was not",
        ),
        (lambda it: it.alarms.clear(), "no alarm named the leak while the twin ran"),
        (lambda it: it.alarms.pop(), "no alarm named the leak while the twin ran"),
        (
            lambda it: it.alarms.__setitem__(0, (115.0, "check_valve_leak")),
            "alarms named check_valve_leak, leakage, and it was the leak alone",
        ),
        (
            lambda it: it.alarms.append((122.0, "ambient_pressure")),
            "alarms named leakage, ambient_pressure, and it was the leak alone",
        ),
        (
            lambda it: it.alarms.insert(0, (112.9, UNKNOWN)),
            "an alarm came before the leak opened",
        ),
        (lambda it: setattr(it, "live", None), "the live twin made no diagnosis"),
        (
            lambda it: it.live.update(causes=[cause("suction_loss", 9.0)]),
            "the diagnosis of the live twin names suction_loss, not the leak",
        ),
        (
            lambda it: it.live.update(causes=[]),
            "the diagnosis of the live twin names nothing, not the leak",
        ),
        (
            lambda it: it.live.update(causes=[cause("leakage", 9.3)]),
            "the onset of the live twin is +0.30 s off",
        ),
        (
            lambda it: it.live.update(causes=[cause("leakage", None)]),
            "the diagnosis of the live twin does not say since when the leak is there",
        ),
        (
            lambda it: it.answer.update(causes=[cause("leakage", 13.0), cause("sensor_lag", 0.0)]),
            "the diagnosis of the log names leakage, sensor_lag, not the leak",
        ),
        (
            lambda it: it.answer.update(causes=[cause("leakage", 12.7)]),
            "the onset of the log is -0.30 s off",
        ),
        (
            lambda it: setattr(it, "opened_ns", None),
            "the log does not hold the moment when the leak opens",
        ),
    ],
)
def test_what_was_not_shown_is_said_and_is_exit_code_1(
    spoil: Callable[[Shown], object], failure: str, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = Shown()
    spoil(shown)
    assert shown.judged() == 1
    assert capsys.readouterr().out == f"The demo FAILED: {failure}.\n"
