"""The diagnosis beside the live loop: asked when it can answer, never waited for, and logged."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import rigs
from command_line import twin
from plc_process import PlcProcess, start_plc

from twin import child_process
from twin.diagnosis import process
from twin.diagnosis.process import LiveDiagnosis, Recent, in_a_line
from twin.events import Event, Kind, Severity
from twin.live import run
from twin.log.check import check
from twin.log.reader import open_log
from twin.quality import Quality
from twin.signals import SAMPLE, Samples

GRIPPER = rigs.path_of("gripper")
LOWEST = 19  # priority that there is
PATIENCE_S = 60.0
CYCLE_NS = 2_000_000_000
_SHARED: list[psutil.Process] = []  # children that ran before the test

CAUSE: dict[str, Any] = {
    "effect": "leakage",
    "course": "step",
    "onset_s": 7.5,
    "onset_low95_s": 7.4,
    "onset_high95_s": 7.6,
    "parameters": {
        "sonic_flow": {"value": 1.9, "unit": "sl/min", "low95": 1.8, "high95": 2.0},
    },
    "probability": 0.98,
    "not_separable_from": [],
    "why": "",
}
BEGIN_NS = 1_790_000_000 * 10**9  # 2026-09-21 14:13:20 UTC, by the clock here
ANSWER: dict[str, Any] = {
    "verdict": "explained",
    "causes": [CAUSE],
    "cycles": {
        "total": 8,
        "fitted": [],
        "held_out": [],
        "begin_s": 4.0,
        "log_begin_ns": BEGIN_NS,
    },
    "unlisted": None,
    "next_experiment": None,
}


# Another process in place of the real one.


def answering(monkeypatch: pytest.MonkeyPatch, answer: dict[str, Any], after_s: float = 0) -> None:
    code = f"import time; time.sleep({after_s}); print('''{json.dumps(answer)}''')"
    monkeypatch.setattr(process, "COMMAND", (sys.executable, "-c", code))


@contextmanager
def quiet() -> Iterator[Callable[[str], None]]:
    yield lambda _what: None


class Stream:
    """Cycles of a few rows, one after the other, to a diagnosis."""

    def __init__(self, *, stopped: bool = False, clock: Callable[[], float] | None = None) -> None:
        self.stopped = stopped
        self.to = LiveDiagnosis(
            rigs.config("gripper"), "a.mcap", lambda: self.stopped, quiet, clock or time.monotonic
        )
        self.now_ns = 0
        self.told: list[Event] = []

    def cycle(self, *, alarm: bool = False) -> None:
        rows = np.zeros(4, SAMPLE)
        rows["time_ns"] = self.now_ns + np.arange(4) * (CYCLE_NS // 4)
        rows["host_ns"] = BEGIN_NS + rows["time_ns"]
        self.now_ns += CYCLE_NS
        events = [Event(self.now_ns, Kind.CYCLE, "")]
        events += [Event(self.now_ns, Kind.DEVIATION, "leakage")] if alarm else []
        self.told += self.to.follow(rows, events)

    def cycles(self, count: int) -> None:
        for _ in range(count):
            self.cycle()

    @property
    def asked(self) -> bool:
        return bool(children())

    def answered(self) -> None:
        """Let blocks without rows pass until the answer has come."""
        before, deadline = len(self.told), time.monotonic() + PATIENCE_S
        while len(self.told) == before:
            assert time.monotonic() < deadline
            self.told += self.to.follow(np.empty(0, SAMPLE), [])
            time.sleep(0.005)


def children() -> list[psutil.Process]:
    """Those that a test has started: what tests share may have some of its own."""
    return [process for process in psutil.Process().children() if process not in _SHARED]


@pytest.fixture(autouse=True)
def shared() -> Iterator[None]:
    _SHARED[:] = psutil.Process().children()
    yield
    _SHARED.clear()


@pytest.fixture
def stream() -> Iterator[Stream]:
    one = Stream()
    yield one
    one.to.close()


def test_it_is_asked_once_enough_cycles_deviate_and_its_answer_is_an_event(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, ANSWER)
    stream.cycles(5)
    stream.cycle(alarm=True)
    stream.cycle()
    assert not stream.asked
    stream.cycle()
    assert stream.asked
    stream.answered()
    (event,) = stream.told
    assert event.kind is Kind.DIAGNOSIS
    assert event.severity is Severity.WARNING
    assert event.time_ns == stream.now_ns - CYCLE_NS // 4  # of the last row
    assert event.data == {"alarm_ns": 6 * CYCLE_NS, "begin_ns": 0, "answer": ANSWER}
    assert event.text == (
        "leakage (1.9 sl/min), since 2026-09-21 14:13:27, 7.5 s into the log;"
        " how sure: 98 %; no other listed cause fits as well;"
        " look at hoses, fittings and cups: a cut, or a loose connection"
    )
    stream.cycles(10)
    assert not stream.asked


def test_an_early_alarm_waits_until_there_are_enough_cycles(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, ANSWER)
    stream.cycle(alarm=True)
    stream.cycles(process.FEWEST - 2)
    assert not stream.asked
    stream.cycle()
    assert stream.asked


def test_without_an_alarm_nothing_is_asked(stream: Stream) -> None:
    stream.cycles(30)
    assert not stream.asked
    assert stream.to.finish() == []


def test_one_at_a_time_and_an_alarm_raised_meanwhile_has_its_own(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, ANSWER, after_s=0.3)
    stream.cycles(7)
    stream.cycle(alarm=True)
    stream.cycles(2)
    (first,) = children()
    stream.cycle(alarm=True)
    stream.cycles(4)
    assert children() == [first]
    stream.answered()
    stream.cycle()
    stream.answered()
    assert [event.data["alarm_ns"] for event in stream.told] == [8 * CYCLE_NS, 11 * CYCLE_NS]


def test_an_answer_that_could_not_be_given_is_asked_for_again_later(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    reason = "only 2 cycles can be judged"
    short = ANSWER | {"verdict": "insufficient", "causes": [], "next_experiment": reason}
    answering(monkeypatch, short)
    stream.cycles(6)
    stream.cycle(alarm=True)
    stream.cycles(2)
    stream.answered()
    assert stream.told[-1].text == f"no answer yet: {reason}"
    answering(monkeypatch, ANSWER)
    stream.cycles(2 * process.DEVIATING - 1)
    assert not stream.asked
    stream.cycle()
    stream.answered()
    assert stream.told[-1].data["answer"] == ANSWER


def test_one_that_breaks_is_told_and_nothing_else_happens(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = "raise SystemExit('cell.toml: the twin is not calibrated')"
    monkeypatch.setattr(process, "COMMAND", (sys.executable, "-c", code))
    stream.cycles(7)
    stream.cycle(alarm=True)
    stream.cycles(2)
    stream.answered()
    assert stream.told[-1].text == (
        "no diagnosis: cell.toml: the twin is not calibrated; twin diagnose LOG does it afterwards"
    )
    stream.cycles(5)
    assert not stream.asked


def test_an_answer_that_cannot_be_read_is_told(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "COMMAND", (sys.executable, "-c", "print('{')"))
    stream.cycles(7)
    stream.cycle(alarm=True)
    stream.cycles(2)
    stream.answered()
    assert stream.told[-1].text.startswith("no diagnosis: its answer cannot be read;")
    stream.cycles(5)
    assert not stream.asked


def test_one_for_which_there_is_no_memory_is_told(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise MemoryError

    monkeypatch.setattr(child_process.pickle, "dump", full)
    stream.cycles(7)
    stream.cycle(alarm=True)
    stream.cycles(5)
    (event,) = stream.told
    assert "could not be started: MemoryError" in event.text


def test_one_that_cannot_be_started_is_told(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "COMMAND", ("/nowhere/python",))
    stream.cycles(7)
    stream.cycle(alarm=True)
    stream.cycles(5)
    (event,) = stream.told
    assert "could not be started: No such file" in event.text


def test_one_that_takes_too_long_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, ANSWER, after_s=PATIENCE_S)
    now = 0.0
    stream = Stream(clock=lambda: now)
    stream.cycles(7)
    stream.cycle(alarm=True)
    stream.cycles(3)
    assert stream.told == []
    now = process.PATIENCE_S + 1.0
    stream.cycle()
    assert "it took too long" in stream.told[-1].text
    assert not stream.asked


def test_at_the_end_the_answer_under_way_is_waited_for(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, ANSWER, after_s=0.2)
    stream.cycles(7)
    stream.cycle(alarm=True)
    stream.cycles(2)
    assert stream.asked
    (event,) = stream.to.finish()
    assert event.data["answer"] == ANSWER


def test_at_the_end_an_alarm_that_waits_is_diagnosed_with_what_there_is(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    answering(monkeypatch, ANSWER)
    stream.cycles(2)
    stream.cycle(alarm=True)
    assert not stream.asked
    (event,) = stream.to.finish()
    assert event.data["answer"] == ANSWER


def test_an_interrupt_ends_the_waiting_and_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, ANSWER, after_s=PATIENCE_S)
    stream = Stream()
    stream.cycles(7)
    stream.cycle(alarm=True)
    stream.cycles(2)
    stream.stopped = True
    (event,) = stream.to.finish()
    assert "the run was interrupted" in event.text
    stream.to.close()
    assert not stream.asked


def test_after_an_interrupt_nothing_new_is_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, ANSWER)
    stream = Stream(stopped=True)
    stream.cycle(alarm=True)
    assert stream.to.finish() == []


def test_it_runs_at_low_priority(stream: Stream, monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, ANSWER, after_s=0.5)
    stream.cycles(7)
    stream.cycle(alarm=True)
    stream.cycles(2)
    (child,) = children()
    assert child.nice() == min(psutil.Process().nice() + process.NICE, LOWEST)


# What is kept.


def rows(count: int, first: int = 0) -> Samples:
    made = np.zeros(count, SAMPLE)
    made["sequence"] = first + np.arange(count)
    return made


def test_the_last_cycles_are_kept_and_no_more() -> None:
    recent = Recent()
    for number in range(100):
        recent.add(rows(10, 10 * number), ended=1)
    kept = recent.rows()["sequence"]
    assert kept.tolist() == list(range(1000 - 10 * (process.CYCLES + 1), 1000))


def test_cycles_that_never_end_are_kept_as_far_as_memory_is_spared() -> None:
    recent = Recent()
    for number in range(40):
        recent.add(rows(10_000, 10_000 * number), ended=0)
        recent.add(rows(0), ended=0)
    kept = recent.rows()["sequence"]
    assert kept.tolist() == list(range(400_000 - process.MOST_ROWS, 400_000))


def test_a_block_is_kept_as_it_was() -> None:
    recent, block = Recent(), rows(5)
    recent.add(block, ended=0)
    block["sequence"] = -1  # a driver's buffer may be used again
    assert recent.rows()["sequence"].tolist() == [0, 1, 2, 3, 4]


# In words.


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"course": "constant"},
            "leakage (1.9 sl/min), since 2026-09-21 14:13:24, 4.0 s into the log, or longer;",
        ),
        (
            {"course": "ramp", "onset_s": 0.0},
            "growing since 2026-09-21 14:13:24, 4.0 s into the log, or longer;",
        ),
        ({"course": "ramp"}, "growing since 2026-09-21 14:13:27, 7.5 s into the log;"),
        ({"course": "intermittent", "share_pct": 40.0}, "in 40 % of the cycles;"),
        ({"probability": 0.6, "not_separable_from": ["suction_loss"]}, "suction loss"),
        ({"not_separable_from": ["suction_loss"]}, "or the nozzles and the silencer"),
    ],
)
def test_a_cause_is_said_with_course_and_certainty(changed: dict[str, Any], said: str) -> None:
    line = in_a_line(ANSWER | {"causes": [CAUSE | changed]})
    assert said in line
    assert "\n" not in line


def test_since_counts_from_the_begin_of_the_run(
    stream: Stream, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside a run that is older than the rows that are diagnosed."""
    asked: list[process.Question] = []
    begin = process.Asked.__init__

    def noting(self: process.Asked, question: process.Question, *rest: Any) -> None:
        asked.append(question)
        begin(self, question, *rest)

    monkeypatch.setattr(process.Asked, "__init__", noting)
    answering(monkeypatch, ANSWER)
    stream.cycles(30)
    stream.cycle(alarm=True)
    stream.cycles(2)
    stream.answered()
    (question,) = asked
    _, rows, _, _, before_s = question
    assert before_s == rows["time_ns"][0] / 1e9 > 30.0
    assert stream.told[0].data["begin_ns"] == 0


def test_a_plc_that_began_anew_moves_no_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    one = LiveDiagnosis(rigs.config("gripper"), "a.mcap", lambda: False, quiet)
    rows = np.zeros(4, SAMPLE)
    rows["time_ns"] = 70 * 10**9 + np.arange(4)
    rows["host_ns"] = BEGIN_NS + np.arange(4)
    one.follow(rows, [])
    rows["host_ns"] += 20 * 10**9
    rows["time_ns"] = np.arange(4)  # it counts from 0 again
    rows["quality"][0] = Quality.RESTART
    one.follow(rows, [])
    assert one._begin_ns == -20 * 10**9


def test_other_verdicts_are_said_as_what_they_are() -> None:
    left = {"where": "hold", "depends_on": [], "shape": "+9 mbar in the mean"}
    unlisted = ANSWER | {"verdict": "unlisted", "causes": [], "unlisted": left}
    line = in_a_line(unlisted)
    assert line == "no listed effect explains what is left in hold: +9 mbar in the mean"
    assert in_a_line(unlisted | {"causes": [CAUSE]}).endswith(f"; and {line}")
    consistent = ANSWER | {"verdict": "consistent", "causes": []}
    assert in_a_line(consistent) == "the last 8 cycles agree with the model after all"


# In the loop.


def test_what_is_found_out_goes_to_every_sink(monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, ANSWER)
    samples, _ = rigs.recorded("gripper", 25.0, ("leakage=2",))
    config, one, other = rigs.config("gripper"), rigs.Collect(), rigs.Collect()
    adviser = LiveDiagnosis(config, "a.mcap", lambda: False, quiet)
    blocks = rigs.cut(samples, 30)
    run(blocks, rigs.twin("gripper"), rigs.monitor("gripper"), [one, other], advisers=[adviser])
    (event,) = one.of(Kind.DIAGNOSIS)
    _, named = one.of(Kind.DEVIATION)
    assert event.data["alarm_ns"] == named.time_ns
    assert other.events == one.events
    assert np.concatenate(one.samples).tobytes() == samples.tobytes()


def test_it_is_ended_when_the_loop_breaks(monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, ANSWER, after_s=PATIENCE_S)
    config = rigs.config("gripper")
    begun = []

    def source() -> Iterator[Samples]:
        for block in rigs.cut(rigs.recorded("gripper", 25.0, ("leakage=2",))[0], 100):
            yield block
            if children():
                begun.append(True)
                raise OSError("cable")

    adviser = LiveDiagnosis(config, "a.mcap", lambda: False, quiet)
    with pytest.raises(OSError, match="cable"):
        run(source(), rigs.twin("gripper"), rigs.monitor("gripper"), [], advisers=[adviser])
    assert begun
    assert not children()


# Beside a PLC, with the real one.


@pytest.fixture(scope="module")
def leaky_plc() -> Iterator[PlcProcess]:
    with start_plc(GRIPPER, "--fault", "leakage=2") as running:
        yield running


def beside(plc: PlcProcess, log: Path, seconds: float) -> tuple[str | Path, ...]:
    address = f"127.0.0.1:{plc.port}"
    return "run", GRIPPER, "--address", address, "--log", log, "--duration", str(seconds)


@pytest.mark.slow
def test_beside_a_plc_the_alarm_is_diagnosed_without_a_lost_sample(
    leaky_plc: PlcProcess,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = tmp_path / "a.mcap"
    monkeypatch.setattr(process, "FEWEST", 4)  # so that it begins while the loop still runs
    monkeypatch.setattr(process, "DEVIATING", 2)
    assert twin(monkeypatch, *beside(leaky_plc, log, 14.0)) == 0
    said = capsys.readouterr()
    assert said.err == ""
    stored = list(open_log(log).events())
    (event,) = (event for event in stored if event.kind is Kind.DIAGNOSIS)
    _, alarm, *_ = (event for event in stored if event.kind is Kind.DEVIATION)
    answer = event.data["answer"]
    assert event.data["alarm_ns"] == alarm.time_ns
    assert answer["log"] == str(log)
    assert [cause["effect"] for cause in answer["causes"]] == ["leakage"]
    assert event.text in said.out
    report = check(log)
    assert (report.sound, report.gaps, report.missing) == (True, 0, 0)
    samples = np.concatenate([rows for rows, _ in open_log(log).blocks()])
    assert (np.diff(samples["sequence"]) == 1).all()
    assert samples["time_ns"][-1] > alarm.time_ns + 2 * CYCLE_NS
    assert twin(monkeypatch, "replay", log) == 0
    assert "deviation" in capsys.readouterr().out


@pytest.mark.slow
def test_an_interrupt_while_it_is_waited_for_leaves_a_readable_log(
    leaky_plc: PlcProcess, tmp_path: Path
) -> None:
    log = tmp_path / "a.mcap"
    command = [sys.executable, "-m", "twin.cli", *map(str, beside(leaky_plc, log, 8.0))]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=rigs.ROOT, stdout=pipe, stderr=pipe, text=True) as live:
        try:
            child = first_child(live)
            live.send_signal(signal.SIGINT)
            out, said = live.communicate(timeout=PATIENCE_S)
        finally:
            live.kill()
    assert live.returncode == 130
    assert said == ""
    assert "no diagnosis: the run was interrupted" in out
    assert not child.is_running()
    assert open_log(log).complete
    assert [event.kind for event in open_log(log).events()][-1] is Kind.DIAGNOSIS


def first_child(parent: "subprocess.Popen[str]") -> psutil.Process:
    deadline = time.monotonic() + PATIENCE_S
    while not (found := psutil.Process(parent.pid).children()):
        assert time.monotonic() < deadline, "nothing is asked"
        time.sleep(0.02)
    return found[0]
