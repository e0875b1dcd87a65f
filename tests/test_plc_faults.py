"""Faults as text, and that each acts as its sentence says and only then."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.plc.faults import EFFECTS, Fault, parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks, with_truth
from twin.errors import ConfigError
from twin.signals import MBAR, Command

# A small gripper that leaks enough for its air saving to switch back on within a cycle.
SETTINGS = PlcSettings.model_validate(
    {
        "rig": {"line_ml": 20, "vessel_ml": 125, "seal_leak_sl_min": 4, "opens": True},
        "program": {"suction_ms": 1000, "blow_off_ms": 200, "idle_ms": 300},
    }
)
SECONDS = 3.5
TYPICAL = [
    "leakage=1",
    "porous_leakage=1",
    "check_valve_leak=1",
    "suction_loss=5",
    "end_vacuum_loss=20",
    "supply_pressure_drop=0.5",
    "filter_clogging=50",
    "added_volume=10",
    "cup_compliance=10",
    "heat_exchange=5",
    "response_delay=5",
    "slow_ramp_up=10",
    "threshold_drift.h1_shift=20",
    "threshold_drift.h2_shift=20",
    "weak_blow_off=20",
    "blow_off_delay=10",
    "sensor_offset=5",
    "sensor_gain=2",
    "sensor_lag=10",
    "ambient_pressure=-20",
    "lip_lift=2",
    "supply_swing=0.5",
    "condensate=1",
    "nozzle_icing=10",
    "sensor_backlash=5",
    "creeping_cup=10",
    "sticking_valve=20",
    "blow_off_valve_leak=2",
    "filling_silencer=40",
    "second_ejector=0.5",
    "adsorbed_moisture=1",
    "sensor_thermal_drift=20",
]
PARAMETERS = [(e, p) for e, effect in EFFECTS.items() for p in effect.parameters]


def trace(*texts, seconds=SECONDS, seed=0):
    faults = [parse_fault(text) for text in texts]
    return np.concatenate(list(blocks(SETTINGS, seconds, faults, seed)))


HEALTHY = trace()


def changed(*texts, seconds=SECONDS):
    """Rows whose pressure differs from the healthy trace's by more than what rounding could."""
    healthy = HEALTHY if seconds == SECONDS else trace(seconds=seconds)
    return np.abs(trace(*texts, seconds=seconds)["pressure"] - healthy["pressure"]) > 0.05 * MBAR


def test_every_effect_has_a_typical_size_here():
    assert {text.split("=")[0].split(".")[0] for text in TYPICAL} == set(EFFECTS)
    assert len(EFFECTS) >= 19 + 12


@pytest.mark.parametrize(("effect", "parameter"), PARAMETERS)
def test_neutral_changes_nothing_to_the_last_bit(effect, parameter):
    neutral = SETTINGS.rig.vessel_film if parameter.neutral is None else parameter.neutral
    given_trace = trace(f"{effect}.{parameter.name}={neutral!r}")
    assert given_trace.tobytes() == HEALTHY.tobytes()


@pytest.mark.parametrize(("effect", "parameter"), PARAMETERS)
def test_at_its_bounds_the_rig_stays_a_rig(effect, parameter):
    for value in (parameter.low, parameter.high):
        fault = parse_fault(f"{effect}.{parameter.name}={value!r}@0.8")
        truth = np.concatenate([t for _, t in with_truth(SETTINGS, 2.5, [fault])])
        assert (truth["port"] > 40 * MBAR).all()
        assert (truth["port"] < 2500 * MBAR).all()
        assert (truth["temperature"] > 150).all()
        assert (truth["temperature"] < 500).all()


@pytest.mark.parametrize("text", TYPICAL)
def test_a_typical_size_changes_the_trace(text):
    given_trace = trace(text)
    difference = np.abs(given_trace["pressure"] - HEALTHY["pressure"])
    assert difference.max() > 2 * MBAR
    assert (given_trace["commands"] == HEALTHY["commands"]).all()


SECOND = [
    "lip_lift.above=300",
    "supply_swing.period=0.5",
    "condensate.used_up_after=0.2",
    "creeping_cup.time_constant=0.5",
    "sticking_valve.stuck_strokes=100",
    "filling_silencer.time_constant=0.3",
    "second_ejector.period=0.7",
    "adsorbed_moisture.time_constant=0.2",
    "sensor_thermal_drift.time_constant=2",
]


@pytest.mark.parametrize("text", SECOND)
def test_a_second_parameter_needs_the_first_and_changes_it(text):
    assert trace(text).tobytes() == HEALTHY.tobytes()
    (size,) = (typical for typical in TYPICAL if typical.startswith(text.split(".")[0] + "="))
    assert trace(size, text).tobytes() != trace(size).tobytes()


def test_a_leak_weakens_the_vacuum_and_a_loss_slows_it_down():
    on = np.flatnonzero(HEALTHY["commands"] == Command.SUCTION)[0]
    for text in ("leakage=5", "suction_loss=20", "added_volume=50", "response_delay=20"):
        assert trace(text)["pressure"][on + 150] > HEALTHY["pressure"][on + 150] + 10 * MBAR


def test_sensor_faults_leave_the_truth_alone():
    for text in ("sensor_offset=20", "sensor_gain=5", "sensor_lag=20", "sensor_backlash=10"):
        parts = zip(
            with_truth(SETTINGS, 2), with_truth(SETTINGS, 2, [parse_fault(text)]), strict=True
        )
        for (_, healthy), (_, faulty) in parts:
            assert healthy.tobytes() == faulty.tobytes()


# --- mechanisms outside the table: each acts as its physics say -----------------------------------

# A closed tank without scatter, noise or air saving, evacuated for 3 s in cycles of 5 s.
STEADY = PlcSettings.model_validate(
    {
        "control": {"air_saving": False},
        "sensor": {"noise_mbar": 0, "supply_noise_mbar": 0},
        "scatter": {"supply_bar": 0, "seal_leak_sl_min": 0, "valve_ms": 0},
        "program": {"suction_ms": 3000, "blow_off_ms": 500, "idle_ms": 1500, "jitter_ms": 0},
    }
)
ON, OFF, SECOND_ON = 500, 3500, 5500  # ms: suction begins, ends, and begins again


def pressures(*texts, settings=STEADY, seconds=10.4):
    """Reading and the vessel's true pressure (mbar), one row each ms."""
    parts = list(with_truth(settings, seconds, [parse_fault(text) for text in texts]))
    return np.concatenate([np.stack([s["pressure"], t["vessel"]]) / MBAR for s, t in parts], axis=1)


def moved(*texts, settings=STEADY):
    """Change (mbar) of the vessel's true pressure."""
    return pressures(*texts, settings=settings)[1] - pressures(settings=settings)[1]


def test_a_cup_that_creeps_gives_up_its_air_later_than_one_that_yields_at_once():
    creeping, yielding = moved("creeping_cup=60"), moved("cup_compliance=60")
    assert creeping[ON + 300] < 0.3 * yielding[ON + 300]
    assert creeping[OFF - 1] > 0.0
    fast = moved("creeping_cup=60", "creeping_cup.time_constant=0.05")
    assert fast[ON + 1000] == pytest.approx(yielding[ON + 1000], abs=5.0)


def test_a_valve_that_sticks_is_late_in_some_strokes_and_in_no_other():
    short = STEADY.program.model_copy(
        update={"suction_ms": 300, "blow_off_ms": 200, "idle_ms": 200}
    )
    quick = STEADY.model_copy(update={"program": short})

    def strokes(*texts):
        parts = with_truth(quick, 30, [parse_fault(text) for text in texts])
        nozzle = np.concatenate([truth["nozzle"] for _, truth in parts]).astype(int)
        return np.flatnonzero(np.diff(nozzle))

    late = strokes("sticking_valve=40") - strokes()
    assert set(late) == {0, 40}
    assert 0.15 < np.mean(late == 40) < 0.5
    assert set(strokes("sticking_valve=40", "sticking_valve.stuck_strokes=100") - strokes()) == {40}


def test_a_leaking_blow_off_valve_feeds_the_port_also_without_vacuum():
    change = moved("blow_off_valve_leak=3")
    assert change[:ON].max() > 0.5  # a leak from ambient would do nothing
    assert change[OFF - 1] > 20.0
    low = {"ejector": STEADY.ejector.model_copy(update={"supply_bar": 3.0})}
    weaker = moved("blow_off_valve_leak=3", settings=STEADY.model_copy(update=low))
    assert weaker[:ON].max() < 0.8 * change[:ON].max()  # its flow follows the supply


def test_exhaust_fills_the_silencer_while_the_nozzle_runs():
    slow, fast = moved("filling_silencer=60"), moved("end_vacuum_loss=60")
    assert slow[ON + 200] < 0.3 * fast[ON + 200]
    assert slow[OFF - 1] == pytest.approx(fast[OFF - 1], rel=0.15)


def test_a_second_ejector_lowers_the_supply_in_its_own_rhythm():
    parts = list(with_truth(STEADY, 6, [parse_fault("second_ejector=0.8")]))
    healthy = list(with_truth(STEADY, 6))
    drop = np.concatenate(
        [
            clean["supply"] - less["supply"]
            for (_, less), (_, clean) in zip(parts, healthy, strict=True)
        ]
    )
    runs = (np.arange(6000) / 2900.0) % 1.0 < 0.4
    assert np.mean(drop[runs]) == pytest.approx(0.8e5, rel=0.05)
    assert np.mean(drop[~runs]) == pytest.approx(0.0, abs=0.02e5)


def test_moisture_comes_off_the_walls_until_they_are_dry():
    flow, leak = moved("adsorbed_moisture=3"), moved("porous_leakage=3")
    assert flow[ON + 500 : OFF].max() > 5.0
    assert flow[OFF - 1] < 0.5 * flow[ON:OFF].max()  # a leak goes on
    assert leak[OFF - 1] > 0.9 * leak[ON:OFF].max()
    again = flow[SECOND_ON : SECOND_ON + 3000].max()
    assert again == pytest.approx(flow[ON:OFF].max(), rel=0.2)  # ambient air renewed it


def test_a_sensor_drifts_as_it_warms_up_and_the_truth_does_not():
    with_drift, without = pressures("sensor_thermal_drift=30"), pressures()
    assert np.array_equal(with_drift[1], without[1])
    drift = (with_drift - without)[0]
    for row in (0, 5000, 10000):
        assert drift[row] == pytest.approx(30.0 * (1.0 - np.exp(-row / 15000.0)), abs=0.15)


def test_effects_add_up_and_stay_inside_their_bounds():
    assert trace("leakage=1", "leakage=2").tobytes() == trace("leakage=3").tobytes()
    assert (
        trace("suction_loss=90", "suction_loss=90").tobytes() == trace("suction_loss=95").tobytes()
    )


def test_a_step_acts_from_its_second_on():
    struck = np.flatnonzero(changed("sensor_offset=5@1.5"))
    assert struck[0] == 1500
    assert len(struck) == len(HEALTHY) - 1500


def test_a_step_acts_from_its_cycle_on():
    begins = np.flatnonzero(np.diff((HEALTHY["commands"] & 1).astype(int)) == 1) + 1
    struck = np.flatnonzero(changed("sensor_offset=5@c1"))
    assert struck[0] == begins[1]
    assert not changed("sensor_offset=5@c99").any()


def test_a_ramp_grows_linearly_after_its_start():
    difference = trace("sensor_offset=100@1/ramp:2")["pressure"] - HEALTHY["pressure"]
    assert difference[:1000] == pytest.approx(0, abs=0.1)
    assert difference[2000] / MBAR == pytest.approx(50, abs=0.2)
    assert difference[3000:] / MBAR == pytest.approx(100, abs=0.2)


def test_every_second_cycle_only():
    begins = np.flatnonzero(np.diff((HEALTHY["commands"] & 1).astype(int)) == 1) + 1
    struck = changed("sensor_offset=5/every:2")
    assert not struck[: begins[0]].any()
    assert struck[begins[0] : begins[1]].all()
    assert not struck[begins[1] : begins[2]].any()
    assert struck[begins[2] :].all()


def test_a_share_of_cycles_is_drawn_by_the_seed():
    struck = changed("sensor_offset=5/share:0.5", seconds=40)
    commands = trace(seconds=40)["commands"]
    begins = np.flatnonzero(np.diff((commands & 1).astype(int)) == 1) + 1
    whole = [struck[a:b].mean() for a, b in itertools.pairwise(begins)]
    assert set(whole) == {0.0, 1.0}
    assert 0.2 < np.mean(whole) < 0.8


@given(
    value=st.floats(0, 50, allow_nan=False),
    start=st.one_of(st.none(), st.floats(0, 1e6), st.integers(0, 10**6)),
    course=st.one_of(
        st.none(),
        st.tuples(st.just("ramp"), st.floats(0.001, 1e6)),
        st.tuples(st.just("every"), st.integers(1, 1000)),
        st.tuples(st.just("share"), st.floats(0, 1)),
    ),
)
def test_what_is_written_is_read(value, start, course):
    text = f"leakage={value!r}"
    wanted = {"effect": "leakage", "parameter": EFFECTS["leakage"].parameters[0], "value": value}
    if start is not None:
        text += f"@c{start}" if isinstance(start, int) else f"@{start!r}"
        wanted |= {"start_cycle" if isinstance(start, int) else "start_s": start}
    if course is not None:
        text += f"/{course[0]}:{course[1]!r}"
        wanted |= {"ramp_s" if course[0] == "ramp" else course[0]: course[1]}
    assert parse_fault(text) == Fault(**wanted)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "cannot be read"),
        ("leakage", "cannot be read"),
        ("leakage=", "cannot be read"),
        ("leakage=1@", "cannot be read"),
        ("leakage=1/ramp", "cannot be read"),
        ("leakage=much", "'much' is not a number"),
        ("leakage=nan", "out of bounds"),
        ("leakage=-1", "out of bounds"),
        ("leakage=1@-5", "out of bounds"),
        ("leakage=1@c1.5", "not a whole number"),
        ("leakage=1/every:0", "not a whole number"),
        ("leakage=1/share:2", "out of bounds"),
        ("leakage=1/often:2", "no course 'often'"),
        ("leak=1", "no effect 'leak'"),
        ("leakage.flow=1", "no parameter 'flow'"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_a_hint(text, complaint):
    with pytest.raises(ConfigError, match=complaint) as refused:
        parse_fault(text)
    assert refused.value.hint
