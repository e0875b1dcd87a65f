"""What OPC UA servers send, judged: numbers, types, times, StatusCodes; and names of nodes."""

from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from typing import Any

import pytest
from asyncua import ua
from asyncua.common.utils import Buffer
from asyncua.ua.ua_binary import from_binary, to_binary
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers.opcua import values
from drivers.opcua.client import OpcuaClient
from drivers.opcua.settings import Node, OpcuaSettings
from drivers.reconnect import REAL, LostError
from twin.errors import SourceError
from twin.quality import Quality

NODE = Node("s=Meas.Pressure")
S = ua.StatusCodes
T = ua.VariantType

variants = st.one_of(
    st.none(),
    st.sampled_from(
        [
            ua.Variant(None, T.Null),
            ua.Variant("7", T.String),
            ua.Variant(True, T.Boolean),
            ua.Variant(b"\x07", T.ByteString),
            ua.Variant(7, T.Int32),
            ua.Variant(1 << 63, T.UInt64),
            ua.Variant(float("nan"), T.Double),
            ua.Variant(datetime(1601, 1, 1, tzinfo=UTC), T.DateTime),
            ua.Variant([1, 2, 3], T.Int16, is_array=True),
            ua.Variant([], T.Float, is_array=True),
            ua.Variant(["a"], T.String, is_array=True),
            ua.Variant([[1, 2], [3, 4]], T.Int32, Dimensions=[2, 2], is_array=True),
            ua.Variant(None, T.Float, is_array=True),
        ]
    ),
)


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        (0, 0),
        (S.GoodClamped, 0),
        (0x0480, 0),  # overflow of a queue says nothing of the value
        (0x0500, Quality.OVERFLOW),  # at its low limit
        (0x0600, Quality.OVERFLOW),  # at its high limit
        (0x0700, 0),  # constant
        (S.UncertainLastUsableValue, Quality.STALE),
        (S.BadWaitingForInitialData, Quality.STALE),
        (S.UncertainSubNormal, Quality.BAD),
        (S.UncertainEngineeringUnitsExceeded, Quality.BAD | Quality.OUT_OF_RANGE),
        (S.BadSensorFailure, Quality.BAD),
        (S.BadSensorFailure | 0x0480, Quality.BAD),
        (0xC0000000, Quality.BAD),  # reserved: to be treated as bad
    ],
)
def test_status_codes_become_quality(code: int, expected: int) -> None:
    assert values.quality(code) == expected


@given(code=st.integers(0, 0xFFFF_FFFF))
def test_only_good_codes_are_good(code: int) -> None:
    unusable = values.quality(code) & (Quality.BAD | Quality.STALE)
    assert bool(unusable) == bool(code & 0xC000_0000)
    assert 0 <= values.quality(code) <= 0xFF


def test_lost_values_are_told_by_the_overflow_bit() -> None:
    assert values.lost_some(0x0480)
    assert not values.lost_some(0x0080)  # not of a data value
    assert not values.lost_some(0x0400)


def taken(take: Callable[[ua.DataValue, Node], Any], value: ua.DataValue) -> Any:
    """What is made of a value; None where that is a clear error."""
    try:
        return take(value, NODE)
    except SourceError as error:
        clear = str(error).startswith("s=Meas.Pressure holds ") and error.hint
        return None if clear else pytest.fail(f"not clear: {error}")


@given(variant=variants, code=st.integers(0, 0xFFFF_FFFF))
def test_whatever_comes_is_a_value_or_a_clear_error(variant: ua.Variant | None, code: int) -> None:
    value = ua.DataValue(Value=variant, StatusCode=ua.StatusCode(code))
    assert isinstance(taken(values.number, value), float | None)
    assert isinstance(taken(values.whole, value), int | None)
    assert 0 <= (taken(values.moment, value) or 0) <= values.LATEST_NS
    for take in (values.numbers, values.wholes):
        array = taken(take, value)
        assert array is None or (array.ndim == 1 and array.dtype.kind in "if")
    for bit in (None, 0, 63):
        assert isinstance(taken(partial(values.truth, bit=bit), value), bool | None)


@pytest.mark.parametrize("kind", [values.numbers, values.wholes])
def test_an_array_with_fewer_values_than_its_dimension_says_is_none(kind: Any) -> None:
    """The library fills it up with empty lists."""
    packed = to_binary(ua.Variant, ua.Variant([1, 2], T.Int32, [2], True))
    short = packed[:-4] + (514).to_bytes(4, "little")
    value = ua.DataValue(from_binary(ua.Variant, Buffer(short)))
    assert len(value.Value.Value) == 514
    with pytest.raises(SourceError, match="an array of Int32; expected is an array"):
        kind(value, NODE)
    whole = ua.DataValue(from_binary(ua.Variant, Buffer(packed)))
    assert kind(whole, NODE).tolist() == [1, 2]


def test_numbers_keep_their_value() -> None:
    array = ua.DataValue(ua.Variant([1, 65535], T.UInt16, is_array=True))
    assert values.wholes(array, NODE).tolist() == [1, 65535]
    assert values.number(ua.DataValue(ua.Variant(-1.5, T.Double)), NODE) == -1.5
    assert values.truth(ua.DataValue(ua.Variant(0x100, T.UInt16)), NODE, 8)
    assert not values.truth(ua.DataValue(ua.Variant(0x100, T.UInt16)), NODE, 7)


@given(ns=st.integers(0, 4_000_000_000_000_000_000))
def test_times_are_utc_and_exact_to_the_microsecond(ns: int) -> None:
    us = ns // 1000
    stamp = values.EPOCH + (datetime.resolution * us)
    assert values.nanoseconds(stamp) == us * 1000
    assert values.nanoseconds(stamp.replace(tzinfo=None)) == us * 1000
    assert values.moment(ua.DataValue(ua.Variant(ns, T.UInt64)), NODE) == ns
    assert values.moment(ua.DataValue(ua.Variant(stamp, T.DateTime)), NODE) == us * 1000


def test_the_source_time_goes_before_the_servers() -> None:
    first, second = (datetime(2026, 1, 1, 0, 0, s, tzinfo=UTC) for s in (1, 2))
    both = ua.DataValue(SourceTimestamp=first, ServerTimestamp=second)
    assert values.time_ns(both) == values.nanoseconds(first)
    assert values.time_ns(ua.DataValue(ServerTimestamp=second)) == values.nanoseconds(second)
    assert values.time_ns(ua.DataValue()) is None
    never = datetime(1601, 1, 1, tzinfo=UTC)
    assert values.time_ns(ua.DataValue(SourceTimestamp=never)) is None
    assert values.time_ns(
        ua.DataValue(SourceTimestamp=never, ServerTimestamp=second)
    ) == values.nanoseconds(second)


@pytest.mark.parametrize(
    ("text", "uri", "identifier"),
    [
        ("s=Meas.Pressure", "", "s=Meas.Pressure"),
        ("i=2258", "", "i=2258"),
        ('nsu=urn:s7;s="DB"."Druck";x', "urn:s7", 's="DB"."Druck";x'),
    ],
)
def test_nodes_are_named_by_uri(text: str, uri: str, identifier: str) -> None:
    assert Node.parse(text) == Node(identifier, uri)
    assert str(Node.parse(text)) == text


TAGS: dict[str, Any] = {
    "pressure": {"node": "s=P", "unit": "mbar", "reference": "absolute"},
    "suction": {"node": "s=Cmd.Suction"},
    "blow_off": {"node": "s=Cell2.Cmd.BlowOff"},  # with the prefix of one of several ejectors
}
FINE: dict[str, Any] = {"url": "opc.tcp://plc:4840", "namespace": "urn:plc", "tags": TAGS}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"url": "http://plc"}, "is no address"),
        ({"url": "opc.tcp://user:secret@plc:4840"}, "the user apart"),
        ({"url": "opc.tcp://plc:bottom"}, "is no address"),
        ({"namespace": ""}, "in which namespace"),
        ({"tags": {**TAGS, "suction": {"node": "ns=2;s=S"}}}, "may be another after a restart"),
        ({"tags": {**TAGS, "suction": {"node": "Cmd.Suction"}}}, "is no node"),
        ({"mode": "subscribe", "tags": {"pressure": TAGS["pressure"]}}, "needs the tags"),
        ({"security": {"policy": "Basic256Sha256"}}, "twin cert makes it"),
        ({"security": {"policy": "Basic128Rsa15"}}, "Input should be"),
        ({"user": {"name": "twin"}}, "belong together"),
        ({"user": {"name": "twin", "password": {"file": "p"}}}, "not sent in the clear"),
        ({"user": {"certificate": "c"}}, "belong together"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes: dict[str, Any], message: str) -> None:
    assert OpcuaSettings.model_validate(FINE)
    with pytest.raises(ValidationError, match=message):
        OpcuaSettings.model_validate(FINE | changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tags": {**TAGS, "suction": {"node": "s=Cmd.BlowOff"}}}, "in bit 0 of its status"),
        ({"tags": {**TAGS, "blow_off": {"node": 's="DB"."Blow"'}}}, "in bit 1 of its status"),
        ({"tags": {**TAGS, "suction": {"node": "s=Cmd.Suction", "bit": 3}}}, "bit 3 has no effect"),
        ({"gap_ms": 20}, "has no effect in block mode"),
        ({"sampling_ms": 1}, "has no effect in block mode"),
    ],
)
def test_what_would_have_no_effect_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        OpcuaSettings.model_validate(FINE | changes)
    assert OpcuaSettings.model_validate(FINE | changes | {"mode": "subscribe"})


def test_a_node_that_was_there_and_is_not_is_waited_for() -> None:
    link = OpcuaClient(OpcuaSettings.model_validate(FINE), REAL)
    with pytest.raises(SourceError, match="there is no node") as never:
        link._refuse(NODE, S.BadNodeIdUnknown)
    link._has_served = True  # it has once served all of it
    with pytest.raises(LostError, match="there is no node"):
        link._refuse(NODE, S.BadNodeIdUnknown)
    assert not isinstance(never.value, LostError)
