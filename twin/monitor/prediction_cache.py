"""What was drawn of some cycles, kept for later ones that go alike: these need not be stepped.

A signature follows from how a cycle goes: its phases, how long each lasts, and the levels that the
model is set on. Where these hardly differ, it is the same, counted from the beginning of a phase.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin.model import kernel
from twin.monitor.bins import Floats, Ints
from twin.signals import MBAR

KEPT = 16  # drawings: a few programs, with what jitters
LONGER = 0.02  # of how long a stretch lasts; signatures differ by about as large a share of them
LONGER_MS = 6.0  # or so much, in a short one
LEVEL = 3.0 * MBAR  # Pa, by which a level may differ


@dataclass(frozen=True)
class Stretches:
    """How a cycle goes, or has gone so far: from one bend of what is expected to the next."""

    first: Ints  # row of each
    phases: bytes
    # From its first row to its last: rows, and ms of PLC time; and the level (Pa) that the model is
    # set on where it begins, 0 for none. (stretches, 3)
    how: Floats

    @cached_property
    def may_differ(self) -> Floats:
        """By how much those of another cycle may differ, (stretches, 3)."""
        differ = np.maximum(LONGER * self.how, LONGER_MS)
        differ[:, 2] = LEVEL
        return differ

    def may_go_as(self, known: "Stretches") -> bool:
        """Whether a cycle that is not over yet may still turn out to go as a known one.

        What does not go alike so far never will: no later row makes it alike again.
        """
        if not known.phases.startswith(self.phases):
            return False
        more = self.how - known.how[: len(self.how)]
        more[-1, :2] = np.maximum(more[-1, :2], 0.0)  # the last goes on
        return bool((np.abs(more) <= known.may_differ[: len(more)]).all())

    def far(self, known: Sequence["Stretches"]) -> Floats:
        """How much a whole cycle differs from known ones of the same phases; inf: it goes apart."""
        share = np.abs(self.how - np.array([one.how for one in known]))
        share /= np.array([one.may_differ for one in known])
        far: Floats = np.where(share.max(axis=(1, 2)) <= 1.0, share.sum(axis=(1, 2)), np.inf)
        return far


@dataclass(frozen=True)
class CachedPrediction:
    """What each hypothesis expects in a cycle, and where the models stand at its end."""

    stretches: Stretches
    drawn: Ints  # rows; the last of every stretch is one of them
    expected: Floats  # Pa, (drawn, hypotheses)
    state: kernel.State

    def at(self, stretches: Stretches, drawn: Ints) -> Floats:
        """What is expected (Pa) at rows of another cycle that goes alike.

        As many rows after the beginning of the stretch; what lasts longer stays as at its end.
        """
        number = np.searchsorted(stretches.first, drawn, "right") - 1
        since = np.minimum(drawn - stretches.first[number], self.stretches.how[number, 0])
        rows = self.stretches.first[number] + since.astype(np.int64)
        there: Floats = np.take(self.expected, np.searchsorted(self.drawn, rows), axis=0)
        return there


class PredictionCache:
    """The last few that were of use."""

    def __init__(self) -> None:
        self._kept: list[CachedPrediction] = []  # the last used comes last

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, drawing: CachedPrediction) -> None:
        """Keep one more; the one that was of no use for longest goes."""
        self._kept = [*self._kept, drawing][-KEPT:]

    def may_be(self, stretches: Stretches) -> bool:
        """Whether a cycle that has gone like this so far may yet turn out to go as a known one."""
        return any(stretches.may_go_as(one.stretches) for one in self._kept)

    def like(self, stretches: Stretches) -> CachedPrediction | None:
        """The drawing of the cycle that a whole one goes most alike, if there is one."""
        alike = [one for one in self._kept if one.stretches.phases == stretches.phases]
        if not alike:
            return None
        far = stretches.far([one.stretches for one in alike])
        nearest = alike[int(far.argmin())]
        if not np.isfinite(far.min()):
            return None
        self._kept = [one for one in self._kept if one is not nearest]
        self.add(nearest)
        return nearest
