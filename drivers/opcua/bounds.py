"""Refuse malformed arrays that asyncua would read for minutes.

- Arrays of Null, or of an unknown type: their elements may take no bytes, so that a message of six
  bytes can claim two thousand million of them. Part 6 of OPC UA forbids them.
- A text or byte string of a length below -1: the library moves back by that length. It reads the
  same bytes again for each element that the array claims.

Either takes minutes and gigabytes.
"""

from collections.abc import Iterable
from typing import Any

from asyncua import ua
from asyncua.common.utils import Buffer
from asyncua.ua import ua_binary


class _ArrayOfNothing:
    """Reader of arrays whose elements take no bytes."""

    @staticmethod
    def unpack_array(_data: Any, length: int) -> Iterable[None]:
        """An empty array; UaError if it claims elements."""
        if length:
            raise ua.UaError(f"an array of {length} values of no type")
        return ()


_read, _skip = Buffer.read, Buffer.skip


def _forwards(size: int) -> int:
    """``size`` (bytes); UaError if it is negative."""
    if size < 0:
        raise ua.UaError(f"a length of {size} bytes")
    return size


def refuse_endless_arrays() -> None:
    """Make the library refuse them from now on, whoever sends them."""
    ua_binary.Primitives1.Null = _ArrayOfNothing
    # The library's name for types beyond the standard's.
    ua_binary.Primitives1.Custom = _ArrayOfNothing
    Buffer.read = lambda self, size: _read(self, _forwards(size))
    Buffer.skip = lambda self, size: _skip(self, _forwards(size))
