"""What a run leaves for its page, made without a PLC: alarms, key figures and live rows."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rigs

from twin.alarms.database import open_store
from twin.alarms.limit_changes import LimitChanges
from twin.alarms.limits import UnitLimits
from twin.alarms.loop import Alarms
from twin.alarms.settings import board_rules
from twin.alarms.writer import AlarmWriter
from twin.assets.unit import Unit
from twin.config import Config
from twin.events import Event, Kind
from twin.page.ring import ROW_NS, LiveRows
from twin.page.settings import RING, folder_of
from twin.settings import Document
from twin.signals import SAMPLE, TICK, Command, Phase, Samples

S = 1_000_000_000
NOW = 1_700_000_000 * S
KEPT = "\n[alarms]\nkeep = true\n\n[figures]\nkeep = true\n\n[page]\nkeep = true\n"
NONE, NO_TICKS = np.empty(0, SAMPLE), np.empty(0, TICK)
LEAK = "deviation_leakage"
AMBIENT = 101_300.0  # Pa


def write_config(folder: Path, unit: str = "gripper-01", kept: str = KEPT) -> Path:
    """The gripper's configuration, of whose runs a page is to be shown."""
    path = folder / f"{unit}.toml"
    text = rigs.path_of("gripper").read_text().replace('"gripper-01"', f'"{unit}"', 1)
    path.write_text(text + kept)
    return path


def config(path: Path) -> Config:
    return Config.of(Document.read(path))


@dataclass
class Run:
    """The part of ``twin run`` that the page sees."""

    config: Config
    clock: Callable[[], int] = lambda: NOW
    alarms: Alarms = field(init=False)
    limits: LimitChanges = field(init=False)
    live: LiveRows = field(init=False)
    _plc_ns: int = 0

    def __post_init__(self) -> None:
        document, asset = self.config.document, self.config.asset
        path = Path(document.name).parent / "alarms.sqlite"
        alarm_writer = AlarmWriter(
            lambda: open_store(path), Unit(asset.type, asset.id), pytest.fail
        )
        before = alarm_writer.begin()
        self.alarms = Alarms(board_rules(document), self.clock, before, alarm_writer)
        self.limits = LimitChanges(UnitLimits.of(self.config), alarm_writer, self.clock)
        ring = folder_of(document, asset) / RING
        self.live = LiveRows(ring, AMBIENT, pytest.fail, self.clock)

    def say(self, kind: Kind, text: str = "", **data: Any) -> None:
        """Something happens."""
        self.alarms.follow(NONE, [Event(self._plc_ns, kind, text or kind.value, data)])

    def leak(self, text: str = "") -> None:
        found = {"effect": "leakage", "also": "porous_leakage", "cycle": 3, "sigma": 9.0}
        self.say(Kind.DEVIATION, text, **found)

    def rest(self) -> None:
        """Nothing happens; what people have asked for is done."""
        self.alarms.follow(NONE, [])
        self.limits.follow(NONE, [])
        self.live.write(NONE, NO_TICKS, [])

    def suck(
        self, seconds: float = 1.0, vacuum_mbar: float = 600.0, expected: float = 650.0
    ) -> None:
        """Rows of a suction that stands still."""
        count = round(seconds * 1000)
        samples, ticks = np.zeros(count, SAMPLE), np.zeros(count, TICK)
        samples["time_ns"] = self._plc_ns + np.arange(count) * 1_000_000
        samples["host_ns"] = self.clock()
        samples["pressure"] = AMBIENT - vacuum_mbar * 100.0
        samples["commands"] = Command.SUCTION
        ticks["expected"], ticks["phase"] = AMBIENT - expected * 100.0, Phase.SUCTION
        self._plc_ns += max(count * 1_000_000, ROW_NS)
        self.live.write(samples, ticks, [])

    def close(self) -> None:
        self.live.close()
        self.alarms.close()


def flat(count: int, begin_ns: int = 0) -> tuple[Samples, Any]:
    """Rows a millisecond apart, with their ticks."""
    samples, ticks = np.zeros(count, SAMPLE), np.zeros(count, TICK)
    samples["time_ns"] = begin_ns + np.arange(count) * 1_000_000
    samples["pressure"], ticks["expected"] = 1e5, 9e4
    return samples, ticks
