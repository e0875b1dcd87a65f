"""The diagnosis beside the live loop: of the last cycles, once an alarm is raised.

It runs in a process of its own at low priority (``__main__.py``), so that the loop never waits for
it. Its answer comes back as an event. One at a time, and only when there are enough cycles to
answer.
"""

import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from twin.config import Config
from twin.diagnosis.text import Times, certainty, left_over, listed, sized, when
from twin.errors import in_words
from twin.events import Event, Kind
from twin.instants import SECOND_NS
from twin.model.effects import effect_of
from twin.signals import NEW_TIME, SAMPLE, Samples

CYCLES = 13  # that are kept: all but the first are judged, in which the model swings in
MOST_ROWS = 300_000  # that are kept, however long cycles are
FEWEST = 7  # cycles before the first try
DEVIATING = 3  # of them since the alarm was raised, its own one included
PATIENCE_S = 300.0  # with one answer
POLL_S = 0.05
NICE = 10  # beyond the loop's own
COMMAND = (sys.executable, "-m", "twin.diagnosis")

REPORT = ".html"

# Rows, whose log, where to draw the answer, and how much of the log there is before the rows (s).
Question = tuple[Config, Samples, str, Path | None, float]
Clock = Callable[[], float]
Status = Callable[[], AbstractContextManager[Callable[[str], None]]]


class LiveDiagnosis:
    """Follows the live loop, and has each alarm diagnosed (``twin.live.EventEnricher``).

    Alarms of a unit that is not commissioned are not: their causes are not named.
    ``status`` gives a function that says what is waited for at the end, until ``stopped`` says that
    nobody wants to wait. ``reports`` is a folder that keeps the page of each answer.
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
        self._first_ns: int | None = None  # when the first row of all was received
        self._begin_ns = 0  # PLC time at which the log began, as the PLC counts now
        self._alarm: Event | None = None  # that waits for its diagnosis
        self._since = 0  # cycles since it was raised, its own one included
        self._wanted = DEVIATING  # of these, before the next try
        self._asked: Asked | None = None

    def follow(self, samples: Samples, events: Sequence[Event]) -> list[Event]:
        """Take rows and what happened; give the answer that has come by now."""
        self._recent.add(samples, sum(_is_whole_cycle(event) for event in events))
        if len(samples):
            self._count(samples)
        for event in events:
            self._note(event)
        if self._asked is not None:
            return self._heard(self._asked)
        if self._alarm and self._since >= self._wanted and self._recent.cycles >= FEWEST:
            return self._ask(self._alarm)
        return []

    def finish(self) -> list[Event]:
        """Wait for the answer under way; an alarm that still waits is diagnosed with what is there.

        An interrupt, and ``PATIENCE_S``, end the waiting.
        """
        told: list[Event] = []
        if self._asked is None and self._alarm and self._since and not self._stopped():
            told = self._ask(self._alarm)
        if self._asked is None:
            return told
        with self._status() as say:
            say(f"diagnosing the last {self._asked.cycles} cycles (Ctrl-C leaves it)")
            while not (heard := self._heard(self._asked)) and not self._stopped():
                self._asked.wait(POLL_S)
        return told + (heard or [self._failed(self._asked.alarm, "the run was interrupted")])

    def close(self) -> None:
        """End what is under way."""
        if self._asked is not None:
            self._asked.close()
            self._asked = None

    def _count(self, samples: Samples) -> None:
        """Know when the log began in PLC time, also after that was set or began anew."""
        self._now_ns = int(samples["time_ns"][-1])
        if self._first_ns is None:
            self._first_ns, self._begin_ns = (
                int(samples[name][0]) for name in ("host_ns", "time_ns")
            )
        for row in np.flatnonzero(samples["quality"] & NEW_TIME)[-1:]:
            since_ns = int(samples["host_ns"][row]) - self._first_ns
            self._begin_ns = int(samples["time_ns"][row]) - since_ns

    def _note(self, event: Event) -> None:
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
        except Exception as error:  # no processes or memory left: no reason to end the loop
            self._alarm = None
            why = getattr(error, "strerror", None) or in_words(error)
            return [self._failed(alarm, f"it could not be started: {why}")]
        return []

    def _heard(self, asked: "Asked") -> list[Event]:
        """What came back, maybe nothing yet."""
        late = self._clock() > asked.deadline
        if not late and not asked.ended():
            return []
        answer = "it took too long" if late else asked.answer()
        self.close()
        if isinstance(answer, str):
            self._settle(asked.alarm)
            return [self._failed(asked.alarm, answer)]
        if answer["verdict"] == "insufficient":  # asked again later
            self._since, self._wanted = 0, 2 * self._wanted
        else:
            self._settle(asked.alarm)
        data = {"alarm_ns": asked.alarm.time_ns, "begin_ns": self._begin_ns, "answer": answer}
        data |= {"report": asked.report.stem} if asked.report else {}
        return [Event(self._now_ns, Kind.DIAGNOSIS, in_a_line(answer), data)]

    def _settle(self, alarm: Event) -> None:
        """The alarm waits no longer; another one may have been raised since."""
        if self._alarm is alarm:
            self._alarm = None

    def _failed(self, alarm: Event, why: str) -> Event:
        text = f"no diagnosis: {why}; twin diagnose LOG does it afterwards"
        return Event(self._now_ns, Kind.DIAGNOSIS, text, {"alarm_ns": alarm.time_ns})


def _is_whole_cycle(event: Event) -> bool:
    """Whether a cycle has ended that was not cut off."""
    return event.kind is Kind.CYCLE and bool(event.data.get("complete", True))


@dataclass
class Recent:
    """The rows of the last cycles."""

    cycles: int = 0  # that have ended since the beginning
    _blocks: deque[tuple[int, Samples]] = field(default_factory=deque)  # with ``cycles`` by then
    _rows: int = 0

    def add(self, samples: Samples, ended: int) -> None:
        """Take rows, with which some cycles ended; forget those that are too old."""
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
    """A diagnosis under way in another process; OSError where there can be none."""

    def __init__(self, question: Question, alarm: Event, cycles: int, deadline: float) -> None:
        self.alarm, self.cycles, self.deadline = alarm, cycles, deadline
        self.report = question[3]
        with ExitStack() as opened:
            asking, self._said, self._complaint = (
                opened.enter_context(tempfile.TemporaryFile()) for _ in range(3)
            )
            pickle.dump(question, asking)
            asking.seek(0)
            self._process = subprocess.Popen(  # noqa: S603  # our own program
                COMMAND,
                stdin=asking,
                stdout=self._said,
                stderr=self._complaint,
                start_new_session=True,  # a Ctrl-C is the loop's to answer
            )
            self._opened = opened.pop_all()
        with suppress(OSError):  # where that is not allowed it runs as it is
            own = os.getpriority(os.PRIO_PROCESS, 0)
            os.setpriority(os.PRIO_PROCESS, self._process.pid, own + NICE)

    def ended(self) -> bool:
        """Whether there is an answer, or will never be one."""
        return self._process.poll() is not None

    def wait(self, seconds: float) -> None:
        """Until it has ended, but no longer."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)

    def answer(self) -> dict[str, Any] | str:
        """The answer of one that has ended, or why there is none."""
        if self._process.returncode == 0:
            self._said.seek(0)
            try:
                found: dict[str, Any] = json.load(self._said)
            except ValueError:
                return "its answer cannot be read"
            return found
        self._complaint.seek(0)
        *_, last = [b"it was killed", *self._complaint.read().splitlines()]
        return last.decode(errors="replace")

    def close(self) -> None:
        """End it, if it has not ended."""
        self._process.kill()
        self._process.wait()
        self._opened.close()


# --- in words -------------------------------------------------------------------------------------


def in_a_line(answer: Mapping[str, Any]) -> str:
    """The answer in a line that is kept: with dates and no ages, which would grow old."""
    times = Times.of(answer, None)
    found = "; and ".join(_cause(cause, times) for cause in answer["causes"])
    match answer["verdict"]:
        case "explained":
            return found
        case "unlisted":
            rest = f"no listed effect explains what is left in {left_over(answer)}"
            return f"{found}; and {rest}" if found else rest
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
