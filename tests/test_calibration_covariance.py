"""How far a calibration's uncertainty goes where the model bends."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest
from calibrations import typed

from twin.calibration.fit import BETTER, MOST_RISE, Problem, allowed, with_more_leak
from twin.inference.sensitivities import sensitivities
from twin.model import theta as c
from twin.model.air import orifice
from twin.model.dataset import DataSet, coefficients
from twin.monitor.healthy import Healthy
from twin.monitor.uncertain_data import both_sides, shifted
from twin.signals import MBAR, SL_MIN

Floats = npt.NDArray[np.float64]
DATA = typed("test_rig").data
LAG = float(coefficients(DATA)[c.SENSOR_LAG])
SIGMA_MS = 1.0


class Kinked(Problem):
    """Residuals that turn at 0: a part that reaches its stop there."""

    def _predict(self, points: Floats) -> Floats:
        return np.stack([3.0 * np.minimum(points[0], 0.0), points[1]])


def problem(kind: type[Problem], **parts: Any) -> Problem:
    low, high = np.full(2, -4.0), np.full(2, 4.0)
    space = SimpleNamespace(free=parts.pop("free", (0, 1)), low=low, high=high, step=0.05)
    return kind(cast(Any, space), cast(Any, parts.get("cycles")), cast(Any, parts.get("weights")))


def test_a_derivative_at_a_kink_is_that_of_both_sides() -> None:
    kinked = problem(Kinked)
    at_the_kink = kinked.jacobian_both_ways(np.zeros(2))
    assert at_the_kink == pytest.approx(np.diag([1.5, 1.0]))
    _, forwards = sensitivities(kinked._predict, np.zeros(2), np.full(2, kinked.space.step))
    assert forwards[0, 0] == 0.0  # to one side alone, the record says nothing


def test_next_to_a_bound_a_derivative_has_one_side() -> None:
    kinked = problem(Kinked)
    assert kinked.jacobian_both_ways(np.array([-4.0, 4.0])) == pytest.approx(np.diag([3.0, 1.0]))


@pytest.mark.parametrize(
    ("steepness", "share"),
    [(1.0, 1.0), (0.5, 1.0), (3.0, 0.5), (30.0, 1.0 / 16.0)],
)
def test_one_sigma_goes_no_further_than_the_record_allows(steepness: float, share: float) -> None:
    """A slower sensor changes nothing here; one faster by a sigma, by so many sigmas."""
    _, faster_data = both_sides(DATA, {"sensor.lag_ms": SIGMA_MS})
    sigma = LAG - coefficients(faster_data)[c.SENSOR_LAG]

    def residuals(thetas: Floats) -> Floats:
        faster: Floats = (LAG - thetas[c.SENSOR_LAG]) / sigma
        return steepness * np.maximum(faster, 0.0)[None, :]

    stub = problem(
        Problem,
        free=(SimpleNamespace(name="sensor.lag_ms"),),
        cycles=SimpleNamespace(residuals=residuals),
        weights=SimpleNamespace(parts=[(np.zeros(1), None)], white=lambda values: [values]),
    )
    (kept,) = allowed(stub, DATA, np.full((1, 1), SIGMA_MS)).ravel()
    assert kept == share * SIGMA_MS
    assert (steepness * kept) ** 2 <= MOST_RISE


LEAKING = 6.0  # sl/min


def with_leak(data: DataSet, leak: float, end: float) -> DataSet:
    """``data`` with another leak and end pressure."""
    ejector = data.ejector.model_copy(update={"end_pressure_mbar": end})
    system = data.system.model_copy(update={"leak_sl_min": leak})
    return data.model_copy(update={"ejector": ejector, "system": system})


def net_flow(data: DataSet, pressure: Floats) -> Floats:
    """Suction less leak (sl/min) at absolute pressures (mbar)."""
    ejector, ambient = data.ejector, data.ambient.pressure_mbar
    end = ejector.end_pressure_mbar
    critical = data.system.leak_critical_ratio
    leaks = np.array([orifice(ratio, critical)[0] for ratio in (pressure / ambient).tolist()])
    share = ejector.share((pressure - end) / (ambient - end))
    flow: Floats = ejector.suction_capacity_sl_min * share - data.system.leak_sl_min * leaks
    return flow


@pytest.mark.parametrize("end", [200.0, 300.0, 400.0])
def test_more_leak_with_more_suction_leaves_nearly_the_same_flow(end: float) -> None:
    """The fit goes on from there; the rest is for it."""
    data = with_leak(DATA, 0.3, end)
    guess = with_more_leak(data, end * MBAR)
    assert guess is not None
    assert guess.ejector.end_pressure_mbar == pytest.approx(BETTER * end)
    assert guess.system.leak_sl_min > 2.0
    pressure = np.linspace(end, data.ambient.pressure_mbar, 50)
    apart = net_flow(guess, pressure) - net_flow(data, pressure)
    assert np.abs(apart).max() < 0.03 * data.ejector.suction_capacity_sl_min


def test_a_good_end_pressure_leaves_no_room_for_a_leak() -> None:
    assert with_more_leak(with_leak(DATA, 0.3, 90.0), 90.0 * MBAR) is None


def test_another_explanation_widens_a_diagnosis_and_not_what_is_healthy() -> None:
    """It is far: the twin varies by nothing on the way there."""
    healthy = Healthy(leaky={"system.leak_sl_min": LEAKING, "ejector.end_pressure_mbar": -60.0})
    *_, shift = shifted(DATA, healthy)
    assert len(list(shifted(DATA, Healthy()))) == len(list(shifted(DATA, healthy))) - 1
    theta = coefficients(DATA)
    np.testing.assert_array_equal(shift.near(theta, 0.1), theta)
    np.testing.assert_array_equal(shift.down, theta)
    assert shift.up[c.LEAK] - theta[c.LEAK] == pytest.approx(LEAKING * SL_MIN)
    assert shift.tied
