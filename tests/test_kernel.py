"""The compiled path: valves, silences, synchronisation, and the same bits however it is called."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
import rigs
from hypothesis import given, settings
from hypothesis import strategies as st
from stepping import MASSES, PRESSURES, advance, temperature

from twin.model import kernel
from twin.model import theta as c
from twin.model.air import GAMMA
from twin.model.theta import Theta
from twin.quality import BREAK, Quality
from twin.signals import MBAR, MS, SAMPLE, Command, Phase, Samples

Rows = npt.NDArray[np.float64]
IDLE, SUCTION, HOLD, BLOW_OFF = Phase
compiling = settings(deadline=None)  # the first example may have to compile


def crisp(name: str = "test_rig") -> Theta:
    """A tank without line and leak, so that only the ejector moves its pressure."""
    theta = rigs.theta(name)
    theta[[c.RESISTANCE, c.LAMINAR, c.LEAK, c.FILM, c.PORT_HEAT, c.LINE_HEAT]] = 0.0
    theta[c.RELEASE] = np.nan
    return theta


# Valves.


def test_nothing_moves_before_the_response() -> None:
    theta = crisp()
    theta[c.RESPONSE] = 20 * MS
    expected = advance(theta, [(SUCTION, 100)])
    assert expected[:21] == pytest.approx(expected[0], abs=1e-6)
    assert expected[22] < expected[0] - 1e-3


@pytest.mark.parametrize("ms", [5, 14])
def test_a_pulse_shorter_than_the_response_is_not_acted_on(ms: int) -> None:
    theta = crisp()
    theta[[c.RESPONSE, c.BLOW_OFF_RESPONSE]] = 15 * MS
    for phase in (SUCTION, BLOW_OFF):
        expected = advance(theta, [(IDLE, 5), (phase, ms), (IDLE, 100)])
        assert expected == pytest.approx(expected[0], abs=1e-6)


def test_a_pulse_longer_than_the_response_is() -> None:
    theta = crisp()
    theta[c.RESPONSE] = 15 * MS
    expected = advance(theta, [(IDLE, 5), (SUCTION, 20), (IDLE, 100)])
    assert expected[-1] < expected[0] - 1 * MBAR


@compiling
@given(st.floats(0.0, 40.0))
def test_a_response_may_end_between_two_samples(delay: float) -> None:
    """Each ms of delay takes away a ms of full suction in the end, fractions included."""
    theta = crisp()
    theta[c.SUCTION] *= 1e-3  # so small that it pulls evenly
    drops = []
    for theta[c.RESPONSE] in (delay * MS, 0.0):
        expected = advance(theta, [(SUCTION, 500)])
        drops.append(expected[-101] - expected[-1])
        drops.append(expected[0] - expected[-1])
    slope = drops[2] / 100  # Pa per ms
    assert drops[3] - drops[1] == pytest.approx(delay * slope, abs=2e-3 * 500 * slope)


def test_hold_seen_in_the_pressure_needs_no_response() -> None:
    """The breakpoint is where the valve has acted already; a command is only where it will."""
    theta = crisp()
    theta[c.RESPONSE_OFF], theta[c.RAMP_DOWN] = 50 * MS, 1 * MS
    seen = advance(theta, [(SUCTION, 500), (HOLD, 40)])
    assert seen[520] == pytest.approx(seen[539], abs=1.0)
    commanded = advance(theta, [(SUCTION, 500), (IDLE, 40)])
    assert commanded[520] > commanded[539] + 5 * MBAR


# Silences and synchronisation.


def test_before_the_first_sync_nothing_is_expected() -> None:
    theta = crisp()
    expected = advance(theta, [(IDLE, 50)], kernel.new_state(), {30: 0.9e5})
    assert np.isnan(expected[:30]).all()
    assert expected[30:] == pytest.approx(0.9e5)


@pytest.mark.parametrize("silence", [-1.0, 0.101, 3.0])
def test_after_a_break_nothing_is_expected_until_the_next_sync(silence: float) -> None:
    theta = crisp()
    dt = np.full(100, MS)
    dt[40] = silence
    expected = advance(theta, [(IDLE, 100)], levels={70: 0.8e5}, dt=dt)
    assert np.isfinite(expected[:40]).all()
    assert np.isnan(expected[40:70]).all()
    assert expected[70:] == pytest.approx(0.8e5)


@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_short_silence_is_bridged_with_its_real_length(name: str) -> None:
    theta = rigs.theta(name)
    whole = advance(theta, [(SUCTION, 400)])
    dt = np.full(301, MS)
    dt[201] = 100 * MS  # rows 201 to 299 of ``whole`` are missing
    gapped = advance(theta, [(SUCTION, 301)], dt=dt)
    assert gapped[:201].tolist() == whole[:201].tolist()
    assert gapped[201:] == pytest.approx(whole[300:], abs=0.1)


def test_a_slow_stream_is_stepped_as_well_as_a_quick_one() -> None:
    theta = rigs.theta("test_rig")
    quick = advance(theta, [(SUCTION, 801)])
    dt = np.full(81, 10 * MS)
    dt[0] = MS
    slow = advance(theta, [(SUCTION, 81)], dt=dt)
    assert slow == pytest.approx(quick[::10], abs=0.5)


@compiling
@given(st.floats(0.3e5, 1.1e5))
def test_a_sync_sets_what_the_sensor_reads(level: float) -> None:
    theta = crisp()
    theta[c.SENSOR_OFFSET], theta[c.SENSOR_GAIN] = 5 * MBAR, 1.02
    expected = advance(theta, [(IDLE, 10)], levels={5: level})
    assert expected[5] == pytest.approx(level, abs=1e-6)


@pytest.mark.parametrize("level", [1.0e5, 0.95e5])
def test_an_open_cup_is_at_ambient_whatever_is_read(level: float) -> None:
    theta = rigs.theta("gripper")
    theta[c.SENSOR_OFFSET] = 7 * MBAR
    expected = advance(theta, [(IDLE, 10)], kernel.new_state(), {0: level})
    assert expected == pytest.approx(theta[c.AMBIENT] + 7 * MBAR)


def test_a_sync_in_hold_keeps_the_gas_temperature_and_shifts_the_pressures() -> None:
    theta = rigs.theta("test_rig")
    state = kernel.at_rest(theta)
    advance(theta, [(SUCTION, 900)], state)
    before = state.copy()
    level = before[kernel.SENSED] + 3 * MBAR
    advance(theta, [(HOLD, 1)], state, {0: level}, dt=np.zeros(1))
    assert temperature(theta, state) == pytest.approx(temperature(theta, before), rel=1e-12)
    assert temperature(theta, state) < theta[c.TEMPERATURE]
    assert state[PRESSURES] - before[PRESSURES] == pytest.approx(3 * MBAR)


@pytest.mark.parametrize("valve", [kernel.NOZZLE, kernel.BLOW])
def test_the_first_sync_finds_the_valves_where_they_are_commanded(valve: int) -> None:
    theta = crisp()
    phase = SUCTION if valve == kernel.NOZZLE else BLOW_OFF
    state = kernel.new_state()
    advance(theta, [(phase, 10)], state, {9: 0.6e5})
    assert state[valve] == 1.0
    assert state[kernel.JET if valve == kernel.NOZZLE else kernel.BLOWING] == 1.0


def test_room_that_is_added_comes_with_gas_of_its_own() -> None:
    theta = rigs.theta("test_rig")
    state = kernel.at_rest(theta)
    advance(theta, [(SUCTION, 500)], state)
    after = theta.copy()
    after[c.VOLUME] += 50e-6
    before = state.copy()
    kernel.take_over(state, theta, after)
    assert state[PRESSURES].tolist() == before[PRESSURES].tolist()
    assert temperature(after, state) == pytest.approx(temperature(theta, before))
    assert state[MASSES[:2]].tolist() == before[MASSES[:2]].tolist()


def test_a_wall_that_gives_way_squeezes_the_gas() -> None:
    theta = rigs.theta("gripper")
    state = kernel.at_rest(theta)
    advance(theta, [(SUCTION, 400)], state)
    after = theta.copy()
    after[c.COMPLIANCE] += 30e-6
    before = state.copy()
    kernel.take_over(state, theta, after)
    assert state[MASSES].tolist() == before[MASSES].tolist()
    pressure = state[kernel.VESSEL] / before[kernel.VESSEL]
    room = (
        after[c.VOLUME] - after[c.COMPLIANCE] * (1.0 - state[kernel.VESSEL] / after[c.AMBIENT])
    ) / theta[c.VOLUME]
    assert pressure > 1.1
    assert pressure * room**GAMMA == pytest.approx(1.0, abs=1e-9)
    kernel.take_over(state, after, theta)
    assert state == pytest.approx(before)


# A gripper's part.


def test_blow_off_lets_the_part_go_and_the_next_suction_brings_one() -> None:
    theta = rigs.theta("gripper")
    state = kernel.at_rest(theta)
    assert state[kernel.OPEN] == 1.0
    advance(theta, [(SUCTION, 500)], state)
    assert state[kernel.OPEN] == 0.0
    expected = advance(theta, [(BLOW_OFF, 400), (IDLE, 300)], state)
    assert state[kernel.OPEN] == 1.0
    assert expected[-1] == pytest.approx(theta[c.AMBIENT], abs=20.0)  # the hose still swings


def test_a_tank_stays_closed() -> None:
    theta = rigs.theta("test_rig")
    state = kernel.at_rest(theta)
    expected = advance(theta, [(SUCTION, 500), (BLOW_OFF, 300), (IDLE, 300)], state)
    assert state[kernel.OPEN] == 0.0
    assert expected[800] > expected[-1] + 20 * MBAR  # the compressed gas cools down again
    assert expected[-1] < theta[c.AMBIENT] - 1 * MBAR


# Running free.


def free(theta: Theta, *steps: tuple[int, int]) -> tuple[npt.NDArray[np.uint8], Rows]:
    commands = np.concatenate([np.full(rows, value, "u1") for value, rows in steps])
    phase, expected = np.empty(len(commands), "u1"), np.empty(len(commands))
    dt = np.full(len(commands), MS)
    kernel.simulate(kernel.at_rest(theta), theta, dt, commands, phase, expected)
    return phase, expected


def test_the_models_own_air_saving_keeps_between_its_levels() -> None:
    theta = rigs.theta("gripper")
    theta[c.LEAK] *= 5
    theta[c.CONTROL_SENSOR] = c.PLC
    phase, expected = free(theta, (Command.SUCTION, 4000))
    vacuum = theta[c.AMBIENT] - expected
    off = np.flatnonzero((phase[1:] == HOLD) & (phase[:-1] == SUCTION)) + 1
    on = np.flatnonzero((phase[1:] == SUCTION) & (phase[:-1] == HOLD)) + 1
    assert len(off) > 1
    assert len(on) > 1
    assert (vacuum[off] >= theta[c.H1]).all()
    assert (vacuum[off - 1] < theta[c.H1]).all()
    assert (vacuum[on] < theta[c.H1_LOW]).all()
    assert (vacuum[on - 1] >= theta[c.H1_LOW]).all()


@pytest.mark.slow
@pytest.mark.parametrize("mode", [c.EXTERNAL, c.INTERNAL, c.TIMED])
@pytest.mark.parametrize("hypotheses", [1, 3])
@settings(deadline=None, max_examples=15)
@given(cuts=st.sets(st.integers(1, 3699), max_size=6))
def test_a_free_run_goes_on_to_the_bit_wherever_it_is_cut(
    hypotheses: int, mode: int, cuts: set[int]
) -> None:
    """Switchings, the switches before them and a timed pulse fall on either side of a cut."""
    theta = np.stack([rigs.theta("gripper")] * hypotheses, axis=1)
    theta[c.LEAK] *= 5.0 + np.arange(hypotheses)  # it protects its valve within three seconds
    theta[c.H1_LOW] = theta[c.H1] - 20 * MBAR
    theta[[c.BLOW_OFF_MODE, c.BLOW_OFF_TIME]] = np.array([[mode], [0.2]])
    commands = np.repeat(np.array([0, 1, 2, 0, 1], "u1"), [100, 2600, 100, 300, 600])

    def run(pieces: Sequence[int]) -> bytes:
        state, control = kernel.at_rest(theta), kernel.Control.anew(hypotheses)
        phase, expected, signals = (
            np.empty((3700, hypotheses), kind) for kind in ("u1", "f8", "u1")
        )
        for rows in (slice(*ends) for ends in pairwise([0, *pieces, 3700])):
            dt, out = np.full(len(commands[rows]), MS), (phase[rows], expected[rows], signals[rows])
            kernel.run_on(state, control, theta, dt, commands[rows], out)
        assert len(np.flatnonzero(np.diff(phase[:, 0].astype(int)))) > 8
        return phase.tobytes() + expected.tobytes() + signals.tobytes()

    assert run(sorted(cuts)) == run([])


def test_many_run_free_as_each_does_alone() -> None:
    thetas = [rigs.theta("gripper") for _ in range(3)]
    for number, theta in enumerate(thetas):
        theta[c.H1] -= number * 40 * MBAR
    commands, dt = np.full(1500, Command.SUCTION, "u1"), np.full(1500, MS)
    together = np.stack(thetas, axis=1)
    phase, expected = np.empty((1500, 3), "u1"), np.empty((1500, 3))
    kernel.simulate(kernel.at_rest(together), together, dt, commands, phase, expected)
    for number, theta in enumerate(thetas):
        alone = free(theta, (Command.SUCTION, 1500))
        assert phase[:, number].tolist() == alone[0].tolist()
        # Pa; a valve acts somewhere within one of the finest steps, which are shared
        assert expected[:, number] == pytest.approx(alone[1], abs=5.0)


def test_each_of_many_may_have_phases_of_its_own() -> None:
    theta = rigs.theta("test_rig")
    phase = np.full((800, 2), SUCTION, "u1")
    phase[500:, 1] = HOLD
    level = np.full(800, np.nan)
    level[0] = theta[c.AMBIENT]
    dt, expected = np.full(800, MS), np.empty((800, 2))
    both = np.stack([theta, theta], axis=1)
    kernel.advance(kernel.new_state(2), both, dt, phase, level, expected)
    for column in range(2):
        alone = np.empty(800)
        kernel.advance(kernel.new_state(), theta, dt, phase[:, column].copy(), level, alone)
        assert expected[:, column] == pytest.approx(alone, abs=0.5)
    assert expected[-1, 1] > expected[-1, 0] + 10 * MBAR


def test_blow_off_wins_over_suction() -> None:
    both = Command.SUCTION | Command.BLOW_OFF
    phase, expected = free(rigs.theta("test_rig"), (both, 300))
    assert (phase == BLOW_OFF).all()
    assert expected[-1] > expected[0]


# The same to the last bit, whoever cuts the blocks.


@compiling
@given(st.lists(st.integers(1, 600), max_size=6))
def test_the_kernel_does_not_see_where_blocks_end(cuts: list[int]) -> None:
    theta = rigs.theta("test_rig")
    theta[[c.RESPONSE, c.BLOW_OFF_RESPONSE]] = [12.34 * MS, 10.01 * MS]
    phases = [(IDLE, 30), (SUCTION, 300), (HOLD, 90), (BLOW_OFF, 100), (IDLE, 80)]
    whole = advance(theta, phases)
    phase = np.concatenate([np.full(rows, value, "u1") for value, rows in phases])
    state, parts = kernel.at_rest(theta), []
    for part in np.split(phase, sorted(cuts)):
        parts += [advance(theta, [(Phase(value), 1) for value in part], state)] if len(part) else []
    assert np.concatenate(parts).tobytes() == whole.tobytes()


def troubled(seed: int) -> Samples:
    """A recording with breaks, silences, jitter and unreadable rows strewn in."""
    rng = np.random.default_rng(seed)
    samples = rigs.recorded("gripper", 6.0)[0].copy()
    kept = np.ones(len(samples), bool)
    for start in rng.integers(0, len(samples), 4):
        kept[start : start + rng.integers(1, 250)] = False
    lost = np.flatnonzero(np.diff(kept.astype(int)) == 1) + 1
    samples["quality"][lost[: len(lost) // 2]] |= Quality.GAP.value
    samples["time_ns"] += rng.integers(0, 300_000, len(samples))
    for flag in (Quality.RESTART, Quality.CLOCK, Quality.OVERFLOW, Quality.BAD):
        samples["quality"][rng.integers(0, len(samples), 2)] |= flag.value
    samples["pressure"][(samples["quality"] & Quality.BAD) != 0] = np.nan
    return samples[kept]


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000), st.lists(st.integers(0, 6000), max_size=30), st.integers(5, 3000))
def test_the_twin_does_not_see_where_blocks_end(seed: int, cuts: list[int], size: int) -> None:
    samples = troubled(seed)
    whole = rigs.expectation(rigs.twin("gripper"), [samples])
    for blocks in (np.split(samples, sorted(cuts)), rigs.cut(samples, size)):
        found = rigs.expectation(rigs.twin("gripper"), blocks)
        assert [part.tobytes() for part in found] == [part.tobytes() for part in whole]


def test_the_twin_gives_every_row_once_and_in_order() -> None:
    samples = troubled(3)
    given_out, ticks = rigs.expectation(rigs.twin("gripper"), rigs.cut(samples, 30))
    assert given_out.tobytes() == samples.tobytes()
    assert given_out.dtype == SAMPLE
    assert len(ticks) == len(samples)


def test_the_twin_is_behind_only_in_suction() -> None:
    twin = rigs.twin("gripper")
    samples, _ = rigs.recorded("gripper", 6.0)
    row = int(np.flatnonzero(samples["commands"] == Command.SUCTION)[-1])
    given_out, _ = twin.advance(samples[:row])
    assert 0 < row - len(given_out) <= twin.detector.lag < 100
    given_out = np.concatenate([given_out, twin.advance(samples[row : row + 2])[0]])
    assert len(given_out) == row + 2


def test_the_twin_expects_nothing_from_a_break_to_the_next_sync() -> None:
    samples = rigs.recorded("test_rig", 10.0)[0].copy()
    in_suction = int(np.flatnonzero(samples["commands"] == Command.SUCTION)[300])
    samples["quality"][in_suction] |= Quality.GAP.value
    given_out, ticks = rigs.expectation(rigs.twin("test_rig"), [samples])
    assert (given_out["quality"][in_suction] & BREAK) != 0
    assert np.isfinite(ticks["expected"][in_suction - 1])
    first_sync = in_suction + int(np.flatnonzero(np.isfinite(ticks["level"][in_suction:]))[0])
    assert first_sync > in_suction
    assert np.isnan(ticks["expected"][in_suction:first_sync]).all()
    assert np.isfinite(ticks["expected"][first_sync:]).all()
