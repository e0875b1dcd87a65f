"""What asyncua reads without a bound: arrays of Null, or of a type that no standard has.

Their elements may take no bytes, and a message of six bytes may say that it has two thousand
million of them; the list of them takes minutes and gigabytes. Part 6 of OPC UA forbids such arrays.
"""

from collections.abc import Iterable
from typing import Any

from asyncua import ua
from asyncua.ua import ua_binary


class _ArrayOfNothing:
    """Reads what may not be there."""

    @staticmethod
    def unpack_array(_data: Any, length: int) -> Iterable[None]:
        """Nothing; UaError where there is to be something."""
        if length:
            raise ua.UaError(f"an array of {length} values of no type")
        return ()


def refuse_arrays_of_nothing() -> None:
    """Have the library refuse them from now on, whoever sends them."""
    ua_binary.Primitives1.Null = _ArrayOfNothing
    ua_binary.Primitives1.Custom = (
        _ArrayOfNothing  # the library's name for types beyond the standard's
    )
