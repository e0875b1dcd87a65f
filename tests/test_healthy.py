"""How far healthy cycles are off, as a calibration learns it."""

import numpy as np
import pytest

from twin.diagnosis.healthy import usual_leftover


def test_what_healthy_cycles_have_left_is_their_mean() -> None:
    left = np.array([0.4, 0.5, 0.6, 0.7, 0.8])
    assert usual_leftover(left) == pytest.approx(np.sqrt(0.6))


def test_one_odd_cycle_does_not_make_all_as_odd() -> None:
    left = np.array([0.56, 0.55, 1.22, 0.63, 37.95, 0.24, 0.11, 0.09, 0.13, 0.12, 0.18])
    assert usual_leftover(left) < 0.7
    assert usual_leftover(np.delete(left, 4)) < usual_leftover(left)
