"""The simulated PLC offline: samples as fast as the machine computes, and the rig's truth."""

from collections.abc import Iterator, Sequence

import numpy as np

from drivers.plc.faults import Fault
from drivers.plc.plant import Record
from drivers.plc.scan import OVERFLOW, PERIOD_NS, REPORTED, Scans, Task
from drivers.plc.settings import PlcSettings, Reports
from twin.quality import Quality, flags_where
from twin.signals import MBAR, SAMPLE, SL_MIN, ZERO_C, Reported, Samples

NOTHING = Reports()
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
    """As ``blocks``, each with ``plant.TRUTH`` row by row, for tests that need the truth."""
    task = Task(settings, faults, seed)
    total = round(duration_s * 1000)
    for first in range(0, total, block):
        scans, truth = task.compute(min(block, total - first))
        yield to_samples(scans, settings.reports), truth


def to_samples(scans: Scans, reports: Reports = NOTHING) -> Samples:
    """Turn scans into samples exactly as a client that reads the float32 registers does.

    Optional signals that are served have a value in each row, as in poll mode.
    """
    samples = np.zeros(len(scans), SAMPLE)
    samples["sequence"] = scans["sequence"]
    samples["time_ns"] = EPOCH_NS + scans["sequence"] * PERIOD_NS
    samples["host_ns"] = samples["time_ns"]
    samples["pressure"] = scans["pressure"].astype(np.float64) * MBAR
    samples["supply"] = scans["supply"].astype(np.float64) * MBAR
    samples["commands"] = scans["status"] & 3
    samples["quality"] = flags_where(scans["status"] & OVERFLOW != 0, Quality.OVERFLOW)
    if reports.bits:
        nozzle, part = scans["status"] >> REPORTED & 1, scans["status"] >> REPORTED + 2 & 1
        samples["reported"] = Reported.NOZZLE_KNOWN | Reported.PART_KNOWN
        samples["reported"] |= (nozzle * Reported.NOZZLE + part * Reported.PART).astype(np.uint8)
    if reports.values:
        samples["ambient"] = scans["ambient"] * (MBAR / 10)
        samples["temperature"] = scans["temperature"] / 10 + ZERO_C
        samples["pressure_2"] = scans["vessel"].astype(np.float64) * MBAR
        samples["flow"] = scans["flow"] * SL_MIN
        samples["reported"] |= np.uint8(Reported.FLOW_KNOWN)
    return samples
