"""Exact numbers from columns of any type; unreadable cells are flagged, not raised."""

import re
from collections.abc import Callable
from decimal import Decimal, DecimalException
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_NO_VALUE = re.compile(r"[+-]?(nan|inf|infinity)", re.IGNORECASE)
_WORDS = {"true": "1", "false": "0", "wahr": "1", "falsch": "0"}
_MOST_DIGITS = 19  # of an int64

Mask = npt.NDArray[np.bool_]


N = TypeVar("N", np.float64, np.int64)


class Numbers(NamedTuple, Generic[N]):
    """A column of n numbers; NaN or 0 where a cell is empty or unreadable."""

    values: npt.NDArray[N]
    empty: Mask
    unreadable: Mask  # neither empty nor a number


def is_readable(kind: pa.DataType) -> bool:
    """Whether an Arrow array of this type holds numbers, or text that may be numbers."""
    inner = kind.value_type if pa.types.is_dictionary(kind) else kind
    types = (
        pa.types.is_integer,
        pa.types.is_floating,
        pa.types.is_decimal,
        pa.types.is_boolean,
        pa.types.is_string,
        pa.types.is_large_string,
        pa.types.is_string_view,
        pa.types.is_null,
    )
    return any(is_type(inner) for is_type in types)


def floats(column: pa.Array) -> Numbers[np.float64]:
    """Read a column as float64; NaN and infinity are numbers here."""
    cells = plain(column)
    try:
        numbers = cells.cast(pa.float64())
    except pa.ArrowInvalid:
        numbers = _one_by_one(cells, _float, pa.float64())
    return as_numbers(cells, numbers, np.nan)


def flags(column: pa.Array) -> Numbers[np.float64]:
    """Read a column as 0 and 1; TRUE and FALSE are these, as are WAHR and FALSCH."""
    cells = plain(column)
    if pa.types.is_string(cells.type):
        words = pc.utf8_lower(cells)
        for word, number in _WORDS.items():
            cells = pc.if_else(pc.equal(words, word), number, cells)
    return floats(cells)


def integers(column: pa.Array, digits: int = 0) -> Numbers[np.int64]:
    """Read a column as int64 units of the last of ``digits`` decimals; finer ones are rounded.

    Nothing is rounded to whole numbers: without digits 1.5 is unreadable.
    """
    cells = plain(column)
    try:
        numbers = _scaled(cells, digits)
    except pa.ArrowInvalid:
        numbers = _one_by_one(cells, lambda text: _integer(text, digits), pa.int64())
    return as_numbers(cells, numbers, 0)


def plain(column: pa.Array) -> pa.Array:
    """Integers, decimals, or text without surrounding blanks; an empty cell is null."""
    if pa.types.is_dictionary(column.type):
        column = column.dictionary_decode()
    if pa.types.is_boolean(column.type):
        return column.cast(pa.uint8())
    if pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
        return column
    text = pc.utf8_trim_whitespace(column.cast(pa.string()))
    return pc.if_else(pc.equal(text, ""), None, text)


def _scaled(cells: pa.Array, digits: int) -> pa.Array:
    if pa.types.is_integer(cells.type):
        return pc.multiply_checked(cells.cast(pa.int64()), 10**digits)
    if pa.types.is_floating(cells.type):
        cells = cells.cast(pa.string())  # the shortest text that is this number
    decimals = cells.cast(pa.decimal128(2 * _MOST_DIGITS, _MOST_DIGITS))
    if digits:
        decimals = pc.round(decimals, digits)
    decimals = decimals.cast(pa.decimal128(_MOST_DIGITS, digits))
    factor = pa.scalar(10**digits, pa.decimal128(digits + 1, 0))
    return pc.multiply(decimals, factor).cast(pa.int64())


def _one_by_one(
    cells: pa.Array, read: Callable[[str], float | int | None], kind: pa.DataType
) -> pa.Array:
    texts = cells.cast(pa.string()).to_pylist()
    return pa.array([None if text is None else read(text) for text in texts], kind)


def _float(text: str) -> float | None:
    return float(text) if _NUMBER.fullmatch(text) or _NO_VALUE.fullmatch(text) else None


def _integer(text: str, digits: int) -> int | None:
    if not _NUMBER.fullmatch(text):
        return None
    try:
        scaled = Decimal(text).scaleb(digits)
    except DecimalException:  # an exponent beyond all numbers
        return None
    if not -(2**63) <= scaled <= 2**63 - 1:
        return None
    integer = int(scaled.to_integral_value())
    return integer if digits or integer == scaled else None


def as_numbers(cells: pa.Array, numbers: pa.Array, none: float) -> Numbers[Any]:
    """Numbers with masks, from ``numbers`` that are null where a cell is empty or unreadable."""
    empty = cells.is_null().to_numpy(zero_copy_only=False)
    missing = numbers.is_null().to_numpy(zero_copy_only=False)
    return Numbers(numbers.fill_null(none).to_numpy(zero_copy_only=False), empty, missing & ~empty)
