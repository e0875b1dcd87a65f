"""DenseSolver: near the exact solution, and the same however they are cut."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
import radau
import rigs
from hypothesis import given, settings
from hypothesis import strategies as st
from stepping import phase_rows
from test_numerics import between_samples, cycle_of, moves_of

from twin.model import dense_solver, kernel
from twin.model import theta as c
from twin.model.dense_solver import DenseSolver
from twin.model.theta import Theta
from twin.signals import MBAR, MS, Phase, Signal

Rows = npt.NDArray[np.float64]
Signals = npt.NDArray[np.uint8]
IDLE, SUCTION, HOLD, BLOW_OFF = Phase
PHASES = [(IDLE, 30), (SUCTION, 300), (HOLD, 90), (SUCTION, 60), (BLOW_OFF, 100), (IDLE, 220)]
ROWS = sum(rows for _, rows in PHASES)
few = settings(max_examples=25, deadline=None)


def stream(theta: Theta, seed: int) -> tuple[Rows, Signals, Rows]:
    """Rows as a PLC gives them: jitter, short gaps, one break, and levels to be set on."""
    rng = np.random.default_rng(seed)
    dt = rng.uniform(0.7, 1.3, ROWS) * MS
    dt[rng.integers(0, ROWS, 6)] = rng.uniform(2.0, 40.0, 6) * MS
    dt[rng.integers(0, ROWS, 3)] = 0.0
    dt[rng.integers(400, ROWS)] = rng.choice([-1.0, 0.5])
    level = np.full(ROWS, np.nan)
    at = rng.integers(0, ROWS, 5)
    level[at] = theta[c.AMBIENT] - rng.uniform(0.0, 500.0, 5) * MBAR
    return dt, phase_rows(PHASES), level


def read(
    model: DenseSolver, theta: Theta, driven: tuple[Rows, Signals, Rows], cuts: Sequence[int] = ()
) -> tuple[Rows, Signals]:
    dt, phase, level = driven
    expected, signals = np.empty(len(dt)), np.empty(len(dt), "u1")
    for rows in (slice(*ends) for ends in pairwise([0, *cuts, len(dt)])):
        out = expected[rows], signals[rows]
        dense_solver.advance(model, theta, dt[rows], phase[rows], level[rows], *out)
    return expected, signals


@pytest.mark.slow
@pytest.mark.parametrize("soft_and_late", [False, True])
@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_whole_cycle_is_within_half_a_pascal_of_the_exact_solution(
    name: str, soft_and_late: bool
) -> None:
    theta = between_samples(name, soft_and_late)
    phases = cycle_of(name)
    phase = phase_rows(phases)
    driven = np.full(len(phase), MS), phase, np.full(len(phase), np.nan)
    expected, _ = read(DenseSolver.at_rest(theta), theta, driven)
    exact = radau.reference(theta, moves_of(theta, phases), (np.arange(len(phase)) + 1) * MS)
    assert np.abs(expected - exact[:, kernel.SENSED]).max() < 0.5


def finely(theta: Theta, driven: tuple[Rows, Signals, Rows], parts: int = 20) -> Rows:
    """What the kernel reads if each row is done in many parts."""
    dt, phase, level = driven
    bridged = np.repeat((dt >= 0.0) & (dt <= kernel.LONGEST_BRIDGE), parts)
    first, last = (np.arange(len(bridged)) % parts == part for part in (0, parts - 1))
    fine = np.where(bridged, np.repeat(dt / parts, parts), np.where(first, np.repeat(dt, parts), 0))
    phases = np.repeat(np.concatenate([[IDLE], phase[:-1]]).astype("u1"), parts)
    phases[last] = phase
    levels, expected = np.full(len(fine), np.nan), np.empty(len(fine))
    levels[last] = level
    kernel.advance(kernel.new_state(), theta, fine, phases, levels, expected, tolerance=1e-3)
    return expected[last]


@few
@given(st.integers(0, 10_000), st.sampled_from(rigs.NAMES))
def test_a_troubled_stream_is_read_as_finer_rows_would_be(seed: int, name: str) -> None:
    """Also where valves move between rows that are far apart, and where levels do not fit.

    Shifted by hundreds of millibar while it draws, a hose swings: then it is a quarter of one off.
    """
    theta = rigs.theta(name)
    driven = stream(theta, seed)
    expected, exact = read(DenseSolver(), theta, driven)[0], finely(theta, driven)
    assert (np.isnan(expected) == np.isnan(exact)).all()
    assert np.nanmax(np.abs(expected - exact), initial=0.0) < 0.5 * MBAR


@few
@given(st.integers(0, 10_000), st.sets(st.integers(1, ROWS - 1), max_size=40))
def test_strides_do_not_see_where_blocks_end(seed: int, cuts: set[int]) -> None:
    theta = rigs.theta("gripper")
    driven = stream(theta, seed)
    whole = read(DenseSolver(), theta, driven)
    pieces = read(DenseSolver(), theta, driven, sorted(cuts))
    assert [array.tobytes() for array in whole] == [array.tobytes() for array in pieces]


def free(theta: Theta, commands: Signals, cuts: Sequence[int] = ()) -> tuple[Signals, Rows]:
    model, control = DenseSolver.at_rest(theta), kernel.Control.anew()
    phase, expected, signals = (np.empty(len(commands), kind) for kind in ("u1", "f8", "u1"))
    for rows in (slice(*ends) for ends in pairwise([0, *cuts, len(commands)])):
        dt, out = np.full(len(commands[rows]), MS), (phase[rows], expected[rows], signals[rows])
        dense_solver.run_on(model, control, theta, dt, commands[rows], out)
    return phase, expected


@pytest.mark.parametrize("mode", [c.EXTERNAL, c.INTERNAL, c.TIMED])
@few
@given(cuts=st.sets(st.integers(1, 3699), max_size=6))
def test_a_free_run_switches_as_the_kernel_does_wherever_it_is_cut(
    mode: int, cuts: set[int]
) -> None:
    theta = rigs.theta("gripper")
    theta[c.LEAK] *= 5.0  # it saves air several times
    theta[c.H1_LOW] = theta[c.H1] - 20 * MBAR
    theta[[c.BLOW_OFF_MODE, c.BLOW_OFF_TIME]] = mode, 0.2
    commands = np.repeat(np.array([0, 1, 2, 0, 1], "u1"), [100, 2600, 100, 300, 600])
    phase, expected = free(theta, commands)
    assert len(np.flatnonzero(np.diff(phase.astype(int)))) > 8
    cut = free(theta, commands, sorted(cuts))
    assert (phase.tobytes(), expected.tobytes()) == (cut[0].tobytes(), cut[1].tobytes())
    theirs, wanted = np.empty(3700, "u1"), np.empty(3700)
    kernel.simulate(kernel.at_rest(theta), theta, np.full(3700, MS), commands, theirs, wanted)
    assert (phase != theirs).sum() <= 12  # a row each, at switchings
    same = np.convolve(phase != theirs, np.ones(40), "same") < 0.5
    assert np.abs(expected - wanted)[same].max() < 30.0  # later by a part of a row


def test_a_step_reaches_over_many_rows_where_little_happens() -> None:
    theta = rigs.theta("test_rig")
    model = DenseSolver.at_rest(theta)
    driven = np.full(800, MS), phase_rows([(SUCTION, 800)]), np.full(800, np.nan)
    begun = []
    for row in range(800):
        read(model, theta, tuple(array[row : row + 1] for array in driven))  # type: ignore[arg-type]
        begun.append(model.begin.tobytes())
    assert len(set(begun[200:])) < 250


def test_a_command_shorter_than_the_response_is_not_acted_on() -> None:
    theta = rigs.theta("test_rig")
    theta[[c.LEAK, c.RESPONSE]] = 0.0, 15 * MS
    phase = phase_rows([(IDLE, 40), (SUCTION, 14), (IDLE, 100)])
    expected, _ = read(
        DenseSolver.at_rest(theta), theta, (np.full(154, MS), phase, np.full(154, np.nan))
    )
    assert expected == pytest.approx(expected[0], abs=1e-6)


def test_a_signal_outlives_a_step_that_is_done_anew() -> None:
    """It came after the step had begun, and vacuum is within its hysteresis where that ends."""
    theta = rigs.theta("test_rig")
    theta[c.H2_LOW], theta[c.H2] = 1 * MBAR, 900 * MBAR
    model = DenseSolver.at_rest(theta)
    driven = np.full(400, MS), phase_rows([(SUCTION, 399), (HOLD, 1)]), np.full(400, np.nan)
    read(model, theta, tuple(array[:399] for array in driven))  # type: ignore[arg-type]
    model.now[kernel.SIGNALS] = Signal.PART_PRESENT
    _, signals = read(model, theta, tuple(array[399:] for array in driven))  # type: ignore[arg-type]
    assert signals.tolist() == [Signal.PART_PRESENT]


def test_numbers_that_no_ejector_has_end_all_the_same() -> None:
    """A fit may try them: what comes is no pressure, but it comes."""
    theta = rigs.theta("test_rig")
    theta[c.RESISTANCE] = np.nan
    phase = phase_rows([(SUCTION, 300), (BLOW_OFF, 100)])
    driven = np.full(len(phase), MS), phase, np.full(len(phase), np.nan)
    expected, _ = read(DenseSolver.at_rest(theta), theta, driven)
    assert not np.isfinite(expected).all()
