"""Check the sizes that the pages of a Parquet file claim: Arrow allocates before it checks.

Footer and page headers are structs in Thrift's compact protocol, with numbered fields. They are
read here, since Arrow tells nothing of pages, and a damaged column can end the process.
"""

from collections.abc import Iterator, Sequence
from typing import BinaryIO

from twin.files import require_within_budget

MAGIC = b"PAR1"
# Bytes of a page's header: enough for nearly all, and for one with long texts in its statistics.
USUAL_HEADER, LONGEST_HEADER = 256, 1 << 16
_DEEPEST = 16  # nested structs; real files have about six
_COLUMN = (4, 1, 3)  # path of fields in the footer down to a column's metadata
_PACKED_SIZE, _FIRST_PAGE, _DICTIONARY = 7, 9, 11  # its fields, in bytes of the file
_UNPACKED, _PACKED = 2, 3  # fields of a page's header
# Kinds of values; 0 ends a struct.
_TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _STRUCT = 1, 2, 3, 7, 8, 9, 10, 12
_WHOLE = (4, 5, 6)  # of 16, 32 and 64 bits


def require_small_pages(file: BinaryIO) -> None:
    """ValueError if a page claims more than the budget, or more bytes than the file has."""
    size = file.seek(0, 2)
    for start, end in _chunks(_footer(file, size)):
        at = start
        while at < end:
            length, unpacked, packed = _header(file, at)
            at += length + packed
            if packed < 0 or unpacked < 0 or at > size:
                raise ValueError("a page is longer than the file")
            require_within_budget(unpacked, "a page")


def _footer(file: BinaryIO, size: int) -> bytes:
    file.seek(max(size - 8, 0))
    last = file.read(8)
    length = int.from_bytes(last[:4], "little")
    if last[4:] != MAGIC or length > size - 12:
        raise ValueError("it has no footer that can be read")
    require_within_budget(length, "its footer")
    file.seek(size - 8 - length)
    return file.read(length)


def _chunks(footer: bytes) -> Iterator[tuple[int, int]]:
    """Begin and end of each column's pages, in bytes of the file."""
    fields = _FIRST_PAGE, _DICTIONARY, _PACKED_SIZE
    try:
        for first, dictionary, size in _Compact(footer).numbers(_COLUMN, fields):
            start = min(first, dictionary) if dictionary > 0 else first
            if start < 0:
                raise ValueError("a column begins before the file")
            yield start, start + size
    except IndexError as error:
        raise ValueError("its footer has no end") from error


def _header(file: BinaryIO, at: int) -> tuple[int, int, int]:
    """Bytes of the header at ``at``, and of its page: unpacked, and as stored in the file."""
    for most in (USUAL_HEADER, LONGEST_HEADER):
        file.seek(at)
        header = _Compact(file.read(most))
        try:
            ((unpacked, packed),) = header.numbers((), (_UNPACKED, _PACKED))
            return header.at, unpacked, packed
        except IndexError:  # the header is longer
            continue
    raise ValueError("the header of a page has no end")


class _Compact:
    """Reader of Thrift's compact protocol, from the first byte on; IndexError if data end early."""

    def __init__(self, data: bytes) -> None:
        self._data, self.at = data, 0

    def numbers(self, path: Sequence[int], fields: Sequence[int]) -> Iterator[list[int]]:
        """Whole numbers in the structs at a path of fields; −1 for a missing one."""
        values = dict.fromkeys(fields, -1)
        for number, kind in self._fields():
            if path and number == path[0]:
                count, inside = self._head() if kind == _LIST else (1, kind)
                self._require(inside == _STRUCT)
                for _ in range(count):
                    yield from self.numbers(path[1:], fields)
            elif not path and number in values:
                self._require(kind in _WHOLE)
                values[number] = self._signed()
            else:
                self._step_over(kind)
        if not path:
            yield [*values.values()]

    def _fields(self) -> Iterator[tuple[int, int]]:
        """Number and kind of each field of a struct; the caller reads its value."""
        number = 0
        while kind := self._byte():
            number = number + (kind >> 4) if kind >> 4 else self._signed()
            yield number, kind & 15

    def _step_over(self, kind: int, deep: int = _DEEPEST) -> None:
        self._require(deep > 0)
        if kind in _WHOLE:
            self._signed()
        elif kind == _STRUCT:
            for _, inside in self._fields():
                self._step_over(inside, deep - 1)
        elif kind in (_LIST, _SET):
            count, inside = self._head()
            for _ in range(count):
                self._step_over(_BYTE if inside in (_TRUE, _FALSE) else inside, deep - 1)
        elif kind == _BINARY:
            length = self._number()
            self.at += length
        elif kind not in (_TRUE, _FALSE):
            self._require(kind in (_BYTE, _DOUBLE))
            self.at += 1 if kind == _BYTE else 8

    def _head(self) -> tuple[int, int]:
        """Number and kind of the elements of a list."""
        head = self._byte()
        return (head >> 4 if head >> 4 < 15 else self._number()), head & 15

    def _byte(self) -> int:
        self.at += 1
        return self._data[self.at - 1]

    def _number(self) -> int:
        """A number in groups of seven bits, the lowest first."""
        number = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            number |= (byte & 0x7F) << shift
            if byte < 0x80:
                return number
        raise ValueError("a number has no end")

    def _signed(self) -> int:
        """A number whose lowest bit is the sign (zigzag)."""
        number = self._number()
        return number >> 1 ^ -(number & 1)

    def _require(self, holds: bool) -> None:
        if not holds:
            raise ValueError("its structure is none of Parquet")
