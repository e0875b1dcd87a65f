"""Whatever a server puts into the trace in the middle of a session: no crash, nothing made up."""

import importlib
import inspect
from typing import Any

import numpy as np
import pytest
from asyncua import ua
from asyncua.common.utils import Buffer
from asyncua.ua.ua_binary import from_binary
from hypothesis import given, settings
from hypothesis import strategies as st
from test_opcua_block import DEPTH, Rig, T, TornServer, flags
from test_opcua_subscribe import FakeLink, change, granted, publication, subscription

from drivers.opcua.bounds import refuse_endless_arrays
from drivers.reconnect import EMPTY, LostError
from twin.errors import SourceError
from twin.quality import BREAK, UNUSABLE, Quality
from twin.signals import Samples

NODES = ("Sequence", "Time", "Boot", "Period", "Sequences", "Statuses", "Pressures")
ODD = [float("nan"), float("inf"), -1e300]
LENGTHS = [0, 1, DEPTH - 1, DEPTH + 1]

wrong_types = st.sampled_from(
    [
        ua.Variant(None, T.Null),
        ua.Variant("1", T.String),
        ua.Variant(b"\1\2", T.ByteString),
        ua.Variant(True, T.Boolean),
        ua.Variant([True] * DEPTH, T.Boolean, None, True),
        ua.Variant(["x"] * DEPTH, T.String, None, True),
        ua.Variant(b"\0" * DEPTH, T.ByteString),
        ua.Variant([[1.0, 2.0], [3.0, 4.0]], T.Float, [2, 2], True),
        ua.Variant(2.5, T.Double),
        ua.Variant(-1, T.Int32),
        ua.Variant(2**64 - 1, T.UInt64),
    ]
)
lengths = st.sampled_from(LENGTHS).map(lambda n: ua.Variant([7] * n, T.UInt16, None, True))
odd_numbers = st.sampled_from(ODD).map(lambda x: ua.Variant([x] * DEPTH, T.Double, None, True))
whole_numbers = st.integers(0, 2**32 - 1).map(lambda n: ua.Variant(n, T.UInt32))
codes = st.one_of(st.just(0), st.integers(0, 2**32 - 1))
replacements = st.one_of(wrong_types, lengths, odd_numbers, whole_numbers)
# What is replaced, by what, with which StatusCode, and for how many blocks.
acts = st.tuples(
    st.sampled_from(["Trace." + name for name in NODES] + ["Supply"]),
    st.one_of(st.none(), replacements),
    codes,
    st.integers(1, 3),
)


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(st.lists(acts, min_size=1, max_size=5))
def test_whatever_the_trace_holds_for_a_while_rows_are_true_or_bad(acts: list[Any]) -> None:
    rig = Rig(TornServer())
    parts = [rig.take(2)]
    for name, variant, code, blocks in acts:
        if variant is not None:
            rig.server.replaced[name] = variant
        rig.server.codes[name] = code
        parts.append(rig.take(blocks))
        if name == "Trace.Pressures" and code & 0xC000_0000:
            assert (parts[-1]["quality"] & (Quality.BAD | Quality.STALE)).all()
        rig.server.replaced.clear()
        rig.server.codes.clear()
        parts.append(rig.take(1))
    parts.append(rig.take(12))  # the way back takes a while
    samples = np.concatenate(parts)
    assert len(parts[-1]), "it did not come back"
    assert_nothing_made_up(rig, samples)
    usual = parts[-1][-20:]
    assert (np.diff(usual["sequence"]) == 1).all()
    assert set(usual["quality"]) == {Quality.OVERFLOW}  # bit 8 of every status here


def assert_nothing_made_up(rig: Rig, samples: Samples) -> None:
    """A row that is not said to be bad has the pressure of its scan; a break in time is marked."""
    said = samples["quality"] & (Quality.BAD | Quality.STALE)
    good = samples[said == 0]
    scan = good["sequence"] % (1 << 32)
    true = np.array([rig.server.pressure(int(number)) * 100 for number in scan])
    # A server may truly hold other pressures; then they are all what was put there.
    put = np.isin(good["pressure"], [700.0])
    assert (np.isclose(good["pressure"], true) | put).all()
    assert np.isfinite(good["pressure"]).all()
    jumps = (np.diff(samples["sequence"]) != 1) | (np.diff(samples["time_ns"]) <= 0)
    assert set(np.flatnonzero(jumps) + 1) <= set(flags(samples, BREAK))


@pytest.mark.parametrize("read_before", [3, 0])
@pytest.mark.parametrize("name", NODES)
def test_values_that_a_starting_plc_does_not_have_yet_are_waited_for(
    name: str, read_before: int
) -> None:
    rig = Rig(TornServer(), lambda _reason: None)
    rig.take(read_before)
    rig.server.replaced[f"Trace.{name}"] = ua.Variant(None, T.Null)
    for code in (ua.StatusCodes.Good, ua.StatusCodes.BadWaitingForInitialData):
        rig.server.codes[f"Trace.{name}"] = code
        assert not (rig.take(8)["quality"] & UNUSABLE == 0).any()
    rig.server.replaced.clear()
    rig.server.codes.clear()
    assert len(rig.take(12))


values = st.one_of(
    st.floats(width=32).map(lambda x: ua.Variant(x, T.Float)),
    st.booleans().map(lambda x: ua.Variant(x, T.Boolean)),
    wrong_types,
)
changes = st.lists(st.tuples(st.integers(-1, 5), st.integers(-50, 50), values, codes), max_size=6)


@settings(max_examples=300, deadline=None)
@given(st.lists(changes, max_size=5))
def test_whatever_is_published_is_rows_or_one_clear_error(parts: list[list[Any]]) -> None:
    sent = [
        publication([raw_change(*change) for change in part], number)
        for number, part in enumerate(parts, 1)
    ]
    rows: list[Samples] = [EMPTY]
    with pytest.raises(SourceError) as caught:  # at the latest, when nothing more is published
        rows.extend(subscription().samples(FakeLink(sent, granted())))  # type: ignore[arg-type]
    assert caught.value.hint or isinstance(caught.value, LostError)
    samples = np.concatenate(rows)
    good = samples[(samples["quality"] & UNUSABLE) == 0]
    assert np.isfinite(good["pressure"]).all()
    assert (np.diff(samples["sequence"]) >= 1).all()


def raw_change(handle: int, ms: int, variant: ua.Variant, code: int) -> Any:
    """As ``change`` makes one, with any value."""
    made = change(0, ms, 1.0, code)
    made.ClientHandle = handle
    made.Value.Value = variant
    return made


@pytest.mark.parametrize("kind", ["80", "9c"])  # of Null; of 28, which is no standard's
def test_an_array_of_nothing_takes_no_memory(kind: str) -> None:
    """asyncua would make a list of 2**31 - 1 of them: minutes and gigabytes for six bytes."""
    refuse_endless_arrays()
    with pytest.raises(ua.UaError, match="an array of 2147483647 values of no type"):
        from_binary(ua.DataValue, Buffer(bytes.fromhex(f"01{kind}ffffff7f")))
    empty = from_binary(ua.DataValue, Buffer(bytes.fromhex("018000000000")))
    assert empty.Value.Value == []
    null = from_binary(ua.DataValue, Buffer(bytes.fromhex("0100")))
    assert null.Value.Value is None


@pytest.mark.parametrize("length", ["fcffffff", "00000080"])
def test_a_text_that_goes_back_is_no_text(length: str) -> None:
    """asyncua would read it again for each of 2**31 - 1 elements: minutes for eleven bytes."""
    refuse_endless_arrays()
    with pytest.raises(ua.UaError, match="a length of -"):
        from_binary(ua.DataValue, Buffer(bytes.fromhex(f"018cffffff7f{length}ff")))
    texts = from_binary(ua.DataValue, Buffer(bytes.fromhex("018c02000000ffffffff0100000041")))
    assert texts.Value.Value == [None, "A"]


@pytest.mark.parametrize("program", ["drivers.opcua.client", "drivers.outputs.serve"])
def test_who_reads_from_strangers_refuses_them(program: str) -> None:
    """The link of a driver and the server of the results."""
    source = importlib.import_module(program)
    assert source.refuse_endless_arrays is refuse_endless_arrays
    assert "    refuse_endless_arrays()\n" in inspect.getsource(source)
