"""Which effect's signature fits a deviation best: the first answer, while the loop runs.

A signature is what the expected pressure would change by if the effect were there. It is linear,
from one cycle and without a price for look-alikes; the diagnosis does it properly.
"""

from dataclasses import dataclass

import numpy as np

from twin.model import kernel
from twin.model.compiled import compiled
from twin.model.effects import EFFECTS, Effect, apply
from twin.model.theta import Theta
from twin.monitor.bins import Floats, Ints, sparse
from twin.signals import BREAK, MBAR, MS, NS, Samples, Ticks, deviation

LOOK_ALIKE = 0.9  # of the best fit's gain
NOTHING = 0.02  # mbar rms: what moves the pressure by less in its typical size is not seen in it


@dataclass(frozen=True)
class Likeness:
    """How well one effect explains a deviation: its size, and the share of squares it takes."""

    effect: str
    size: float  # in the unit of the effect's first parameter
    unit: str
    share: float


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
    dt = steps(samples, None)
    begins |= (dt < 0.5 * MS) | (dt > 1.5 * MS)
    return sparse(begins)


def likenesses(theta: Theta, samples: Samples, ticks: Ticks, begin: int) -> list[Likeness]:
    """Rank the effects by how much of the deviation from row ``begin`` on they explain.

    The rows before ``begin`` let the model swing in.
    """
    changed = np.stack([theta, *(_typical(theta, effect) for effect in EFFECTS.values())], axis=1)
    drawn = drawn_rows(samples, ticks)
    expected = _expect(changed, samples, ticks, drawn) / MBAR
    signatures, number = expected[:, 1:] - expected[:, :1], np.arange(len(samples))
    off = deviation(samples, ticks) / MBAR
    rows = np.isfinite(off) & np.isfinite(np.interp(number, drawn, expected[:, 0]))
    rows[:begin] = False
    if not rows.any():
        return []
    found = [
        _fit(effect, off[rows], np.interp(number[rows], drawn, signature))
        for effect, signature in zip(EFFECTS.values(), signatures.T, strict=True)
    ]
    return sorted(found, key=lambda likeness: -likeness.share)


def look_alikes(ranking: list[Likeness]) -> list[str]:
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


def _typical(theta: Theta, effect: Effect) -> Theta:
    sizes = {p.name: p.neutral(theta) + p.typical for p in effect.parameters}
    return apply(theta, effect.name, sizes)


def _fit(effect: Effect, off: Floats, signature: Floats) -> Likeness:
    """Fit ``off`` by a multiple of the signature, of a sign the effect can have."""
    first = effect.parameters[0]
    power = float(signature @ signature)
    moves = power > NOTHING**2 * len(signature)
    times = float(off @ signature) / power if moves else 0.0
    if first.low == 0.0 and first.coefficient is None:
        times = max(times, 0.0)
    share = times * times * power / max(float(off @ off), 1e-12)
    return Likeness(effect.name, times * first.typical, first.unit, share)
