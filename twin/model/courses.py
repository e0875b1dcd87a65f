"""How an effect runs in time: constant, step, ramp or intermittent, for every effect alike.

A cause is an effect with a course. Causes become coefficients that hold from one row of a log until
the next change; the kernel itself has no time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from twin.model.effects import apply, effect_of
from twin.model.theta import Theta

HOUR = 3600.0  # s
# Steps of a ramp's coefficients from its onset to the last row, each to the value in mid-step. So a
# step is 0.5 % of what the ramp reaches, whether the log is of seconds or of hours. Chosen.
RAMP_STEPS = 200

# Coefficients over time: pairs of a first row and the coefficients from it on, beginning at row 0.
Schedule = list[tuple[int, Theta]]


class Course(StrEnum):
    """How an effect runs in time."""

    CONSTANT = "constant"
    STEP = "step"
    RAMP = "ramp"
    INTERMITTENT = "intermittent"


MEANING = {
    Course.CONSTANT: "it is there from beginning to end",
    Course.STEP: "it begins at `onset_s` and stays",
    Course.RAMP: "it grows from `onset_s` on; its size is a rate per hour",
    Course.INTERMITTENT: "it is there in some cycles: their share, and which",
}


@dataclass(frozen=True)
class Cause:
    """An effect with sizes and a course; the ``values`` of a ramp are changes per hour."""

    effect: str
    values: Mapping[str, float]
    course: Course = Course.CONSTANT
    onset_s: float = 0.0  # of step and ramp, since the first row
    cycles: frozenset[int] = frozenset()  # of an intermittent one

    def law(self) -> dict[str, float]:
        """The value of the effect's law, if it is given beside the sizes."""
        law = effect_of(self.effect).law
        return {law.name: self.values[law.name]} if law and law.name in self.values else {}

    def at(self, theta: Theta, second: float, cycle: int) -> Mapping[str, float]:
        """Values of the parameters at a time (s) in a cycle; empty if the cause does not act."""
        if self.course == Course.INTERMITTENT:
            return self.values if cycle in self.cycles else {}
        if self.course == Course.CONSTANT:
            return self.values
        if second < self.onset_s:
            return {}
        if self.course == Course.STEP:
            return self.values
        values = self.law()
        for parameter in effect_of(self.effect).parameters:
            neutral = parameter.neutral(theta)
            given = self.values.get(parameter.name, neutral if parameter.shapes else 0.0)
            ramped = neutral + given * (second - self.onset_s) / HOUR
            value = given if parameter.shapes else ramped
            values[parameter.name] = min(max(value, parameter.low), parameter.high)
        return values


def schedule(
    theta: Theta,
    causes: Sequence[Cause],
    seconds: npt.NDArray[np.float64],
    cycles: npt.NDArray[np.int64],
) -> Schedule:
    """Coefficients over the rows of a log, given the time and the cycle of each.

    ``seconds`` rise from 0. ConfigError for an unknown effect, parameter or course, and for a value
    out of bounds.
    """
    changes: Schedule = []
    half_steps = [_ramp_step(cause, seconds) / 2.0 for cause in causes]
    for row in _changes(causes, seconds, cycles):
        changed = theta
        for cause, half_step in zip(causes, half_steps, strict=True):
            values = cause.at(changed, float(seconds[row]) + half_step, int(cycles[row]))
            changed = apply(changed, cause.effect, values)
        changes.append((row, changed))
    return changes


def _ramp_step(cause: Cause, seconds: npt.NDArray[np.float64]) -> float:
    """Time (s) between two changes of a ramp's coefficients; 0 for other courses."""
    if cause.course != Course.RAMP or not len(seconds):
        return 0.0
    return max(float(seconds[-1]) - cause.onset_s, 0.0) / RAMP_STEPS


def _changes(
    causes: Sequence[Cause], seconds: npt.NDArray[np.float64], cycles: npt.NDArray[np.int64]
) -> list[int]:
    """Rows at which any cause changes, row 0 first."""
    rows = {0}
    for cause in causes:
        effect_of(cause.effect)
        times: npt.NDArray[np.floating] = np.empty(0)
        if cause.course == Course.STEP:
            times = np.array([cause.onset_s])
        elif step := _ramp_step(cause, seconds):
            times = cause.onset_s + step * np.arange(RAMP_STEPS)
        elif cause.course == Course.INTERMITTENT:
            acts = np.isin(cycles, [*cause.cycles])
            rows |= set((np.flatnonzero(np.diff(acts)) + 1).tolist())
        rows |= set(np.searchsorted(seconds, times).tolist())
    return sorted(row for row in rows if row < len(seconds))


def table() -> str:
    """The table of courses in Markdown, as the README has it and ``twin effects`` prints it."""
    lines = ["| course | how an effect runs in time |", "| --- | --- |"]
    lines += [f"| `{course}` | {MEANING[course]} |" for course in Course]
    return "\n".join(lines)
