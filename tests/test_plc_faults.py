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
    assert len(EFFECTS) >= 19 + 4


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


@pytest.mark.parametrize("text", ["lip_lift.above=300", "supply_swing.period=0.5"])
def test_a_second_parameter_needs_the_first_and_changes_it(text):
    assert trace(text).tobytes() == HEALTHY.tobytes()
    size = {"lip_lift": "lip_lift=2", "supply_swing": "supply_swing=0.5"}[text.split(".")[0]]
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
