"""What healthy cycles are like: how far the model is off in them, and what scatters by how much."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin.diagnosis.covariance import Covariance, Weights, moved, scatter
from twin.diagnosis.evidence import HEALTHY, Evidence
from twin.model.term import KINDS
from twin.monitor.bins import Bools, Floats, Ints, unwarped
from twin.monitor.healthy import Healthy, ModelError
from twin.monitor.scatter_covariance import FIRST_ERROR, SCATTER
from twin.signals import MS

ROUNDS = 3
FEWEST = 6  # cycles, to judge on others what was learned from some
LEAST_COMMON, LEAST_ALONE = 0.15, 0.1  # mbar
ODD = 3.0  # times the median of cycles' chi-square, beyond which one is odd and counts no more
HIDDEN = 1.3  # the error over what is left of it once the data set was fitted to the same cycles
LEAST_SCATTER, MOST_SCATTER = 0.2, 5.0  # of what is usual


@dataclass(frozen=True)
class _Healthy:
    """How far the twin is off in healthy cycles (mbar), and what moves that, (bins, ·)."""

    evidence: Evidence
    off: Floats
    moves: Floats  # by the usual size of each scatter
    left_open: Floats  # by each way that the data set is uncertain

    def by(self, healthy: Healthy) -> Covariance:
        """What bins have in common by what was learned."""
        evidence = replace(self.evidence, healthy=healthy)
        _, moves, _ = moved(evidence, HEALTHY, scatter(evidence))
        return Covariance(evidence, np.zeros_like(self.off), moves, self.left_open)


def learned(evidence: Evidence) -> Healthy:
    """Learn the model's error and the scatter from healthy cycles; the rest stays as it is."""
    evidence = replace(evidence, another_day=False)
    seen = _Healthy(evidence, *moved(evidence, HEALTHY, SCATTER, evidence.uncertain))
    judged = evidence.judged
    halves = [(judged[::2], judged[1::2]), (judged[1::2], judged[::2])]
    if len(judged) < FEWEST:
        halves = [(judged, judged)]
    left = [_left(seen, _learned(seen, here), there) for here, there in halves]
    return _learned(seen, judged).model_copy(
        update={"leftover": usual_leftover(np.concatenate(left))}
    )


def _left(seen: _Healthy, healthy: Healthy, cycles: Sequence[int]) -> Floats:
    """Chi-square per residual that each cycle has by what was learned from others."""
    weights = seen.by(healthy).of(cycles)
    white = weights.white(seen.off[:, None])[: len(weights.bins), 0]
    return left_in_each(seen.evidence, weights, white)


def left_in_each(evidence: Evidence, weights: Weights, white: Floats) -> Floats:
    """Chi-square per residual in each cycle of ``weights``, from ``white`` ones.

    They are of bins, or of bins and then levels.
    """
    cycle = np.concatenate([evidence.bins.cycle[weights.bins], weights.level_cycles])
    cycle, squares = cycle[: len(white)], white**2
    return np.array([np.mean(squares[cycle == one]) for one in weights.cycles if one in cycle])


def usual_leftover(left: Floats) -> float:
    """Sigmas that cycles have by what was learned from others; one odd cycle is not all of them.

    What is learned in the end has seen that one as well.
    """
    return float(np.sqrt(np.mean(np.minimum(left, ODD * np.median(left)))))


def are_odd(left: Floats) -> Bools:
    """Which cycles are off by far more than most, from chi-square in each."""
    return left > ODD * np.median(left)


def _learned(seen: _Healthy, cycles: Sequence[int]) -> Healthy:
    """What some cycles say."""
    evidence = seen.evidence
    found = evidence.healthy.model_copy(
        update={"error": dict.fromkeys(KINDS, FIRST_ERROR), "scatter": {}, "leftover": 1.0}
    )
    for _ in range(ROUNDS):
        amplitudes, spread = _amplitudes(seen, found, cycles)
        left = seen.off - np.einsum("bs,bs->b", seen.moves, amplitudes[evidence.bins.cycle])
        sizes = np.sqrt(amplitudes[cycles].var(axis=0, ddof=1) + spread[cycles].mean(axis=0))
        sizes = np.clip(sizes[: len(SCATTER)], LEAST_SCATTER, MOST_SCATTER)
        found = found.model_copy(
            update={
                "error": _errors(evidence, left, cycles),
                "scatter": {
                    name: float(size * times)
                    for (name, (_, size)), times in zip(SCATTER.items(), sizes, strict=True)
                },
            }
        )
    return found


def _amplitudes(seen: _Healthy, healthy: Healthy, cycles: Sequence[int]) -> tuple[Floats, Floats]:
    """What scattered in each cycle, in its usual sizes, and with what variance that is known."""
    evidence, moves = replace(seen.evidence, healthy=healthy), seen.moves
    size = (evidence.cycles, moves.shape[1])
    found, spread = np.zeros(size), np.zeros(size)
    known = Covariance(evidence, np.zeros_like(seen.off), moves, seen.left_open)
    known_sizes = [healthy.scatter.get(name, size) / size for name, (_, size) in SCATTER.items()]
    prior = np.ones(moves.shape[1])
    prior[: len(known_sizes)] = known_sizes
    for cycle in cycles:
        alone = known.of([cycle], scattered=False)
        both = alone.white(np.column_stack([seen.off, moves]))
        information = both[:, 1:].T @ both[:, 1:] + np.diag(prior**-2.0)
        variance = np.linalg.inv(information)
        found[cycle] = variance @ both[:, 1:].T @ both[:, 0]
        spread[cycle] = np.diag(variance)
    return found, spread


def _errors(evidence: Evidence, left: Floats, cycles: Sequence[int]) -> dict[str, ModelError]:
    """How far the model is off in some cycles, by kind of stretch and time since it began."""
    found, bins = {}, evidence.bins
    for kind, name in enumerate(KINDS):
        here = np.flatnonzero((bins.kind == kind) & np.isin(bins.cycle, cycles))
        if len(here):
            found[name] = _error(evidence, left, here)
    return found


def _error(evidence: Evidence, left: Floats, here: Ints) -> ModelError:
    unit = np.floor(evidence.bins.time[here]).astype(np.int64)
    noise = evidence.noise**2 / evidence.bins.count[here]
    after, common, alone = [], [], []
    for one in np.unique(unit):
        at = here[unit == one]
        apart = _apart(evidence, left, at)
        after.append(float(unwarped(np.array(one + 0.5)) / MS))
        noisy = float(np.mean(noise[unit == one]))
        common.append(float(np.sqrt(max(HIDDEN**2 * (apart[0] - apart[1]), LEAST_COMMON**2))))
        alone.append(float(np.sqrt(max(apart[2] - noisy, LEAST_ALONE**2))))
    return ModelError(after_ms=tuple(after), common_mbar=tuple(common), alone_mbar=tuple(alone))


def _apart(evidence: Evidence, left: Floats, at: Ints) -> tuple[float, float, float]:
    """Mean square of bins' means over cycles, what of it is chance, and the variance about them."""
    place = evidence.bins.place[at]
    squares, chance, within = [], [], []
    for one in np.unique(place):
        values = left[at[place == one]]
        variance = float(np.var(values, ddof=1)) if len(values) > 1 else 0.0
        squares.append(float(np.mean(values)) ** 2)
        chance.append(variance / len(values))
        within.append(variance)
    return float(np.mean(squares)), float(np.mean(chance)), float(np.mean(within))
