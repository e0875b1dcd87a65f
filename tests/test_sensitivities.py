"""Derivatives by finite differences: exact where a model is linear, near where it is the plant."""

import numpy as np
import numpy.typing as npt
import pytest
import rigs
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.errors import ConfigError
from twin.inference.sensitivities import (
    STEP,
    central,
    coefficients_at,
    derivatives,
    inside,
    points,
    sensitivities,
)
from twin.model import kernel
from twin.model import theta as c
from twin.model.effects import EFFECTS, apply
from twin.signals import MBAR, MS, Phase

Floats = npt.NDArray[np.float64]
ROWS = np.repeat(np.array([Phase.IDLE, Phase.SUCTION, Phase.BLOW_OFF], np.uint8), (50, 400, 250))
TYPICAL = [
    (effect.name, {p.name: p.typical}) for effect in EFFECTS.values() for p in effect.parameters
]


def expected(theta: Floats) -> Floats:
    """Pressure (mbar) in a cycle of the gripper, (rows, n)."""
    found, level = np.empty((len(ROWS), theta.shape[1])), np.full(len(ROWS), np.nan)
    level[0] = theta[c.AMBIENT, 0]  # what is read at first, in all of them
    state = kernel.new_state(theta.shape[1])
    kernel.advance(state, theta, np.full(len(ROWS), MS), ROWS, level, found)
    return found / MBAR


@settings(deadline=None)
@given(
    st.integers(1, 6),
    st.integers(1, 5),
    st.integers(0, 2**32 - 1),
    st.floats(1e-3, 10.0),
)
def test_a_linear_model_has_its_own_matrix_whatever_the_step(
    rows: int, count: int, seed: int, step: float
) -> None:
    random = np.random.default_rng(seed)
    matrix, x = random.normal(size=(rows, count)), random.normal(size=count)
    steps = step * random.choice([-1.0, 1.0], count)
    at, slopes = sensitivities(lambda points: matrix @ points + 3.0, x, steps)
    np.testing.assert_allclose(at, matrix @ x + 3.0, atol=1e-12)
    np.testing.assert_allclose(slopes, matrix, atol=1e-9 / step)


@given(st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(0.1, 5.0)), min_size=1, max_size=6))
def test_no_point_is_beyond_a_bound(places: list[tuple[float, float]]) -> None:
    high = np.array([width for _, width in places])
    x = np.array([share * width for share, width in places])
    around = points(x, inside(x, high))
    assert around.shape == (len(x), 1 + len(x))
    assert (around <= high[:, None]).all()
    forwards = x + STEP <= high
    np.testing.assert_array_equal(inside(x, high) > 0.0, forwards)


def test_at_a_bound_a_derivative_is_taken_backwards() -> None:
    """A model that stands still beyond its bound would show nothing forwards."""
    _, slopes = sensitivities(
        lambda at: 4.0 * np.minimum(at, 1.0), np.ones(1), inside(np.ones(1), np.ones(1))
    )
    assert slopes == pytest.approx(4.0)


def test_central_differences_part_what_is_linear_from_what_is_bent() -> None:
    """Both have the variance that they stand for: a normal variable's square has 2."""
    moves, bends = central(np.array([[3.0 + 0.5]]), np.array([[-3.0 + 0.5]]))
    assert moves == pytest.approx(3.0)
    assert bends == pytest.approx(0.5 * np.sqrt(2.0))
    random = np.random.default_rng(5).normal(size=200_000)
    spread = np.var(3.0 * random + 0.5 * random**2)
    assert spread == pytest.approx(float(moves[0, 0] ** 2 + bends[0, 0] ** 2), rel=0.02)


def test_derivatives_over_no_parameter_are_none() -> None:
    at, slopes = derivatives(np.ones((4, 1)))
    assert at.shape == (4,)
    assert slopes.shape == (4, 0)


def test_steps_of_the_plant_give_what_tiny_ones_do() -> None:
    """Within 5 %, and 15 % of what delays: an edge that moves is not linear in that."""
    theta = rigs.theta("gripper")

    def slopes(step: float) -> Floats:
        steps = np.full(len(TYPICAL), step)
        return sensitivities(
            lambda at: expected(coefficients_at(theta, TYPICAL, at)), 0.0 * steps, steps
        )[1]

    usual, tiny = slopes(STEP), slopes(1e-3)
    size = np.linalg.norm(tiny, axis=0)
    apart = np.linalg.norm(usual - tiny, axis=0) / size
    times = np.array([EFFECTS[name].parameters[0].unit == "ms" for name, _ in TYPICAL])
    seen = size > 1.0  # no threshold is met in these rows
    assert seen.sum() == len(TYPICAL) - 2
    assert apart[seen & ~times].max() < 0.05
    assert apart[times].max() < 0.15


def test_coefficients_are_those_of_the_effects_one_after_the_other() -> None:
    theta = rigs.theta("gripper")
    at = np.zeros((len(TYPICAL), 3))
    names = [name for name, _ in TYPICAL]
    at[names.index("leakage"), 1:] = 2.0
    at[names.index("heat_exchange"), 2] = -0.5
    found = coefficients_at(theta, TYPICAL, at)
    leaks = apply(theta, "leakage", {"sonic_flow": 2.0})
    np.testing.assert_array_equal(found[:, 0], theta)
    np.testing.assert_array_equal(found[:, 1], leaks)
    film = {"film_coefficient": float(theta[c.FILM]) - 2.5}
    np.testing.assert_array_equal(found[:, 2], apply(leaks, "heat_exchange", film))


def test_what_an_effect_cannot_be_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"leakage.sonic_flow = -1.0 sl/min is out of bounds"):
        coefficients_at(rigs.theta("gripper"), TYPICAL, -np.eye(len(TYPICAL))[:, :1])
