"""The compiled model beside the same scheme in C, for one hypothesis and for many."""

import ctypes
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.figures import Line, Measured, Run, medians
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.native import PLAIN, library
from benchmarks.recording import Recording, hour
from twin.model import dense_solver, kernel
from twin.model.effects import EFFECTS, Effect, apply
from twin.model.theta import Theta
from twin.monitor.rows import time_steps

ROWS = 100_000
REPEATS = 11
HYPOTHESES = 64
BANK_ROWS = 10_000  # three cycles
BANK_REPEATS = 5
CUT_ROWS = 10_000
CUTS = (1, 2, 5, 10, 20, 50)  # rows of a call
CUT_REPEATS = 9
SIZES = (1.0, 0.5, 2.0, 4.0)  # of an effect, in typical sizes
AGREE = 1e-9  # relative
# Without -fno-tree-pre gcc moves values out of the loop and then does not vectorise it.
VECTORS = ("-O3", "-march=native", "-fopenmp-simd", "-fno-math-errno", "-fno-trapping-math")
VECTORS += ("-fno-tree-pre", f"-DLANES={kernel.LANES}")

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]
Advance = Callable[[Floats, Theta, Floats, Bytes, Floats, Floats, Bytes], None]
Driven = tuple[Floats, Bytes, Floats]  # time steps, phases, levels


def speed(run: Run) -> Sequence[Measured]:
    """Processor time (ns) of a row: row by row, with dense output, and for 64 hypotheses at once.

    The floors of the last are C for each alone, and C for several at once. Then the time (µs) of a
    call beyond its rows.
    """
    run.tell("kernel: simulating the rig")
    theta, bank = hour().theta, hypotheses(hour().theta)
    single_rows, bank_rows = first_rows(hour(), ROWS), first_rows(hour(), BANK_ROWS)
    native, vectors = in_c(run.folder), in_c(run.folder, VECTORS)
    with on_core(TWIN_CORE):
        run.tell("kernel: one hypothesis")
        single = _one(theta, single_rows, native)
        run.tell(f"kernel: {HYPOTHESES} hypotheses")
        together = _many(bank, bank_rows, native, vectors)
        run.tell("kernel: dense output, and calls of few rows")
        return (
            single,
            _dense(theta, single_rows, native),
            *together,
            _calls(theta, first_rows(hour(), CUT_ROWS)),
        )


def hypotheses(theta: Theta, count: int = HYPOTHESES) -> list[Theta]:
    """Coefficients with each effect of the table at its typical size, then at other sizes."""
    variants = (_changed(theta, effect, size) for size in SIZES for effect in EFFECTS.values())
    return list(islice(variants, count))


def _changed(theta: Theta, effect: Effect, size: float) -> Theta:
    sizes = {
        p.name: min(max(p.neutral(theta) + size * p.typical, p.low), p.high)
        for p in effect.parameters
    }
    return apply(theta, effect.name, sizes)


def _one(theta: Theta, driven: Driven, native: Advance | None) -> Measured:
    expected = timed(kernel.advance, theta, driven)[1]
    if native is None:
        ours = [timed(kernel.advance, theta, driven)[0] for _ in range(REPEATS)]
        return Measured(ours, note="no C compiler")
    note = _compared(expected, timed(native, theta, driven)[1])
    turns = [
        (timed(kernel.advance, theta, driven)[0], timed(native, theta, driven)[0])
        for _ in range(REPEATS)
    ]
    ours, c = zip(*turns, strict=True)
    return Measured(ours, c, note)


def _dense(theta: Theta, driven: Driven, native: Advance | None) -> Measured:
    """One hypothesis with dense output, as in the twin, beside the C that goes row by row."""
    expected, row_by_row = (
        timed(way, theta, driven)[1] for way in (_with_dense_output, kernel.advance)
    )
    note = f"within {np.nanmax(np.abs(expected - row_by_row)):.1g} Pa of the kernel's"
    ours, c = [], []
    for _ in range(REPEATS):
        ours.append(timed(_with_dense_output, theta, driven)[0])
        c += [timed(native, theta, driven)[0]] if native else []
    return Measured(ours, c, note)


def _with_dense_output(_: Floats, *given: Any) -> None:
    dense_solver.advance(dense_solver.DenseSolver(), *given)


def _many(
    bank: Sequence[Theta], rows: Driven, native: Advance | None, vectors: Advance | None
) -> tuple[Measured, Measured]:
    """All of ``bank`` in one call, by turns with C: one hypothesis at a time, then in lanes."""
    together = np.ascontiguousarray(np.transpose(bank))
    expected = timed(kernel.advance, together, rows)[1]
    alone = np.transpose([timed(kernel.advance, theta, rows)[1] for theta in bank])
    note = f"each within {np.nanmax(np.abs(expected - alone)):.1g} Pa of itself alone"
    if native is None or vectors is None:
        ours = [timed(kernel.advance, together, rows)[0] for _ in range(BANK_REPEATS)]
        return Measured(ours, note=f"{note}; no C compiler"), Measured(ours)
    _compared(alone, np.transpose([timed(native, theta, rows)[1] for theta in bank]))
    lanes = in_lanes(bank)
    in_c_at_once = np.hstack([timed(vectors, lane, rows)[1] for lane in lanes])
    at_once = _compared(expected, in_c_at_once[:, : len(bank)])
    ours, c, simd = [], [], []
    for _ in range(BANK_REPEATS):
        ours.append(timed(kernel.advance, together, rows)[0])
        c.append(float(np.mean([timed(native, theta, rows)[0] for theta in bank])))
        simd.append(float(np.mean([timed(vectors, lane, rows)[0] for lane in lanes])))
    return Measured(ours, c, note), Measured(ours, simd, at_once)


def _calls(theta: Theta, driven: Driven) -> Measured:
    """Time (µs) of a call beyond its rows, from the same rows cut into calls of several lengths."""
    whole = timed(kernel.advance, theta, driven)[1]
    runs = [[_cut(theta, driven, rows, whole) for rows in CUTS] for _ in range(CUT_REPEATS)]
    rests = [Line("", "", CUTS, run).rest for run in runs]
    line = Line("a call, µs", "rows of it", CUTS, medians(runs))
    return Measured(rests, note=f"{line.off:.1f} % from a line at most", line=line)


def _cut(theta: Theta, driven: Driven, rows: int, whole: Floats) -> float:
    """Processor time (µs) of a call of ``rows`` rows; results must equal those of one call."""
    state, expected, signals = kernel.new_state(), np.empty_like(whole), np.empty(len(whole), "u1")
    parts = [slice(at, at + rows) for at in range(0, len(whole), rows)]
    dt, phase, level = driven
    calls = [(dt[p], phase[p], level[p], expected[p], signals[p]) for p in parts]
    begin = time.thread_time()
    for call in calls:
        kernel.advance(state, theta, *call)
    spent = 1e6 * (time.thread_time() - begin) / len(calls)
    np.testing.assert_array_equal(expected, whole)
    return spent


def in_lanes(bank: Sequence[Theta]) -> list[Theta]:
    """Hypotheses in groups for the C that runs many at once: (coefficients, lanes) each.

    Copies of the last hypothesis fill the last group.
    """
    whole = [*bank, *[bank[-1]] * (-len(bank) % kernel.LANES)]
    starts = range(0, len(whole), kernel.LANES)
    return [np.ascontiguousarray(np.transpose(whole[at : at + kernel.LANES])) for at in starts]


def _compared(expected: Floats, native: Floats) -> str:
    """Agreement with the C in words; a difference above AGREE is an error.

    A difference far below AGREE may still be a change of the scheme.
    """
    np.testing.assert_allclose(native, expected, rtol=AGREE, err_msg="kernel.c is another scheme")
    if np.array_equal(native, expected, equal_nan=True):
        return "with the C's results to the last bit"
    worst = np.nanmax(np.abs(native / expected - 1.0))
    return f"with results up to {worst:.0e} from the C's: is kernel.c behind?"


def in_c(folder: Path, options: Sequence[str] = PLAIN) -> Advance | None:
    """``kernel.advance`` in C for one hypothesis, or for ``LANES`` with VECTORS.

    None without a compiler.
    """
    compiled = library("kernel", folder, options)
    return None if compiled is None else partial(_advance, compiled)


def first_rows(recording: Recording, rows: int) -> Driven:
    """Time steps, phases and levels of the first ``rows``."""
    samples, ticks = recording.samples[:rows], recording.ticks[:rows]
    phase = np.ascontiguousarray(ticks["phase"])
    return time_steps(samples, None), phase, ticks["level"].astype(np.float64)


def timed(advance: Advance, theta: Theta, driven: Driven) -> tuple[float, Floats]:
    """Processor time (ns) per row and hypothesis of a fresh model, and its expected pressure (Pa).

    The model only computes, so processor time leaves out the time that other processes take.
    """
    many = theta.shape[1:]
    shape = (len(driven[0]), *many)
    state, expected, signals = kernel.new_state(*many), np.empty(shape), np.empty(shape, np.uint8)
    begin = time.thread_time()
    advance(state, theta, *driven, expected, signals)
    return 1e9 * (time.thread_time() - begin) / expected.size, expected


def _advance(
    compiled: ctypes.CDLL,
    state: Floats,
    theta: Theta,
    dt: Floats,
    phase: Bytes,
    level: Floats,
    expected: Floats,
    signals: Bytes,
) -> None:
    arrays = (state, theta, dt, phase, level, expected, signals)
    assert all(array.flags.c_contiguous for array in arrays)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
    compiled.advance(*pointers, ctypes.c_int64(len(dt)))
