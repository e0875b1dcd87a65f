"""How far healthy cycles are off, as a calibration learns it."""

import numpy as np
import pytest

from twin.diagnosis.healthy import usual_leftover
from twin.monitor.scatter_covariance import as_left


def test_what_healthy_cycles_have_left_is_their_mean() -> None:
    left = np.array([0.4, 0.5, 0.6, 0.7, 0.8])
    assert usual_leftover(left) == pytest.approx(np.sqrt(0.6))


def test_one_odd_cycle_does_not_make_all_as_odd() -> None:
    left = np.array([0.56, 0.55, 1.22, 0.63, 37.95, 0.24, 0.11, 0.09, 0.13, 0.12, 0.18])
    assert usual_leftover(left) < 0.7
    assert usual_leftover(np.delete(left, 4)) < usual_leftover(left)


def test_what_is_left_shrinks_by_what_healthy_cycles_show_but_noise_does_not() -> None:
    noise = np.array([0.04, 0.01])
    scatter = np.array([[0.9, 0.3], [0.3, 0.5]])
    shrunk = as_left(scatter + np.diag(noise), 0.5, noise)
    assert shrunk == pytest.approx(0.25 * scatter + np.diag(noise))
    widened = as_left(scatter + np.diag(noise), 2.0, noise)
    assert widened == pytest.approx(4.0 * (scatter + np.diag(noise)))
