"""Addresses, codings and meanings of a PLC's values."""

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.tags import Address, Pressure, Tag
from twin.errors import ConfigError
from twin.quality import Quality
from twin.settings import Document
from twin.signals import PASCAL

AMBIENT = 101_325.0
FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}


def words_of(value: float, kind: str, order: str) -> np.ndarray:
    """What a PLC would hold: the encoder, kept apart from the decoder on purpose."""
    words = np.frombuffer(struct.pack(FORMATS[kind], value), ">u2").astype(np.uint16)
    return (words if order == "big" else words[::-1]).reshape(1, -1)


def pressure(**changes: Any) -> Pressure:
    table = {"address": "input:1", "type": "float32", "unit": "mbar", "reference": "absolute"}
    return Pressure.model_validate(table | changes)


@pytest.mark.parametrize(
    ("text", "area", "offset", "both"),
    [
        ("40001", "holding", 0, "holding:0 [40001]"),
        ("holding:0", "holding", 0, "holding:0 [40001]"),
        ("30005", "input", 4, "input:4 [30005]"),
        ("10017", "discrete", 16, "discrete:16 [10017]"),
        ("00002", "coil", 1, "coil:1 [00002]"),
        ("coil:1", "coil", 1, "coil:1 [00002]"),
        ("49999", "holding", 9998, "holding:9998 [49999]"),
        ("410000", "holding", 9999, "holding:9999 [410000]"),
        ("465536", "holding", 65535, "holding:65535 [465536]"),
    ],
)
def test_an_address_is_read_in_both_notations_and_said_in_both(
    text: str, area: str, offset: int, both: str
) -> None:
    address = Address.parse(text)
    assert (address.area, address.offset, str(address)) == (area, offset, both)


@given(st.sampled_from(["coil", "discrete", "input", "holding"]), st.integers(0, 65535))
def test_both_notations_of_an_address_mean_the_same(area: str, offset: int) -> None:
    address = Address.parse(f"{area}:{offset}")
    assert Address.parse(address.manual) == address


@pytest.mark.parametrize(
    "text", ["40000", "4000", "holding:65536", "465537", "50001", "holding", "holding:-1", "", 1]
)
def test_what_is_no_address_is_refused_with_the_notations(text: object) -> None:
    with pytest.raises(ValueError, match="no address"):
        Address.parse(text)


@given(
    kind=st.sampled_from(["int16", "uint16", "int32", "uint32"]),
    order=st.sampled_from(["big", "little"]),
    data=st.data(),
)
def test_whole_numbers_come_back_in_either_word_order(
    kind: str, order: Any, data: st.DataObject
) -> None:
    limits = np.iinfo(kind)
    value = data.draw(st.integers(int(limits.min), int(limits.max)))
    tag = Tag(address="holding:2", type=kind)  # type: ignore[arg-type]
    assert tag.raw(words_of(value, kind, order), order)[0] == value


@given(st.floats(width=32), st.sampled_from(["big", "little"]))
@example(3.3e38, "big")
def test_a_float_in_mbar_becomes_its_pascal_or_is_flagged(value: float, order: Any) -> None:
    pascal, quality = pressure().decode(words_of(value, "float32", order), order, AMBIENT)
    with np.errstate(over="ignore"):
        expected = np.float32(np.float64(value) * 100.0)
    if np.isfinite(expected):
        assert pascal[0] == expected
        assert quality[0] == 0
    else:
        assert np.isnan(pascal[0])
        assert quality[0] == Quality.BAD


@given(st.lists(st.integers(0, 0xFFFF), min_size=2, max_size=2))
def test_no_bits_whatever_upset_the_decoder(words: list[int]) -> None:
    tag = pressure(range=[0, 1300], overflow_above=5000)
    pascal, quality = tag.decode(np.array([words], np.uint16), "big", AMBIENT)
    assert math.isfinite(pascal[0]) or quality[0] & Quality.BAD


@pytest.mark.parametrize("unit", PASCAL)
@pytest.mark.parametrize(
    ("reference", "absolute"),
    [("absolute", 40_000.0), ("gauge", AMBIENT + 40_000.0), ("vacuum", AMBIENT - 40_000.0)],
)
def test_units_and_references(unit: Any, reference: Any, absolute: float) -> None:
    tag = pressure(unit=unit, reference=reference)
    words = words_of(40_000.0 / PASCAL[unit], "float32", "big")
    assert tag.decode(words, "big", AMBIENT)[0][0] == pytest.approx(absolute, rel=1e-6)
    gauge = tag.decode(words, "big", AMBIENT, onto="gauge")[0][0]
    assert gauge == pytest.approx(absolute - AMBIENT, rel=1e-6)


def test_scale_and_offset_apply_to_the_raw_number() -> None:
    siemens = pressure(type="int16", scale=1000 / 27648, offset=-1000, reference="gauge")
    pascal, _ = siemens.decode(words_of(13824, "int16", "big"), "big", AMBIENT)
    assert pascal[0] == pytest.approx(AMBIENT - 50_000.0)


@pytest.mark.parametrize(
    ("raw", "expected"),
    [(32511, 0), (32512, Quality.OVERFLOW), (-32512, 0), (-32513, Quality.OVERFLOW)],
)
def test_counts_beyond_what_the_input_measures_overflow(raw: int, expected: int) -> None:
    tag = pressure(type="int16", overflow_above=32511)
    assert tag.decode(words_of(raw, "int16", "big"), "big", AMBIENT)[1][0] == expected


@pytest.mark.parametrize(
    ("value", "flagged"), [(-0.5, True), (0.0, False), (1300.0, False), (1300.5, True)]
)
def test_beyond_its_range_a_value_is_flagged_and_kept(value: float, flagged: bool) -> None:
    words = words_of(value, "float32", "big")
    pascal, quality = pressure(range=[0, 1300]).decode(words, "big", AMBIENT)
    assert pascal[0] == value * 100
    assert quality[0] == (Quality.OUT_OF_RANGE if flagged else 0)


def test_an_overflowing_supply_is_none() -> None:
    tag = pressure(type="int16", reference="gauge", overflow_above=32511)
    words = np.array([[5000], [32767]], np.uint16)
    np.testing.assert_array_equal(tag.supply(words, "big", AMBIENT), [500_000.0, np.nan])


@given(st.integers(0, 0xFFFF), st.integers(0, 15))
def test_a_bit_of_a_word(word: int, bit: int) -> None:
    tag = Tag(address="input:4", bit=bit)  # type: ignore[arg-type]
    assert tag.raw(np.array([[word]], np.uint16), "little")[0] == word >> bit & 1


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('address = "input:4"', r"input:4 \[30005\] is a 16-bit word: say which bit"),
        ('address = "coil:0"\nbit = 3', "bit belongs to"),
        ('address = "coil:0"\ntype = "int16"', r"coil:0 \[00001\] holds one bit"),
        ('address = "40000"', "no address"),
        ("address = 40001\nbits = 3", "unknown key"),
    ],
)
def test_a_tag_that_cannot_be_is_refused_where_it_stands(table: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Document.parse(table, "rig.toml").section(Tag)


@pytest.mark.parametrize("changes", [{"range": [5, 5]}, {"scale": 0}, {"address": "coil:0"}])
def test_a_pressure_that_cannot_be_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"range|scale|one bit"):
        pressure(**changes)
