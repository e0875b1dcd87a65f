"""Calibration of a healthy unit: from its samples to its data set."""

import time
from collections.abc import Sequence

from benchmarks.figures import Measured, Run
from benchmarks.processes import CONFIG
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from twin.calibration.calibrate import calibrate
from twin.config import Config
from twin.settings import Document
from twin.signals import MS, Samples

CYCLES = 12  # complete ones: the first and the last do not count
REPEATS = 3


def from_cycles(run: Run) -> Sequence[Measured]:
    """Time (s) of a calibration on the rig's healthy cycles, on all cores."""
    run.tell("calibration: simulating the rig")
    document = Document.read(CONFIG)
    config, samples = Config.of(document), _healthy(document.section(PlcSettings, "plc"))
    calibrate(config, samples, run.tell)  # compiles first
    times = []
    for number in range(REPEATS):
        run.tell(f"calibration: {number + 1} of {REPEATS}")
        begin = time.perf_counter()
        calibrated = calibrate(config, samples, lambda _: None)
        times.append(time.perf_counter() - begin)
    return (Measured(times, note=f"for {calibrated.cycles} cycles"),)


def _healthy(rig: PlcSettings) -> list[Samples]:
    program = rig.program
    cycle = (program.suction_ms + program.blow_off_ms + program.idle_ms) * MS
    return list(blocks(rig, program.start_ms * MS + (CYCLES + 1.2) * cycle, seed=1))
