"""Which effect's signature fits a deviation best: the first answer, while the loop runs.

A signature is what the expected pressure would change by if the effect were there. It is from one
cycle and without a price for look-alikes; the diagnosis does it properly.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin.inference.sensitivities import coefficients_at, sensitivities
from twin.model import kernel
from twin.model.compiled import compiled
from twin.model.effects import EFFECTS, UNKNOWN, Effect, find_effect
from twin.model.theta import Theta
from twin.monitor.bins import Floats, Ints, drawn
from twin.signals import BREAK, MBAR, NS, Samples, Ticks, deviation

LOOK_ALIKE = 0.9  # of the best fit's gain
UNNAMED = "its cause is sought in the first whole cycle"
ROUNDS = 2  # of fitting: the second one in the sizes that the first has found
NOTHING = 0.02  # mbar rms: what moves the pressure by less in its typical size is not seen in it


@dataclass(frozen=True)
class Likeness:
    """How well one effect explains a deviation: its size, and the share of squares it takes."""

    effect: str
    size: float | None  # in the unit of the effect's first parameter; None where it is not known
    unit: str
    share: float

    @property
    def is_small(self) -> bool:
        """Whether what it does is about in proportion to its size: typical ones are the limit."""
        effect = find_effect(self.effect)
        typical = effect.parameters[0].typical if effect else 0.0
        return self.size is not None and abs(self.size) <= typical

    @property
    def words(self) -> str:
        """The effect and its size, or why none is told."""
        if self.effect == UNKNOWN:
            return UNNAMED
        if self.size is None:
            return f"fits {self.effect}; its size cannot be told, the estimate is out of its bounds"
        return f"fits {self.effect} {self.size:.3g} {self.unit}"

    def plain(self) -> dict[str, float | int | str]:
        """The same as JSON has it; without a size where none is known."""
        told: dict[str, float | int | str] = {"effect": self.effect, "share": self.share}
        return told if self.size is None else {**told, "size": self.size, "unit": self.unit}


def steps(samples: Samples, before_ns: int | None) -> Floats:
    """Seconds from row to row, −1 where time does not run on; ``before_ns`` is the row before."""
    dt = np.empty(len(samples))
    if len(dt):
        _steps(samples, int(samples["time_ns"][0]) if before_ns is None else before_ns, dt)
    return dt


@compiled
def _steps(samples, before_ns, dt):  # type: ignore[no-untyped-def]
    for row in range(len(dt)):
        time_ns = samples[row].time_ns
        dt[row] = -1.0 if samples[row].quality & BREAK else (time_ns - before_ns) * NS
        before_ns = time_ns


def drawn_rows(samples: Samples, ticks: Ticks) -> Ints:
    """Rows that suffice to draw what is expected: every one where something changes."""
    begins = np.diff(ticks["phase"], prepend=255) != 0
    begins |= np.isfinite(ticks["level"])
    known = np.isfinite(ticks["expected"])
    begins |= np.diff(known, prepend=False) != 0
    return drawn(steps(samples, None), begins)


def likenesses(
    theta: Theta, samples: Samples, ticks: Ticks, begin: int, known: Sequence[Effect] = ()
) -> list[Likeness]:
    """Rank the effects, also ``known`` ones beside the table, by how much they explain.

    That is of the deviation from row ``begin`` on.

    The rows before ``begin`` let the model swing in. Each effect is fitted by its typical size, and
    then by what it does in the size found: what is large is not in proportion to what is typical.
    """
    drawn, number = drawn_rows(samples, ticks), np.arange(len(samples))
    off = deviation(samples, ticks) / MBAR
    rows = np.isfinite(off)
    rows[:begin] = False
    effects = [*EFFECTS.values(), *known]
    firsts = [effect.parameters[0] for effect in effects]
    typical = [
        (one.name, {p.name: p.typical for p in one.parameters if not p.shapes}) for one in effects
    ]
    bounds = [np.array(first.range(theta)) / first.typical for first in firsts]
    sizes, shares = np.ones(len(typical)), np.zeros(len(typical))

    def expect(at: Floats) -> Floats:
        return _expect(coefficients_at(theta, typical, at), samples, ticks, drawn) / MBAR

    for _ in range(ROUNDS):
        steps = np.where(sizes == 0.0, 1.0, sizes)
        expected, slopes = sensitivities(expect, np.zeros(len(sizes)), steps)
        rows &= np.isfinite(np.interp(number, drawn, expected))
        if not rows.any():
            return []
        for i, slope in enumerate(slopes.T):
            signature = np.interp(number[rows], drawn, slope)
            sizes[i], shares[i] = _fit(bounds[i], sizes[i], off[rows], signature)
    found = [
        Likeness(name, first.reported(size * first.typical, theta), first.unit, share)
        for (name, _), first, size, share in zip(
            typical, firsts, sizes.tolist(), shares.tolist(), strict=True
        )
    ]
    return sorted(found, key=lambda likeness: -likeness.share)


def look_alikes(ranking: Sequence[Likeness]) -> list[str]:
    """Name the effects behind the best that explain nearly as much."""
    return [one.effect for one in ranking[1:] if one.share >= LOOK_ALIKE * ranking[0].share > 0.0]


def _expect(theta: Theta, samples: Samples, ticks: Ticks, rows: Ints) -> Floats:
    """Pressure (Pa) expected at some rows, (rows, n); ``theta`` is (coefficients, n)."""
    breaks = steps(samples, None)[rows] < 0.0
    dt = np.where(breaks, -1.0, np.diff(samples["time_ns"][rows], prepend=0) * NS)
    dt[:1] = 0.0
    driven = dt, ticks["phase"][rows], ticks["level"][rows].astype(np.float64)
    state, expected = kernel.new_state(theta.shape[1]), np.empty((len(rows), theta.shape[1]))
    kernel.advance(state, theta, *driven, expected, tolerance=kernel.ROUGHLY)
    return expected


def _fit(bounds: Floats, size: float, off: Floats, signature: Floats) -> tuple[float, float]:
    """Size within bounds, and share of squares, by a ``signature`` that was taken at a ``size``."""
    power, common = float(signature @ signature), float(off @ signature)
    if not size**2 * power > NOTHING**2 * len(signature):  # NaN: the model has no answer
        return 0.0, 0.0
    found = float(np.clip(common / power, *bounds))
    return found, found * (2.0 * common - found * power) / max(float(off @ off), 1e-12)
