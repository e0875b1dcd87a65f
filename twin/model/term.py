"""Terms from data: parts of the pressure that the physics of the model does not explain.

A term adds to the expected pressure in one kind of stretch. It depends on the vacuum or on the time
since the stretch began. It names no cause; it removes a deviation that is not in the table.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from twin.settings import Settings
from twin.signals import MBAR, MS, Phase

# Kinds of stretches. Suction after hold is a kind of its own: it begins at another pressure.
KINDS = ("idle", "suction", "hold", "blow_off", "suction_again")
AGAIN = KINDS.index("suction_again")
_SUCTION, _HOLD = int(Phase.SUCTION), int(Phase.HOLD)  # NumPy compares bytes with plain integers

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]


class Term(Settings):
    """Addition to the expected pressure (mbar) at each knot, linear between knots."""

    where: Literal[
        "idle", "suction", "hold", "blow_off", "suction_again"
    ]  # the stretch that it is added in
    over: Literal["vacuum", "time"]  # mbar below ambient, or ms since the stretch began
    at: tuple[float, ...] = Field(min_length=1)  # the knots, rising
    mbar: tuple[float, ...] = Field(min_length=1)  # correction at each knot

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if len(self.at) != len(self.mbar):
            raise ValueError("at and mbar need as many values each")
        if (np.diff(self.at) <= 0.0).any():
            raise ValueError("at must rise")
        return self


def kinds(phase: Bytes, before: Bytes) -> Ints:
    """Kinds of stretches by their phase and the phase before, as indices into KINDS."""
    again = (phase == _SUCTION) & (before == _HOLD)
    return np.where(again, AGAIN, phase).astype(np.int64)


@dataclass
class Terms:
    """Adds terms to the expected pressure, block by block."""

    terms: Sequence[Term]
    ambient: float  # Pa
    _phase: int = -1  # of the last row
    _kind: int = 0
    _rows: int = 0  # since its stretch began

    def add(self, phase: Bytes, expected: Floats) -> None:
        """Add to ``expected`` (Pa), of shape (rows,) or (rows, hypotheses), in place."""
        if not self.terms or not len(phase):
            return
        kind, since = self._where(phase)
        for term in self.terms:
            here = np.flatnonzero(kind == KINDS.index(term.where))
            over = since[here] if term.over == "time" else (self.ambient - expected[here]) / MBAR
            added = np.interp(over, term.at, term.mbar) * MBAR
            expected[here] += added if added.ndim == expected.ndim else added[:, None]

    def _where(self, phase: Bytes) -> tuple[Ints, Floats]:
        """Kind of stretch and time (ms) since it began, of each row."""
        before = np.concatenate([[self._phase], phase[:-1]])
        begins = phase != before
        first = np.flatnonzero(begins)
        stretch = np.cumsum(begins)  # 0: the one that goes on from the last block
        kind = np.concatenate([[self._kind], kinds(phase[first], before[first].astype(np.uint8))])
        row = np.concatenate([[-self._rows], first])
        since = np.arange(len(phase)) - row[stretch]
        self._phase, self._kind = int(phase[-1]), int(kind[stretch[-1]])
        self._rows = int(since[-1]) + 1
        return kind[stretch], since * MS * 1e3  # pyright: ignore[reportReturnType]
