"""Calibrations of the simulated rigs from the type's data, made once and shared by the tests."""

from functools import cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from once import once

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from tools.calibration_coverage import as_type, recorded, rig_of, shipped
from twin.calibration.calibrate import Calibration, calibrate
from twin.config import Config
from twin.live import Twin
from twin.model.dataset import DataSet
from twin.signals import MBAR, Phase, Samples, Ticks, deviation

CYCLES = 8
SEED = 3  # of the log that is calibrated on; all other seeds are held out


def quiet(_what: str) -> None:
    """Take progress and say nothing."""


@cache
def typed(name: str) -> Config:
    return as_type(shipped(name))


@cache
def rig(name: str) -> PlcSettings:
    return rig_of(shipped(name))


@cache
def log_of(
    name: str, seed: int = SEED, faults: tuple[str, ...] = (), cycles: int = CYCLES
) -> Samples:
    """A log in which ``cycles`` count, for reading only."""
    samples = recorded(rig(name), cycles, seed, [parse_fault(text) for text in faults])
    samples.flags.writeable = False
    return samples


@once
def calibrated(name: str) -> Calibration:
    return calibrate(typed(name), [log_of(name)], quiet)


def beside(data: DataSet, samples: Samples) -> tuple[Samples, Ticks]:
    """All rows of a log with what the twin of a data set says to them."""
    twin = Twin.of(data)
    (early, said), (late, last) = twin.advance(samples), twin.flush()
    return np.concatenate([early, late]), np.concatenate([said, last])


Stretches = dict[tuple[int, ...], npt.NDArray[np.void]]


def stretches(samples: Samples, ticks: Ticks) -> Stretches:
    """Rows of each stretch of one phase from the second cycle on, by cycle and turn."""
    phase = ticks["phase"]
    edges = np.append(np.flatnonzero(np.diff(phase)) + 1, len(phase))
    found: Stretches = {}
    cycle = 0
    for first, last in pairwise(edges):
        if phase[first] == Phase.SUCTION and phase[first - 1] != Phase.HOLD:
            cycle, turn = cycle + 1, 0
        turn += 1
        if cycle > 1 and last < len(phase):
            found[cycle, turn, int(phase[first]), int(phase[first - 1])] = np.arange(first, last)
    return found


def floor(data: DataSet, name: str, seeds: tuple[int, int]) -> float:
    """Deviation (mbar rms) between two runs of one rig, as a run has from the perfect model.

    Laid over each other stretch by stretch, at the level on which the twin is synchronised.
    """
    runs = [beside(data, log_of(name, seed)) for seed in seeds]
    one, two = (stretches(*run) for run in runs)
    squares = []
    for key in one.keys() & two.keys():
        rows = min(len(one[key]), len(two[key]))
        pressures = []
        for (samples, ticks), where in zip(runs, (one[key], two[key]), strict=True):
            pressure, level = samples["pressure"][where[:rows]], ticks["level"][where[0]]
            start = level if np.isfinite(level) else pressure[:5].mean()
            pressures.append(pressure.astype(float) - start)
        squares.append((pressures[0] - pressures[1]) ** 2 / 2.0)
    return float(np.sqrt(np.mean(np.concatenate(squares)))) / MBAR


def left(data: DataSet, name: str, seed: int) -> float:
    """Deviation (mbar rms) of a run from what the twin of a data set expects."""
    samples, ticks = beside(data, log_of(name, seed))
    rows = np.concatenate(list(stretches(samples, ticks).values()))
    off = deviation(samples, ticks)[rows]
    return float(np.sqrt(np.mean(off**2))) / MBAR
