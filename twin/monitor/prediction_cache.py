"""Cache of predictions of cycles: a later similar cycle needs no stepping.

A signature depends on the phases of a cycle, their durations, and the levels to which the model is
set. Cycles that hardly differ in these have the same signature, counted from the start of a phase.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin.model import kernel
from twin.monitor.bins import Floats, Ints
from twin.signals import MBAR

KEPT = 16  # predictions in the cache: enough for a few programs with their jitter
LONGER = 0.02  # largest relative difference of durations; signatures differ by about as much
LONGER_MS = 6.0  # largest difference of short durations
LEVEL = 3.0 * MBAR  # Pa, largest difference of a level


@dataclass(frozen=True)
class Stretches:
    """Stretches of a cycle, or of its rows so far: from one breakpoint to the next."""

    first: Ints  # first row of each
    phases: bytes
    # Rows and ms of PLC time from its first row to its last, and the level (Pa) to which the model
    # is set where it begins, 0 for none. (stretches, 3)
    how: Floats

    @cached_property
    def may_differ(self) -> Floats:
        """Largest differences of a similar cycle, in the units of ``how``, (stretches, 3)."""
        differ = np.maximum(LONGER * self.how, LONGER_MS)
        differ[:, 2] = LEVEL
        return differ

    def could_match(self, cached: "Stretches") -> bool:
        """Whether an unfinished cycle may still be similar to a known one.

        Later rows cannot remove a difference.
        """
        if not cached.phases.startswith(self.phases):
            return False
        difference = self.how - cached.how[: len(self.how)]
        difference[-1, :2] = np.maximum(difference[-1, :2], 0.0)  # the last stretch may continue
        return bool((np.abs(difference) <= cached.may_differ[: len(difference)]).all())

    def distances_from(self, cached: Sequence["Stretches"]) -> Floats:
        """Distances of a whole cycle from cached ones with the same phases; inf if not similar."""
        deviation = np.abs(self.how - np.array([stretches.how for stretches in cached]))
        deviation /= np.array([stretches.may_differ for stretches in cached])
        distance: Floats = np.where(
            deviation.max(axis=(1, 2)) <= 1.0, deviation.sum(axis=(1, 2)), np.inf
        )
        return distance


@dataclass(frozen=True)
class CachedPrediction:
    """Expected pressures of each hypothesis in a cycle, and the models' state at its end."""

    stretches: Stretches
    drawn: Ints  # subsampled rows, with the last row of every stretch
    expected: Floats  # Pa, (drawn, hypotheses)
    state: kernel.State

    def at(self, stretches: Stretches, drawn: Ints) -> Floats:
        """Expected pressure (Pa) at the rows ``drawn`` of another, similar cycle.

        Rows count from the beginning of their stretch; after its end the last value is held.
        """
        number = np.searchsorted(stretches.first, drawn, "right") - 1
        since = np.minimum(drawn - stretches.first[number], self.stretches.how[number, 0])
        rows = self.stretches.first[number] + since.astype(np.int64)
        expected: Floats = np.take(self.expected, np.searchsorted(self.drawn, rows), axis=0)
        return expected


class PredictionCache:
    """The most recently used predictions."""

    def __init__(self) -> None:
        self._kept: list[CachedPrediction] = []  # the most recently used one is last

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, prediction: CachedPrediction) -> None:
        """Add a prediction; a full cache drops the least recently used one."""
        self._kept = [*self._kept, prediction][-KEPT:]

    def could_hit(self, stretches: Stretches) -> bool:
        """Whether an unfinished cycle may still be similar to a cached one."""
        return any(stretches.could_match(prediction.stretches) for prediction in self._kept)

    def lookup(self, stretches: Stretches) -> CachedPrediction | None:
        """The prediction of the most similar cycle; None if none is similar."""
        candidates = [
            candidate for candidate in self._kept if candidate.stretches.phases == stretches.phases
        ]
        if not candidates:
            return None
        distances = stretches.distances_from([candidate.stretches for candidate in candidates])
        nearest = candidates[int(distances.argmin())]
        if not np.isfinite(distances.min()):
            return None
        self._kept = [candidate for candidate in self._kept if candidate is not nearest]
        self.add(nearest)
        return nearest
