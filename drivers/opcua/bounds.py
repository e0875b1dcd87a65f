"""What asyncua reads without an end, and is refused here.

- Arrays of Null, or of a type that no standard has: their elements may take no bytes, and a message
  of six bytes may say that it has two thousand million of them. Part 6 of OPC UA forbids them.
- A text or byte string of a length below -1: the library goes back by as much, and reads the same
  bytes again for each of as many elements as the array claims.

Either takes minutes and gigabytes.
"""

from collections.abc import Iterable
from typing import Any

from asyncua import ua
from asyncua.common.utils import Buffer
from asyncua.ua import ua_binary


class _ArrayOfNothing:
    """Reads what may not be there."""

    @staticmethod
    def unpack_array(_data: Any, length: int) -> Iterable[None]:
        """Nothing; UaError where there is to be something."""
        if length:
            raise ua.UaError(f"an array of {length} values of no type")
        return ()


_read, _skip = Buffer.read, Buffer.skip


def _forwards(size: int) -> int:
    """A number of bytes; UaError where it goes back."""
    if size < 0:
        raise ua.UaError(f"a length of {size} bytes")
    return size


def refuse_endless_arrays() -> None:
    """Have the library refuse them from now on, whoever sends them."""
    ua_binary.Primitives1.Null = _ArrayOfNothing
    # The library's name for types beyond the standard's.
    ua_binary.Primitives1.Custom = _ArrayOfNothing
    Buffer.read = lambda self, size: _read(self, _forwards(size))
    Buffer.skip = lambda self, size: _skip(self, _forwards(size))
