"""What one cycle says of every suspect: one whitened number each, of sigma 1 in healthy cycles.

The deviation is averaged into bins, the levels at which the air saving switched are put beside it,
and both are held against each suspect's signature, weighed by what healthy cycles scatter.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
import numpy.typing as npt

from twin.model.dataset import DataSet, coefficients
from twin.model.theta import Theta
from twin.monitor.bank import DELAYS, LARGER, SUSPECTS, UNSURE_OF, hypotheses
from twin.monitor.bins import Bins, Floats, Ints, binned
from twin.monitor.cycles import Cycle
from twin.monitor.healthy import Healthy
from twin.monitor.phases import Knees, expected_knees
from twin.monitor.switching import seen
from twin.monitor.weights import SCATTER, from_cycle_to_cycle, model_error
from twin.signals import MBAR, UNUSABLE, deviation

PER_UNIT = 2  # bins in each unit of warped time
LEVELS = ("h1_level", "h1_low_level")
UNKNOWN_LEVEL_MBAR = 3.0  # one sigma of a level that healthy cycles do not show
SUCTION_ROWS = 4000  # commanded, to see where each suspect switches
WEAK = 1e-4  # sigmas² of a step: nothing in the cycle depends on it


@dataclass(frozen=True)
class Said:
    """What a cycle says, place by place: a bin at the same time in every cycle, or a level."""

    place: Ints  # no two the same
    kind: Ints  # of stretch, of each place; below zero for a level
    time: Floats  # warped, since the stretch began
    off: Floats  # mbar, measured less expected
    signatures: Floats  # mbar, by each suspect's step, (places, suspects)
    larger: Floats  # mbar, by the larger sizes of what delays, (places, DELAYS · LARGER)
    unsure: Floats  # mbar, by which that of a low supply may be another, (places, ways)
    alone: Floats  # mbar², covariance of what differs from cycle to cycle
    common: Floats  # mbar, one sigma of what is off in all cycles

    def at(self, places: npt.NDArray[np.bool_]) -> "Said":
        """What it says of some places."""
        columns = {
            one.name: getattr(self, one.name)[places] for one in fields(self) if one.name != "alone"
        }
        return Said(alone=self.alone[np.ix_(places, places)], **columns)

    def scores(self) -> Floats:
        """How many sigmas of each signature there are; NaN for what this cycle does not show."""
        weighed, power = self._weighed()
        scores: Floats = self.off @ weighed / np.sqrt(np.where(power > 0.0, power, np.nan))
        return scores

    def sizes(self) -> Floats:
        """Steps of each suspect that fit best, were nothing else wrong; NaN as in ``scores``."""
        weighed, power = self._weighed()
        sizes: Floats = self.off @ weighed / np.where(power > 0.0, power, np.nan)
        return sizes

    def alike(self) -> Floats:
        """Cosines between the signatures, whitened; 0 for what this cycle does not show."""
        weighed, power = self._weighed()
        unit = 1.0 / np.sqrt(np.where(power > 0.0, power, np.inf))
        cosines: Floats = self.signatures.T @ weighed * np.outer(unit, unit)
        return cosines

    def _weighed(self) -> tuple[Floats, Floats]:
        """Signatures by the inverse covariance, and the sigmas² of each; 0 where there are none."""
        weighed = np.linalg.solve(self.alone, self.signatures).astype(np.float64)
        power = np.sum(self.signatures * weighed, axis=0)
        power[power < WEAK] = 0.0
        return weighed, power


@dataclass
class Listener:
    """Makes statistics of cycles."""

    theta: Theta
    healthy: Healthy
    noise: float  # mbar, of a row
    knees: Knees
    _levels: Floats = field(init=False)  # mbar, by which each level moves, (levels, hypotheses)
    _means: Floats = field(init=False)  # mbar, of each level in healthy cycles
    _sigmas: Floats = field(init=False)

    @classmethod
    def of(cls, data: DataSet, healthy: Healthy) -> "Listener":
        """The one for cycles beside the twin of a data set."""
        theta, noise = coefficients(data), data.sensor.noise_mbar
        return cls(theta, healthy, noise, expected_knees(theta, noise * MBAR))

    def __post_init__(self) -> None:
        found = seen(hypotheses(self.theta), SUCTION_ROWS, self.knees)
        vacuum = np.array([one.levels for one in found]).T
        self._levels = np.nan_to_num(vacuum[:, 1:] - vacuum[:, :1])
        known = [self.healthy.figures.get(name) for name in LEVELS]
        means = [one.mean if one else at for one, at in zip(known, vacuum[:, 0], strict=True)]
        self._means = np.nan_to_num(np.array(means))
        self._sigmas = np.array([one.sigma if one else UNKNOWN_LEVEL_MBAR for one in known])

    def hear(
        self, cycle: Cycle, drawn: Ints, expected: Floats, figures: Mapping[str, float]
    ) -> Said | None:
        """What a whole cycle says; ``drawn`` rows and ``expected`` (Pa) there are the bank's.

        ``figures`` are the monitor's.
        """
        off = deviation(cycle.samples, cycle.ticks) / MBAR
        known: npt.NDArray[np.bool_] = np.all(np.isfinite(expected), axis=1)
        if not known.any():
            return None
        between = np.interp(np.arange(len(off)), drawn, known.astype(float), 0.0, 0.0)
        usable = np.isfinite(off) & (between == 1.0)
        usable &= (cycle.samples["quality"] & UNUSABLE) == 0
        if not usable.any():
            return None
        bins = binned(cycle.ticks["phase"], usable, np.zeros(1, np.int64), PER_UNIT)
        moved = (expected[:, 1:] - expected[:, :1]) / MBAR
        moved[~known] = 0.0
        signatures = bins.through(drawn, moved)
        return self._with_levels(bins, bins.mean(off), signatures, figures)

    def _with_levels(
        self, bins: Bins, off: Floats, signatures: Floats, figures: Mapping[str, float]
    ) -> Said:
        place, first = np.unique(bins.place, return_index=True)  # what comes again counts once
        common, alone = model_error(self.healthy.error, bins.kind[first], bins.time[first])
        moves = self._moves(signatures[first])
        covariance = from_cycle_to_cycle(bins, first, alone, moves, self.noise)
        shown = [number for number, name in enumerate(LEVELS) if name in figures]
        level = np.array([figures[LEVELS[number]] for number in shown]) - self._means[shown]
        moved = np.concatenate([signatures[first], self._levels[shown]])
        known = np.cumsum([len(SUSPECTS), len(DELAYS) * LARGER])
        suspects, larger, ways = np.split(moved, known, axis=1)
        numbers = np.array(shown, np.int64) - len(LEVELS)
        return Said(
            np.concatenate([place, numbers]),
            np.concatenate([bins.kind[first], numbers]),
            np.concatenate([bins.time[first], np.zeros(len(shown))]),
            np.concatenate([off[first], level]),
            suspects,
            larger,
            ways - suspects[:, [UNSURE_OF]],
            _beside(covariance * self.healthy.leftover**2, self._sigmas[shown] ** 2),
            np.concatenate([common, self._sigmas[shown]]),
        )

    def _moves(self, signatures: Floats) -> Floats:
        """By how much (mbar) what scatters moves each bin, one sigma of it, (bins, scatters)."""
        numbers, sigmas = self._scatters
        moves: Floats = signatures[:, numbers] * sigmas
        return moves

    @cached_property
    def _scatters(self) -> tuple[list[int], list[float]]:
        """Which suspects scatter in healthy cycles, and one sigma of each in its steps."""
        numbers, sigmas = [], []
        for number, one in enumerate(SUSPECTS):
            parameter, usual = SCATTER.get(one.effect, ("", 0.0))
            if parameter == one.parameter.name:
                numbers.append(number)
                sigmas.append(self.healthy.scatter.get(one.effect, usual) / one.step)
        return numbers, sigmas


def _beside(covariance: Floats, variances: Floats) -> Floats:
    """The covariance together with what varies by itself."""
    count = len(covariance)
    whole = np.diag(np.concatenate([np.zeros(count), variances]))
    whole[:count, :count] = covariance
    return whole
