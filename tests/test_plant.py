"""The right-hand side and its integrator: against Radau, closed formulas, balances, the paper."""

import numpy as np
import numpy.typing as npt
import pytest
import rigs
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp

from twin.model import dataset as c
from twin.model import kernel
from twin.model.dataset import DataSet, Theta, coefficients, resistance
from twin.model.gas import GAMMA, R
from twin.model.plant import (
    ORDER,
    at_supply,
    characteristic,
    port,
    rates,
    reading,
    runge_kutta,
    scratch,
    sensed_at,
)
from twin.signals import MBAR, ML, MS, SL_MIN, Command

Run = npt.NDArray[np.float64]  # a row of the continuous state per millisecond

# Where each phase of a cycle begins: pressure over ambient, jet, nozzle, blow-off; and how far off
# (Pa) a step of 1 ms may be. Blow-off has a kink, where the port begins to breathe out.
STARTS = {
    "evacuation": (1.0, 0.0, 1.0, 0.0, 0.5),
    "hold": (0.26, 1.0, 0.0, 0.0, 0.5),
    "blow_off": (0.26, 0.0, 0.0, 1.0, 3.0),
}


def data_set(**tables: object) -> Theta:
    return coefficients(DataSet.model_validate(tables))


def closed_vessel(**vessel: float) -> Theta:
    """A vessel without leak and without line on an ejector that is off."""
    none = {"line_drop_mbar": 0.0, "leak_sl_min": 0.0, "film_coefficient": 0.0}
    return data_set(vessel=none | vessel)


def standing(theta: Theta, pressure: float, jet: float = 0.0) -> Run:
    return np.array([pressure, theta[c.TEMPERATURE], jet, 0.0, pressure])


def integrate(
    theta: Theta, y: Run, seconds: float, nozzle: float = 0.0, blow: float = 0.0, h: float = MS
) -> Run:
    y, work, supplied = y.copy(), scratch(), at_supply(theta)
    rows = [y.copy()]
    for _ in range(round(seconds / h)):
        runge_kutta(y, h, 0.0, nozzle, blow, theta, supplied, work)
        rows.append(y.copy())
    return np.array(rows)[:: round(MS / h)]


def exact(theta: Theta, y: Run, seconds: float, nozzle: float = 0.0, blow: float = 0.0) -> Run:
    supplied = at_supply(theta)

    def change(_: float, state: Run) -> Run:
        dy = np.empty(ORDER)
        rates(np.ascontiguousarray(state), 0.0, nozzle, blow, theta, supplied, dy)
        return dy

    at = np.linspace(0.0, seconds, round(seconds / MS) + 1)
    small = [1e-6, 1e-9, 1e-12, 1e-12, 1e-6]
    found = solve_ivp(change, (0.0, seconds), y, "Radau", at, rtol=1e-10, atol=small)
    return found.y.T


# Accuracy.


@pytest.mark.parametrize("name", rigs.NAMES)
@pytest.mark.parametrize("phase", STARTS)
def test_a_millisecond_step_is_as_good_as_the_exact_solution(name: str, phase: str) -> None:
    theta = rigs.theta(name)
    theta[[c.RAMP_UP, c.BLOW_OFF_RAMP]] = np.maximum(theta[[c.RAMP_UP, c.BLOW_OFF_RAMP]], 2 * MS)
    ratio, jet, nozzle, blow, within = STARTS[phase]
    start = standing(theta, ratio * theta[c.AMBIENT], jet)
    off = integrate(theta, start, 0.6, nozzle, blow) - exact(theta, start, 0.6, nozzle, blow)
    assert np.abs(off[:, 0]).max() < within
    assert np.abs(off[:, 1]).max() < 1e-2  # K


def test_the_integrator_is_of_fourth_order() -> None:
    theta = rigs.theta("test_rig")
    start = standing(theta, theta[c.AMBIENT])
    reference = exact(theta, start, 0.2, nozzle=1.0)
    errors = [
        np.abs(integrate(theta, start, 0.2, nozzle=1.0, h=h)[:, 4] - reference[:, 4]).max()
        for h in (MS, MS / 2)
    ]
    assert np.log2(errors[0] / errors[1]) > 3.7


def test_blow_off_settles_where_relief_and_flow_are_equal() -> None:
    theta = closed_vessel()
    end = integrate(theta, standing(theta, 0.3e5), 3.0, blow=1.0)[-1, 0]
    assert end == pytest.approx(theta[c.AMBIENT] + theta[c.BLOW_OFF] / theta[c.RELIEF], rel=1e-6)


# Balances.


@pytest.mark.parametrize("warmer", [-80.0, 0.0, 80.0])
def test_a_closed_adiabatic_vessel_stays_as_it_is(warmer: float) -> None:
    theta = closed_vessel()
    start = standing(theta, 0.4e5)
    start[1] += warmer
    assert np.array_equal(integrate(theta, start, 0.1)[-1], start)


@pytest.mark.parametrize("warmer", [-80.0, 80.0])
def test_a_closed_vessel_takes_the_temperature_of_its_wall_and_keeps_its_gas(warmer: float) -> None:
    theta = closed_vessel(film_coefficient=50.0)
    start = standing(theta, 0.4e5)
    start[1] += warmer
    rows = integrate(theta, start, 3.0)
    assert rows[-1, 1] == pytest.approx(theta[c.TEMPERATURE], abs=0.02)
    assert rows[:, 0] / rows[:, 1] == pytest.approx(start[0] / start[1], rel=1e-9)  # p/T ~ mass


def test_heat_goes_into_the_gas_at_the_rate_of_the_film() -> None:
    theta = closed_vessel(film_coefficient=10.0, wall_area_cm2=500.0, volume_ml=755.0)
    start = standing(theta, 0.4e5)
    start[1] -= 100.0
    dy = np.empty(ORDER)
    rates(start, 0.0, 0.0, 0.0, theta, at_supply(theta), dy)
    power = 10.0 * 500e-4 * 100.0  # W
    assert dy[0] == pytest.approx((GAMMA - 1) * power / 755e-6)


@pytest.mark.parametrize("film_coefficient", [0.0, 20.0])
@pytest.mark.parametrize("compliance_ml", [0.0, 20.0])
def test_a_sonic_leak_brings_its_mass_whatever_the_heat(
    film_coefficient: float, compliance_ml: float
) -> None:
    theta = closed_vessel(film_coefficient=film_coefficient, leak_sl_min=4.0)
    theta[c.COMPLIANCE] = compliance_ml * ML
    rows = integrate(theta, standing(theta, 0.2e5), 1.0)
    volume = theta[c.VOLUME] - theta[c.COMPLIANCE] * (1 - rows[:, 0] / theta[c.AMBIENT])
    mass = rows[:, 0] * volume / (R * rows[:, 1])
    sonic = rows[:, 0] < 0.528 * theta[c.AMBIENT]
    assert sonic.sum() > 300
    brought = 4.0 * SL_MIN * np.arange(len(rows)) * MS
    assert (mass - mass[0])[sonic] == pytest.approx(brought[sonic], rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("compliance_ml", [0.0, 100.0])
def test_an_adiabatic_leak_heats_as_the_first_law_says(compliance_ml: float) -> None:
    theta = closed_vessel(leak_sl_min=4.0, volume_ml=755.0)
    theta[c.COMPLIANCE] = compliance_ml * ML
    rows = integrate(theta, standing(theta, 0.2e5), 1.0)
    pressure = rows[rows[:, 0] < 0.528 * theta[c.AMBIENT], 0]
    volume = theta[c.VOLUME] - theta[c.COMPLIANCE] * (1 - pressure / theta[c.AMBIENT])
    energy = pressure * volume / (GAMMA - 1)  # J
    work = np.concatenate(([0], np.cumsum((pressure[1:] + pressure[:-1]) / 2 * np.diff(volume))))
    enthalpy = GAMMA / (GAMMA - 1) * R * theta[c.TEMPERATURE] * 4.0 * SL_MIN  # W, with the leak
    brought = enthalpy * np.arange(len(pressure)) * MS
    assert energy - energy[0] + work == pytest.approx(brought, rel=1e-6, abs=1e-9)


def test_an_isothermal_laminar_leak_fills_exponentially() -> None:
    theta = closed_vessel(volume_ml=500.0)
    theta[c.LAMINAR_LEAK] = 1e-9
    theta[c.FILM] = 3000.0
    rows = integrate(theta, standing(theta, 0.5e5), 1.0)
    rate = 1e-9 * R * theta[c.TEMPERATURE] / (500 * ML)
    vacuum = (theta[c.AMBIENT] - 0.5e5) * np.exp(-rate * np.arange(len(rows)) * MS)
    assert theta[c.AMBIENT] - rows[:, 0] == pytest.approx(vacuum, rel=2e-3)


# The founding paper.


def paper(volume_ml: float, ambient_mbar: float, celsius: float, capacity: float) -> Theta:
    """The founding paper's model: adiabatic, straight characteristic, nothing else."""
    return data_set(
        ambient={"pressure_mbar": ambient_mbar, "temperature_c": celsius},
        ejector={"suction_capacity_sl_min": capacity, "end_pressure_mbar": 150.0},
        vessel={
            "volume_ml": volume_ml,
            "film_coefficient": 0.0,
            "line_drop_mbar": 0.0,
            "leak_sl_min": 0.0,
        },
    )


def evacuation_ms(theta: Theta, target: float) -> float:
    rows = integrate(theta, standing(theta, theta[c.AMBIENT], jet=1.0), 1.5, nozzle=1.0)
    return float(np.interp(-target, -rows[:, 0], np.arange(len(rows))))


RIG = (755.0, 993.0, 25.0, 393.0)  # ml, mbar, °C, mbar to reach
APPLICATION = (150.0, 1000.0, 20.0, 400.0)


@pytest.mark.parametrize(
    ("system", "capacity", "paper_ms", "within"),
    [
        (RIG, 35.0, 1097.0, 6.0),  # recomputed with another density of standard air
        (RIG, 33.4, 1150.0, 6.0),
        (APPLICATION, 35.0, 220.0, 1.0),
        (APPLICATION, 33.4, 230.0, 1.2),
    ],
)
def test_the_founding_papers_evacuation_times(
    system: tuple[float, float, float, float], capacity: float, paper_ms: float, within: float
) -> None:
    volume, ambient, celsius, target = system
    theta = paper(volume, ambient, celsius, capacity)
    assert evacuation_ms(theta, target * MBAR) == pytest.approx(paper_ms, abs=within)


@pytest.mark.parametrize("system", [RIG, APPLICATION])
def test_an_adiabatic_evacuation_is_the_integral_of_the_isentrope(
    system: tuple[float, float, float, float],
) -> None:
    volume, ambient, celsius, target = system
    theta = paper(volume, ambient, celsius, 35.0)
    p0, end = ambient * MBAR, 150.0 * MBAR

    def per_pascal(p: float) -> float:
        temperature = theta[c.TEMPERATURE] * (p / p0) ** (1 - 1 / GAMMA)
        flow = 35.0 * SL_MIN * (p - end) / (p0 - end)
        return volume * ML / (GAMMA * R * temperature * flow)

    seconds, _ = quad(per_pascal, target * MBAR, p0)
    assert evacuation_ms(theta, target * MBAR) == pytest.approx(seconds / MS, abs=0.01)


# What must hold for every data set.


DATA_SETS = st.fixed_dictionaries(
    {
        "ambient": st.fixed_dictionaries(
            {"pressure_mbar": st.floats(650, 1100), "temperature_c": st.floats(-20, 60)}
        ),
        "supply": st.fixed_dictionaries({"pressure_bar": st.floats(3, 6)}),
        "ejector": st.fixed_dictionaries(
            {
                "suction_capacity_sl_min": st.floats(5, 100),
                "end_pressure_mbar": st.floats(50, 400),
                "bulge": st.floats(-0.5, 1.5),
                "skew": st.floats(-1, 0.5),
                "ramp_up_ms": st.floats(1, 100),
                "blow_off_sl_min": st.floats(0, 200),
            }
        ),
        "vessel": st.fixed_dictionaries(
            {
                "volume_ml": st.floats(60, 5000),
                "film_coefficient": st.floats(0, 50),
                "line_drop_mbar": st.floats(0, 400),
                "leak_sl_min": st.floats(0, 20),
            }
        ),
    }
)


def free_run(theta: Theta, commands: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
    """Expected pressure of a free-running cycle of 1 ms rows; H1 is out of reach."""
    theta[[c.H1, c.H1_LOW]] = [2e5, 1e5]
    rows = len(commands)
    dt, phase, expected = np.full(rows, MS), np.empty(rows, "u1"), np.empty(rows)
    kernel.simulate(kernel.at_rest(theta), theta, dt, commands, phase, expected)
    return expected


@settings(max_examples=60, deadline=None)
@given(DATA_SETS)
def test_every_cycle_stays_physical(tables: dict[str, object]) -> None:
    theta = data_set(**tables)
    steps = (Command.SUCTION, 600), (Command.BLOW_OFF, 200), (Command(0), 200)
    commands = np.concatenate([np.full(n, command, np.uint8) for command, n in steps])
    pressure = free_run(theta, commands)
    assert np.isfinite(pressure).all()
    _, end, blow_off = at_supply(theta)
    assert pressure.min() > 0.98 * end
    most = theta[c.AMBIENT] + blow_off / theta[c.RELIEF]
    assert pressure.max() < most * (1 + 1e-6) + 0.1 * theta[c.AMBIENT]  # cold gas warms up again


@settings(max_examples=60, deadline=None)
@given(DATA_SETS)
def test_adiabatic_evacuation_only_goes_down(tables: dict[str, object]) -> None:
    theta = data_set(**tables)
    theta[c.FILM] = theta[c.LEAK] = 0.0  # heat and leaks may push back
    pressure = free_run(theta, np.full(800, Command.SUCTION, np.uint8))
    assert (np.diff(pressure) <= 1e-9 * pressure[1:]).all()


@settings(max_examples=60, deadline=None)
@given(st.floats(-500.0, 500.0), st.floats(0.0, 60.0), st.floats(150.0, 1000.0))
def test_nothing_chatters_at_equal_pressures(start: float, leak: float, volume: float) -> None:
    theta = closed_vessel(volume_ml=volume, leak_sl_min=leak)
    rows = integrate(theta, standing(theta, theta[c.AMBIENT] + start), 0.3)
    vacuum = theta[c.AMBIENT] - rows[:, 0]
    assert (vacuum * vacuum[0] >= -1e-9).all()  # never to the other side
    assert (np.diff(np.abs(vacuum)) <= 1e-9).all()


# The port.


@given(st.floats(0.01, 1.6), st.floats(0.0, 1.0), st.floats(0.0, 200.0))
def test_without_resistance_the_port_has_the_vessels_pressure(
    ratio: float, jet: float, blow: float
) -> None:
    theta = closed_vessel()
    assert theta[c.RESISTANCE] == 0.0
    suction, end, _ = at_supply(theta)
    p = ratio * theta[c.AMBIENT]
    p_port, _ = port(p, jet, blow * SL_MIN, theta, suction, end)
    assert p_port == p


@settings(max_examples=400, deadline=None)
@given(
    st.floats(0.02, 1.5),
    st.one_of(st.tuples(st.floats(0, 1), st.just(0.0)), st.tuples(st.just(0.0), st.floats(0, 200))),
    st.floats(0.0, 800.0),
    st.floats(-0.5, 2.0),
    st.floats(-1.5, 0.0),
)
def test_the_port_solves_its_equation(
    ratio: float, jet_or_blow: tuple[float, float], drop: float, bulge: float, skew: float
) -> None:
    """p_port² = p² − K w|w|, with the flow w of jet, relief and blow-off at the port's pressure."""
    jet, blow = jet_or_blow[0], jet_or_blow[1] * SL_MIN
    theta = rigs.theta("gripper")
    theta[c.BULGE], theta[c.SKEW] = bulge, skew
    theta[c.RESISTANCE] = resistance(theta, drop * MBAR)
    suction, end, _ = at_supply(theta)
    ambient = theta[c.AMBIENT]
    p = (min(ratio, 1.0) if jet > 0.0 else ratio) * ambient  # only blow-off goes beyond ambient
    p_port, through = port(p, jet, blow, theta, suction, end)
    share, _ = characteristic((p_port - end) / (ambient - end), bulge, skew)
    flow = jet * suction * share + theta[c.RELIEF] * max(p_port - ambient, 0.0) - blow
    squares = p * p + p_port * p_port
    assert abs(p_port**2 - p**2 + theta[c.RESISTANCE] * flow * abs(flow)) < 2e-3 * squares
    assert through == pytest.approx(flow, abs=0.02 * suction)
    assert p_port >= min(p, end)


@given(
    st.floats(1e3, 2e5), st.floats(-200.0, 200.0), st.floats(-30.0, 30.0), st.floats(500.0, 1100.0)
)
def test_a_reading_is_undone(sensed: float, offset: float, error: float, ambient: float) -> None:
    theta = data_set(ambient={"pressure_mbar": ambient})
    theta[c.SENSOR_OFFSET], theta[c.SENSOR_GAIN] = offset * MBAR, 1 + error / 100
    assert sensed_at(reading(sensed, theta), theta) == pytest.approx(sensed, rel=1e-9)


# Supply and characteristic.


def test_suction_peaks_at_the_optimum_supply() -> None:
    theta = data_set()
    at = np.linspace(3e5, 6e5, 31)
    flows = []
    for theta[c.SUPPLY] in at:
        flows.append(at_supply(theta)[0])
    assert at[np.argmax(flows)] == pytest.approx(theta[c.SUPPLY_OPTIMUM])


def test_missing_supply_raises_the_end_pressure_and_weakens_blow_off() -> None:
    theta = data_set()
    _, end, blow_off = at_supply(theta)
    assert end == pytest.approx(150.0 * MBAR)
    assert blow_off == theta[c.BLOW_OFF]
    theta[c.SUPPLY] -= 1e5
    _, less_end, less_blow_off = at_supply(theta)
    assert less_end == pytest.approx(1.2 * end)
    assert less_blow_off == pytest.approx(blow_off * (3.5e5 + 101300) / (4.5e5 + 101300))


def test_the_characteristic_is_straight_without_bulge_and_closes_below_end_pressure() -> None:
    assert characteristic(0.3, 0.0, 0.0) == (0.3, 1.0)
    assert characteristic(-0.1, 1.0, 1.0) == (0.0, 0.0)
    assert characteristic(1.0, 1.0, -0.5)[0] == 1.0


@given(st.floats(0.01, 0.99), st.floats(-0.5, 2.0), st.floats(-1.5, 0.5))
def test_the_slope_is_that_of_the_characteristic(x: float, bulge: float, skew: float) -> None:
    step = 1e-6
    ahead, behind = (characteristic(x + d, bulge, skew)[0] for d in (step, -step))
    slope = characteristic(x, bulge, skew)[1]
    if ahead > 0.0 and behind > 0.0:
        assert slope == pytest.approx((ahead - behind) / (2 * step), abs=1e-6)
