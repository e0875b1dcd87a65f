"""The flow through an opening, at its limits and against closed formulas."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin.model.gas import CP, CRITICAL_RATIO, GAMMA, LAMINAR_RATIO, R, orifice

RATIOS = st.floats(0.0, 1.0)


def test_the_gas_is_dry_air() -> None:
    assert pytest.approx(1004.7, abs=0.1) == CP
    assert pytest.approx(CP / (CP - R)) == GAMMA


@pytest.mark.parametrize("ratio", [0.0, 1e-9, 0.3, CRITICAL_RATIO])
def test_the_flow_is_sonic_up_to_the_critical_ratio(ratio: float) -> None:
    assert orifice(ratio) == 1.0


def test_no_pressure_difference_no_flow() -> None:
    assert orifice(1.0) == 0.0


@pytest.mark.parametrize("ratio", [0.55, 0.7, 0.9, 0.99])
def test_below_sonic_it_is_the_ellipse_of_iso_6358(ratio: float) -> None:
    below = (ratio - 0.528) / (1 - 0.528)
    assert orifice(ratio) == pytest.approx(math.sqrt(1 - below**2), rel=1e-14)


@pytest.mark.parametrize("ratio", [0.55, 0.7, 0.9, 0.99])
def test_the_ellipse_is_near_the_isentropic_nozzle(ratio: float) -> None:
    def flow(r: float) -> float:  # Saint-Venant and Wantzel
        return math.sqrt(2 * GAMMA / (GAMMA - 1) * (r ** (2 / GAMMA) - r ** (1 + 1 / GAMMA)))

    critical = (2 / (GAMMA + 1)) ** (GAMMA / (GAMMA - 1))
    assert critical == pytest.approx(CRITICAL_RATIO, abs=5e-4)
    assert orifice(ratio) == pytest.approx(flow(ratio) / flow(critical), rel=0.02)


@given(RATIOS, RATIOS)
def test_more_back_pressure_never_lets_more_through(one: float, other: float) -> None:
    low, high = sorted((one, other))
    assert 0.0 <= orifice(high) <= orifice(low) <= 1.0


@given(st.floats(CRITICAL_RATIO, LAMINAR_RATIO))
def test_there_is_no_step(ratio: float) -> None:
    assert orifice(ratio) == pytest.approx(orifice(ratio + 1e-9), abs=1e-5)


@given(st.floats(LAMINAR_RATIO, 1.0))
def test_near_equal_pressures_the_slope_is_finite(ratio: float) -> None:
    slope = orifice(LAMINAR_RATIO) / (1 - LAMINAR_RATIO)
    assert orifice(ratio) == pytest.approx(slope * (1 - ratio), rel=1e-9, abs=1e-15)
    assert slope < 100
