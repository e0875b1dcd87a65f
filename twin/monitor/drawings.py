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

KEPT = 8  # drawings: a program or two, with what jitters
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

    def far(self, known: Floats, may_differ: Floats) -> Floats:
        """How much a whole cycle differs from ``known`` ones; inf: it goes apart.

        They are of the same phases, each as ``how`` here, and so is what they ``may_differ`` by.
        """
        share = np.abs(self.how - known) / may_differ
        share = share.reshape(len(share), -1)
        far: Floats = np.where(share.max(axis=1) <= 1.0, share.sum(axis=1), np.inf)
        return far


@dataclass(frozen=True)
class Drawing:
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


class Drawings:
    """The last few that were of use."""

    def __init__(self) -> None:
        self._kept: list[Drawing] = []  # the last used comes last
        self._alike: dict[bytes, _Alike] = {}  # by their phases, as far as asked for

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, drawing: Drawing) -> None:
        """Keep one more; the one that was of no use for longest goes."""
        self._kept = [*self._kept, drawing][-KEPT:]
        self._alike.clear()

    def may_be(self, stretches: Stretches) -> bool:
        """Whether a cycle that has gone like this so far may yet turn out to go as a known one."""
        return any(stretches.may_go_as(one.stretches) for one in self._kept)

    def like(self, stretches: Stretches) -> Drawing | None:
        """The drawing of the cycle that a whole one goes most alike, if there is one."""
        phases = stretches.phases
        if phases not in self._alike:
            self._alike[phases] = _Alike.of(
                [one for one in self._kept if one.stretches.phases == phases]
            )
        alike = self._alike[phases]
        if not alike.drawings:
            return None
        far = stretches.far(alike.how, alike.may_differ)
        least = int(far.argmin())
        if far[least] == np.inf:
            return None
        nearest = alike.drawings[least]
        self._kept = [*(one for one in self._kept if one is not nearest), nearest]
        return nearest


@dataclass(frozen=True)
class _Alike:
    """Drawings of cycles of the same phases, and their stretches together."""

    drawings: Sequence[Drawing]
    how: Floats  # (drawings, stretches, 3)
    may_differ: Floats

    @classmethod
    def of(cls, drawings: Sequence[Drawing]) -> "_Alike":
        known = [one.stretches for one in drawings]
        together = (
            np.array([getattr(one, name) for one in known]) for name in ("how", "may_differ")
        )
        return cls(drawings, *together)
