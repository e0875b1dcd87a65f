"""The right-hand side piece by piece, against closed formulas."""

import math

import numpy as np
import numpy.typing as npt
import pytest
import rigs
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import least_squares
from stepping import closed, standing, states, switched_on, temperature, theta_of

from drivers.plc.rig import bulging
from twin.model import kernel
from twin.model import theta as c
from twin.model.air import GAMMA, R
from twin.model.dataset import Ejector
from twin.model.plant import (
    Driven,
    Gas,
    at_supply,
    characteristic,
    choking,
    convection,
    drain_stage,
    leak_flow,
    line_flow,
    port_flows,
    prepare,
    reading,
    sensed_at,
    suction_at,
)
from twin.model.theta import Theta
from twin.signals import MBAR, ML, MS, SL_MIN, Phase

Prepared = npt.NDArray[np.float64]
compiling = settings(deadline=None)  # the first example has to compile

# As nearly one vessel as a system can be: a short wide tube, a small port.
VESSEL = ({"kind": "tube", "length_mm": 20.0, "diameter_mm": 12.0},)
CLOSED_TANK = {"kind": "vessel", "volume_ml": 1000.0}


def one(theta: Theta) -> Prepared:
    return np.asarray(prepare(theta.reshape(-1, 1)))


def still(vessel: float) -> Gas:
    """Gas that does not flow, of which only the pressure in the vessel matters."""
    return Gas(vessel, 1.0, vessel, 1.0, vessel, 1.0, 0.0, 0.0, 0.0)


def supplied(theta: Theta, missing: float = 0.0) -> tuple[float, float, float]:
    """Suction, end pressure and blow-off with ``missing`` Pa less than nominal supply."""
    flows: tuple[float, float, float] = at_supply(theta[c.SUPPLY_NOMINAL] - missing, one(theta), 0)
    return flows


# Supply.


@pytest.mark.parametrize("name", rigs.NAMES)
def test_at_nominal_supply_all_is_nominal(name: str) -> None:
    theta = rigs.theta(name)
    expected = [theta[c.SUCTION], theta[c.END_RATIO] * theta[c.AMBIENT], theta[c.BLOW_OFF]]
    assert supplied(theta) == pytest.approx(expected)


def test_suction_peaks_at_the_optimum_supply() -> None:
    theta = theta_of(supply={"pressure_bar": 4.0, "optimum_bar": 4.8})
    at = np.linspace(3e5, 6e5, 31)
    flows = [at_supply(supply, one(theta), 0)[0] for supply in at]
    assert at[np.argmax(flows)] == pytest.approx(theta[c.SUPPLY_OPTIMUM])
    assert max(flows) > theta[c.SUCTION]


def test_missing_supply_raises_the_end_pressure_and_weakens_blow_off() -> None:
    theta = theta_of()
    _, end, blow_off = supplied(theta)
    _, less_end, less_blow_off = supplied(theta, 1e5)
    assert less_end == pytest.approx(1.2 * end)
    assert less_blow_off == pytest.approx(blow_off * (3.5e5 + 101300) / (4.5e5 + 101300))


def test_over_ambient_a_jet_depends_on_the_supply_over_ambient_alone() -> None:
    theta = theta_of()
    everywhere = one(theta)
    theta[c.AMBIENT] *= 0.8
    for supply in (3.0e5, 4.5e5, 6.0e5):
        suction, end, _ = at_supply(supply, everywhere, 0)
        higher_up = at_supply(0.8 * supply, one(theta), 0)
        assert higher_up[:2] == pytest.approx([0.8 * suction, 0.8 * end])


def test_in_thin_air_the_same_supply_makes_a_deeper_vacuum() -> None:
    theta = theta_of()
    _, end, _ = supplied(theta)
    theta[c.AMBIENT] *= 0.96
    relative = theta[c.SUPPLY_NOMINAL] * (1.0 / 0.96 - 1.0)
    assert supplied(theta)[1] == pytest.approx(0.96 * end * (1.0 - theta[c.END_SLOPE] * relative))


def test_the_supply_droops_while_a_valve_is_open_and_recovers_with_its_lag() -> None:
    theta = theta_of(supply={"droop_bar": 0.5, "lag_ms": 30.0})
    rows = states(theta, [(Phase.SUCTION, 300), (Phase.IDLE, 300)])
    regulated = theta[c.SUPPLY]
    assert rows[299, kernel.SUPPLIED] == pytest.approx(regulated - 0.5e5, rel=1e-4)
    closed_at = 300 + round(theta[c.RESPONSE_OFF] / MS)
    missing = regulated - rows[closed_at + 30, kernel.SUPPLIED]
    assert missing == pytest.approx(0.5e5 * np.exp(-1.0), rel=0.05)


# The characteristic.


def bent(**bends: float) -> Prepared:
    return one(theta_of(ejector=bends))


def test_the_characteristic_is_straight_without_bends_and_closes_below_end_pressure() -> None:
    assert characteristic(0.3, bent(), 0) == (0.3, 1.0)
    assert characteristic(-0.1, bent(bulge=0.5, skew=0.2), 0) == (0.0, 0.0)
    assert characteristic(1.0, bent(bulge=0.5, skew=0.2), 0)[0] == 1.0


@compiling
@given(
    st.floats(0.01, 0.99),
    st.floats(-0.4, 0.8),
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
    st.floats(0.0, 0.8),
    st.floats(0.1, 0.9),
)
def test_the_slope_is_that_of_the_characteristic(
    x: float, bulge: float, skew: float, bend_2: float, bend_3: float, kink: float, at: float
) -> None:
    bends = {"bulge": bulge, "skew": skew, "bend_2": bend_2, "bend_3": bend_3}
    stage = {"kink": kink, "kink_at": at}
    theta = theta_of()
    theta[[c.KINK, c.KINK_AT]] = kink, at
    theta[[c.BULGE, c.SKEW, c.BEND_2, c.BEND_3]] = bulge, skew, bend_2, bend_3
    k, step = one(theta), 1e-6
    ahead, behind = (characteristic(x + d, k, 0)[0] for d in (step, -step))
    share, slope = characteristic(x, k, 0)
    assert slope == pytest.approx(max((ahead - behind) / (2 * step), 0.0), abs=1e-6)
    by_hand = x * (1 + (1 - x) * np.polyval([bend_3, bend_2, skew, bulge], x))
    second = max(x - at, 0.0) / (1.0 - at)
    rounded = kink * 0.016 / (1.0 - at) + 1e-12
    assert share == pytest.approx((1.0 - kink) * by_hand + kink * second, abs=rounded)
    shape = Ejector.model_construct(**bends, **stage).share(np.array([x]))
    assert share == pytest.approx(float(shape[0]))


def test_above_ambient_the_characteristic_goes_on_straight_whatever_its_bends() -> None:
    """A vessel that blow-off has filled to 1.4 bar is drawn faster than one at ambient."""
    k = bent(bulge=-0.6, skew=5.2, bend_2=-10.8, bend_3=7.0)
    share, slope = characteristic(1.0, k, 0)
    assert (share, slope) == (1.0, pytest.approx(1.0 - (-0.6 + 5.2 - 10.8 + 7.0)))
    for x in (1.1, 1.5):
        assert characteristic(x, k, 0) == (pytest.approx(1.0 + (x - 1.0) * slope), slope)
    flat = bent(bulge=1.0)  # at ambient it rises no more
    assert characteristic(1.3, flat, 0) == (1.0, 0.0)


@pytest.mark.parametrize(("second", "depth"), [(0.3, 0.5), (0.45, 0.35), (0.6, 0.7)])
def test_the_kink_of_a_second_stage_is_that_of_the_simulated_rig(
    second: float, depth: float
) -> None:
    way = np.linspace(0.01, 1.0, 100)
    deeper = [bulging(x, 1.25) for x in way]
    closes = [bulging((x - 1.0) / depth + 1.0, 1.25) for x in way]
    law = (1.0 - second) * np.array(deeper) + second * np.array(closes)
    keys = ("bulge", "skew", "bend_2", "bend_3", "kink", "kink_at")

    def off(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return Ejector.model_construct(**dict(zip(keys, x, strict=False))).share(way) - law

    without = least_squares(off, [0.3, 0.0, 0.0, 0.0])
    with_it = least_squares(off, [0.3, 0.0, 0.0, 0.0, 0.3, 0.4])
    assert np.std(with_it.fun) < 0.4 * np.std(without.fun)
    assert with_it.x[-1] == pytest.approx(1.0 - depth, abs=0.05)


def test_suction_runs_from_capacity_at_ambient_to_none_at_end_pressure() -> None:
    theta = rigs.theta("test_rig")
    assert suction_at(theta, theta[c.AMBIENT]) == pytest.approx(theta[c.SUCTION])
    assert suction_at(theta, theta[c.END_RATIO] * theta[c.AMBIENT]) == 0.0


def test_a_characteristic_that_moves_gives_at_each_pressure_what_it_gave_below() -> None:
    theta = rigs.theta("test_rig")
    moved = theta.copy()
    moved[c.MOVED] = 40.0 * MBAR
    for vacuum in (0.0, 150.0, 400.0):
        p = theta[c.AMBIENT] - vacuum * MBAR
        assert suction_at(moved, p) == pytest.approx(suction_at(theta, p - 40.0 * MBAR))
    end = theta[c.END_RATIO] * theta[c.AMBIENT] + 40.0 * MBAR
    assert suction_at(moved, end) == 0.0 < suction_at(moved, end + 5.0 * MBAR)


# Flows at the nodes.


def driven(jet: float = 0.0, blow_off: float = 0.0, is_open: float = 0.0) -> Driven:
    return Driven(jet, 35.0 * SL_MIN, 150.0 * MBAR, blow_off, is_open)


def flow_out(theta: Theta, p: float, jet: float) -> float:
    out, slope, _, _ = port_flows(p, driven(jet), one(theta), 0)
    return float(out + slope * p)


def flow_in(theta: Theta, p: float, jet: float = 0.0, blow_off: float = 0.0) -> float:
    _, _, blown, slope = port_flows(p, driven(jet, blow_off), one(theta), 0)
    return float(blown + slope * p)


def test_a_jet_that_builds_up_draws_neither_as_much_nor_as_deep() -> None:
    theta = theta_of()
    ambient, span = theta[c.AMBIENT], theta[c.AMBIENT] - 150 * MBAR
    assert flow_out(theta, ambient, 1.0) == pytest.approx(35 * SL_MIN)
    assert flow_out(theta, ambient, 0.5) == pytest.approx(0.25 * 35 * SL_MIN)
    assert flow_out(theta, ambient - 0.5 * span, 0.5) == pytest.approx(0.0, abs=1e-12)
    assert flow_out(theta, 0.9 * ambient, 0.0) == 0.0


def test_above_ambient_the_exhaust_lets_out() -> None:
    theta = theta_of(ejector={"relief_sl_min": 200.0})
    assert flow_out(theta, theta[c.AMBIENT] + 100 * MBAR, 0.0) == pytest.approx(200 * SL_MIN)
    assert flow_out(theta, theta[c.AMBIENT], 0.0) == 0.0


def test_a_check_valve_lets_out_from_its_cracking_pressure_on() -> None:
    theta = theta_of(ejector={"relief_sl_min": 200.0, "cracking_pressure_mbar": 6.0})
    assert flow_out(theta, theta[c.AMBIENT] + 5.9 * MBAR, 0.0) == 0.0
    assert flow_out(theta, theta[c.AMBIENT] + 106 * MBAR, 0.0) == pytest.approx(200 * SL_MIN)
    theta[c.RELIEF], theta[c.EXHAUST] = 0.0, 200 * SL_MIN
    assert flow_out(theta, theta[c.AMBIENT] + 5.9 * MBAR, 0.0) == 0.0
    behind = theta.copy()
    behind[c.CRACKING_PRESSURE] = 0.0
    lets_out = flow_out(behind, theta[c.AMBIENT] + 100 * MBAR, 0.0)
    assert flow_out(theta, theta[c.AMBIENT] + 106 * MBAR, 0.0) == pytest.approx(lets_out)


def test_a_relief_valve_lets_out_from_its_own_pressure_on() -> None:
    told = {"relief_sl_min": 200.0, "cracking_pressure_mbar": 6.0, "relief_pressure_mbar": 250.0}
    theta = theta_of(ejector=told)
    assert flow_out(theta, theta[c.AMBIENT] + 249 * MBAR, 0.0) == 0.0
    assert flow_out(theta, theta[c.AMBIENT] + 300 * MBAR, 0.0) == pytest.approx(100 * SL_MIN)


def test_a_blow_off_drains_its_own_reservoir_and_that_fills_again() -> None:
    """To where as much comes in as goes out, and back to full, exponentially."""
    theta = theta_of(ejector={"blow_off_drain_per_s": 5.0, "blow_off_refill": 0.25})
    k, step = prepare(theta.reshape(-1, 1)), 1e-4
    drained = [0.0]
    for row in range(30000):
        valve = 1.0 if row < 15000 else 0.0
        drained.append(drain_stage.py_func(drained[-1], valve, step, k, 0))
    assert drained[15000] == pytest.approx(0.8, rel=1e-3)
    assert drained[1600] == pytest.approx(0.8 * (1.0 - np.exp(-1.0)), rel=1e-3)
    assert drained[15000 + 8000] == pytest.approx(0.8 * np.exp(-1.0), rel=1e-3)


def test_a_check_valve_leaks_only_while_the_nozzle_is_off() -> None:
    theta = theta_of()
    theta[c.BACK_FLOW] = 3.0 * SL_MIN
    assert flow_in(theta, 0.3e5) == pytest.approx(3 * SL_MIN)
    assert flow_in(theta, 0.3e5, jet=0.5) == pytest.approx(1.5 * SL_MIN)
    assert flow_in(theta, 0.3e5, jet=1.0) == pytest.approx(0.0, abs=1e-15)
    assert flow_in(theta, 1.1e5) == pytest.approx(0.0, abs=1e-15)
    assert flow_in(theta, 0.3e5, jet=1.0, blow_off=1e-3) == pytest.approx(1e-3)


def test_a_vessel_is_leaked_into_by_hole_pore_and_rim() -> None:
    theta = theta_of(system={"parts": [*VESSEL, {"kind": "cups", "volume_ml": 20.0}]})
    ambient, p = theta[c.AMBIENT], 0.4 * theta[c.AMBIENT]
    theta[[c.LEAK, c.LAMINAR_LEAK]] = 2.0 * SL_MIN, 1e-9
    theta[c.HOLE] = 1.5 * SL_MIN
    opened = theta[c.OPENING] * 0.6 * ambient + theta[c.HOLE]
    for is_open, more in ((0.0, 0.0), (1.0, opened)):
        level, slope = leak_flow(p, driven(is_open=is_open), one(theta), 0)
        assert level + slope * p == pytest.approx(2 * SL_MIN + 1e-9 * 0.6 * ambient + more)


@compiling
@given(
    st.floats(1e3, 3e5),
    st.floats(1e3, 3e5),
    st.floats(0.0, 1e9),
    st.floats(0.0, 1e9),
    st.floats(0.0, 1e17),
    st.floats(1.0, 1e13),
    st.floats(-1e9, 1e9),
)
def test_flow_through_a_line_solves_its_equation(
    rest: float,
    before: float,
    fall: float,
    rise: float,
    quadratic: float,
    linear: float,
    pushed: float,
) -> None:
    """p₁² − p₂² = K w |w| + L w − pushed, with both pressures linear in w."""
    w = line_flow(rest, fall, before, rise, quadratic, linear, pushed)
    first, second = rest - fall * w, before + rise * w
    if first < 0.0 or second < 0.0:
        return  # such flows do not come from any state, and are cut off
    left = first**2 - second**2 + pushed
    size = rest**2 + before**2 + abs(pushed)
    assert left == pytest.approx(quadratic * w * abs(w) + linear * w, abs=1e-6 * size)


CRITICAL = (0.1, 0.3, 0.5)


@pytest.mark.parametrize("critical", CRITICAL)
@pytest.mark.parametrize("ratio", [0.01, 0.09, 0.29, 0.31, 0.49, 0.6, 0.9, 0.999, 1.0])
def test_a_line_passes_what_iso_6358_says_either_way(critical: float, ratio: float) -> None:
    high, sonic = 0.8e5, 2e-8  # Pa, kg/(s Pa)
    low = ratio * high
    subsonic = max(ratio - critical, 0.0) / (1.0 - critical)
    expected = sonic * high * math.sqrt(1.0 - subsonic**2)
    quadratic = (1.0 - critical) / sonic**2
    for port, vessel, way in ((low, high, 1.0), (high, low, -1.0)):
        friction = quadratic * choking(port, vessel, critical)
        flow = line_flow(vessel, 0.0, port, 0.0, friction, 1e-3, 0.0)
        assert flow == pytest.approx(way * expected, rel=1e-9, abs=1e-15)


@compiling
@given(st.floats(1.0, 1e7), st.floats(1.0, 1e7))
def test_without_a_critical_ratio_a_line_is_as_it_was_to_the_bit(
    port: float, vessel: float
) -> None:
    assert choking(port, vessel, 0.0) == 1.0


@pytest.mark.parametrize("critical", CRITICAL)
def test_a_small_drop_is_the_same_with_any_critical_ratio(critical: float) -> None:
    assert choking(1e5, 1e5, critical) == 1.0
    assert choking(0.999e5, 1e5, critical) == pytest.approx(1.0, abs=1e-3)


def test_no_difference_no_flow() -> None:
    assert line_flow(1e5, 10.0, 1e5, 10.0, 1e14, 1e9, 0.0) == 0.0
    assert line_flow(1e5, 0.0, 1e5, 0.0, 0.0, 1e-9, 0.0) == 0.0


# The sensor.


@compiling
@given(
    st.floats(1e3, 2e5), st.floats(-200.0, 200.0), st.floats(-30.0, 30.0), st.floats(500.0, 1100.0)
)
def test_a_reading_is_undone(sensed: float, offset: float, error: float, ambient: float) -> None:
    theta = rigs.theta("test_rig")
    theta[c.AMBIENT] = ambient * MBAR
    theta[c.SENSOR_OFFSET], theta[c.SENSOR_GAIN] = offset * MBAR, 1 + error / 100
    k = one(theta)
    assert sensed_at(reading(sensed, k, 0), k, 0) == pytest.approx(sensed, rel=1e-9)


def test_a_sensor_that_reads_too_much_vacuum_reads_too_little_pressure() -> None:
    theta = rigs.theta("test_rig")
    theta[c.SENSOR_GAIN] = 1.02
    assert reading(theta[c.AMBIENT] - 5e4, one(theta), 0) == pytest.approx(theta[c.AMBIENT] - 5.1e4)


def test_the_sensor_follows_in_two_stages() -> None:
    """As two lags in line: after a step t/τ = 1, a share of 1 − 2/e is there."""
    theta = closed()
    theta[[c.SENSOR_LAG, c.SLOW_SENSOR]] = 20 * MS, 0.0
    state = standing(theta, 0.5e5)
    state[[kernel.SENSOR_STAGE, kernel.SENSED]] = 0.6e5
    rows = states(theta, [(Phase.IDLE, 20)], state)
    assert rows[-1, kernel.SENSED] == pytest.approx(0.6e5 - 0.1e5 * (1 - 2 / np.e), rel=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_sensor_reads_the_pressure_of_its_place(share: float) -> None:
    parts = [
        {"kind": "tube", "length_mm": 1000.0, "diameter_mm": 4.0},
        {"kind": "vessel", "volume_ml": 5000.0},
    ]
    at = {0.0: 0, 0.5: 1, 1.0: 1}[share]
    half = [{"kind": "tube", "length_mm": 500.0, "diameter_mm": 4.0}] * 2
    pipes = half if share == 0.5 else parts[:1]
    placed = [*pipes[:at], {"kind": "sensor", "tube_diameter_mm": 1.0}, *pipes[at:], parts[1]]
    theta = theta_of(system={"parts": placed})
    rows = states(theta, [(Phase.SUCTION, 300)])
    port, vessel, sensed = rows[-1, [kernel.PORT, kernel.VESSEL, kernel.SENSED]]
    assert vessel - port > 10 * MBAR
    assert sensed == pytest.approx(port + share * (vessel - port), abs=1 * MBAR)


# The whole, where a formula says what comes out.


def paper(volume_ml: float, ambient_mbar: float, celsius: float) -> Theta:
    """An adiabatic vessel on a straight characteristic, nothing else."""
    return theta_of(
        ambient={"pressure_mbar": ambient_mbar, "temperature_c": celsius},
        ejector={"suction_capacity_sl_min": 35.0, "end_pressure_mbar": 150.0},
        system={
            "parts": [*VESSEL, {"kind": "vessel", "volume_ml": volume_ml}],
            "film_coefficient": 0.0,
            "tube_film_coefficient": 0.0,
            "line_factor": 0.0,
            "leak_sl_min": 0.0,
        },
    )


@pytest.mark.parametrize(
    ("volume", "ambient", "celsius", "target"),
    [(755.0, 993.0, 25.0, 393.0), (150.0, 1000.0, 20.0, 400.0)],
)
def test_an_adiabatic_evacuation_is_the_integral_of_the_isentrope(
    volume: float, ambient: float, celsius: float, target: float
) -> None:
    theta = paper(volume, ambient, celsius)
    rows = states(theta, [(Phase.SUCTION, 1300)], switched_on(standing(theta, ambient * MBAR)))
    found = float(np.interp(-target * MBAR, -rows[:, kernel.VESSEL], np.arange(1, len(rows) + 1)))
    p0, end = ambient * MBAR, 150.0 * MBAR
    everything = theta[[c.PORT_VOLUME, c.LINE_VOLUME, c.VOLUME]].sum()

    def per_pascal(p: float) -> float:
        kelvin = theta[c.TEMPERATURE] * (p / p0) ** (1 - 1 / GAMMA)
        flow = 35.0 * SL_MIN * (p - end) / (p0 - end)
        return float(everything / (GAMMA * R * kelvin * flow))

    seconds, _ = quad(per_pascal, target * MBAR, p0)
    assert found == pytest.approx(seconds / MS, rel=2e-3)
    isentrope = theta[c.TEMPERATURE] * (rows[:, kernel.VESSEL] / p0) ** (1 - 1 / GAMMA)
    assert temperature(theta, rows) == pytest.approx(isentrope, rel=1e-4)


def test_an_isothermal_laminar_leak_fills_exponentially() -> None:
    parts = [*VESSEL, {"kind": "vessel", "volume_ml": 500.0}]
    theta = closed(parts, film_coefficient=3000.0, tube_film_coefficient=3000.0)
    theta[c.LAMINAR_LEAK] = 1e-9
    rows = states(theta, [(Phase.IDLE, 1000)], standing(theta, 0.5e5))
    everything = theta[[c.PORT_VOLUME, c.LINE_VOLUME, c.VOLUME]].sum()
    assert everything == pytest.approx(503.3 * ML, rel=1e-3)
    rate = 1e-9 * R * theta[c.TEMPERATURE] / everything
    vacuum = (theta[c.AMBIENT] - 0.5e5) * np.exp(-rate * np.arange(1, 1001) * MS)
    assert theta[c.AMBIENT] - rows[:, kernel.VESSEL] == pytest.approx(vacuum, rel=3e-3)


def test_blow_off_settles_where_exhaust_and_flow_are_equal() -> None:
    theta = closed()
    rows = states(theta, [(Phase.BLOW_OFF, 4000)], standing(theta, 0.3e5))
    above = rows[-1, kernel.PORT] - theta[c.AMBIENT]
    assert above == pytest.approx(theta[c.BLOW_OFF] / theta[c.RELIEF], rel=1e-4)


def test_after_blow_off_a_closed_vessel_stays_at_the_cracking_pressure() -> None:
    theta = closed(film_coefficient=3000.0, tube_film_coefficient=3000.0)
    theta[[c.CRACKING_PRESSURE, c.RELIEF_PRESSURE]] = 8 * MBAR
    rows = states(theta, [(Phase.BLOW_OFF, 4000), (Phase.IDLE, 3000)], standing(theta, 0.3e5))
    above = rows[-1, [kernel.PORT, kernel.VESSEL]] - theta[c.AMBIENT]
    assert above == pytest.approx(8 * MBAR, abs=0.05 * MBAR)


@pytest.mark.parametrize(("warmer", "pressure"), [(10.0, 1.0), (-40.0, 0.25), (2.5, 0.5)])
def test_free_convection_grows_with_the_difference_and_the_density(
    warmer: float, pressure: float
) -> None:
    """Nu in proportion to Ra^¼, laminar; what the film coefficient says is at 10 K and ambient."""
    theta = closed(film_coefficient=10.0)
    gas = still(pressure * theta[c.AMBIENT])
    assert convection(gas, warmer, one(theta), 0) == 1.0
    theta[c.FREE_CONVECTION] = 0.6
    free = (pressure**2 * abs(warmer) / 10.0) ** 0.25
    assert convection(gas, warmer, one(theta), 0) == pytest.approx(0.4 + 0.6 * free)


def test_a_jet_that_enters_the_vessel_stirs_its_gas_and_one_that_leaves_does_not() -> None:
    theta = closed(film_coefficient=10.0, forced_convection=2.0)
    gas, flow = still(theta[c.AMBIENT]), theta[c.BLOW_OFF]
    assert convection(gas._replace(far=-flow), 10.0, one(theta), 0) == pytest.approx(3.0)
    assert convection(gas._replace(far=-flow / 4), 10.0, one(theta), 0) == pytest.approx(2.0)
    assert convection(gas._replace(far=flow), 10.0, one(theta), 0) == 1.0


def test_a_line_comes_to_swing_without_a_step() -> None:
    """A fit that meets a step in the coefficients goes no further."""

    def inertance(port_ml: float) -> float:
        parts = [{"kind": "tube", "length_mm": 186.0, "diameter_mm": 7.5}, CLOSED_TANK]
        ejector = {"port_volume_ml": port_ml}
        return float(theta_of(ejector=ejector, system={"parts": parts})[c.NEAR_INERTANCE])

    at = np.array([inertance(port) for port in np.linspace(1.0, 40.0, 400)])
    assert at[0] == 0.0 < at[-1]
    assert np.abs(np.diff(at)).max() < 0.02 * at[-1]


def test_the_jet_builds_up_in_two_stages_and_collapses_in_its_own_time() -> None:
    theta = closed()
    theta[[c.RESPONSE, c.RESPONSE_OFF]] = 0.0
    theta[[c.RAMP_UP, c.RAMP_DOWN, c.SLOW_RAMP_UP]] = 20 * MS, 10 * MS, 0.0
    rows = states(theta, [(Phase.SUCTION, 301), (Phase.IDLE, 11)])
    assert rows[20, kernel.JET] == pytest.approx(1 - 2 / np.e, abs=1e-3)  # commanded from row 0
    assert rows[-1, kernel.JET] == pytest.approx(2 / np.e, abs=1e-3)
