"""The scan task gives the same samples however it is called, and its ring loses none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.plc.faults import parse_fault
from drivers.plc.scan import DEPTH, PERIOD_NS, Task
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import EPOCH_NS, blocks, to_samples
from twin.quality import Quality
from twin.signals import MBAR, SAMPLE, Command

FAST = PlcSettings.model_validate(
    {
        "rig": {"vessel_ml": 125, "opens": True},
        "program": {"start_ms": 50, "suction_ms": 300, "blow_off_ms": 80, "idle_ms": 70},
    }
)
FAULTS = [parse_fault(t) for t in ("leakage=2@c1/share:0.5", "suction_loss=20@0.3/ramp:1")]
SCANS = 2000
WHOLE = np.concatenate(list(blocks(FAST, SCANS / 1000, FAULTS, seed=7, block=SCANS)))


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(1, 700), min_size=1, max_size=30))
def test_the_samples_do_not_depend_on_how_the_calls_are_chopped(parts):
    task = Task(FAST, FAULTS, seed=7)
    scans = [task.compute(n)[0] for n in parts]
    samples = to_samples(np.concatenate(scans))[:SCANS]
    assert samples.tobytes() == WHOLE[: len(samples)].tobytes()


def test_a_stall_of_the_host_is_caught_up_without_a_missing_scan():
    stalled, steady = Task(FAST, seed=3), Task(FAST, seed=3)
    stalled.advance_to(1)
    stalled.advance_to(6000)
    for now in range(10, 6001, 10):
        steady.advance_to(now)
    assert stalled.newest == steady.newest == 5999
    assert stalled.ring.tobytes() == steady.ring.tobytes()
    kept = np.sort(stalled.ring["sequence"])
    assert (kept == np.arange(6000 - DEPTH, 6000)).all()


def test_time_that_stands_still_computes_nothing():
    task = Task(FAST)
    task.advance_to(100)
    before = task.ring.tobytes()
    task.advance_to(100)
    task.advance_to(50)
    assert task.newest == 99
    assert task.ring.tobytes() == before


def test_seeds_differ_and_repeat():
    again = np.concatenate(list(blocks(FAST, SCANS / 1000, FAULTS, seed=7)))
    other = np.concatenate(list(blocks(FAST, SCANS / 1000, FAULTS, seed=8)))
    assert again.tobytes() == WHOLE.tobytes()
    assert (other["pressure"] != WHOLE["pressure"]).mean() > 0.5
    assert (other["commands"] != WHOLE["commands"]).any()  # the cycle's jitter


def test_blocks_are_samples_without_a_hole():
    given_blocks = list(blocks(FAST, 1.25, block=500))
    assert [len(b) for b in given_blocks] == [500, 500, 250]
    samples = np.concatenate(given_blocks)
    assert samples.dtype == SAMPLE
    assert (samples["sequence"] == np.arange(1250)).all()
    assert (samples["time_ns"] == EPOCH_NS + PERIOD_NS * samples["sequence"]).all()
    assert (samples["quality"] == 0).all()
    assert samples["supply"][0] == pytest.approx(5e5, abs=2000)
    assert samples["pressure"][0] == pytest.approx(1013 * MBAR, abs=2 * MBAR)


def test_readings_come_in_the_steps_of_the_input_card():
    coarse = PlcSettings.model_validate({"sensor": {"step_mbar": 0.5}})
    pressure = np.concatenate(list(blocks(coarse, 2)))["pressure"].astype(float) / MBAR
    assert pressure * 2 == pytest.approx(np.rint(pressure * 2), abs=1e-3)
    assert len(np.unique(np.rint(pressure * 2))) > 100


def test_beyond_its_range_the_input_card_says_so():
    narrow = PlcSettings.model_validate({"sensor": {"full_scale_mbar": 1050}})
    samples = np.concatenate(list(blocks(narrow, 3.2)))
    over = samples["quality"] == Quality.OVERFLOW
    assert over.any()
    assert samples["pressure"][over] == pytest.approx(1050 * MBAR)
    assert not (samples["commands"][over] & Command.SUCTION).any()


def test_commands_follow_the_program_with_its_jitter():
    commands = np.concatenate(list(blocks(FAST, 60)))["commands"]
    edges = np.flatnonzero(np.diff(commands.astype(int))) + 1
    durations = np.diff(edges)
    assert edges[0] == 50
    assert [int(c) for c in commands[edges[:4]]] == [1, 2, 0, 1]
    assert durations[0:-2:3].mean() == pytest.approx(300, abs=3)
    assert durations[0:-2:3].std() == pytest.approx(5, abs=1.5)


def test_coils_command_the_rig_from_the_next_scan_on():
    coils = PlcSettings.model_validate({"program": {"commands": "coils"}})
    task = Task(coils, [parse_fault("sensor_offset=50@c0")])
    quiet, _ = task.compute(500)
    task.coils = Command.SUCTION
    sucking, _ = task.compute(500)
    assert (quiet["status"] == 0).all()
    assert (sucking["status"] == Command.SUCTION).all()
    assert sucking["pressure"][0] - quiet["pressure"][0] > 45  # the cycle began, and with it c0
    assert sucking["pressure"][-1] < 800
