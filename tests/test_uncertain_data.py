"""Data sets that a unit may have: drawn as calibration left them open, and as cycles scatter."""

import numpy as np
import pytest
import rigs

from twin.model import theta as c
from twin.model.dataset import coefficients
from twin.monitor.healthy import Healthy
from twin.monitor.uncertain_data import drawn, scattered, shifted

COUNT = 400


@pytest.mark.parametrize("name", rigs.NAMES)
def test_draws_are_as_wide_as_the_shifts_of_one_sigma(name: str) -> None:
    config = rigs.config(name)
    healthy = Healthy(uncertain=config.monitor.healthy.uncertain)
    rng = np.random.default_rng(1)
    draws = np.array([drawn(config.data, healthy, rng) for _ in range(COUNT)])
    shifts = shifted(config.data, healthy)
    sigma = np.linalg.norm([(shift.up - shift.down) / 2.0 for shift in shifts], axis=0)
    for coefficient in (c.SUCTION, c.END_RATIO, c.FILM, c.SENSOR_LAG):
        ratio = draws[:, coefficient].std() / sigma[coefficient]
        assert ratio == pytest.approx(1.0, abs=0.12), coefficient


def test_a_way_that_moves_other_values_by_much_ties_them() -> None:
    data = rigs.config("test_rig").data
    rows = {
        "ejector.suction_capacity_sl_min": (1.0,),
        "ejector.end_pressure_mbar": (0.9, 0.1),  # known only together with the suction
        "ejector.response_ms": (0.001, 0.002, 0.5),  # stands alone
    }
    shifts = list(shifted(data, Healthy(uncertain=rows)))
    assert [shift.tied for shift in shifts[-3:]] == [True, False, False]
    assert not any(shift.tied for shift in shifts[:-3])  # of the supply


def test_cycles_scatter_either_way_and_no_flow_gets_negative() -> None:
    theta = rigs.theta("gripper")
    healthy = Healthy(scatter={"leakage": 0.02, "supply_pressure_drop": 0.01})
    rng = np.random.default_rng(1)
    draws = np.array([scattered(theta, healthy, rng) for _ in range(COUNT)])
    supply = draws[:, c.SUPPLY] - theta[c.SUPPLY]
    assert supply.std() == pytest.approx(0.01e5, rel=0.12)
    assert abs(supply.mean()) < 0.2 * supply.std()
    wild = scattered(theta, Healthy(scatter={"leakage": 50.0}), np.random.default_rng(4))
    assert (draws[:, c.LEAK] >= 0.0).all()
    assert wild[c.LEAK] >= 0.0


def test_nothing_known_scatters_nothing() -> None:
    theta = coefficients(rigs.config("test_rig").data)
    same = scattered(theta, Healthy(), np.random.default_rng(1))
    assert np.array_equal(same, theta, equal_nan=True)
