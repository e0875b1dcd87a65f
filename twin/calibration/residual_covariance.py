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
from twin.monitor.scatter_covariance import SCATTERING, least_time_ms
from twin.signals import MBAR, ML, MS

FIRST_ERROR = 3.0 * MBAR  # Pa, of a model that has not been fitted
LEAST_ERROR = 0.15 * MBAR  # Pa
VOLUME = 0.01  # relative sigma of the evacuated volume
LATE = 0.5 * MS  # s, sigma of the time of an edge in the model
HIDDEN = 1.5  # model error before a fit, over the residual that the fit leaves of it
NEAR = 4  # neighbouring bins on either side over which the error's variance is averaged
TIMES = np.array([parameter.is_time for parameter in SCATTERING.values()])  # among scatter
LEAST_MORE = 0.1  # cycles beyond one: less than any mean over neighbours that is not zero


@dataclass(frozen=True)
class CycleWhitener:
    """Whitens residuals cycle by cycle."""

    parts: Sequence[tuple[Ints, Covariance]]  # bins of a cycle, and their covariance

    def white(self, residuals: Floats) -> list[Floats]:
        """Whitened residuals (bins, n) of each cycle; bins without a cycle are left out."""
        return [covariance.white(residuals[rows]) for rows, covariance in self.parts]

    def followed_by(self, other: "CycleWhitener", bins: int) -> "CycleWhitener":
        """These weights, for a pressure with ``bins``, then those of a second pressure."""
        return CycleWhitener(
            [*self.parts, *((rows + bins, covariance) for rows, covariance in other.parts)]
        )


def plain(cycles: Cycles, noise: float, error: float, late: float) -> CycleWhitener:
    """Weights before the scatter is known: each bin by noise and the model's own error.

    That is ``error`` (Pa), and the change of pressure within ``late`` (s).
    """
    bins = cycles.bins
    errors = np.hypot(error, late * _slope(cycles))
    parts, rows_by_cycle = [], _settled(bins)
    for rows in rows_by_cycle:
        covariance = low_rank(cycles.unsure[rows]) * len(rows_by_cycle)
        add_independent(covariance, errors[rows] ** 2 + noise**2 / bins.count[rows])
        parts.append((rows, Covariance.of(covariance)))
    return CycleWhitener(parts)


def weighted(cycles: Cycles, theta: Theta, noise: float, *, fitted: bool) -> CycleWhitener:
    """Weights for residuals about ``theta``; their errors come from its residuals if ``fitted``.

    ``noise`` (Pa) is the sensor's.
    """
    bins = cycles.bins
    more_volume, parameter = standing_for(c.VOLUME)
    volume_change = (more_volume.name, {parameter.name: VOLUME * theta[c.VOLUME] / ML})
    sigmas = [volume_change, *_scatter_changes(float(np.median(cycles.dt)))]
    residuals, moves = sensitivities(
        lambda at: cycles.residuals(coefficients_at(theta, sigmas, at)),
        np.zeros(len(sigmas)),
        np.ones(len(sigmas)),
    )
    always, scatter = np.column_stack([moves[:, :1], cycles.unsure]), moves[:, 1:]
    errors, cycle_error = np.full(len(residuals), FIRST_ERROR), np.zeros(len(residuals))
    if fitted:
        residuals = _without_sensor_error(residuals, cycles.unsure)
        sizes, timely = _without_times(residuals, scatter[:, TIMES], bins, noise)
        scatter[:, TIMES] *= np.maximum(sizes, 1.0)
        errors, cycle_error = _errors(residuals, timely, bins, noise)
    errors = np.hypot(errors, LATE * _slope(cycles))
    parts, rows_by_cycle = [], _settled(bins)
    for rows in rows_by_cycle:
        time = bins.time[rows]
        covariance = fading(errors[rows], time, bins.kind[rows]) + low_rank(always[rows])
        covariance *= len(rows_by_cycle)
        covariance += fading(cycle_error[rows], time, bins.stretch[rows]) + low_rank(scatter[rows])
        add_independent(covariance, noise**2 / bins.count[rows])
        parts.append((rows, Covariance.of(covariance)))
    return CycleWhitener(parts)


def _settled(bins: Bins) -> list[Ints]:
    """Bins of each cycle but the first, in which the model settles."""
    numbers = np.unique(bins.cycle[bins.cycle >= 1])
    return [np.flatnonzero(bins.cycle == number) for number in numbers]


def _scatter_changes(period: float) -> list[tuple[str, dict[str, float]]]:
    """Each scattering effect with one sigma of its size; rows are ``period`` (s) apart."""
    least = least_time_ms(period / MS)
    return [
        (name, {p.name: max(p.healthy_sigma, least) if p.is_time else p.healthy_sigma})
        for name, p in SCATTERING.items()
    ]


def _without_times(
    residuals: Floats, late: Floats, bins: Bins, noise: float
) -> tuple[Floats, Floats]:
    """How much times scatter (rms over cycles, in sigmas), and the residuals (Pa) without that.

    ``late`` are changes (Pa) by one sigma of each time, (bins, times): this is its prior.
    """
    sizes, timely = [], residuals.copy()
    for rows in _settled(bins):
        covariance = fading(np.full(len(rows), FIRST_ERROR), bins.time[rows], bins.stretch[rows])
        add_independent(covariance, noise**2 / bins.count[rows])
        white = Covariance.of(covariance).white(np.column_stack([residuals[rows], late[rows]]))
        information = white[:, 1:].T @ white[:, 1:] + np.eye(late.shape[1])
        sizes.append(np.linalg.solve(information, white[:, 1:].T @ white[:, 0]))
        timely[rows] -= late[rows] @ sizes[-1]
    return np.sqrt(np.mean(np.square(sizes), axis=0)), timely


def _without_sensor_error(residuals: Floats, unsure: Floats) -> Floats:
    """Residuals (Pa) without the part that errors of the sensor explain."""
    remainder: Floats = residuals - unsure @ np.linalg.lstsq(unsure, residuals)[0]
    return remainder


def _slope(cycles: Cycles) -> Floats:
    """Slope of the measured pressure in each bin (Pa/s)."""
    pressure = np.nan_to_num(cycles.samples["pressure"].astype(np.float64))
    return cycles.bins.mean(np.gradient(pressure) / float(np.median(cycles.dt)))


def _errors(residuals: Floats, timely: Floats, bins: Bins, noise: float) -> tuple[Floats, Floats]:
    """The model's error in each bin (Pa): common to all cycles, and differing between them.

    Cycles that differ have a mean by chance: this is no common error. ``timely`` are the residuals
    without what the scatter of times explains. It can be far larger than all other differences.
    """
    settled = np.concatenate(_settled(bins))
    places, number, cycles = np.unique(bins.place[settled], return_inverse=True, return_counts=True)
    kinds, counts = places >> 16, cycles.astype(np.float64)
    more = np.maximum(_neighbour_mean(counts - 1.0, kinds), LEAST_MORE)

    def sums(values: Floats) -> Floats:
        return np.bincount(number, values).astype(np.float64)

    def mean_and_variance(residual: Floats) -> tuple[Floats, Floats]:
        mean = sums(residual) / counts
        return mean, _neighbour_mean(sums((residual - mean[number]) ** 2), kinds) / more

    mean, variance = mean_and_variance(residuals[settled])
    _, timely_variance = mean_and_variance(timely[settled])
    noise_variance = _neighbour_mean(sums(noise**2 / bins.count[settled]) / counts, kinds)
    common = np.maximum(_neighbour_mean(mean**2 - variance / counts, kinds), LEAST_ERROR**2)
    alone = np.maximum(timely_variance - noise_variance, 0.0)
    errors = np.zeros((2, len(residuals)))
    errors[:, settled] = HIDDEN * np.sqrt(common)[number], np.sqrt(alone)[number]
    return errors[0], errors[1]


def _neighbour_mean(values: Floats, kind: Ints) -> Floats:
    """Mean over NEAR bins of the same kind on either side."""
    smooth = np.empty_like(values)
    for stretch_kind in np.unique(kind):
        rows = np.flatnonzero(kind == stretch_kind)
        window = np.ones(2 * NEAR + 1)
        sums = np.convolve(values[rows], window)[NEAR:-NEAR]
        smooth[rows] = sums / np.convolve(np.ones(len(rows)), window)[NEAR:-NEAR]
    return smooth
