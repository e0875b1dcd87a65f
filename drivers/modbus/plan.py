"""Plan of the fewest requests that read all tags of a Modbus PLC."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.tags import Address, Tag, WordOrder, Words

MOST_WORDS = 125  # in one request, by the protocol


@dataclass(frozen=True)
class Request:
    """Words or bits to read at once."""

    address: Address
    count: int

    @property
    def size(self) -> int:
        """Bytes of data in the answer."""
        return 2 * self.count if self.address.of_words else (self.count + 7) // 8

    def words(self, data: npt.NDArray[np.uint8]) -> Words:
        """Words, or bits as 0 and 1, (rows, count) from the data of answers (rows, size)."""
        if self.address.of_words:
            return np.ascontiguousarray(data).view(">u2").astype(np.uint16)
        return np.unpackbits(data, axis=1, count=self.count, bitorder="little").astype(np.uint16)


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


def holds(request: Request, tag: Tag) -> bool:
    """Whether the answer to ``request`` brings the tag."""
    return _column(request, tag) is not None


def _column(request: Request, tag: Tag) -> slice | None:
    """Where in the answer the tag lies, if it does."""
    start = tag.address.offset - request.address.offset
    inside = tag.address.area == request.address.area and 0 <= start < request.count
    return slice(start, start + tag.size) if inside else None


@dataclass(frozen=True)
class Answers:
    """Answers to repeated requests: for each request, words (rows, count)."""

    requests: Sequence[Request]
    answers: Sequence[Words]

    @classmethod
    def of(cls, requests: Sequence[Request], rows: Sequence[bytes]) -> "Answers":
        """From rows, each the data of all answers one behind the other."""
        data = np.frombuffer(b"".join(rows), np.uint8).reshape(len(rows), -1)
        starts = np.cumsum([request.size for request in requests])
        columns = np.split(data, starts[:-1], axis=1)
        words = [request.words(column) for request, column in zip(requests, columns, strict=True)]
        return cls(requests, words)

    def words(self, tag: Tag) -> Words:
        """Words of one tag (rows, size)."""
        for request, words in zip(self.requests, self.answers, strict=True):
            if (columns := _column(request, tag)) is not None:
                return words[:, columns]
        raise AssertionError(f"{tag.address} is in no request")

    def raw(self, tag: Tag, order: WordOrder) -> npt.NDArray[np.generic]:
        """Its numbers as they stand in the PLC, row by row."""
        return tag.raw(self.words(tag), order)

    def floats(self, tag: Tag, order: WordOrder) -> npt.NDArray[np.float64]:
        """The same numbers as float64."""
        return tag.floats(self.words(tag), order)
