"""The flow through an opening, at its limits and against closed formulas."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.model.air import CP, CRITICAL_RATIO, GAMMA, LAMINAR_RATIO, R
from twin.model.gas import opening, orifice

RATIOS = st.floats(0.0, 1.0)
compiling = settings(deadline=None)  # the first example has to compile


def test_the_gas_is_dry_air() -> None:
    assert pytest.approx(1004.7, abs=0.1) == CP
    assert pytest.approx(CP / (CP - R)) == GAMMA


def share(ratio: float) -> float:
    flow, _ = orifice(ratio, CRITICAL_RATIO)
    return float(flow)


@pytest.mark.parametrize("ratio", [0.0, 1e-9, 0.3, CRITICAL_RATIO])
def test_the_flow_is_sonic_up_to_the_critical_ratio(ratio: float) -> None:
    assert share(ratio) == 1.0


def test_no_pressure_difference_no_flow() -> None:
    assert share(1.0) == 0.0


@pytest.mark.parametrize("ratio", [0.55, 0.7, 0.9, 0.99])
def test_below_sonic_it_is_the_ellipse_of_iso_6358(ratio: float) -> None:
    below = (ratio - 0.528) / (1 - 0.528)
    assert share(ratio) == pytest.approx(math.sqrt(1 - below**2), rel=1e-14)


@pytest.mark.parametrize("ratio", [0.55, 0.7, 0.9, 0.99])
def test_the_ellipse_is_near_the_isentropic_nozzle(ratio: float) -> None:
    def flow(r: float) -> float:  # Saint-Venant and Wantzel
        return math.sqrt(2 * GAMMA / (GAMMA - 1) * (r ** (2 / GAMMA) - r ** (1 + 1 / GAMMA)))

    critical = (2 / (GAMMA + 1)) ** (GAMMA / (GAMMA - 1))
    assert critical == pytest.approx(CRITICAL_RATIO, abs=5e-4)
    assert share(ratio) == pytest.approx(flow(ratio) / flow(critical), rel=0.02)


@pytest.mark.parametrize("critical", [0.2, 0.35, 0.528])
def test_a_fitting_is_sonic_up_to_a_ratio_of_its_own(critical: float) -> None:
    assert orifice(critical, critical)[0] == 1.0
    below = (0.8 - critical) / (1 - critical)
    assert orifice(0.8, critical)[0] == pytest.approx(math.sqrt(1 - below**2), rel=1e-14)
    assert orifice(1.0, critical)[0] == 0.0


@compiling
@given(RATIOS, RATIOS)
def test_more_back_pressure_never_lets_more_through(one: float, other: float) -> None:
    low, high = sorted((one, other))
    assert 0.0 <= share(high) <= share(low) <= 1.0


@compiling
@given(st.floats(CRITICAL_RATIO, LAMINAR_RATIO))
def test_there_is_no_step(ratio: float) -> None:
    assert share(ratio) == pytest.approx(share(ratio + 1e-9), abs=1e-5)


@compiling
@given(st.floats(LAMINAR_RATIO, 1.0))
def test_near_equal_pressures_the_slope_is_finite(ratio: float) -> None:
    slope = share(LAMINAR_RATIO) / (1 - LAMINAR_RATIO)
    assert share(ratio) == pytest.approx(slope * (1 - ratio), rel=1e-9, abs=1e-15)
    assert slope < 100


@compiling
@given(st.floats(0.0, 1.0))
def test_the_slope_is_that_of_the_flow(ratio: float) -> None:
    step = 1e-7
    if min(abs(ratio - CRITICAL_RATIO), abs(ratio - LAMINAR_RATIO)) > step < ratio < 1 - step:
        steep = (share(ratio + step) - share(ratio - step)) / (2 * step)
        assert orifice(ratio, CRITICAL_RATIO)[1] == pytest.approx(steep, rel=1e-4, abs=1e-6)


# An opening to ambient.


def into(p: float, ambient: float) -> float:
    flow, _ = opening(p, ambient, CRITICAL_RATIO)
    return float(flow)


@compiling
@given(st.floats(1.0, 5e5), st.floats(5e4, 1.2e5))
def test_air_flows_towards_the_lower_pressure(p: float, ambient: float) -> None:
    assert into(p, ambient) * (ambient - p) >= 0.0
    assert into(ambient, ambient) == 0.0


@compiling
@given(st.floats(1.0, 5e4))
def test_far_below_ambient_it_is_sonic_and_far_above_in_proportion_to_pressure(p: float) -> None:
    assert into(p, 1e5) == 1.0
    assert into(2e5 + p, 1e5) == pytest.approx(-(2e5 + p) / 1e5)


@compiling
@given(st.floats(2e4, 4e5))
def test_the_slope_of_an_opening_is_that_of_its_flow(p: float) -> None:
    ambient, step = 1e5, 1e-3
    kinks = [r * ambient for r in (CRITICAL_RATIO, LAMINAR_RATIO, 1.0)]
    kinks += [ambient / LAMINAR_RATIO, ambient / CRITICAL_RATIO]
    if min(abs(p - kink) for kink in kinks) > 2 * step:
        steep = (into(p + step, ambient) - into(p - step, ambient)) / (2 * step)
        assert opening(p, ambient, CRITICAL_RATIO)[1] == pytest.approx(steep, rel=1e-3, abs=1e-10)
