"""A small fleet's logs."""

from pathlib import Path

import rigs

from tools.calibration_coverage import shipped
from tools.fleet_trial import write_log
from twin.config import Config

CYCLES = 5


def write(
    folder: Path, unit: str, seed: int, faults: tuple[str, ...] = (), cycles: int = CYCLES
) -> Path:
    """A log of a unit on the tank rig."""
    config = Config.of(shipped("test_rig"), unit=unit, own=unit)  # a unit to be calibrated yet
    samples, _ = rigs.recorded("test_rig", 3.1 * (cycles + 1.2), faults, seed)
    path = folder / f"{unit}-{seed}.mcap"
    write_log(path, config, samples)
    return path
