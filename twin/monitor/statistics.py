"""Scores of one cycle: one whitened number for each suspect, of sigma 1 in healthy cycles.

The deviation is averaged into bins, and the switching levels of the air saving are appended. Both
are projected on each suspect's signature, whitened by the scatter of healthy cycles.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
import numpy.typing as npt

from twin.inference.sensitivities import derivatives
from twin.inference.whitening import Covariance
from twin.model.dataset import DataSet, coefficients
from twin.model.theta import Theta
from twin.monitor.bins import Bins, Floats, Ints, averaged
from twin.monitor.cycles import Cycle
from twin.monitor.detector_window import detector_of
from twin.monitor.healthy import Healthy
from twin.monitor.model_bank import (
    DELAYS,
    LARGER,
    SUSPECTS,
    Suspect,
    hypotheses,
    suspects_of,
    variants,
)
from twin.monitor.scatter_covariance import (
    SCATTER,
    Reading,
    by_contact,
    from_cycle_to_cycle,
    lasting,
    model_error,
)
from twin.monitor.simulated_switching import detected_switching
from twin.monitor.switching_detector import DetectorSettings
from twin.signals import MBAR

PER_UNIT = 2  # bins in each unit of warped time
LEVELS = ("h1_level", "h1_low_level")
PLACES = 8  # cached layouts of bins: of a program or two, with their jitter
SUCTION = 4.0  # s, simulated to find the switching levels with each suspect
# Sigmas² of a step below which a cycle does not depend on it. Hypotheses that are stepped
# separately differ by a pascal, which is some 0.002; the weakest real dependence has 3.
WEAK = 0.01


@dataclass(frozen=True)
class CycleResidual:
    """Residuals of a cycle by place: a bin at the same time in every cycle, or a level."""

    place: Ints  # unique
    kind: Ints  # of stretch, of each place; below zero for a level
    time: Floats  # warped, since the stretch began
    off: Floats  # mbar, measured less expected
    signatures: Floats  # mbar, by each suspect's step, (places, suspects)
    larger: Floats  # mbar, by the larger sizes of delays, (places, DELAYS · LARGER)
    unsure: Floats  # mbar, one sigma of the signature of an uncertain law, (places, variants)
    alone: Floats  # mbar², covariance of differences between cycles
    common: Floats  # mbar, one sigma of the error common to all cycles

    def at(self, places: npt.NDArray[np.bool_]) -> "CycleResidual":
        """The residuals at some places."""
        columns = {
            attribute.name: getattr(self, attribute.name)[places]
            for attribute in fields(self)
            if attribute.name != "alone"
        }
        return CycleResidual(alone=self.alone[np.ix_(places, places)], **columns)

    def scores(self) -> Floats:
        """Significance (sigmas) of each signature; NaN if this cycle does not show it."""
        off, signatures, power = self._whitened()
        scores: Floats = off @ signatures / np.sqrt(np.where(power > 0.0, power, np.nan))
        return scores

    def moved_by(self, changes: Floats) -> Floats:
        """One sigma of each score by changes (mbar) of one sigma each, (places, n)."""
        white = Covariance.of(self.alone).white(np.column_stack([self.signatures, changes]))
        signatures, moves = np.split(white, [self.signatures.shape[1]], axis=1)
        length = np.sqrt(np.maximum(np.einsum("ij,ij->j", signatures, signatures), WEAK))
        sigmas: Floats = np.sqrt(np.sum((signatures.T @ moves) ** 2, axis=1)) / length
        return sigmas

    def sigmas(self) -> Floats:
        """Score (sigmas) of one step of each suspect; 0 if this cycle does not show it."""
        sigmas: Floats = np.sqrt(self._whitened()[2])
        return sigmas

    def sizes(self) -> Floats:
        """Best size (steps) of each suspect by itself; NaN as in ``scores``."""
        off, signatures, power = self._whitened()
        sizes: Floats = off @ signatures / np.where(power > 0.0, power, np.nan)
        return sizes

    def alike(self) -> Floats:
        """Cosines between the whitened signatures; 0 if this cycle does not show one."""
        _, signatures, power = self._whitened()
        unit = 1.0 / np.sqrt(np.where(power > 0.0, power, np.inf))
        cosines: Floats = signatures.T @ signatures * np.outer(unit, unit)
        return cosines

    def _whitened(self) -> tuple[Floats, Floats, Floats]:
        """Whitened residuals and signatures, and the sigmas² of each signature; 0 if weak."""
        white = Covariance.of(self.alone).white(np.column_stack([self.off, self.signatures]))
        off, signatures = white[:, 0], white[:, 1:]
        power = np.einsum("ij,ij->j", signatures, signatures)
        power[power < WEAK] = 0.0
        return off, signatures, power


@dataclass
class ScoreExtractor:
    """Computes the residuals of cycles."""

    theta: Theta
    healthy: Healthy
    noise: float  # mbar, of a row
    detector: DetectorSettings
    suspects: Sequence[Suspect] = SUSPECTS
    _levels: Floats = field(init=False)  # mbar, change of each level, (levels, hypotheses)
    _means: Floats = field(init=False)  # mbar, of each level in healthy cycles
    _sigmas: Floats = field(init=False)
    _seen: dict[bytes, "_Places"] = field(default_factory=dict)  # by layout of the bins

    @classmethod
    def of(cls, data: DataSet, healthy: Healthy) -> "ScoreExtractor":
        """The extractor for cycles with the twin of a data set."""
        theta, noise = coefficients(data), data.sensor.noise_in_means()
        return cls(theta, healthy, noise, detector_of(data), suspects_of(data, theta))

    def __post_init__(self) -> None:
        thetas = hypotheses(self.theta, self.suspects)
        runs = detected_switching(thetas, round(SUCTION / self.detector.period), self.detector)
        vacuum = np.array([scatter.levels for scatter in runs]).T
        self._levels = np.nan_to_num(derivatives(vacuum)[1])
        scatters = [self.healthy.figures.get(name) for name in LEVELS]
        means = [
            scatter.mean if scatter else expected_level
            for scatter, expected_level in zip(scatters, vacuum[:, 0], strict=True)
        ]
        self._means = np.nan_to_num(np.array(means))
        self._sigmas = np.array(
            [scatter.sigma if scatter else self.healthy.unseen_level_mbar for scatter in scatters]
        )

    def extract(
        self, cycle: Cycle, drawn: Ints, expected: Floats, figures: Mapping[str, float]
    ) -> CycleResidual | None:
        """Residuals of a whole cycle; None without bins.

        Rows ``drawn`` and ``expected`` (Pa) there are the bank's; ``figures`` are the monitor's.
        """
        bins, off, bin_means = averaged(cycle.ticks["phase"], cycle.off, drawn, expected, PER_UNIT)
        if not len(off):
            return None
        shown_levels = [number for number, name in enumerate(LEVELS) if name in figures]
        level = (
            np.array([figures[LEVELS[number]] for number in shown_levels])
            - self._means[shown_levels]
        )
        cells = self._places(bins, shown_levels)
        bin_means = bin_means[cells.first]
        changes = np.concatenate([derivatives(bin_means / MBAR)[1], self._levels[shown_levels]])
        count = len(self.suspects)
        suspects, larger, varied = np.split(changes, (count, count + len(DELAYS) * LARGER), axis=1)
        contact = by_contact(
            bins, cells.first, drawn, expected[:, 0] / MBAR, self.theta, self.detector.period
        )
        moves = np.hstack(
            [self._moves(suspects[: len(cells.first)]), contact * self.healthy.meets_ms]
        )
        covariance = from_cycle_to_cycle(
            bins,
            cells.first,
            cells.goes_on,
            moves,
            Reading(self.noise, self.healthy.rounding_mbar),
            self.healthy.leftover,
        )
        return CycleResidual(
            cells.place,
            cells.kind,
            cells.time,
            np.concatenate([off[cells.first], level]),
            suspects,
            larger,
            varied - suspects[:, self.variant_of],
            _block_diagonal(covariance, self._sigmas[shown_levels] ** 2),
            cells.common,
        )

    def _places(self, bins: Bins, shown: Sequence[int]) -> "_Places":
        """The places of a cycle, cached: most cycles have the same."""
        key = b"".join(
            column.tobytes() for column in (bins.stretch, bins.kind, bins.since)
        ) + bytes(shown)
        if key not in self._seen:
            if len(self._seen) == PLACES:
                self._seen.clear()
            self._seen[key] = _Places.of(bins, shown, self._sigmas[shown], self.healthy)
        return self._seen[key]

    def _moves(self, signatures: Floats) -> Floats:
        """Changes (mbar) of each bin by one sigma of each scattering suspect, (bins, scatters)."""
        numbers, sigmas = self._scatters
        moves: Floats = signatures[:, numbers] * sigmas
        return moves

    @cached_property
    def variant_of(self) -> Ints:
        """Numbers of the suspects of which the uncertain signatures are."""
        return np.array([number for number, _ in variants(self.theta)])

    @cached_property
    def _scatters(self) -> tuple[list[int], list[float]]:
        """Numbers of the suspects that scatter in healthy cycles, and their sigmas in steps."""
        numbers, sigmas = [], []
        for number, suspect in enumerate(self.suspects):
            parameter, default = SCATTER.get(suspect.effect, ("", 0.0))
            if parameter == suspect.parameter.name:
                numbers.append(number)
                sigmas.append(self.healthy.scatter.get(suspect.effect, default) / suspect.step)
        return numbers, sigmas


@dataclass(frozen=True)
class _Places:
    """Places of a cycle's bins and levels, and covariances that depend only on them."""

    first: Ints  # bins; a repeated place counts once
    place: Ints  # of these bins, then of the levels, as for kind, time and common
    kind: Ints
    time: Floats
    common: Floats  # mbar, sigma of the error common to all cycles
    goes_on: Floats  # mbar², covariance of bins by errors that persist, differing by cycle

    @classmethod
    def of(cls, bins: Bins, shown: Sequence[int], sigmas: Floats, healthy: Healthy) -> "_Places":
        """Places of bins and of the levels ``shown``, which have ``sigmas`` (mbar)."""
        place, first = np.unique(bins.place, return_index=True)
        kind, time = bins.kind[first], bins.time[first]
        common, alone = model_error(healthy.error, kind, time)
        numbers = np.array(shown, np.int64) - len(LEVELS)
        return cls(
            first,
            np.concatenate([place, numbers]),
            np.concatenate([kind, numbers]),
            np.concatenate([time, np.zeros(len(shown))]),
            np.concatenate([np.hypot(common, healthy.rounding_mbar), sigmas]),
            lasting(bins, first, alone),
        )


def _block_diagonal(covariance: Floats, variances: Floats) -> Floats:
    """The covariance, with independent variances appended on the diagonal."""
    count = len(covariance)
    joint = np.zeros((count + len(variances), count + len(variances)))
    joint[:count, :count] = covariance
    np.fill_diagonal(joint[count:, count:], variances)
    return joint
