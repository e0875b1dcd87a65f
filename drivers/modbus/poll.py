"""Poll mode: read the tags once a millisecond, for PLCs that keep no trace.

A general-purpose machine cannot do this without loss: slots are numbered, and a missed one is a
missing number. The time of a sample is the middle of its request, by this machine's clock.
"""

from collections.abc import Iterator
from typing import Protocol

import numpy as np
import numpy.typing as npt

from drivers.modbus.plan import Answers, Request, holds, plan
from drivers.modbus.settings import ModbusSettings
from drivers.optional_signals import BITS, VALUES, ambient_of, put_bits, put_values
from drivers.reconnect import Clock, Connection
from twin.errors import SourceError
from twin.quality import Flags, Quality, flags_where
from twin.signals import MBAR, SAMPLE, Command, Samples

SLOT_NS = 1_000_000
SPIN_NS = 60_000  # a sleeping thread wakes about this late; longer spinning won nothing
HEARTBEAT_NS = 100_000_000  # unchanged for longer: the PLC's program stands still


class Link(Connection, Protocol):
    """A connection whose answers are taken as they come, and decoded later."""

    def ask(self, request: Request) -> bytes:
        """Data of the answer, ``request.size`` bytes; LostError or SourceError without one."""
        ...


class Poller:
    """Reads one PLC slot by slot; it outlives connections."""

    def __init__(self, settings: ModbusSettings, clock: Clock) -> None:
        tags = settings.tags
        self._settings = settings
        self._clock = clock
        self._requests = plan(tag for _, tag in tags if tag is not None)
        # The pressure comes last: slow answers to other requests do not shift its time.
        self._requests.sort(key=lambda request: holds(request, tags.pressure))
        self._start_ns = clock.now_ns()
        self._wall_ns = clock.wall_ns() - self._start_ns  # anchored once: time never runs back
        self._slot = 0  # to be read next
        self._last = -1  # slot of the last sample given
        self._failure: SourceError | None = None  # raised after the rows before it
        self._beat: np.generic | None = None
        self._beat_ns = 0

    def samples(self, link: Link) -> Iterator[Samples]:
        """Blocks of the slots that were read; ends only by an exception."""
        while True:
            yield self._block(link)

    def _block(self, link: Link) -> Samples:
        """Samples of one interval; if the connection breaks, those before that."""
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure
        end = max(self._slot, self._now_slot()) + round(self._settings.interval_ms)
        rows: list[bytes] = []
        slots: list[tuple[int, int, int]] = []  # slot, middle of the request, receipt
        try:
            while self._slot < end:
                self._wait()
                row, asked_ns, answered_ns = self._ask(link)
                rows.append(row)
                slots.append((self._slot, (asked_ns + answered_ns) // 2, answered_ns))
                self._slot += 1
        except SourceError as error:
            if not rows:
                raise
            self._failure = error  # raised once these rows are given
        return self._decode(Answers.of(self._requests, rows), np.array(slots, dtype=np.int64))

    def _now_slot(self) -> int:
        return (self._clock.now_ns() - self._start_ns) // SLOT_NS

    def _wait(self) -> None:
        """Wait until the slot begins; slots that are over are skipped."""
        self._slot = max(self._slot, self._now_slot())
        due = self._start_ns + self._slot * SLOT_NS
        remaining_ns = due - SPIN_NS - self._clock.now_ns()
        if remaining_ns > 0:
            self._clock.sleep(remaining_ns * 1e-9)
        while self._clock.now_ns() < due:
            pass

    def _ask(self, link: Link) -> tuple[bytes, int, int]:
        """Data of all answers of a slot; request and arrival time of the last answer (ns)."""
        row, asked_ns = b"", 0
        for request in self._requests:
            asked_ns = self._clock.now_ns()
            row += link.ask(request)
        return row, asked_ns, self._clock.now_ns()

    def _decode(self, answers: Answers, slots: npt.NDArray[np.int64]) -> Samples:
        tags, order = self._settings.tags, self._settings.word_order
        block = np.zeros(len(slots), SAMPLE)
        block["sequence"] = slots[:, 0]
        block["time_ns"] = slots[:, 1] + self._wall_ns
        block["host_ns"] = slots[:, 2] + self._wall_ns
        for tag, command in ((tags.suction, Command.SUCTION), (tags.blow_off, Command.BLOW_OFF)):
            assert tag is not None  # the settings check it
            bits = answers.raw(tag, order).astype(np.uint8)
            block["commands"] |= bits * np.uint8(command)
        bit_tags = {name: getattr(tags, name) for name in BITS if getattr(tags, name) is not None}
        put_bits(block, {name: answers.floats(tag, order) for name, tag in bit_tags.items()})
        value_tags = {
            name: getattr(tags, name) for name in VALUES if getattr(tags, name) is not None
        }
        raw = {name: answers.floats(tag, order) for name, tag in value_tags.items()}
        fixed = self._settings.ambient_mbar * MBAR
        ambient = ambient_of(block, tags, raw, fixed)
        put_values(block, tags, raw, ambient)
        words = answers.words(tags.pressure)
        block["pressure"], block["quality"] = tags.pressure.decode(words, order, ambient)
        block["supply"] = np.nan
        if tags.supply is not None:
            block["supply"] = tags.supply.supply(answers.words(tags.supply), order, fixed)
        block["quality"] |= self._gaps(slots[:, 0])
        if tags.heartbeat is not None:
            beats = answers.raw(tags.heartbeat, order)
            block["quality"] |= self._stale(beats, slots[:, 2])
        return block

    def _gaps(self, slots: npt.NDArray[np.int64]) -> Flags:
        missing = np.diff(slots, prepend=slots[0] - 1 if self._last < 0 else self._last) - 1
        self._last = int(slots[-1])
        return flags_where(missing > self._settings.gap_ms, Quality.GAP)

    def _stale(self, beats: npt.NDArray[np.generic], at_ns: npt.NDArray[np.int64]) -> Flags:
        """Flags for samples that were read while the heartbeat had been at rest for too long."""
        before = beats[0] if self._beat is None else self._beat
        changed = np.diff(beats, prepend=before) != 0
        changed[0] |= self._beat is None
        changed_ns = np.maximum.accumulate(np.where(changed, at_ns, self._beat_ns))
        self._beat, self._beat_ns = beats[-1], int(changed_ns[-1])
        return flags_where(at_ns - changed_ns > HEARTBEAT_NS, Quality.STALE)
