"""Diagnosis from end to end: a log in, a cause out; beside a fit of that alone, and a replay."""

import json
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from benchmarks import log
from benchmarks.figures import Measured, Run
from benchmarks.kernel import Driven, first_rows, timed
from benchmarks.processes import TWIN, usage
from benchmarks.recording import HOUR_S, Recording, recorded
from twin.log.reader import open_log
from twin.model import kernel
from twin.model.effects import apply

REPEATS, LONG_REPEATS = 2, 7
SHORT_S = 2.0 + 13.2 * 3.2  # 12 complete cycles
LEAK, PARAMETER, SIZE = "leakage", "sonic_flow", 2.0  # sl/min


def end_to_end(run: Run) -> Sequence[Measured]:
    """Time (s) and peak memory (MB) for 12 cycles, then for an hour."""
    run.tell("diagnosis: simulating the rig")
    short = recorded(SHORT_S, [f"{LEAK}={SIZE}"])
    few = log.keep(run.folder / "leak.mcap", short)
    many = log.keep(
        run.folder / "leak in an hour.mcap",
        recorded(HOUR_S, [f"{LEAK}={SIZE}@{HOUR_S / 2}"]),
    )
    return (*_measured(run, few, short), *_measured(run, many, None))


def _measured(run: Run, path: Path, fitted: Recording | None) -> tuple[Measured, Measured]:
    """The floor of the time is a fit where there is a recording for it, else the replay's."""
    repeats = LONG_REPEATS if run.long else REPEATS
    answer = run.folder / "answer.json"
    usage([TWIN, "diagnose", path, "--json", answer])  # compiles what is not compiled yet
    named = [cause["effect"] for cause in json.loads(answer.read_text())["causes"]]
    assert named == [LEAK], f"the diagnosis named {named}"
    ours, replays, fits = [], [], []
    for number in range(repeats):
        run.tell(f"diagnosis: {path.stem}, {number + 1} of {repeats}")
        ours.append(usage([TWIN, "diagnose", path, "--json", answer]))
        replays.append(usage([TWIN, "replay", path]))
        if fitted is not None:
            fits.append(_fit(path, fitted))
    times, memories = zip(*ours, strict=True)
    replay_times, replay_memories = zip(*replays, strict=True)
    return Measured(times, fits or replay_times), Measured(memories, replay_memories)


def _fit(path: Path, recording: Recording) -> float:
    """Time (s) to read the log and to fit the leak, nothing else being tried."""
    begin = time.perf_counter()
    measured = np.concatenate([rows["pressure"] for rows, _ in open_log(path).blocks()])
    rows = first_rows(recording, len(measured))
    found = least_squares(_off, [0.5 * SIZE], args=(recording, rows, measured), diff_step=1e-3)
    assert found.success
    assert abs(found.x[0] / SIZE - 1.0) < 0.5, f"least squares found {found.x[0]:.2f}"
    return time.perf_counter() - begin


def _off(
    x: npt.NDArray[np.float64],
    recording: Recording,
    rows: Driven,
    measured: npt.NDArray[np.float32],
) -> npt.NDArray[np.float64]:
    """Deviations (Pa) with a leak of so much."""
    theta = apply(recording.theta, LEAK, {PARAMETER: float(x[0])})
    return np.nan_to_num(measured - timed(kernel.advance, theta, rows)[1])
