"""Python to C: the same numbers from both; what has no translation is refused with its place."""

import ctypes
import math
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from twin.exchange.c_expressions import INDEX, LANE, NUMBER, ROWS, WHOLE, Untranslatable
from twin.exchange.translate import Program

LOW, _STEEP = 2, 0.1
Floats = npt.NDArray[np.float64]


class Pair(NamedTuple):
    one: float
    two: float


def precedence(a: float, b: float) -> float:
    negative = -a
    twice = -(-negative)  # noqa: B002 - what C would take for a decrement
    return twice - (b - a) - a / (b / a) * -b + (a + b) * (a - b) ** 2 - abs(a - 3.0) ** (1.0 / 3.0)


def extremes(a: float, b: float) -> float:
    return min(a, b, 1.5) + 10.0 * max(a, b)


def chosen(a: float, b: float) -> float:
    large = a > b or (b > 2.0 and not a < 0.0)
    size = 2 if large else 0.5
    if a == b:
        return 0.0
    if large and a:
        size += 1
    else:
        size *= _STEEP
    return size / 3 if size >= LOW else size


def swapped(a: float, b: float) -> float:
    a, b = b, a
    pair = Pair(a, b)
    three = (pair.one, pair.two, a * b)
    first, _, third = three
    return first + 2.0 * pair.two + 4.0 * three[1] + 8.0 * third


def counted(a: float, b: float) -> float:
    total = 3
    total /= 2
    for n in range(1, 4):
        total += 1
        for _ in range(n):
            total += n * a
    for factor, power in ((2, b), (LOW, a)):
        total -= factor * power
    return total


def whole_numbers(a: float, b: float) -> float:
    bits = int(a) & 6 | (1 if b > 0.0 else 0)
    steps = min(max(math.ceil(abs(b)), 1), 5)
    return bits / steps + steps + math.floor(b) * 0.5


def logs(a: float, b: float) -> float:
    there = np.where(a > 0.0, math.sqrt(abs(a)), b).copy()
    return np.log(abs(b) + 1.0) + np.exp(-abs(there)) + (1.0 if math.isnan(a) else 0.0)


FUNCTIONS = (precedence, extremes, chosen, swapped, counted, whole_numbers, logs)
VALUES = [(1.0, 2.0), (2.5, -1.25), (3.0, 3.0), (-7.0, 0.3), (5.0, 2.5), (-0.1, 4.75)]


def rows(state: Floats, k: Floats, i: int) -> None:
    """Every row over and over."""
    state[0, i] = state[1, i] = k[LOW, i]
    state[[2, 3]] += k[0, i]
    state[3 if k[1, i] > 0.0 else 2] *= 2.0


def lanes(state: Floats, out: Floats) -> None:
    for i in range(state.shape[1]):
        before = state[0].copy()
        if state[1, i] < 0.0:
            continue
        out[i] = before[i] + state[1, i]


def loaded(text: str, folder: Path) -> ctypes.CDLL:
    (folder / "all.c").write_text(f"#include <math.h>\n{text}")
    command = ["cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "all.c"]
    done = subprocess.run(
        [*command, "-o", "all.so", "-lm"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(folder / "all.so"))


@pytest.fixture(scope="module", params=[pytest.param("cc", marks=pytest.mark.needs("cc"))])
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    program = Program()
    for function in FUNCTIONS:
        program.function(function, NUMBER, NUMBER)
    program.function(rows, ROWS, ROWS, INDEX)
    program.function(lanes, ROWS, LANE)
    text = program.text().replace("static double test_", "double test_")
    return loaded(text.replace("static void test_", "void test_"), tmp_path_factory.mktemp("c"))


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: function.__name__)
def test_both_give_the_same_to_the_last_bit(
    function: Callable[..., float], library: ctypes.CDLL
) -> None:
    translated = getattr(library, f"test_translate_{function.__name__}")
    translated.restype, translated.argtypes = ctypes.c_double, [ctypes.c_double] * 2
    for values in VALUES:
        assert translated(*values) == float(function(*values)), values


def test_minimum_and_maximum_of_no_number_are_those_of_python(library: ctypes.CDLL) -> None:
    translated = library.test_translate_extremes
    translated.restype, translated.argtypes = ctypes.c_double, [ctypes.c_double] * 2
    for values in ((math.nan, 1.0), (1.0, math.nan)):
        here, there = extremes(*values), translated(*values)
        assert here == there or (math.isnan(here) and math.isnan(there))


def test_rows_are_written_and_lanes_are_one(library: ctypes.CDLL) -> None:
    state, k = np.arange(4.0), np.array([0.5, 1.0, 7.0])
    expected = state[:, None].copy()
    rows(expected, k[:, None], 0)
    pointer = ctypes.POINTER(ctypes.c_double)
    library.test_translate_rows(state.ctypes.data_as(pointer), k.ctypes.data_as(pointer))
    assert state.tolist() == expected[:, 0].tolist() == [7.0, 7.0, 2.5, 7.0]
    out = np.zeros(1)
    library.test_translate_lanes(state.ctypes.data_as(pointer), out.ctypes.data_as(pointer))
    assert out[0] == 14.0
    state[1] = -1.0
    library.test_translate_lanes(state.ctypes.data_as(pointer), out.ctypes.data_as(pointer))
    assert out[0] == 14.0


def _while(a: float) -> float:
    while a > 1.0:
        a -= 1.0
    return a


def _text(a: float) -> str | float:
    return "more" if a > 0.0 else a


def _floored(a: float) -> float:
    return a // 2.0


def _rounded(a: float) -> int:
    return round(a)


def _chained(a: float) -> float:
    return 1.0 if 0.0 < a < 1.0 else 2.0


def _powered(a: float) -> float:
    a **= 3.0
    return a


def _strode(a: float) -> float:
    for _ in range(1, 9, 2): a += 1.0  # noqa: E701  # fmt: skip
    return a


def _skipped(a: float) -> float:
    for n in (1.0, 2.0):  # fmt: skip
        if a > n:
            continue
        a += n
    return a


def _is(a: float) -> float:
    return 1.0 if a is None else a


def _keyword(a: float) -> Pair:
    return Pair(one=a, two=a)


REFUSED = (
    _while, _text, _floored, _rounded, _chained, _powered, _strode, _skipped, _is, _keyword,
)  # fmt: skip


@pytest.mark.parametrize("function", REFUSED)
def test_what_has_no_translation_is_refused_with_its_place(function: Any) -> None:
    line = function.__code__.co_firstlineno + 1
    with pytest.raises(Untranslatable, match=rf"test_translate\.py:{line}: no translation"):
        Program().function(function, NUMBER)


def test_a_name_holds_one_kind_of_thing() -> None:
    def mixed(a: float) -> float:
        pair = (a, a)
        pair = 1.0
        return pair + a

    with pytest.raises(Untranslatable, match="no kind in common"):
        Program().function(mixed, NUMBER)


def test_functions_are_made_for_each_kind_of_argument() -> None:
    program = Program()
    names = {program.function(chosen, kind, kind).name for kind in (WHOLE, NUMBER, NUMBER)}
    assert names == {"test_translate_chosen", "test_translate_chosen_again"}
