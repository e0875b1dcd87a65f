"""A simulated hour of the test rig with the twin's rows, made once for several benchmarks."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from benchmarks.processes import CONFIG
from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from twin.config import Config
from twin.live import Twin
from twin.model.theta import Theta
from twin.settings import Document
from twin.signals import MS, NS, Samples, Ticks

HOUR_S = 3600.0
MINUTE = 60_000  # rows
BLOCK = 10_000  # rows of a message in a log
LIVE_BLOCK = 30  # rows that a live driver receives at once


@dataclass(frozen=True)
class Recording:
    """Rows of SAMPLE and TICK, with the configuration and coefficients behind them."""

    config: Config
    theta: Theta
    samples: Samples
    ticks: Ticks

    def blocks(self, size: int = BLOCK) -> list[tuple[Samples, Ticks]]:
        """Views of the rows, ``size`` at a time."""
        starts = range(0, len(self.samples), size)
        return [(self.samples[at : at + size], self.ticks[at : at + size]) for at in starts]


def new_twin(config: Config) -> Twin:
    """The twin of the rig as the command line makes it."""
    return Twin.of(config.data)


@cache
def hour() -> Recording:
    """An hour, 3.6 million rows, received as by a live driver: in blocks, a little late."""
    return recorded(HOUR_S)


def recorded(seconds: float, faults: Sequence[str] = ()) -> Recording:
    """A recording of ``seconds`` of the test rig with faults."""
    document = Document.read(CONFIG)
    config = Config.of(document)
    rig = document.section(PlcSettings, "plc")
    hidden = [parse_fault(fault) for fault in faults]
    simulated = np.concatenate(list(blocks(rig, seconds, hidden, seed=1, block=BLOCK)))
    simulated["host_ns"] = _received(simulated["time_ns"])
    twin = new_twin(config)
    starts = range(0, len(simulated), BLOCK)
    parts = [twin.advance(simulated[at : at + BLOCK]) for at in starts] + [twin.flush()]
    samples, ticks = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Recording(config, twin.theta, samples, ticks)


def _received(
    time_ns: np.ndarray[tuple[int], np.dtype[np.int64]],
) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Host times of rows in a live driver: a block at once, 0.2 to 3 ms after its last row."""
    last = np.arange(len(time_ns)) // LIVE_BLOCK * LIVE_BLOCK + LIVE_BLOCK - 1
    random = np.random.default_rng(1)
    late = random.uniform(0.2 * MS, 3.0 * MS, len(time_ns) // LIVE_BLOCK + 1) / NS
    return time_ns[np.minimum(last, len(time_ns) - 1)] + late.astype(np.int64)[last // LIVE_BLOCK]
