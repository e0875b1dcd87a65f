"""Widths of a calibration: what counts as the model's error, and what as scatter of cycles."""

from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from tests.calibrations import log_of, typed
from twin.calibration.cycles import Cycles
from twin.calibration.residual_covariance import weighted
from twin.inference.sensitivities import coefficients_at, sensitivities
from twin.model.dataset import coefficients
from twin.signals import MBAR, Phase

NOISE = 0.4 * MBAR
THETA = coefficients(typed("test_rig").data)
Floats = npt.NDArray[np.float64]


@cache
def cycles(every: int = 1) -> Cycles:
    """Cycles with one row of so many (ms)."""
    return Cycles.found(log_of("test_rig")[::every].copy(), typed("test_rig").data)


def with_residual(residual: Floats, every: int = 1) -> Cycles:
    """The cycles as if the model were off by ``residual`` (Pa) in each bin, and by noise."""
    known = cycles(every)
    expected = known.measured - known.residuals(THETA[:, None])[:, 0]
    noise = np.random.default_rng(5).normal(0.0, NOISE / np.sqrt(known.bins.count))
    return replace(known, measured=expected + residual + noise)


def in_suction(of_cycle: Floats) -> Floats:
    """The same in all bins of a cycle's suction: ``of_cycle`` for each cycle, from the first on."""
    bins = cycles().bins
    in_it = (bins.cycle >= 0) & (bins.kind == Phase.SUCTION)
    residual: Floats = of_cycle[np.maximum(bins.cycle, 0)] * in_it
    return residual


def sigma_in_suction(fitted: Cycles) -> float:
    """Sigma (Pa) of the mean over the cycles in a bin in the midst of suction."""
    bins = fitted.bins
    places = bins.place[(bins.cycle == 1) & (bins.kind == Phase.SUCTION)]
    variances = [
        float(np.sum(covariance.factor[bins.place[rows] == places[len(places) // 2]] ** 2))
        for rows, covariance in weighted(fitted, THETA, NOISE, fitted=True).parts
    ]
    return float(np.sqrt(np.sum(variances)) / (count() - 1))


def sigma_of(direction: Floats, fitted: Cycles) -> float:
    """Sigma of the size of a ``direction`` (Pa in each bin) that all cycles have."""
    white = weighted(fitted, THETA, NOISE, fitted=True).white(direction[:, None])
    return float(np.sum(np.concatenate(white) ** 2) ** -0.5)


def effect(name: str, parameter: str, size: float, every: int = 1) -> Floats:
    """Change of the residuals (Pa) by an effect."""
    _, changes = sensitivities(
        lambda at: cycles(every).residuals(coefficients_at(THETA, [(name, {parameter: size})], at)),
        np.zeros(1),
        np.ones(1),
    )
    return changes[:, 0]


def count() -> int:
    return int(cycles().bins.cycle.max()) + 1


def test_a_mean_by_chance_is_no_error_of_the_model() -> None:
    """Cycles that differ have a mean of their own: it is in the width once, as scatter."""
    draw, scatter = np.random.default_rng(1), 8.0 * MBAR
    of_mean = scatter / np.sqrt(count() - 1)
    sigmas, means = [], []
    for _ in range(12):
        levels = draw.normal(0.0, scatter, count())
        sigmas.append(sigma_in_suction(with_residual(in_suction(levels))))
        means.append(levels[1:].mean())
    assert 0.9 * of_mean < np.mean(sigmas) < 1.35 * of_mean
    assert np.mean(np.abs(means) < 1.96 * np.array(sigmas)) > 0.8


@pytest.mark.parametrize("scatter", [0.0, 8.0 * MBAR])
def test_an_error_that_all_cycles_share_is_in_the_width(scatter: float) -> None:
    levels = np.resize([scatter, -scatter], count())
    levels -= levels[1:].mean()
    sigma = sigma_in_suction(with_residual(in_suction(6.0 * MBAR + levels)))
    assert sigma > 6.0 * MBAR


@pytest.mark.parametrize(
    ("name", "parameter", "scatter"),
    [("supply_pressure_drop", "drop", 0.02), ("response_delay", "delay", 0.5)],
)
def test_so_is_one_that_looks_like_scatter(name: str, parameter: str, scatter: float) -> None:
    """No supply and no valve is off by ten sigmas in all cycles alike: the model is."""
    change = effect(name, parameter, scatter)
    usual = sigma_of(change, with_residual(0.0 * change))
    assert usual < 1.0
    assert sigma_of(change, with_residual(10.0 * change)) > 3.0


def test_the_first_cycle_does_not_count() -> None:
    """The model settles in it: as a share of the mean it would pass for an error of the model."""
    levels = np.zeros(count())
    usual = sigma_in_suction(with_residual(in_suction(levels)))
    levels[0] = 50.0 * MBAR
    assert sigma_in_suction(with_residual(in_suction(levels))) == pytest.approx(usual)


@pytest.mark.parametrize(("every", "most"), [(1, 0.6), (10, 1.5)])
def test_a_time_is_known_to_a_row_in_each_cycle(every: int, most: float) -> None:
    late = effect("response_delay", "delay", 1.0, every)
    least = every / np.sqrt(12.0 * (count() - 1))  # ms, of a mean
    assert least < sigma_of(late, with_residual(0.0 * late, every)) < most
