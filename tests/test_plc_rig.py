"""The simulated rig obeys mass and energy, behaves like the paper's rig, and keeps its secrets."""

import numpy as np
import pytest

from drivers.plc.courses import Schedule
from drivers.plc.faults import parse_fault
from drivers.plc.plant import CV, READING, TRUTH, at_rest, plant
from drivers.plc.rig import CP, NOISES, run
from drivers.plc.scan import Task
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import with_truth
from twin.errors import ConfigError
from twin.signals import MBAR, Command

QUIET = {
    "sensor": {"noise_mbar": 0, "supply_noise_mbar": 0},
    "scatter": {"supply_bar": 0, "seal_leak_sl_min": 0, "valve_ms": 0},
    "control": {"noise_mbar": 0},
}
GRIPPER = {
    "rig": {
        "port_ml": 5,
        "line_ml": 20,
        "vessel_ml": 125,
        "line_length_m": 2,
        "line_diameter_mm": 4,
        "vessel_area_m2": 0.02,
        "opens": True,
    },
    "ejector": {"bulge": 1.4, "second_stage": 0.15, "blow_off_sl_min": 60},
    "program": {"suction_ms": 1200, "blow_off_ms": 200, "idle_ms": 600},
}


def settings(**tables):
    return PlcSettings.model_validate(tables)


def traces(configuration, seconds, **options):
    parts = list(with_truth(configuration, seconds, **options))
    return np.concatenate([s for s, _ in parts]), np.concatenate([t for _, t in parts])


def let_run(configuration, state, scans=400, faults=()):
    """Let the rig go on from ``state`` without a command; gives the truth."""
    rows = Schedule(faults, 0, configuration.rig.vessel_film).rows(0, np.zeros(scans, np.int64))
    truth = np.zeros(scans, TRUTH)
    commands, noise = np.zeros(scans, np.uint8), np.zeros((scans, NOISES))
    run(plant(configuration), state, rows, commands, noise, np.zeros(scans, READING), truth)
    return truth


def evacuated_vessel(configuration, pressure):
    """State with everything but the vessel at ambient."""
    state = at_rest(plant(configuration), 1013 * MBAR)
    for place in ("port", "line", "vessel"):
        part = pressure / state[f"{place}_pressure"]
        for quantity in ("mass", "energy", "pressure"):
            state[f"{place}_{quantity}"] *= part
    return state


def after(samples, command, nth=0):
    """Row at which ``command`` is given for the nth time."""
    given = (samples["commands"] & command) != 0
    return int(np.flatnonzero(np.diff(given.astype(np.int8)) == 1)[nth]) + 1


def vacuum(samples):
    return 1013 - samples["pressure"] / MBAR


ISOLATED = settings(
    rig={"vessel_film": 0, "tube_film": 0, "seal_leak_sl_min": 0}, scatter=QUIET["scatter"]
)


def test_closed_and_adiabatic_keeps_mass_energy_and_evens_out():
    state = evacuated_vessel(ISOLATED, 300 * MBAR)
    state["vessel_mass"] *= 0.8
    state["vessel_energy"] *= 0.8
    state["vessel_pressure"] *= 0.8
    truth = let_run(ISOLATED, state)
    assert truth["mass"][-1] == pytest.approx(truth["mass"][0], rel=1e-12)
    assert truth["energy"][-1] == pytest.approx(truth["energy"][0], rel=1e-12)
    assert abs(truth["port"][0] - truth["vessel"][0]) > 50 * MBAR
    assert truth["port"][-1] == pytest.approx(truth["vessel"][-1], abs=0.1 * MBAR)


def test_filling_through_a_leak_brings_the_enthalpy_of_ambient_air():
    leaking = settings(
        rig={"vessel_film": 0, "tube_film": 0, "seal_leak_sl_min": 5}, scatter=QUIET["scatter"]
    )
    truth = let_run(leaking, evacuated_vessel(leaking, 200 * MBAR), 1500)
    came, brought = truth["mass"][-1] - truth["mass"][0], truth["energy"][-1] - truth["energy"][0]
    assert came == pytest.approx(5 * 1.185e-3 / 60 * 1.499, rel=0.01)  # sonic all the time
    assert brought == pytest.approx(CP * 293.15 * came, rel=1e-9)
    assert truth["temperature"][-1] > 293.15 + 5  # compressed by what came in


def test_a_cup_that_shrinks_does_work_on_the_gas():
    state = evacuated_vessel(ISOLATED, 400 * MBAR)
    truth = let_run(ISOLATED, state, 200, [parse_fault("cup_compliance=50")])
    gained = truth["energy"][-1] - truth["energy"][0]
    assert truth["mass"][-1] == pytest.approx(truth["mass"][0], rel=1e-12)
    shrunk = 50e-6 * (1 - truth["vessel"][-1] / (1013 * MBAR))
    assert gained == pytest.approx(
        shrunk * (truth["vessel"][0] + truth["vessel"][-1]) / 2, rel=0.01
    )


def test_gas_and_wall_even_out_at_the_film_coefficient():
    warm = settings(rig={"tube_film": 0, "seal_leak_sl_min": 0}, scatter=QUIET["scatter"])
    state = evacuated_vessel(warm, 500 * MBAR)
    for place in ("port", "line", "vessel"):
        state[f"{place}_mass"] *= 293.15 / 253.15
    truth = let_run(warm, state, 1500)
    mass = truth["mass"][0]
    rate = 10 * 0.047 / (mass * CV)
    left = (293.15 - truth["temperature"]) / 40
    assert left[0] == pytest.approx(1, rel=1e-6)
    assert left[1000] == pytest.approx(np.exp(-rate), rel=0.05)


def test_the_tank_is_evacuated_as_fast_as_the_papers():
    samples, _ = traces(settings(), 3)
    on = after(samples, Command.SUCTION)
    assert int(np.argmax(vacuum(samples)[on:] >= 600)) == pytest.approx(1091, rel=0.05)


def test_evacuation_starts_adiabatic_and_ends_isothermal():
    samples, truth = traces(
        settings(program={"suction_ms": 6000}, control={"air_saving": False}), 6
    )
    on = after(samples, Command.SUCTION)
    early, late = truth[on + 120], truth[-1]
    adiabatic = 293.15 * (early["vessel"] / (1013 * MBAR)) ** 0.2857
    assert early["temperature"] - 293.15 == pytest.approx(adiabatic - 293.15, rel=0.25)
    assert late["temperature"] == pytest.approx(293.15, abs=8)


def test_the_closed_tank_pulls_itself_back_under_vacuum_after_blow_off():
    samples, _ = traces(settings(), 3.7)
    blown = after(samples, Command.BLOW_OFF)
    assert vacuum(samples)[blown : blown + 300].min() < -20
    assert vacuum(samples)[-1] > 30


def test_the_gripper_opens_and_idles_at_ambient():
    samples, truth = traces(settings(**GRIPPER), 4.4)
    on = after(samples, Command.SUCTION)
    assert 200 <= int(np.argmax(vacuum(samples)[on:] >= 600)) <= 245
    idle = np.flatnonzero(samples["commands"] == 0)
    again = after(samples, Command.SUCTION, 1)
    settled = idle[(idle > after(samples, Command.BLOW_OFF) + 400) & (idle < again)]
    assert np.abs(vacuum(samples)[settled]).max() < 3
    assert truth["open"][again - 1] == 1
    assert truth["open"][again + 2] == 0


def test_the_air_saving_is_on_in_the_truth_and_nowhere_in_the_samples():
    leaky = settings(rig={"seal_leak_sl_min": 3}, program={"suction_ms": 6000}, **QUIET)
    samples, truth = traces(leaky, 6)
    sucking = (samples["commands"] & Command.SUCTION) != 0
    switches = np.flatnonzero(np.diff(truth["nozzle"].astype(np.int8)))
    assert len(switches) >= 4
    assert (samples["commands"][sucking] == Command.SUCTION).all()
    levels = vacuum(samples)[switches[1:4]]
    assert levels == pytest.approx([750, 600, 750], abs=15)
    assert truth["part_present"][switches[1]] == 1


def test_without_air_saving_it_reaches_its_end_pressure():
    steady = settings(
        rig={"seal_leak_sl_min": 0}, control={"air_saving": False}, program={"suction_ms": 19000}
    )
    samples, _ = traces(steady, 15)
    assert samples["pressure"][-1] / MBAR == pytest.approx(150, abs=4)


def test_blow_off_wins_over_suction():
    both = settings(program={"commands": "coils"})
    task = Task(both)
    task.coils = Command.SUCTION
    task.compute(1000)
    task.coils = Command.SUCTION | Command.BLOW_OFF
    _, truth = task.compute(200)
    assert truth["nozzle"][-1] == 0
    assert truth["port"][-1] > truth["port"][0] + 50 * MBAR


@pytest.mark.parametrize(("supply", "weaker"), [(3.0, True), (4.8, False), (7.0, True)])
def test_suction_is_best_at_the_optimum_supply(supply, weaker):
    ejector = {"supply_droop_bar": 0, "supply_bar": supply}
    best = {"supply_droop_bar": 0, "supply_bar": 4.8}
    given, _ = traces(settings(ejector=ejector, **QUIET), 1)
    reference, _ = traces(settings(ejector=best, **QUIET), 1)
    assert (vacuum(given)[-1] < vacuum(reference)[-1] - 5) == weaker


def test_end_pressure_scales_with_ambient():
    steady = settings(
        rig={"seal_leak_sl_min": 0}, control={"air_saving": False}, program={"suction_ms": 19000}
    )
    high, _ = traces(steady, 15, faults=[parse_fault("ambient_pressure=-200")])
    assert high["pressure"][0] / MBAR == pytest.approx(813, abs=2)
    assert high["pressure"][-1] / MBAR == pytest.approx(150 * 813 / 1013, abs=4)


@pytest.mark.parametrize(
    ("rig", "key"),
    [
        ({"port_ml": 0.5}, "port_ml"),
        ({"line_length_m": 0.02, "line_diameter_mm": 40}, "line_length_m"),
        ({"opens": True, "vessel_ml": 5}, "opening_sl_min"),
    ],
)
def test_a_rig_too_quick_for_its_steps_is_refused(rig, key):
    with pytest.raises(ConfigError, match=key):
        Task(settings(rig=rig))
