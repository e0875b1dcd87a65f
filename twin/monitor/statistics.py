"""What one cycle says of every suspect: one whitened number each, of sigma 1 in healthy cycles.

The deviation is averaged into bins, the levels at which the air saving switched are put beside it,
and both are held against each suspect's signature, weighed by what healthy cycles scatter.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
import numpy.typing as npt

from twin.inference.covariance import Covariance
from twin.inference.sensitivities import derivatives
from twin.model.dataset import DataSet, coefficients
from twin.model.theta import Theta
from twin.monitor.bins import Bins, Floats, Ints, averaged
from twin.monitor.cycles import Cycle
from twin.monitor.detector_window import knees_of
from twin.monitor.healthy import Healthy
from twin.monitor.model_bank import (
    DELAYS,
    LARGER,
    SUSPECTS,
    UNSURE_OF,
    Suspect,
    hypotheses,
    suspects_of,
)
from twin.monitor.phase_detector import Knees
from twin.monitor.scatter_covariance import SCATTER, from_cycle_to_cycle, lasting, model_error
from twin.monitor.simulated_switching import seen
from twin.signals import MBAR

PER_UNIT = 2  # bins in each unit of warped time
LEVELS = ("h1_level", "h1_low_level")
PLACES = 8  # that are remembered: of a program or two, with what jitters
SUCTION = 4.0  # s, commanded to see where each suspect switches
# Sigmas² of a step: nothing in the cycle depends on it. Hypotheses that are stepped apart from each
# other are a pascal apart, which looks like some 0.002; the least that depends has 3.
WEAK = 0.01


@dataclass(frozen=True)
class CycleResidual:
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

    def at(self, places: npt.NDArray[np.bool_]) -> "CycleResidual":
        """What it says of some places."""
        columns = {
            one.name: getattr(self, one.name)[places] for one in fields(self) if one.name != "alone"
        }
        return CycleResidual(alone=self.alone[np.ix_(places, places)], **columns)

    def scores(self) -> Floats:
        """How many sigmas of each signature there are; NaN for what this cycle does not show."""
        off, signatures, power = self._whitened()
        scores: Floats = off @ signatures / np.sqrt(np.where(power > 0.0, power, np.nan))
        return scores

    def sizes(self) -> Floats:
        """Steps of each suspect that fit best, were nothing else wrong; NaN as in ``scores``."""
        off, signatures, power = self._whitened()
        sizes: Floats = off @ signatures / np.where(power > 0.0, power, np.nan)
        return sizes

    def alike(self) -> Floats:
        """Cosines between the signatures, whitened; 0 for what this cycle does not show."""
        _, signatures, power = self._whitened()
        unit = 1.0 / np.sqrt(np.where(power > 0.0, power, np.inf))
        cosines: Floats = signatures.T @ signatures * np.outer(unit, unit)
        return cosines

    def _whitened(self) -> tuple[Floats, Floats, Floats]:
        """What is off and the signatures, and the sigmas² of each of these; 0 where none are."""
        white = Covariance.of(self.alone).white(np.column_stack([self.off, self.signatures]))
        off, signatures = white[:, 0], white[:, 1:]
        power = np.einsum("ij,ij->j", signatures, signatures)
        power[power < WEAK] = 0.0
        return off, signatures, power


@dataclass
class ScoreExtractor:
    """Makes statistics of cycles."""

    theta: Theta
    healthy: Healthy
    noise: float  # mbar, of a row
    knees: Knees
    suspects: Sequence[Suspect] = SUSPECTS
    _levels: Floats = field(init=False)  # mbar, by which each level moves, (levels, hypotheses)
    _means: Floats = field(init=False)  # mbar, of each level in healthy cycles
    _sigmas: Floats = field(init=False)
    _seen: dict[bytes, "_Places"] = field(default_factory=dict)  # by where the bins are

    @classmethod
    def of(cls, data: DataSet, healthy: Healthy) -> "ScoreExtractor":
        """The one for cycles beside the twin of a data set."""
        theta, noise = coefficients(data), data.sensor.noise_mbar
        return cls(theta, healthy, noise, knees_of(data), suspects_of(data, theta))

    def __post_init__(self) -> None:
        looked = hypotheses(self.theta, self.suspects)
        found = seen(looked, round(SUCTION / self.knees.period), self.knees)
        vacuum = np.array([one.levels for one in found]).T
        self._levels = np.nan_to_num(derivatives(vacuum)[1])
        known = [self.healthy.figures.get(name) for name in LEVELS]
        means = [one.mean if one else at for one, at in zip(known, vacuum[:, 0], strict=True)]
        self._means = np.nan_to_num(np.array(means))
        self._sigmas = np.array(
            [one.sigma if one else self.healthy.unseen_level_mbar for one in known]
        )

    def hear(
        self, cycle: Cycle, drawn: Ints, expected: Floats, figures: Mapping[str, float]
    ) -> CycleResidual | None:
        """What a whole cycle says; ``drawn`` rows and ``expected`` (Pa) there are the bank's.

        ``figures`` are the monitor's.
        """
        bins, off, through = averaged(cycle.ticks["phase"], cycle.off, drawn, expected, PER_UNIT)
        if not len(off):
            return None
        shown = [number for number, name in enumerate(LEVELS) if name in figures]
        level = np.array([figures[LEVELS[number]] for number in shown]) - self._means[shown]
        at = self._places(bins, shown)
        through = through[at.first]
        moved = np.concatenate([derivatives(through / MBAR)[1], self._levels[shown]])
        count = len(self.suspects)
        suspects, larger, ways = np.split(moved, (count, count + len(DELAYS) * LARGER), axis=1)
        moves = self._moves(suspects[: len(at.first)])
        covariance = from_cycle_to_cycle(bins, at.first, at.goes_on, moves, self.noise)
        return CycleResidual(
            at.place,
            at.kind,
            at.time,
            np.concatenate([off[at.first], level]),
            suspects,
            larger,
            ways - suspects[:, UNSURE_OF : UNSURE_OF + 1],
            _beside(covariance * self.healthy.leftover**2, self._sigmas[shown] ** 2),
            at.common,
        )

    def _places(self, bins: Bins, shown: Sequence[int]) -> "_Places":
        """Where a cycle says something, with what follows from it; most say it at the same."""
        key = b"".join(of.tobytes() for of in (bins.stretch, bins.kind, bins.since)) + bytes(shown)
        if key not in self._seen:
            if len(self._seen) == PLACES:
                self._seen.clear()
            self._seen[key] = _Places.of(bins, shown, self._sigmas[shown], self.healthy)
        return self._seen[key]

    def _moves(self, signatures: Floats) -> Floats:
        """By how much (mbar) what scatters moves each bin, one sigma of it, (bins, scatters)."""
        numbers, sigmas = self._scatters
        moves: Floats = signatures[:, numbers] * sigmas
        return moves

    @cached_property
    def _scatters(self) -> tuple[list[int], list[float]]:
        """Which suspects scatter in healthy cycles, and one sigma of each in its steps."""
        numbers, sigmas = [], []
        for number, one in enumerate(self.suspects):
            parameter, usual = SCATTER.get(one.effect, ("", 0.0))
            if parameter == one.parameter.name:
                numbers.append(number)
                sigmas.append(self.healthy.scatter.get(one.effect, usual) / one.step)
        return numbers, sigmas


@dataclass(frozen=True)
class _Places:
    """Where the bins of a cycle are, and what is the same for all that have theirs there."""

    first: Ints  # bins; what comes again counts once
    place: Ints  # of those and of the levels, as are all of these
    kind: Ints
    time: Floats
    common: Floats  # mbar, by which the model is off in all cycles
    goes_on: Floats  # mbar², covariance of bins: what does so for a while, and differs by cycle

    @classmethod
    def of(cls, bins: Bins, shown: Sequence[int], sigmas: Floats, healthy: Healthy) -> "_Places":
        """Those of bins and of the levels ``shown``, whose ``sigmas`` (mbar) are given."""
        place, first = np.unique(bins.place, return_index=True)
        kind, time = bins.kind[first], bins.time[first]
        common, alone = model_error(healthy.error, kind, time)
        numbers = np.array(shown, np.int64) - len(LEVELS)
        return cls(
            first,
            np.concatenate([place, numbers]),
            np.concatenate([kind, numbers]),
            np.concatenate([time, np.zeros(len(shown))]),
            np.concatenate([common, sigmas]),
            lasting(bins, first, alone),
        )


def _beside(covariance: Floats, variances: Floats) -> Floats:
    """The covariance together with what varies by itself."""
    count = len(covariance)
    whole = np.zeros((count + len(variances), count + len(variances)))
    whole[:count, :count] = covariance
    np.fill_diagonal(whole[count:, count:], variances)
    return whole
