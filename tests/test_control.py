"""The field's modes: air saving with its safeguards, and blow-off's timed pulses."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest
import rigs
from hypothesis import given, settings
from hypothesis import strategies as st
from stepping import Rows, standing, switched_on

from twin.model import kernel
from twin.model import theta as c
from twin.model.control import (
    CONTINUOUS,
    effective_commands,
    new_timer,
    nothing_done,
    switch,
)
from twin.model.safeguards import LEAK_SETTLE_S, PROTECTED_S, PROTECTED_SWITCHES
from twin.model.theta import Theta
from twin.signals import MBAR, MS, Command, Phase, Signal

SUCTION, BLOW_OFF, BOTH = 1, 2, 3
COMMANDS = st.lists(st.tuples(st.integers(0, 3), st.integers(1, 400)), min_size=1, max_size=12)
Bytes = npt.NDArray[np.uint8]
compiling = settings(deadline=None)  # the first example may have to compile


def rows(commands: Sequence[tuple[int, int]]) -> Bytes:
    return np.concatenate([np.full(many, command, "u1") for command, many in commands])


# Blow-off.


def told(commands: Bytes, mode: int, duration: float = 0.2, blocks: int = 1) -> Bytes:
    timer, effective = new_timer(), np.empty_like(commands)
    for part in np.array_split(np.arange(len(commands)), blocks):
        found = np.empty(len(part), "u1")
        effective_commands(timer, commands[part], np.full(len(part), MS), mode, duration, found)
        effective[part] = found
    return effective


@compiling
@given(COMMANDS)
def test_external_blow_off_is_what_is_commanded(commands: list[tuple[int, int]]) -> None:
    given_in = rows(commands)
    assert told(given_in, c.EXTERNAL).tolist() == given_in.tolist()


@pytest.mark.parametrize("ms", [100, 250])
def test_internal_blow_off_is_a_pulse_after_suction(ms: int) -> None:
    found = told(rows([(0, 50), (SUCTION, 300), (0, 500)]), c.INTERNAL, ms * MS)
    assert np.flatnonzero(found & BLOW_OFF).tolist() == list(range(350, 350 + ms))
    assert (found[50:350] == SUCTION).all()


@compiling
@given(COMMANDS, st.integers(100, 400))
def test_internal_pulses_have_their_length(commands: list[tuple[int, int]], ms: int) -> None:
    """From each end of suction on, and no others; a command from outside still counts."""
    given_in = rows(commands)
    pulse = np.zeros(len(given_in), bool)
    for end in np.flatnonzero((given_in[:-1] & SUCTION > 0) & (given_in[1:] & SUCTION == 0)):
        pulse[end + 1 : end + 1 + ms] = True
    found = told(given_in, c.INTERNAL, ms * MS)
    assert ((found & BLOW_OFF) > 0).tolist() == (pulse | (given_in & BLOW_OFF > 0)).tolist()


@compiling
@given(COMMANDS, st.integers(100, 400))
def test_timed_pulses_begin_with_the_command_and_have_their_length(
    commands: list[tuple[int, int]], ms: int
) -> None:
    given_in = rows(commands)
    pulse = np.zeros(len(given_in), bool)
    before = np.concatenate(([0], given_in[:-1]))
    for start in np.flatnonzero((given_in & BLOW_OFF > 0) & (before & BLOW_OFF == 0)):
        pulse[start : start + ms] = True  # however long it is commanded
    found = told(given_in, c.TIMED, ms * MS)
    assert ((found & BLOW_OFF) > 0).tolist() == pulse.tolist()
    assert (found & SUCTION).tolist() == (given_in & SUCTION).tolist()


@compiling
@given(COMMANDS, st.sampled_from([c.EXTERNAL, c.INTERNAL, c.TIMED]), st.integers(1, 9))
def test_the_timer_does_not_see_where_blocks_end(
    commands: list[tuple[int, int]], mode: int, blocks: int
) -> None:
    given_in = rows(commands)
    assert told(given_in, mode, blocks=blocks).tolist() == told(given_in, mode).tolist()


@pytest.mark.parametrize("mode", [c.EXTERNAL, c.INTERNAL, c.TIMED])
@compiling
@given(commands=COMMANDS)
def test_blow_off_wins_over_suction(mode: int, commands: list[tuple[int, int]]) -> None:
    theta = rigs.theta("test_rig")
    theta[[c.BLOW_OFF_MODE, c.BLOW_OFF_TIME]] = mode, 0.2
    given_in = rows(commands)
    phase = np.empty_like(given_in)
    dt, expected = np.full(len(given_in), MS), np.empty(len(given_in))
    kernel.simulate(kernel.at_rest(theta), theta, dt, given_in, phase, expected)
    found = told(given_in, mode)
    assert ((phase == Phase.BLOW_OFF) == (found & BLOW_OFF > 0)).all()
    assert (np.isin(phase, [Phase.SUCTION, Phase.HOLD]) == (found == SUCTION)).all()


# Air saving.


def saving(mode: int) -> Theta:
    theta = rigs.theta("test_rig")
    theta[[c.H1, c.H1_LOW]] = 750 * MBAR, 600 * MBAR
    theta[[c.AIR_SAVING, c.PERMITTED_LEAKAGE]] = mode, 250 * MBAR
    return theta


def nozzle(
    theta: Theta, vacuum: Sequence[float], dt: float, state: Rows | None = None
) -> list[bool]:
    """Whether the nozzle is on, asked every ``dt`` with suction commanded; vacuum in mbar."""
    state = nothing_done() if state is None else state
    k = theta.reshape(-1, 1)
    return [bool(switch(state, True, mbar * MBAR, dt, k, 0)) for mbar in vacuum]


@compiling
@given(st.lists(st.floats(0.0, 900.0), min_size=1, max_size=50))
def test_off_means_the_nozzle_stays_on(vacuum: list[float]) -> None:
    assert all(nozzle(saving(c.OFF), vacuum, 0.1))


@compiling
@given(st.lists(st.floats(0.0, 900.0), min_size=1, max_size=50))
def test_between_its_points_the_nozzle_stays_as_it_is(vacuum: list[float]) -> None:
    on = True
    for mbar, found in zip(vacuum, nozzle(saving(c.ON), vacuum, 10.0), strict=True):
        on = mbar < 750.0 and (on or mbar < 600.0)
        assert found == on


def test_what_is_not_asked_for_is_off_and_begins_anew() -> None:
    state, k = nothing_done(), saving(c.ON).reshape(-1, 1)
    state[CONTINUOUS] = 1.0
    assert not switch(state, False, 800 * MBAR, MS, k, 0)
    assert state[CONTINUOUS] == 0.0
    assert switch(state, True, 700 * MBAR, MS, k, 0)


SWINGS = [800.0, 500.0] * 10  # off and on again


@pytest.mark.parametrize("mode", [c.ON, c.LEAK_MONITORING])
def test_too_frequent_switching_ends_in_continuous_suction(mode: int) -> None:
    """The seventh switching within 3 s is one too many."""
    found = nozzle(saving(mode), SWINGS, 0.4)
    assert found[:PROTECTED_SWITCHES] == [False, True] * (PROTECTED_SWITCHES // 2)
    assert all(found[PROTECTED_SWITCHES:])


@compiling
@given(st.floats(PROTECTED_S / PROTECTED_SWITCHES * 1.01, 10.0))
def test_slow_switching_goes_on(dt: float) -> None:
    assert nozzle(saving(c.ON), SWINGS, dt) == [False, True] * 10


def test_without_continuous_suction_it_never_gives_up() -> None:
    assert nozzle(saving(c.WITHOUT_CONTINUOUS), SWINGS, 0.01) == [False, True] * 10


@compiling
@given(st.floats(1.0, 1000.0))
def test_leak_monitoring_gives_up_where_vacuum_falls_too_quickly(rate: float) -> None:
    seconds = np.arange(0.0, 0.14, 0.01)
    falling = np.maximum(751.0 - rate * seconds, 610.0)
    found = nozzle(saving(c.LEAK_MONITORING), falling.tolist(), 0.01)
    given_up = any(found)
    if abs(rate - 250.0) > 1.0:
        assert given_up == (rate > 250.0)
    assert not any(found[: int(LEAK_SETTLE_S / 0.01)])  # not judged at once
    assert not any(nozzle(saving(c.ON), falling.tolist(), 0.01))


def test_a_vessel_that_leaks_is_sucked_continuously_in_the_end() -> None:
    """Over the whole model: air saving with leak monitoring against a leak it cannot hold."""
    theta = saving(c.LEAK_MONITORING)
    theta[[c.H1, c.H1_LOW]] = 700 * MBAR, 550 * MBAR
    theta[c.LEAK] *= 10.0
    commands = np.full(3000, Command.SUCTION, "u1")
    phase, expected = np.empty_like(commands), np.empty(3000)
    theta[c.PERMITTED_LEAKAGE] = 40 * MBAR
    kernel.simulate(kernel.at_rest(theta), theta, np.full(3000, MS), commands, phase, expected)
    off = np.flatnonzero(phase == Phase.HOLD)
    assert 1 <= len(off) < 200
    assert (phase[off[-1] + 1 :] == Phase.SUCTION).all()


# The signals handed out.


@pytest.mark.parametrize("name", rigs.NAMES)
def test_signals_come_and_go_at_their_points_with_hysteresis(name: str) -> None:
    theta = rigs.theta(name)
    phase = rows([(Phase.SUCTION, 2500), (Phase.HOLD, 50), (Phase.BLOW_OFF, 300)])
    level, dt = np.full(len(phase), np.nan), np.full(len(phase), MS)
    state, port, signals = kernel.at_rest(theta), [], np.empty(len(phase), "u1")
    for row in range(len(phase)):
        at, out = slice(row, row + 1), signals[row : row + 1]
        kernel.advance(state, theta, dt[at], phase[at], level[at], np.empty(1), out)
        port.append(state[kernel.PORT])
    vacuum = theta[c.AMBIENT] - np.array(port)
    for signal, high, low in (
        (Signal.PART_PRESENT, c.H2, c.H2_LOW),
        (Signal.AIR_SAVING, c.H1, c.H1_LOW),
    ):
        on = (signals & signal) > 0
        come, gone = np.flatnonzero(on)[[0, -1]]
        assert on[come : gone + 1].all()
        assert vacuum[come] >= theta[high] > vacuum[come - 1]
        assert vacuum[gone] >= theta[low] > vacuum[gone + 1]


def test_signals_are_each_hypothesis_own() -> None:
    theta = rigs.theta("test_rig")
    thetas = np.stack([theta, theta], axis=1)
    thetas[c.H2, 1] = 700 * MBAR
    state = np.stack([switched_on(standing(theta, theta[c.AMBIENT] - 600 * MBAR))] * 2, axis=1)
    signals = np.empty((1, 2), "u1")
    one, phase = np.full(1, MS), np.full(1, Phase.SUCTION, "u1")
    kernel.advance(state, thetas, one, phase, np.full(1, np.nan), np.empty((1, 2)), signals)
    assert signals.tolist() == [[Signal.PART_PRESENT, 0]]


@pytest.mark.parametrize("silence", [-1.0, 3.0])
def test_what_waits_for_a_sync_hands_out_nothing(silence: float) -> None:
    """Before the first one no pressure is known, and after a break none any more."""
    theta = rigs.theta("test_rig")
    inside = theta[c.AMBIENT] - (theta[c.H2] + theta[c.H2_LOW]) / 2.0  # kept only if it was there
    dt, phase = np.full(60, MS), np.full(60, Phase.IDLE, "u1")
    level, signals = np.full(60, np.nan), np.empty(60, "u1")
    dt[40], level[20], level[30] = silence, theta[c.AMBIENT] - 600.0 * MBAR, inside
    level[50] = inside
    kernel.advance(kernel.new_state(), theta, dt, phase, level, np.empty(60), signals)
    on = (signals & Signal.PART_PRESENT) > 0
    assert (np.flatnonzero(on) == np.arange(20, 40)).all()
    assert not (signals & Signal.AIR_SAVING).any()
