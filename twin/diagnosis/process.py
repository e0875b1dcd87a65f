"""Diagnosis of the last cycles beside the live loop, once an alarm is raised.

It runs in its own process at low priority (``__main__.py``), so that the loop never waits for it.
Its answer comes back as an event. Only one runs at a time, and only with enough cycles.
"""

import json
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from twin.child_process import ChildProcess
from twin.config import Config
from twin.diagnosis.text import Times, certainty, left_over, listed, sized, when
from twin.errors import in_words
from twin.events import Event, Kind
from twin.instants import SECOND_NS
from twin.model.effects import effect_of
from twin.quality import NEW_TIME
from twin.signals import SAMPLE, Samples

CYCLES = 13  # kept cycles: all are judged but the first, in which the model settles
MOST_ROWS = 300_000  # kept rows, however long cycles are
FEWEST = 7  # cycles before the first attempt
DEVIATING = 3  # of them since the alarm was raised, its own cycle included
PATIENCE_S = 300.0  # longest time for one answer
POLL_S = 0.05
NICE = 10  # added to the loop's niceness
COMMAND = (sys.executable, "-m", "twin.diagnosis")

REPORT = ".html"

# Configuration, rows, name of the log, path of the report, and duration of the log before the
# rows (s).
Question = tuple[Config, Samples, str, Path | None, float]
Clock = Callable[[], float]
Status = Callable[[], AbstractContextManager[Callable[[str], None]]]


class LiveDiagnosis:
    """Follows the live loop, and diagnoses each alarm (``twin.live.EventEnricher``).

    Alarms of a unit that is not commissioned are not diagnosed: their causes are not named.
    ``status`` gives a function that shows the wait at the end; ``stopped`` ends that wait.
    ``reports`` is a folder for the report of each answer.
    """

    def __init__(
        self,
        config: Config,
        log: str,
        stopped: Callable[[], bool],
        status: Status,
        clock: Clock = time.monotonic,
        reports: Path | None = None,
    ) -> None:
        self._config, self._log, self._reports = config, log, reports
        self._stopped, self._status, self._clock = stopped, status, clock
        self._recent = Recent()
        self._now_ns = 0  # of the last row, PLC time
        self._first_ns: int | None = None  # host time of the first row
        self._begin_ns = 0  # begin of the log in present PLC time
        self._alarm: Event | None = None  # that waits for its diagnosis
        self._since = 0  # cycles since it was raised, its own one included
        self._wanted = DEVIATING  # of these, before the next attempt
        self._asked: Asked | None = None

    def follow(self, samples: Samples, events: Sequence[Event]) -> list[Event]:
        """Take rows and events; give the answer if it has arrived."""
        self._recent.add(samples, sum(_is_whole_cycle(event) for event in events))
        if len(samples):
            self._track_time(samples)
        for event in events:
            self._track(event)
        if self._asked is not None:
            return self._collect(self._asked)
        if self._alarm and self._since >= self._wanted and self._recent.cycles >= FEWEST:
            return self._ask(self._alarm)
        return []

    def finish(self) -> list[Event]:
        """Wait for the running diagnosis; an alarm that still waits is diagnosed first.

        An interrupt ends the wait, and so does ``PATIENCE_S``.
        """
        events: list[Event] = []
        if self._asked is None and self._alarm and self._since and not self._stopped():
            events = self._ask(self._alarm)
        if self._asked is None:
            return events
        with self._status() as say:
            say(f"diagnosing the last {self._asked.cycles} cycles (Ctrl-C leaves it)")
            while not (answer := self._collect(self._asked)) and not self._stopped():
                self._asked.ended(POLL_S)
        return events + (answer or [self._failed(self._asked.alarm, "the run was interrupted")])

    def close(self) -> None:
        """End the running diagnosis."""
        if self._asked is not None:
            self._asked.close()
            self._asked = None

    def _track_time(self, samples: Samples) -> None:
        """Track the begin of the log in PLC time, also when that is set or restarts."""
        self._now_ns = int(samples["time_ns"][-1])
        if self._first_ns is None:
            self._first_ns, self._begin_ns = (
                int(samples[name][0]) for name in ("host_ns", "time_ns")
            )
        for row in np.flatnonzero(samples["quality"] & NEW_TIME)[-1:]:
            since_ns = int(samples["host_ns"][row]) - self._first_ns
            self._begin_ns = int(samples["time_ns"][row]) - since_ns

    def _track(self, event: Event) -> None:
        if _is_whole_cycle(event):
            self._since += 1
        elif event.kind is Kind.DEVIATION and self._config.monitor.healthy.is_known:
            if self._alarm is None:
                self._since, self._wanted = 1, DEVIATING
            self._alarm = event

    def _ask(self, alarm: Event) -> list[Event]:
        report = self._reports / f"{uuid4().hex}{REPORT}" if self._reports else None
        rows = self._recent.rows()
        before_s = max((int(rows["time_ns"][0]) - self._begin_ns) / SECOND_NS, 0.0)
        question = self._config, rows, self._log, report, before_s
        cycles, deadline = min(self._recent.cycles, CYCLES), self._clock() + PATIENCE_S
        try:
            self._asked = Asked(question, alarm, cycles, deadline)
        except Exception as error:  # such as no processes or memory left: the loop must go on
            self._alarm = None
            reason = getattr(error, "strerror", None) or in_words(error)
            return [self._failed(alarm, f"it could not be started: {reason}")]
        return []

    def _collect(self, running: "Asked") -> list[Event]:
        """The event of a diagnosis that has ended or timed out; else nothing."""
        is_late = self._clock() > running.deadline
        if not is_late and not running.ended():
            return []
        answer = "it took too long" if is_late else running.answer()
        self.close()
        if isinstance(answer, str):
            self._settle(running.alarm)
            return [self._failed(running.alarm, answer)]
        if answer["verdict"] == "insufficient":  # try again later
            self._since, self._wanted = 0, 2 * self._wanted
        else:
            self._settle(running.alarm)
        data = {"alarm_ns": running.alarm.time_ns, "begin_ns": self._begin_ns, "answer": answer}
        data |= {"report": running.report.stem} if running.report else {}
        return [Event(self._now_ns, Kind.DIAGNOSIS, in_a_line(answer), data)]

    def _settle(self, alarm: Event) -> None:
        """Forget the alarm, unless another one was raised since."""
        if self._alarm is alarm:
            self._alarm = None

    def _failed(self, alarm: Event, reason: str) -> Event:
        text = f"no diagnosis: {reason}; twin diagnose LOG does it afterwards"
        return Event(self._now_ns, Kind.DIAGNOSIS, text, {"alarm_ns": alarm.time_ns})


def _is_whole_cycle(event: Event) -> bool:
    """Whether the event is that of a complete cycle."""
    return event.kind is Kind.CYCLE and bool(event.data.get("complete", True))


@dataclass
class Recent:
    """The rows of the last cycles."""

    cycles: int = 0  # ended since the beginning
    _blocks: deque[tuple[int, Samples]] = field(default_factory=deque)  # with ``cycles`` then
    _rows: int = 0

    def add(self, samples: Samples, ended: int) -> None:
        """Take rows, in which ``ended`` cycles ended; forget those that are too old."""
        self.cycles += ended
        if not len(samples):
            return
        self._blocks.append((self.cycles, samples.copy()))
        self._rows += len(samples)
        while self._rows > MOST_ROWS or self.cycles - self._blocks[0][0] > CYCLES:
            self._rows -= len(self._blocks.popleft()[1])

    def rows(self) -> Samples:
        """All of them in one stretch."""
        return np.concatenate([np.empty(0, SAMPLE), *(rows for _, rows in self._blocks)])


class Asked:
    """A running diagnosis in another process; raises OSError if that cannot start."""

    def __init__(self, question: Question, alarm: Event, cycles: int, deadline: float) -> None:
        self.alarm, self.cycles, self.deadline = alarm, cycles, deadline
        self.report = question[3]
        self._child = ChildProcess(COMMAND, question)
        with suppress(OSError):  # without permission it runs at the same priority
            own = os.getpriority(os.PRIO_PROCESS, 0)
            os.setpriority(os.PRIO_PROCESS, self._child.pid, own + NICE)

    def ended(self, seconds: float = 0.0) -> bool:
        """Whether the process has ended within ``seconds``, with an answer or without."""
        return self._child.ended(seconds)

    def answer(self) -> dict[str, Any] | str:
        """The answer of a diagnosis that has ended, or the reason why there is none."""
        text = self._child.answer()
        if text is None:
            return self._child.complaint()
        try:
            answer: dict[str, Any] = json.loads(text)
        except ValueError:
            return "its answer cannot be read"
        return answer

    def close(self) -> None:
        """End the process if it still runs."""
        self._child.close()


# --- in words -------------------------------------------------------------------------------------


def in_a_line(answer: Mapping[str, Any]) -> str:
    """The answer in one line to be stored: with dates instead of ages."""
    times = Times.of(answer, None)
    causes = "; and ".join(_cause(cause, times) for cause in answer["causes"])
    match answer["verdict"]:
        case "explained":
            return causes
        case "unlisted":
            unlisted = f"no listed effect explains what is left in {left_over(answer)}"
            return f"{causes}; and {unlisted}" if causes else unlisted
        case "consistent":
            return f"the last {answer['cycles']['total']} cycles agree with the model after all"
    return f"no answer yet: {answer['next_experiment']}"


def _cause(cause: Mapping[str, Any], times: Times) -> str:
    look_at = [effect_of(cause["effect"]).look_at]
    look_at += [effect_of(name).look_at for name in cause["not_separable_from"]]
    return (
        f"{sized(cause)}, {when(cause, times)}; how sure: {certainty(cause)};"
        f" look at {listed(look_at, 'or')}"
    )
