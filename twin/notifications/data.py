"""Data published beside alarms: key figures of every cycle, and values at a slower pace."""

import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from twin.events import Event, Kind
from twin.notifications.message import Asset, Message, beside, iso_time
from twin.quality import UNUSABLE
from twin.signals import MBAR, Phase, Samples, Ticks, joined

CYCLE_FORMAT = "ejector-twin-cycle/1"
VALUES_FORMAT = "ejector-twin-values/1"
CYCLE, VALUES = "cycle", "values"  # their topics, below the unit's
TOGETHER_S = 5.0  # one message covers periods of so long
MOST_HELD = 200_000  # samples after which a period ends in any case: one second at 200 kHz
WORDS = [phase.name.lower() for phase in Phase]

Clock = Callable[[], int]
Floats = npt.NDArray[np.float64]


class MessageSource(Protocol):
    """Makes messages for one topic from the loop's blocks."""

    topic: str

    def tell(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> Iterable[Message]:
        """Take a block and return the messages to send."""

    def rest(self) -> Iterable[Message]:
        """Return the remaining messages after the last row."""


class Cycles:
    """The key figures of every cycle, taken from its event."""

    topic = CYCLE

    def __init__(self, asset: Asset, clock: Clock = time.time_ns) -> None:
        self._asset, self._clock = asset, clock

    def tell(self, _samples: Samples, _ticks: Ticks, events: Sequence[Event]) -> list[Message]:
        """A message for each cycle."""
        return [self._message_of(event) for event in events if event.kind is Kind.CYCLE]

    def rest(self) -> list[Message]:
        """Nothing is held back."""
        return []

    def _message_of(self, event: Event) -> Message:
        figures = {name: value for name, value in event.data.items() if name != "answer"}
        plc_time = {"plc_time": iso_time(event.time_ns), "plc_time_ns": event.time_ns}
        received_ns = int(figures.pop("host_ns", self._clock()))
        return beside(CYCLE_FORMAT, self._asset, received_ns, plc_time | figures)


class Values:
    """Measured and expected vacuum, phase and commands: one row for each period of PLC time.

    ``ambient`` is in Pa. A period without samples has no row. A message holds several periods.
    """

    topic = VALUES

    def __init__(self, asset: Asset, period_s: float, ambient: float) -> None:
        self._asset, self._period_s, self._ambient = asset, period_s, ambient
        self._period_ns = round(period_s * 1e9)
        self._rows_per_message = max(1, round(TOGETHER_S / period_s))
        self._blocks: list[tuple[Samples, Ticks]] = []  # of the period under way
        self._held = 0
        self._rows: list[Mapping[str, Any]] = []

    def tell(self, samples: Samples, ticks: Ticks, _events: Sequence[Event]) -> list[Message]:
        """A message whenever enough periods have ended."""
        if not len(samples):
            return []
        period = samples["time_ns"] // self._period_ns
        cuts = [0, *(np.flatnonzero(np.diff(period)) + 1), len(samples)]
        if self._blocks and self._blocks[-1][0]["time_ns"][-1] // self._period_ns != period[0]:
            self._end()
        for begin, end in itertools.pairwise(cuts):
            if begin:
                self._end()
            self._blocks.append((samples[begin:end].copy(), ticks[begin:end].copy()))
            self._held += end - begin
        if self._held >= MOST_HELD:
            self._end()
        full = len(self._rows) - len(self._rows) % self._rows_per_message
        messages = [self._message(start) for start in range(0, full, self._rows_per_message)]
        del self._rows[:full]
        return messages

    def rest(self) -> list[Message]:
        """A message with the unsent periods, including the one under way."""
        if self._blocks:
            self._end()
        messages = [self._message(0)] if self._rows else []
        self._rows.clear()
        return messages

    def _end(self) -> None:
        """End the period and add its row."""
        samples, ticks = (joined(*blocks) for blocks in zip(*self._blocks, strict=True))
        self._blocks.clear()
        self._held = 0
        usable = (samples["quality"] & UNUSABLE) == 0
        measured = np.where(usable, samples["pressure"].astype(float), np.nan)
        counts = np.bincount(ticks["phase"], minlength=len(WORDS))
        self._rows.append(
            {
                "time_ns": int(samples["host_ns"][-1]),
                "plc_time_ns": int(samples["time_ns"][-1]),
                "samples": len(samples),
                "measured_mbar": self._vacuum(measured),
                "expected_mbar": self._vacuum(ticks["expected"].astype(float)),
                "phase": WORDS[int(counts.argmax())],
                "commands": int(np.bitwise_or.reduce(samples["commands"])),
                "quality": int(np.bitwise_or.reduce(samples["quality"])),
            }
        )

    def _vacuum(self, pressure: Floats) -> dict[str, float | None]:
        """Lowest, mean and highest vacuum in mbar; None if there is no finite pressure."""
        vacuum = (self._ambient - pressure[np.isfinite(pressure)]) / MBAR
        if not len(vacuum):
            return dict.fromkeys(("low", "mean", "high"))
        extremes = {"low": vacuum.min(), "mean": vacuum.mean(), "high": vacuum.max()}
        return {name: round(float(value), 2) for name, value in extremes.items()}

    def _message(self, begin: int) -> Message:
        rows = self._rows[begin : begin + self._rows_per_message]
        content = {"period_s": self._period_s, "rows": rows}
        return beside(VALUES_FORMAT, self._asset, int(rows[-1]["time_ns"]), content)
