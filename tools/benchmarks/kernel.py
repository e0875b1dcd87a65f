"""The compiled step of the model beside the same scheme in C."""

import ctypes
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.figures import Measured, Run
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.native import library
from benchmarks.recording import Recording, hour
from twin.model import kernel
from twin.monitor.signatures import steps

ROWS = 100_000
REPEATS = 25
AGREE = 1e-9  # relative

Floats = npt.NDArray[np.float64]
Advance = Callable[[Floats, Floats, Floats, npt.NDArray[np.uint8], Floats, Floats], None]


def step(run: Run) -> Sequence[Measured]:
    """Processor time (ns) of one step of 1 ms, in numba and in C by turns."""
    run.tell("kernel: simulating the rig")
    driven = _rows(hour(), ROWS)
    native = in_c(run.folder)
    run.tell("kernel")
    with on_core(TWIN_CORE):
        _, expected = _timed(kernel.advance, *driven)
        if native is None:
            ours = [_timed(kernel.advance, *driven)[0] for _ in range(REPEATS)]
            return (Measured(_per_step(ours), note="no C compiler"),)
        note = _compared(expected, _timed(native, *driven)[1])
        turns = [
            (_timed(kernel.advance, *driven)[0], _timed(native, *driven)[0]) for _ in range(REPEATS)
        ]
    ours, c = zip(*turns, strict=True)
    return (Measured(_per_step(ours), _per_step(c), note),)


def _per_step(seconds: Sequence[float]) -> list[float]:
    return [1e9 * one / ROWS for one in seconds]


def _compared(expected: Floats, native: Floats) -> str:
    """Say whether the C is still the same scheme: a difference far below AGREE may be a change."""
    np.testing.assert_allclose(native, expected, rtol=AGREE, err_msg="kernel.c is another scheme")
    if np.array_equal(native, expected, equal_nan=True):
        return "with the C's results to the last bit"
    worst = np.nanmax(np.abs(native / expected - 1.0))
    return f"with results up to {worst:.0e} from the C's: is kernel.c behind?"


def over_hour(native: Advance) -> float:
    """Processor time (s) of ``native`` for every row of the hour."""
    return _timed(native, *_rows(hour(), len(hour().samples)))[0]


def in_c(folder: Path) -> Advance | None:
    """``kernel.advance`` in C; None where there is no compiler."""
    compiled = library("kernel", folder)
    return None if compiled is None else partial(_advance, compiled)


def _rows(recording: Recording, rows: int) -> tuple[Floats, Floats, npt.NDArray[np.uint8], Floats]:
    """Coefficients, time steps, phases and levels of the first ``rows``."""
    samples, ticks = recording.samples[:rows], recording.ticks[:rows]
    phase = np.ascontiguousarray(ticks["phase"])
    return recording.theta, steps(samples, None), phase, ticks["level"].astype(np.float64)


def _timed(
    advance: Advance,
    theta: Floats,
    dt: Floats,
    phase: npt.NDArray[np.uint8],
    level: Floats,
) -> tuple[float, Floats]:
    """Processor seconds for a fresh model over the rows, and what it expects (Pa).

    Both only compute, so the time that others take on the machine can be left out.
    """
    state, expected = kernel.new_state(), np.empty(len(dt))
    begin = time.thread_time()
    advance(state, theta, dt, phase, level, expected)
    return time.thread_time() - begin, expected


def _advance(
    compiled: ctypes.CDLL,
    state: Floats,
    theta: Floats,
    dt: Floats,
    phase: npt.NDArray[np.uint8],
    level: Floats,
    expected: Floats,
) -> None:
    arrays = (state, theta, dt, phase, level, expected)
    assert all(array.flags.c_contiguous for array in arrays)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
    compiled.advance(*pointers, ctypes.c_int64(len(dt)))
