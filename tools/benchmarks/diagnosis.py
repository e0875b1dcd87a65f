"""Diagnosis from end to end, beside a fit of its cause alone and a replay."""

import json
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from benchmarks import log, replay
from benchmarks.figures import Measured, Run
from benchmarks.kernel import Driven, first_rows, timed
from benchmarks.processes import TWIN, usage
from benchmarks.recording import HOUR_S, Recording, recorded
from twin.log.reader import open_log
from twin.model import kernel
from twin.model.effects import apply

REPEATS, LONG_REPEATS = 3, 7
SHORT_S = 2.0 + 13.2 * 3.2  # 12 complete cycles
LEAK, PARAMETER, SIZE = "leakage", "sonic_flow", 2.0  # sl/min


def end_to_end(run: Run) -> Sequence[Measured]:
    """Time (s) and peak memory (MB) for 12 cycles, then for an hour."""
    run.tell("diagnosis: simulating the rig")
    short = recorded(SHORT_S, [f"{LEAK}={SIZE}"])
    short_log = log.keep(run.folder / "leak.mcap", short)
    hour_log = log.keep(
        run.folder / "leak in an hour.mcap",
        recorded(HOUR_S, [f"{LEAK}={SIZE}@{HOUR_S / 2}"]),
    )
    return (*_cycles(run, short_log, short), *_hour(run, hour_log))


def _cycles(run: Run, path: Path, recording: Recording) -> tuple[Measured, Measured]:
    """Time beside a fit of the leak alone, and memory beside that of a replay."""
    _diagnosed(run, path)  # compiles first
    ours, replays, fits = [], [], []
    repeats = LONG_REPEATS if run.long else REPEATS
    for number in range(repeats):
        run.tell(f"diagnosis: 12 cycles, {number + 1} of {repeats}")
        ours.append(_diagnosed(run, path))
        replays.append(usage([TWIN, "replay", path])[1])
        fits.append(_fit(path, recording))
    times, memories = zip(*ours, strict=True)
    return Measured(times, fits), Measured(memories, replays)


def _hour(run: Run, path: Path) -> tuple[Measured, Measured]:
    """Time and memory beside the replay of an hour without the leak."""
    floor, ours = replay.replays(run, 60), []
    for number in range(REPEATS):
        run.tell(f"diagnosis: an hour, {number + 1} of {REPEATS}")
        ours.append(_diagnosed(run, path))
    times, memories = zip(*ours, strict=True)
    return Measured(times, floor.times), Measured(memories, floor.memories)


def _diagnosed(run: Run, path: Path) -> tuple[float, float]:
    """Time (s) and peak memory (MB) of a diagnosis; a wrong answer is an error."""
    answer = run.folder / "answer.json"
    used = usage([TWIN, "diagnose", path, "--json", answer])
    named = [cause["effect"] for cause in json.loads(answer.read_text())["causes"]]
    assert named == [LEAK], f"the diagnosis named {named}"
    return used


def _fit(path: Path, recording: Recording) -> float:
    """Time (s) to read the log and to fit the leak alone."""
    begin = time.perf_counter()
    measured = np.concatenate([rows["pressure"] for rows, _ in open_log(path).blocks()])
    rows = first_rows(recording, len(measured))
    fit = least_squares(_off, [0.5 * SIZE], args=(recording, rows, measured), diff_step=1e-3)
    assert fit.success
    assert abs(fit.x[0] / SIZE - 1.0) < 0.5, f"least squares found {fit.x[0]:.2f}"
    return time.perf_counter() - begin


def _off(
    x: npt.NDArray[np.float64],
    recording: Recording,
    rows: Driven,
    measured: npt.NDArray[np.float32],
) -> npt.NDArray[np.float64]:
    """Deviations (Pa) with a leak of size ``x``."""
    theta = apply(recording.theta, LEAK, {PARAMETER: float(x[0])})
    return np.nan_to_num(measured - timed(kernel.advance, theta, rows)[1])
