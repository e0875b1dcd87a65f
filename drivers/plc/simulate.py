"""The simulated PLC offline: its samples as fast as the machine goes, and the truth behind."""

from collections.abc import Iterator, Sequence

import numpy as np

from drivers.plc.faults import Fault
from drivers.plc.plant import Record
from drivers.plc.scan import OVERFLOW, PERIOD_NS, Scans, Task
from drivers.plc.settings import PlcSettings
from twin.signals import MBAR, SAMPLE, Quality, Samples

EPOCH_NS = 1_767_225_600_000_000_000  # 2026-01-01, PLC time of sequence 0


def blocks(
    settings: PlcSettings,
    duration_s: float,
    faults: Sequence[Fault] = (),
    seed: int = 0,
    block: int = 1000,
) -> Iterator[Samples]:
    """Yield ``duration_s`` of samples as blocks of ``SAMPLE``, each of at most ``block`` rows."""
    for samples, _ in with_truth(settings, duration_s, faults, seed, block):
        yield samples


def with_truth(
    settings: PlcSettings,
    duration_s: float,
    faults: Sequence[Fault] = (),
    seed: int = 0,
    block: int = 1000,
) -> Iterator[tuple[Samples, Record]]:
    """As ``blocks``, each with ``plant.TRUTH`` row for row, for tests that may look behind."""
    task = Task(settings, faults, seed)
    total = round(duration_s * 1000)
    for first in range(0, total, block):
        scans, truth = task.compute(min(block, total - first))
        yield to_samples(scans), truth


def to_samples(scans: Scans) -> Samples:
    """Turn scans into samples exactly as a client that reads the float32 registers does."""
    samples = np.zeros(len(scans), SAMPLE)
    samples["sequence"] = scans["sequence"]
    samples["time_ns"] = EPOCH_NS + scans["sequence"] * PERIOD_NS
    samples["host_ns"] = samples["time_ns"]
    samples["pressure"] = scans["pressure"].astype(np.float64) * MBAR
    samples["supply"] = scans["supply"].astype(np.float64) * MBAR
    samples["commands"] = scans["status"] & 3
    samples["quality"] = np.where(scans["status"] & OVERFLOW, Quality.OVERFLOW, 0)
    return samples
