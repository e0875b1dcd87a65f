"""OPC UA values as numbers, times and quality; whatever a server sends is checked here."""

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import numpy.typing as npt
from asyncua import ua

from drivers.opcua.settings import Node
from drivers.reconnect import AbsentError
from drivers.trace import LATEST_NS
from twin.errors import SourceError
from twin.quality import Quality

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_T = ua.VariantType
WHOLE = {_T.SByte, _T.Byte, _T.Int16, _T.UInt16, _T.Int32, _T.UInt32, _T.Int64, _T.UInt64}
NUMBERS = WHOLE | {_T.Float, _T.Double}
WRITABLE = NUMBERS | {_T.Boolean}
BITS = {
    **dict.fromkeys((_T.SByte, _T.Byte), 8),
    **dict.fromkeys((_T.Int16, _T.UInt16), 16),
    **dict.fromkeys((_T.Int32, _T.UInt32), 32),
    **dict.fromkeys((_T.Int64, _T.UInt64), 64),
}
SIGNED = {_T.SByte, _T.Int16, _T.Int32, _T.Int64}

# StatusCodes (OPC 10000-4, 7.39): the code proper, and flags that may come with any value.
SEVERITY, UNCERTAIN = 0xC000_0000, 0x4000_0000
CODE = 0xFFFF_0000
DATA_INFO, LIMITS, LOST = 0x0400, 0x0300, 0x0080  # the others mean something with the first
LIMITED = (0x0100, 0x0200)  # the input stands at its low or high end
NO_LONGER_FRESH = {
    ua.StatusCodes.UncertainLastUsableValue,
    ua.StatusCodes.UncertainNoCommunicationLastUsableValue,
    ua.StatusCodes.BadWaitingForInitialData,
}
BEYOND = {ua.StatusCodes.UncertainEngineeringUnitsExceeded, ua.StatusCodes.BadOutOfRange}


def code_of(value: ua.DataValue) -> int:
    """The StatusCode of a value; a missing one means good."""
    return int(value.StatusCode.value) if value.StatusCode is not None else 0


def quality(code: int) -> int:
    """Quality bits of a value with this StatusCode; 0 if it is good."""
    limited = code & DATA_INFO and code & LIMITS in LIMITED
    flags = int(Quality.OVERFLOW) if limited else 0
    if not code & SEVERITY:
        return flags
    if code & CODE in NO_LONGER_FRESH:
        return flags | Quality.STALE
    return flags | Quality.BAD | (Quality.OUT_OF_RANGE if code & CODE in BEYOND else 0)


def lost_some(code: int) -> bool:
    """Whether the server says that its queue overflowed before this value."""
    return bool(code & DATA_INFO and code & LOST)


def status_name(code: int) -> str:
    """Name of a StatusCode in the standard."""
    return str(ua.StatusCode(code & CODE).name)


def time_ns(value: ua.DataValue) -> int | None:
    """When the source gave the value, ns since 1970; None without a plausible time."""
    for stamp in (value.SourceTimestamp, value.ServerTimestamp):
        if stamp is not None and 0 < (ns := nanoseconds(stamp)) < LATEST_NS:  # 1601 means none
            return ns
    return None


def nanoseconds(stamp: datetime) -> int:
    """Nanoseconds since 1970; OPC UA means UTC where a time has no zone."""
    aware = stamp if stamp.tzinfo is not None else stamp.replace(tzinfo=UTC)
    return (aware - EPOCH) // timedelta(microseconds=1) * 1000


def readable(value: ua.DataValue) -> bool:
    """Whether there is a value, of whatever quality."""
    return value.Value is not None and value.Value.Value is not None


def _is_many(variant: ua.Variant) -> bool:
    """Whether it is an array; the library makes one of a single value that claims dimensions."""
    return bool(variant.is_array or isinstance(variant.Value, list))


def number(value: ua.DataValue, node: Node) -> float:
    """One number; NaN without a value. SourceError for another type."""
    if not readable(value):
        return float("nan")
    variant = value.Value
    if _is_many(variant) or variant.VariantType not in NUMBERS:
        raise wrong_type(node, variant, "a number")
    return float(variant.Value)


def whole(value: ua.DataValue, node: Node) -> int:
    """One whole number; SourceError for another type, or without a value."""
    variant = value.Value
    if not readable(value) or _is_many(variant) or variant.VariantType not in WHOLE:
        raise wrong_type(node, variant, "a whole number")
    return int(variant.Value)


def moment(value: ua.DataValue, node: Node) -> int:
    """A time in ns since 1970, from a whole number of ns or a DateTime; 0 if it is earlier."""
    variant = value.Value
    if readable(value) and not _is_many(variant) and variant.VariantType == _T.DateTime:
        ns = nanoseconds(variant.Value)
    else:
        ns = whole(value, node)
    return min(max(ns, 0), LATEST_NS)


def truth(value: ua.DataValue, node: Node, bit: int | None) -> bool:
    """On or off: a Boolean, or one bit of a whole number; SourceError for another type."""
    variant = value.Value
    if bit is not None:
        return bool(whole(value, node) >> bit & 1)
    if not readable(value) or _is_many(variant) or variant.VariantType != _T.Boolean:
        raise wrong_type(node, variant, "a Boolean (or a number, and bit = …)")
    return bool(variant.Value)


def numbers(value: ua.DataValue, node: Node) -> Floats:
    """An array of numbers; SourceError for another type, or without a value."""
    return np.array(_array(value, node, NUMBERS, "an array of numbers"), np.float64)


def wholes(value: ua.DataValue, node: Node) -> Integers:
    """An array of whole numbers; SourceError for another type, or without a value."""
    fitting = WHOLE - {_T.UInt64}  # the ring counts with 32 bits
    return np.array(_array(value, node, fitting, "an array of whole numbers"), np.int64)


def _array(value: ua.DataValue, node: Node, kinds: set[ua.VariantType], expected: str) -> list[Any]:
    variant = value.Value
    fits = readable(value) and variant.is_array and variant.VariantType in kinds
    if not fits or (variant.Dimensions and not _is_flat(variant)):
        raise wrong_type(node, variant, expected)
    elements: list[Any] = variant.Value
    return elements


def _is_flat(variant: ua.Variant) -> bool:
    """Whether an array has one dimension; the library pads missing elements with lists."""
    return len(variant.Dimensions) == 1 and not any(
        isinstance(item, list) for item in variant.Value
    )


def typed(number: float, kind: ua.VariantType, node: Node) -> ua.Variant:
    """A number as a variant of type ``kind``; SourceError if the type cannot hold it."""
    if kind == _T.Boolean:
        return ua.Variant(bool(number), kind)
    if kind not in WHOLE:
        return ua.Variant(float(number), kind)
    bits = BITS[kind] - (kind in SIGNED)
    low = -(1 << bits) if kind in SIGNED else 0
    if not low <= round(number) < 1 << bits:
        raise SourceError(
            f"{node} is of type {kind.name} and cannot hold {round(number)}",
            "choose another unit, scale or range for it under [hil.tags]",
        )
    return ua.Variant(round(number), kind)


def wrong_type(node: Node, variant: ua.Variant | None, expected: str) -> SourceError:
    """The error for a node of another type than ``expected``, or one that holds nothing yet."""
    error: type[SourceError] = AbsentError
    content = "nothing"
    if variant is not None and variant.VariantType != _T.Null:
        content = f"{'an array of ' if variant.is_array else ''}{variant.VariantType.name}"
        error = SourceError
    return error(
        f"{node} holds {content}; expected is {expected}",
        "compare the nodes in [driver] with the server's; twin probe shows what they hold",
    )
