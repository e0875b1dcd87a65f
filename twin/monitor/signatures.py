"""Which effect's signature fits a deviation best: the first answer, while the loop runs.

A signature is what the expected pressure would change by if the effect were there. It is linear,
from one cycle and without a price for look-alikes; the diagnosis does it properly.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.model import kernel
from twin.model.effects import EFFECTS, Effect, apply
from twin.model.theta import Theta
from twin.signals import BREAK, MBAR, NS, Samples, Ticks, deviation

LOOK_ALIKE = 0.9  # of the best fit's gain


@dataclass(frozen=True)
class Likeness:
    """How well one effect explains a deviation: its size, and the share of squares it takes."""

    effect: str
    size: float  # in the unit of the effect's first parameter
    unit: str
    share: float


def expect(
    theta: Theta, samples: Samples, phase: npt.NDArray[np.uint8], level: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Expected pressure (Pa) of fresh models over rows whose phases and levels are known.

    ``theta`` is (coefficients, n), one column for each of n hypotheses; the result is (rows, n).
    """
    state, expected = kernel.new_state(theta.shape[1]), np.empty((len(samples), theta.shape[1]))
    kernel.advance(state, theta, steps(samples, None), phase, level, expected)
    return expected


def steps(samples: Samples, before_ns: int | None) -> npt.NDArray[np.float64]:
    """Seconds from row to row, −1 where time does not run on; ``before_ns`` is the row before."""
    times = samples["time_ns"]
    first = times[:1] if before_ns is None else np.array([before_ns])
    dt: npt.NDArray[np.float64] = np.diff(np.concatenate([first[: len(times)], times])) * NS
    dt[(samples["quality"] & BREAK) != 0] = -1.0
    return dt


def likenesses(theta: Theta, samples: Samples, ticks: Ticks, begin: int) -> list[Likeness]:
    """Rank the effects by how much of the deviation from row ``begin`` on they explain.

    The rows before ``begin`` let the model swing in.
    """
    changed = np.stack([theta, *(_typical(theta, effect) for effect in EFFECTS.values())], axis=1)
    expected = expect(changed, samples, ticks["phase"], ticks["level"].astype(np.float64)) / MBAR
    off = deviation(samples, ticks) / MBAR
    rows = np.isfinite(off) & np.isfinite(expected[:, 0])
    rows[:begin] = False
    if not rows.any():
        return []
    signatures = expected[rows, 1:] - expected[rows, :1]
    found = [
        _fit(effect, off[rows], signature)
        for effect, signature in zip(EFFECTS.values(), signatures.T, strict=True)
    ]
    return sorted(found, key=lambda likeness: -likeness.share)


def look_alikes(ranking: list[Likeness]) -> list[str]:
    """Name the effects behind the best that explain nearly as much."""
    return [one.effect for one in ranking[1:] if one.share >= LOOK_ALIKE * ranking[0].share > 0.0]


def _typical(theta: Theta, effect: Effect) -> Theta:
    sizes = {p.name: p.neutral(theta) + p.typical for p in effect.parameters}
    return apply(theta, effect.name, sizes)


def _fit(
    effect: Effect, off: npt.NDArray[np.float64], signature: npt.NDArray[np.float64]
) -> Likeness:
    """Fit ``off`` by a multiple of the signature, of a sign the effect can have."""
    first = effect.parameters[0]
    power = float(signature @ signature)
    times = float(off @ signature) / power if power > 0.0 else 0.0
    if first.low == 0.0 and first.coefficient is None:
        times = max(times, 0.0)
    share = times * times * power / max(float(off @ off), 1e-12)
    return Likeness(effect.name, times * first.typical, first.unit, share)
