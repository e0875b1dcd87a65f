"""How often sums over healthy cycles exceed their limit, by importance sampling.

An alarm in a month is one in a million cycles. So cycles are drawn from simulated ones with other
probabilities: at some cycle a change of the detector's own kind begins, in one suspect with one
sign and size, and from then on cycles with a high score are drawn more often. Each run ends with an
alarm, which counts as the likelihood ratio of no change to all these changes. That is the inverse
of the detector's sum, with the means of exp(score) that the simulated cycles have.

Cycles are drawn independently: the detector has removed the correlation with the cycle before.
"""

import numpy as np
import numpy.typing as npt

from twin.monitor.change_detection import MOST, ChangeDetector, limit

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

BEGINS = 200  # cycles, in one of which a change begins: sums are then as in a device that runs
ENDS = 2000  # cycles after which each run has had its alarm


class Weighing(ChangeDetector):
    """The detector's sums as likelihood ratios for simulated scores, and changes drawn by them."""

    def fit(self, scores: Floats, runs: int) -> None:
        """Take the means of exp(score) from healthy cycles, (cycles, suspects), for so many runs.

        A suspect is NaN if no cycle shows it.
        """
        self._shown = np.flatnonzero(np.isfinite(scores).all(axis=0))
        grown = np.exp(np.clip(scores, -MOST, MOST)[:, :, None, None] * self._shift)
        self._half[self._shown] = np.log(grown.mean(axis=0))[self._shown]
        weights = np.exp(self._weight)[self._shown].ravel()
        grown = grown[:, self._shown].reshape(len(scores), -1)
        self._shares = weights / weights.sum()
        self._cumulative = (np.cumsum(grown, axis=0) / grown.sum(axis=0)).T.copy()
        self._cycles = len(scores)
        self.take(np.full((runs, scores.shape[1]), np.nan))

    def drawn_changes(self, rng: np.random.Generator, runs: int) -> Ints:
        """The number of a change for each run."""
        return rng.choice(len(self._shares), size=runs, p=self._shares)

    def drawn_cycles(self, rng: np.random.Generator, changes: Ints, begun: Flags) -> Ints:
        """A cycle for each run, with the probabilities of its change where that has begun."""
        drawn = rng.random(len(changes))
        cycles = (drawn * self._cycles).astype(np.int64)
        for change in np.unique(changes[begun]).tolist():
            here = begun & (changes == change)
            cycles[here] = np.searchsorted(self._cumulative[change], drawn[here])
        return np.minimum(cycles, self._cycles - 1)


def times_wanted(
    scores: Floats,
    changes: ChangeDetector,
    weighing: Weighing,
    wanted: float,
    rng: np.random.Generator,
    runs: int,
) -> float:
    """Alarms of ``changes`` over the wanted number, which is one in ``wanted`` cycles.

    ``scores`` are normal scores of healthy cycles, (cycles, suspects), NaN for a suspect that none
    shows. ``weighing`` looks for the same changes with the same weights.
    """
    weighing.fit(scores, runs)
    changes.take(np.full((runs, scores.shape[1]), np.nan))  # as many as that
    kinds, first = weighing.drawn_changes(rng, runs), rng.integers(BEGINS, size=runs)
    times = np.full(runs, np.nan)
    for cycle in range(BEGINS + ENDS):
        cycles = weighing.drawn_cycles(rng, kinds, cycle >= first)
        changes.take(scores[cycles])
        weighing.take(scores[cycles])
        raised = np.isnan(times) & (changes.log_sums >= limit(wanted))
        times[raised] = np.exp(np.log(wanted) - weighing.log_sums[raised])
        if np.isfinite(times).all():
            break
    return float(times.mean())
