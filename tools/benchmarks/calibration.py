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

CYCLES = 12  # that count: the first and the last do not
REPEATS = 3


def from_cycles(run: Run) -> Sequence[Measured]:
    """Time (s) in which the rig's healthy cycles become a data set, on all cores there are."""
    run.tell("calibration: simulating the rig")
    document = Document.read(CONFIG)
    config, samples = Config.of(document), _healthy(document.section(PlcSettings, "plc"))
    calibrate(config, samples, run.tell)  # compiles what is not compiled yet
    times = []
    for number in range(REPEATS):
        run.tell(f"calibration: {number + 1} of {REPEATS}")
        begin = time.perf_counter()
        found = calibrate(config, samples, lambda _: None)
        times.append(time.perf_counter() - begin)
    return (Measured(times, note=f"for {found.cycles} cycles"),)


def _healthy(rig: PlcSettings) -> list[Samples]:
    program = rig.program
    cycle = (program.suction_ms + program.blow_off_ms + program.idle_ms) * MS
    return list(blocks(rig, program.start_ms * MS + (CYCLES + 1.2) * cycle, seed=1))
