"""The shipped configurations: their rigs simulated, and the twin and the monitor beside them."""

from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import with_truth
from twin.config import Config
from twin.events import Event, Kind
from twin.live import Twin, run
from twin.model.dataset import coefficients
from twin.model.theta import Theta
from twin.monitor.detector_window import expected_detector
from twin.monitor.isolation import Isolation
from twin.monitor.monitor import Monitor
from twin.monitor.switching_detector import DetectorSettings
from twin.quality import Quality
from twin.settings import Document
from twin.signals import MBAR, Samples, Ticks

ROOT = Path(__file__).parents[1]
NAMES = ("test_rig", "gripper")


def path_of(name: str) -> Path:
    return ROOT / "configs" / f"{name}.toml"


@cache
def config(name: str) -> Config:
    return Config.of(Document.read(path_of(name)))


def theta(name: str) -> Theta:
    """Coefficients of the configuration's data set; the caller's own."""
    return coefficients(config(name).data)


@cache
def detector(name: str) -> DetectorSettings:
    return expected_detector(theta(name), config(name).data.sensor.noise_mbar * MBAR)


def twin(name: str) -> Twin:
    return Twin.of(config(name).data)


def monitor(name: str) -> Monitor:
    return Monitor(config(name).monitor, theta(name))


def isolating(name: str) -> Monitor:
    """A monitor with the bank of hypotheses, as ``twin run`` and ``twin replay`` have it."""
    healthy = config(name).monitor.healthy
    isolation = Isolation.of(config(name).data, healthy, config(name).monitor.false_alarm_days)
    return Monitor(config(name).monitor, theta(name), isolation=isolation)


@cache
def recorded(
    name: str, seconds: float, faults: tuple[str, ...] = (), seed: int = 1, air_saving: bool = True
) -> tuple[Samples, npt.NDArray[np.void]]:
    """Simulate the rig of a configuration: samples and ``TRUTH`` row for row, for reading only."""
    rig = config(name).document.section(PlcSettings, "plc")
    control = rig.control.model_copy(update={"air_saving": air_saving})
    program = rig.program.model_copy(update={"start_ms": 500.0})
    rig = rig.model_copy(update={"control": control, "program": program})
    parts = with_truth(rig, seconds, [parse_fault(text) for text in faults], seed)
    samples, truth = (np.concatenate(column) for column in zip(*parts, strict=True))
    samples.flags.writeable = truth.flags.writeable = False
    return samples, truth


def spoilt(samples: Samples, share: float, seed: int) -> Samples:
    """With bad rows, one to three at a time."""
    rng = np.random.default_rng(seed)
    rows = np.flatnonzero(rng.random(len(samples) - 3) < share / 2)
    rows = np.unique(np.concatenate([row + np.arange(rng.integers(1, 4)) for row in rows]))
    samples = samples.copy()
    samples["pressure"][rows], samples["quality"][rows] = 5e5, Quality.BAD
    return samples


def cut(samples: Samples, size: int) -> list[Samples]:
    return [samples[start : start + size] for start in range(0, len(samples), size)]


def expectation(beside: Twin, blocks: Iterable[Samples]) -> tuple[Samples, Ticks]:
    """Take all blocks through a twin, to the end."""
    parts = [*map(beside.advance, blocks), beside.flush()]
    samples, ticks = (np.concatenate(column) for column in zip(*parts, strict=True))
    return samples, ticks


class Collect:
    """A sink that keeps everything."""

    def __init__(self) -> None:
        self.samples: list[Samples] = []
        self.ticks: list[Ticks] = []
        self.events: list[Event] = []
        self.closed = 0

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        self.samples.append(samples)
        self.ticks.append(ticks)
        self.events.extend(events)

    def close(self) -> None:
        self.closed += 1

    def of(self, *kinds: Kind) -> list[Event]:
        return [event for event in self.events if event.kind in kinds]


def watch(name: str, blocks: Iterable[Samples]) -> Collect:
    """Run the loop of a configuration over blocks."""
    seen = Collect()
    run(blocks, twin(name), monitor(name), [seen])
    return seen
