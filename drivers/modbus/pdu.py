"""Modbus TCP messages: requests as bytes, answers as bytes and as words."""

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.tags import Address, Area, Words

MOST_WORDS = 125  # in one request, by the protocol
FUNCTION: dict[Area, int] = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}
MOST_STORED = 123  # words in one request that writes, by the protocol
STORING: dict[Area, int] = {"coil": 15, "holding": 16}
REFUSAL = 0x80  # set in the function code of an answer that brings an exception

QUESTION = struct.Struct(">HHHBBHH")  # transaction, protocol 0, length, unit, function, from, count
# Transaction, protocol 0, length, unit, function, number of data bytes that follow. An exception
# has its code in place of that number, and nothing follows. The length counts from the unit on.
HEAD = struct.Struct(">HHHBBB")


@dataclass(frozen=True)
class Request:
    """Words or bits to read at once."""

    address: Address
    count: int

    @property
    def size(self) -> int:
        """Bytes of data in the answer."""
        return 2 * self.count if self.address.of_words else (self.count + 7) // 8

    def question(self, transaction: int, unit: int) -> bytes:
        """Encode the whole request."""
        function = FUNCTION[self.address.area]
        return QUESTION.pack(transaction, 0, 6, unit, function, self.address.offset, self.count)

    def head(self, transaction: int, unit: int) -> bytes:
        """The head of an answer that brings the data; only the data follow."""
        function = FUNCTION[self.address.area]
        return HEAD.pack(transaction, 0, 3 + self.size, unit, function, self.size)

    def words(self, data: npt.NDArray[np.uint8]) -> Words:
        """Words, or bits as 0 and 1, (rows, count) from the data of answers (rows, size)."""
        if self.address.of_words:
            return np.ascontiguousarray(data).view(">u2").astype(np.uint16)
        return np.unpackbits(data, axis=1, count=self.count, bitorder="little").astype(np.uint16)


@dataclass(frozen=True)
class Store:
    """Words, or bits as 0 and 1, to write at once; the answer repeats address and count."""

    address: Address
    values: tuple[int, ...]

    @property
    def count(self) -> int:
        """How many words or bits."""
        return len(self.values)

    @property
    def size(self) -> int:
        """Bytes of the answer that follow its head."""
        return len(self.echo)

    @property
    def echo(self) -> bytes:
        """The rest of the answer: the low byte of the address, and the count."""
        return struct.pack(">BH", self.address.offset & 0xFF, self.count)

    def question(self, transaction: int, unit: int) -> bytes:
        """Encode the whole request."""
        values = np.array(self.values, ">u2")
        if not self.address.of_words:
            values = np.packbits(values.astype(np.uint8), bitorder="little")
        data, function = values.tobytes(), STORING[self.address.area]
        head = (transaction, 0, 7 + len(data), unit, function, self.address.offset, self.count)
        return QUESTION.pack(*head) + bytes([len(data)]) + data

    def head(self, transaction: int, unit: int) -> bytes:
        """The head of the answer to a successful write."""
        function, high = STORING[self.address.area], self.address.offset >> 8
        return HEAD.pack(transaction, 0, 6, unit, function, high)


def belongs(head: bytes, expected: bytes) -> bool:
    """Whether ``head`` answers the request whose answer should begin with ``expected``."""
    *stamp, _, unit, function, _ = HEAD.unpack(head)
    *expected_stamp, _, expected_unit, expected_function, _ = HEAD.unpack(expected)
    return (stamp, unit, function & ~REFUSAL) == (expected_stamp, expected_unit, expected_function)


def exception(head: bytes) -> int | None:
    """Code of the exception in an answer; None if it has none."""
    *_, length, _, function, code = HEAD.unpack(head)
    return code if function & REFUSAL and length == 3 else None
