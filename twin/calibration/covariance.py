"""What a residual weighs: the covariance of noise, cycle-to-cycle scatter and the model's error.

Scatter differs from cycle to cycle and averages out. The model's own error is the same in all of
them and does not: the fit may not believe in more than it would from the mean cycle. So the error
counts in each of n cycles with n times its variance, which is the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin.calibration.cycles import Cycles
from twin.inference.covariance import Covariance, add_independent, fading, low_rank
from twin.inference.sensitivities import coefficients_at, sensitivities
from twin.model import theta as c
from twin.model.theta import Theta
from twin.monitor.bins import Bins, Floats, Ints
from twin.monitor.scatter_covariance import SCATTER
from twin.signals import MBAR, ML, MS

FIRST_ERROR = 3.0 * MBAR  # Pa, of a model that has not been fitted
LEAST_ERROR = 0.15 * MBAR  # Pa
VOLUME = 0.01  # of what is evacuated, to which its parts are known
LATE = 0.5 * MS  # s, by which what the model has at an edge may be early or late
HIDDEN = 1.5  # the error over what is left of it once a fit has done its best
NEAR = 4  # places before and behind, over which the error's size is taken


@dataclass(frozen=True)
class Weights:
    """Whitens residuals cycle by cycle."""

    parts: Sequence[tuple[Ints, Covariance]]  # bins of a cycle, and what they have in common

    def white(self, off: Floats) -> list[Floats]:
        """Residuals (bins, n) in sigmas for each cycle; what belongs to none is left out."""
        return [covariance.white(off[here]) for here, covariance in self.parts]

    def followed_by(self, other: "Weights", bins: int) -> "Weights":
        """Those of one pressure with ``bins``, then those of another."""
        return Weights([*self.parts, *((here + bins, one) for here, one in other.parts)])


def plain(cycles: Cycles, noise: float, error: float, late: float) -> Weights:
    """Weights where nobody knows yet what scatters: each bin by noise and the model's own error.

    That is ``error`` (Pa), and what the pressure moves by in ``late`` (s).
    """
    bins = cycles.bins
    errors = np.hypot(error, late * _slope(cycles))
    parts = []
    numbers = np.unique(bins.cycle[bins.cycle >= 1])  # the model swings in in the first
    for one in numbers:
        here = np.flatnonzero(bins.cycle == one)
        covariance = low_rank(cycles.unsure[here]) * len(numbers)
        add_independent(covariance, errors[here] ** 2 + noise**2 / bins.count[here])
        parts.append((here, Covariance.of(covariance)))
    return Weights(parts)


def weighted(cycles: Cycles, theta: Theta, noise: float, *, fitted: bool) -> Weights:
    """Weights for residuals about ``theta``, by what it leaves if it is ``fitted``.

    ``noise`` (Pa) is the sensor's.
    """
    bins = cycles.bins
    bigger = ("added_volume", {"volume": VOLUME * theta[c.VOLUME] / ML})
    scattering = [(name, {key: size}) for name, (key, size) in SCATTER.items()]
    sigmas = [bigger, *scattering]
    off, moves = sensitivities(
        lambda at: cycles.off(coefficients_at(theta, sigmas, at)),
        np.zeros(len(sigmas)),
        np.ones(len(sigmas)),
    )
    errors, cycle_error = np.full(len(off), FIRST_ERROR), np.zeros(len(off))
    if fitted:
        errors, cycle_error = _errors(_beside(off, cycles.unsure), bins, noise)
    errors = np.hypot(errors, LATE * _slope(cycles))
    numbers = np.unique(bins.cycle[bins.cycle >= 0])
    always, scatter = np.column_stack([moves[:, :1], cycles.unsure]), moves[:, 1:]
    parts = []
    for one in numbers:
        here = np.flatnonzero(bins.cycle == one)
        time = bins.time[here]
        covariance = fading(errors[here], time, bins.kind[here]) + low_rank(always[here])
        covariance *= len(numbers)
        covariance += fading(cycle_error[here], time, bins.stretch[here]) + low_rank(scatter[here])
        add_independent(covariance, noise**2 / bins.count[here])
        parts.append((here, Covariance.of(covariance)))
    return Weights(parts)


def _beside(off: Floats, unsure: Floats) -> Floats:
    """What is left (Pa) once the ways that a sensor may be off in are taken from it."""
    taken: Floats = off - unsure @ np.linalg.lstsq(unsure, off)[0]
    return taken


def _slope(cycles: Cycles) -> Floats:
    """Slope of the measured pressure in each bin (Pa/s)."""
    pressure = np.nan_to_num(cycles.samples["pressure"].astype(np.float64))
    return cycles.bins.mean(np.gradient(pressure) / float(np.median(cycles.dt)))


def _errors(off: Floats, bins: Bins, noise: float) -> tuple[Floats, Floats]:
    """How far the model is off in each bin (Pa): in all cycles alike, and in each differently."""
    places, place, many = np.unique(bins.place, return_inverse=True, return_counts=True)
    mean = np.bincount(place, off) / many
    noisy = np.bincount(place, noise**2 / bins.count) / many
    within = np.bincount(place, (off - mean[place]) ** 2) / np.maximum(many - 1, 1) - noisy
    kind = places >> 16
    common = np.maximum(_near(mean**2 - noisy / many, kind), LEAST_ERROR**2)
    alone = np.maximum(_near(within, kind), 0.0)
    return HIDDEN * np.sqrt(common)[place], np.sqrt(alone)[place]


def _near(values: Floats, kind: Ints) -> Floats:
    """Mean over NEAR places of the same kind on either side."""
    smooth = np.empty_like(values)
    for one in np.unique(kind):
        here = np.flatnonzero(kind == one)
        window = np.ones(2 * NEAR + 1)
        sums = np.convolve(values[here], window)[NEAR:-NEAR]
        smooth[here] = sums / np.convolve(np.ones(len(here)), window)[NEAR:-NEAR]
    return smooth
