"""Covariance of residuals: noise, cycle-to-cycle scatter and the model's own error.

Scatter differs from cycle to cycle and averages out. The model's error is the same in all cycles
and does not: the fit must be no surer than with the mean cycle alone. So each of n cycles counts
the error with n times its variance, which is equivalent.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin.calibration.cycles import Cycles
from twin.inference.sensitivities import coefficients_at, sensitivities
from twin.inference.whitening import Covariance, add_independent, fading, low_rank
from twin.model import theta as c
from twin.model.effects import standing_for
from twin.model.theta import Theta
from twin.monitor.bins import Bins, Floats, Ints
from twin.monitor.scatter_covariance import SCATTER
from twin.signals import MBAR, ML, MS

FIRST_ERROR = 3.0 * MBAR  # Pa, of a model that has not been fitted
LEAST_ERROR = 0.15 * MBAR  # Pa
VOLUME = 0.01  # relative sigma of the evacuated volume
LATE = 0.5 * MS  # s, sigma of the time of an edge in the model
HIDDEN = 1.5  # model error before a fit, over the residual that the fit leaves of it
NEAR = 4  # neighbouring bins on either side over which the error's variance is averaged


@dataclass(frozen=True)
class Weights:
    """Whitens residuals cycle by cycle."""

    parts: Sequence[tuple[Ints, Covariance]]  # bins of a cycle, and their covariance

    def white(self, off: Floats) -> list[Floats]:
        """Whitened residuals (bins, n) of each cycle; bins without a cycle are left out."""
        return [covariance.white(off[rows]) for rows, covariance in self.parts]

    def followed_by(self, other: "Weights", bins: int) -> "Weights":
        """These weights, for a pressure with ``bins``, then those of a second pressure."""
        return Weights(
            [*self.parts, *((rows + bins, covariance) for rows, covariance in other.parts)]
        )


def plain(cycles: Cycles, noise: float, error: float, late: float) -> Weights:
    """Weights before the scatter is known: each bin by noise and the model's own error.

    That is ``error`` (Pa), and the change of pressure within ``late`` (s).
    """
    bins = cycles.bins
    errors = np.hypot(error, late * _slope(cycles))
    parts = []
    numbers = np.unique(bins.cycle[bins.cycle >= 1])  # the model settles in the first
    for number in numbers:
        rows = np.flatnonzero(bins.cycle == number)
        covariance = low_rank(cycles.unsure[rows]) * len(numbers)
        add_independent(covariance, errors[rows] ** 2 + noise**2 / bins.count[rows])
        parts.append((rows, Covariance.of(covariance)))
    return Weights(parts)


def weighted(cycles: Cycles, theta: Theta, noise: float, *, fitted: bool) -> Weights:
    """Weights for residuals about ``theta``; their errors come from its residuals if ``fitted``.

    ``noise`` (Pa) is the sensor's.
    """
    bins = cycles.bins
    more_volume, parameter = standing_for(c.VOLUME)
    volume_change = (more_volume.name, {parameter.name: VOLUME * theta[c.VOLUME] / ML})
    scatter_changes = [(name, {key: size}) for name, (key, size) in SCATTER.items()]
    sigmas = [volume_change, *scatter_changes]
    off, moves = sensitivities(
        lambda at: cycles.off(coefficients_at(theta, sigmas, at)),
        np.zeros(len(sigmas)),
        np.ones(len(sigmas)),
    )
    errors, cycle_error = np.full(len(off), FIRST_ERROR), np.zeros(len(off))
    if fitted:
        errors, cycle_error = _errors(_without_sensor_error(off, cycles.unsure), bins, noise)
    errors = np.hypot(errors, LATE * _slope(cycles))
    numbers = np.unique(bins.cycle[bins.cycle >= 0])
    always, scatter = np.column_stack([moves[:, :1], cycles.unsure]), moves[:, 1:]
    parts = []
    for number in numbers:
        rows = np.flatnonzero(bins.cycle == number)
        time = bins.time[rows]
        covariance = fading(errors[rows], time, bins.kind[rows]) + low_rank(always[rows])
        covariance *= len(numbers)
        covariance += fading(cycle_error[rows], time, bins.stretch[rows]) + low_rank(scatter[rows])
        add_independent(covariance, noise**2 / bins.count[rows])
        parts.append((rows, Covariance.of(covariance)))
    return Weights(parts)


def _without_sensor_error(off: Floats, unsure: Floats) -> Floats:
    """Residuals (Pa) without the part that errors of the sensor explain."""
    remainder: Floats = off - unsure @ np.linalg.lstsq(unsure, off)[0]
    return remainder


def _slope(cycles: Cycles) -> Floats:
    """Slope of the measured pressure in each bin (Pa/s)."""
    pressure = np.nan_to_num(cycles.samples["pressure"].astype(np.float64))
    return cycles.bins.mean(np.gradient(pressure) / float(np.median(cycles.dt)))


def _errors(off: Floats, bins: Bins, noise: float) -> tuple[Floats, Floats]:
    """The model's error in each bin (Pa): common to all cycles, and differing between them."""
    bin_places, place_number, counts = np.unique(
        bins.place, return_inverse=True, return_counts=True
    )
    mean = np.bincount(place_number, off) / counts
    noise_variance = np.bincount(place_number, noise**2 / bins.count) / counts
    scatter_variance = (
        np.bincount(place_number, (off - mean[place_number]) ** 2) / np.maximum(counts - 1, 1)
        - noise_variance
    )
    kinds = bin_places >> 16
    common = np.maximum(_neighbour_mean(mean**2 - noise_variance / counts, kinds), LEAST_ERROR**2)
    per_cycle = np.maximum(_neighbour_mean(scatter_variance, kinds), 0.0)
    return HIDDEN * np.sqrt(common)[place_number], np.sqrt(per_cycle)[place_number]


def _neighbour_mean(values: Floats, kind: Ints) -> Floats:
    """Mean over NEAR bins of the same kind on either side."""
    smooth = np.empty_like(values)
    for stretch_kind in np.unique(kind):
        rows = np.flatnonzero(kind == stretch_kind)
        window = np.ones(2 * NEAR + 1)
        sums = np.convolve(values[rows], window)[NEAR:-NEAR]
        smooth[rows] = sums / np.convolve(np.ones(len(rows)), window)[NEAR:-NEAR]
    return smooth
