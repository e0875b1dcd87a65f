"""Poll mode: read the tags once a millisecond, for PLCs that keep no trace.

It cannot be lossless on a general-purpose machine: slots are numbered, and a missed one is a
missing number. Time is that of the middle of the request here.
"""

from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt

from drivers.lasting import Clock, LostError
from drivers.link import Link, ModbusSettings
from drivers.tags import Flags, Tag, Words
from drivers.telegram import MOST_WORDS, Request
from twin.signals import MBAR, SAMPLE, Command, Quality, Samples

SLOT_NS = 1_000_000
SPIN_NS = 60_000  # a sleeping thread wakes about this late; longer spinning won nothing
HEARTBEAT_NS = 100_000_000  # unchanged for longer: the PLC's program stands still


def plan(tags: Iterable[Tag], most: int = MOST_WORDS) -> list[Request]:
    """Fewest requests that cover all tags, none longer than ``most``."""
    requests: list[Request] = []
    for tag in sorted(tags, key=lambda tag: (tag.address.area, tag.address.offset)):
        end = tag.address.offset + tag.size
        last = requests[-1] if requests else None
        if (
            last is not None
            and last.address.area == tag.address.area
            and end - last.address.offset <= most
        ):
            count = max(last.count, end - last.address.offset)
            requests[-1] = Request(last.address, count)
        else:
            requests.append(Request(tag.address, tag.size))
    return requests


class Poller:
    """The slots of one PLC; it outlives connections."""

    def __init__(self, settings: ModbusSettings, clock: Clock) -> None:
        tags = settings.tags
        self._settings = settings
        self._clock = clock
        known = (tags.pressure, tags.suction, tags.blow_off, tags.supply, tags.heartbeat)
        self._requests = plan(tag for tag in known if tag is not None)
        # The pressure last, so that a slow answer for the rest does not put its time off.
        self._requests.sort(key=lambda request: self._column(tags.pressure, request) is not None)
        self._start_ns = clock.now_ns()
        self._wall_ns = clock.wall_ns() - self._start_ns  # anchored once: time never runs back
        self._slot = 0  # to be read next
        self._last = -1  # slot of the last sample given
        self._beat: np.generic | None = None
        self._beat_ns = 0

    def samples(self, link: Link) -> Iterator[Samples]:
        """Blocks of the slots that were read; ends only by an exception."""
        while True:
            yield self._block(link)

    def _block(self, link: Link) -> Samples:
        """The slots of one interval; where the connection breaks, those before it."""
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
        except LostError:
            if not rows:
                raise  # else the closed connection says so again at the next block
        return self._decode(self._answers(rows), np.array(slots, dtype=np.int64))

    def _now_slot(self) -> int:
        return (self._clock.now_ns() - self._start_ns) // SLOT_NS

    def _wait(self) -> None:
        """Until the slot begins; slots that are over are left out."""
        self._slot = max(self._slot, self._now_slot())
        due = self._start_ns + self._slot * SLOT_NS
        rest = due - SPIN_NS - self._clock.now_ns()
        if rest > 0:
            self._clock.sleep(rest * 1e-9)
        while self._clock.now_ns() < due:
            pass

    def _ask(self, link: Link) -> tuple[bytes, int, int]:
        """One slot: the data of all answers, when the last was asked for and when it came."""
        row, asked_ns = b"", 0
        for request in self._requests:
            asked_ns = self._clock.now_ns()
            row += link.ask(request)
        return row, asked_ns, self._clock.now_ns()

    def _answers(self, rows: list[bytes]) -> list[Words]:
        """Words (rows, count) for each request."""
        data = np.frombuffer(b"".join(rows), np.uint8).reshape(len(rows), -1)
        starts = np.cumsum([request.size for request in self._requests])
        parts = np.split(data, starts[:-1], axis=1)
        return [request.words(part) for request, part in zip(self._requests, parts, strict=True)]

    def _column(self, tag: Tag, request: Request) -> slice | None:
        """Where in the answer to ``request`` the tag lies, if it does."""
        at = tag.address.offset - request.address.offset
        inside = tag.address.area == request.address.area and 0 <= at < request.count
        return slice(at, at + tag.size) if inside else None

    def _words(self, tag: Tag, answers: list[Words]) -> Words:
        """Words of one tag (rows, size) from all answers."""
        for request, words in zip(self._requests, answers, strict=True):
            if (columns := self._column(tag, request)) is not None:
                return words[:, columns]
        raise AssertionError(f"{tag.address} is in no request")

    def _decode(self, answers: list[Words], slots: npt.NDArray[np.int64]) -> Samples:
        tags, order = self._settings.tags, self._settings.word_order
        ambient = self._settings.ambient_mbar * MBAR
        block = np.zeros(len(slots), SAMPLE)
        block["sequence"] = slots[:, 0]
        block["time_ns"] = slots[:, 1] + self._wall_ns
        block["host_ns"] = slots[:, 2] + self._wall_ns
        for tag, command in ((tags.suction, Command.SUCTION), (tags.blow_off, Command.BLOW_OFF)):
            assert tag is not None  # the settings see to it
            bits = tag.raw(self._words(tag, answers), order).astype(np.uint8)
            block["commands"] |= bits * np.uint8(command)
        words = self._words(tags.pressure, answers)
        block["pressure"], block["quality"] = tags.pressure.decode(words, order, ambient)
        block["supply"] = np.nan
        if tags.supply is not None:
            block["supply"] = tags.supply.supply(self._words(tags.supply, answers), order, ambient)
        block["quality"] |= self._gaps(slots[:, 0])
        if tags.heartbeat is not None:
            beats = tags.heartbeat.raw(self._words(tags.heartbeat, answers), order)
            block["quality"] |= self._stale(beats, slots[:, 2])
        return block

    def _gaps(self, slots: npt.NDArray[np.int64]) -> Flags:
        missing = np.diff(slots, prepend=slots[0] - 1 if self._last < 0 else self._last) - 1
        self._last = int(slots[-1])
        return np.where(missing > self._settings.gap_ms, Quality.GAP.value, 0).astype(np.uint8)

    def _stale(self, beats: npt.NDArray[np.generic], at_ns: npt.NDArray[np.int64]) -> Flags:
        """Flag what was read while the heartbeat had been at rest for too long."""
        before = beats[0] if self._beat is None else self._beat
        changed = np.diff(beats, prepend=before) != 0
        changed[0] |= self._beat is None
        since = np.maximum.accumulate(np.where(changed, at_ns, self._beat_ns))
        self._beat, self._beat_ns = beats[-1], int(since[-1])
        return np.where(at_ns - since > HEARTBEAT_NS, Quality.STALE.value, 0).astype(np.uint8)
