"""Bins: means over rows, and over lines between the rows that were drawn."""

from dataclasses import fields

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st

from twin.model.term import AGAIN
from twin.monitor.bins import (
    FARTHEST,
    PER_UNIT,
    SPARSE,
    Ints,
    _between,
    averaged,
    binned,
    sparse,
    warped,
)
from twin.signals import MS, Phase

Bytes = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]


def test_a_mean_of_lines_is_that_of_every_row_on_them() -> None:
    phase = np.repeat([Phase.IDLE, Phase.SUCTION, Phase.HOLD], [300, 900, 800]).astype(np.uint8)
    usable = np.random.default_rng(1).random(len(phase)) < 0.9
    bins = binned(phase, usable, np.zeros(1, np.int64))
    kept = sparse(np.diff(phase, prepend=255) != 0)
    values = np.random.default_rng(2).normal(size=(len(kept), 3))
    rows = [np.interp(np.arange(len(phase)), kept, column) for column in values.T]
    np.testing.assert_allclose(bins.through(kept, values), bins.mean(np.stack(rows, axis=1)))


def test_what_is_not_known_beside_a_bin_does_not_spoil_its_mean() -> None:
    phase = np.full(60, Phase.IDLE, np.uint8)
    usable = np.arange(60) >= 30
    bins = binned(phase, usable, np.zeros(1, np.int64))
    kept = np.array([0, 29, 30, 59])
    values = np.array([[np.nan], [np.nan], [1.0], [1.0]])
    np.testing.assert_allclose(bins.through(kept, values), 1.0)


def test_a_second_hold_of_a_cycle_is_another_place_by_turn() -> None:
    parts = [Phase.SUCTION, Phase.HOLD, Phase.SUCTION, Phase.HOLD, Phase.IDLE]
    cycle = np.repeat(parts, [90, 40, 30, 40, 20])
    phase = np.tile(cycle, 3).astype(np.uint8)
    starts = np.arange(3) * len(cycle)
    bins = binned(phase, np.ones(len(phase), np.bool_), starts)
    first, second = bins.stretch % 5 == 1, bins.stretch % 5 == 3
    assert set(bins.place[first]) == set(bins.place[second])
    assert not set(bins.place_by_turn[first]) & set(bins.place_by_turn[second])
    for place in np.unique(bins.place_by_turn):  # each is in all cycles
        assert sorted(bins.cycle[bins.place_by_turn == place]) == [0, 1, 2]


# --- against plain NumPy ------------------------------------------------------------------------


@st.composite
def recorded(draw: st.DrawFn) -> tuple[Bytes, Bools, Ints]:
    """Phases, usable rows, and where cycles start."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lengths = st.integers(1, 3) | st.integers(1, 900)
    runs = draw(st.lists(st.tuples(st.sampled_from(Phase), lengths), max_size=8))
    phase = np.repeat([run for run, _ in runs], [rows for _, rows in runs]).astype(np.uint8)
    usable = random.random(len(phase)) < draw(st.sampled_from([0.0, 0.1, 0.9, 1.0]))
    starts = draw(st.lists(st.integers(0, 3000), max_size=4, unique=True))
    return phase, usable, np.array(sorted(starts), np.int64)


@given(recorded(), st.sampled_from([2, 4]))
def test_bins_are_what_numpy_makes_of_every_row(
    found: tuple[Bytes, Bools, Ints], per_unit: int
) -> None:
    phase, usable, starts = found
    row = np.arange(len(phase))
    begins = (np.diff(phase, prepend=255) != 0) | np.isin(row, starts)
    stretch, first = np.cumsum(begins) - 1, np.flatnonzero(begins)
    since = row - first[stretch]
    step = np.floor(warped(since * MS) * per_unit).astype(np.int64)
    before = phase[np.maximum(first - 1, 0)]
    again = (phase[first] == Phase.SUCTION) & (before == Phase.HOLD)
    kind = np.where(again, AGAIN, phase[first]).astype(np.int64)
    _, here, number, count = np.unique(
        ((stretch << 16) + step)[usable], return_index=True, return_inverse=True, return_counts=True
    )
    here = row[usable][here]
    bins = binned(phase, usable, starts, per_unit)
    np.testing.assert_array_equal(bins.number[usable], number)
    assert (bins.number[~usable] == -1).all()
    np.testing.assert_array_equal(bins.count, count)
    np.testing.assert_array_equal(bins.cycle, np.searchsorted(starts, here, "right") - 1)
    np.testing.assert_array_equal(bins.stretch, stretch[here])
    np.testing.assert_array_equal(bins.kind, kind[stretch[here]])
    np.testing.assert_array_equal(bins.time, warped(since[here] * MS))
    np.testing.assert_array_equal(bins.place, (kind[stretch[here]] << 16) + step[here])


def test_a_step_of_warped_time_begins_at_the_same_row_hours_later() -> None:
    rows = 4_000_000
    bins = binned(np.zeros(rows, np.uint8), np.ones(rows, np.bool_), np.zeros(1, np.int64))
    step = np.floor(warped(np.arange(rows) * MS) * PER_UNIT)
    np.testing.assert_array_equal(bins.number, np.cumsum(np.diff(step, prepend=0.0) > 0.0))


@given(recorded(), st.integers(1, 400))
def test_a_mean_of_lines_between_any_rows(found: tuple[Bytes, Bools, Ints], apart: int) -> None:
    phase, usable, starts = found
    bins = binned(phase, usable, starts)
    kept = np.union1d(np.arange(0, len(phase), apart), np.arange(len(phase))[-1:])
    values = np.random.default_rng(apart).normal(size=(len(kept), 2))
    rows = [np.interp(np.arange(len(phase)), kept, of) if len(kept) else of for of in values.T]
    means = [np.bincount(bins.number[usable], row[usable]) / bins.count for row in rows]
    np.testing.assert_allclose(
        bins.through(kept, values), np.stack(means, axis=1), rtol=1e-9, atol=1e-9
    )


@given(recorded(), st.integers(1, 400))
def test_a_cycle_is_averaged_as_its_bins_are(found: tuple[Bytes, Bools, Ints], apart: int) -> None:
    phase, usable, _ = found
    drawn = np.union1d(np.arange(0, len(phase), apart), np.arange(len(phase))[-1:])
    random = np.random.default_rng(apart)
    expected = random.normal(size=(len(drawn), 3))
    off = np.where(usable, random.normal(size=len(phase)), np.nan)
    bins, mean, through = averaged(phase, off, drawn, expected)
    apart_from = binned(phase, usable, np.zeros(1, np.int64))
    for field in fields(bins):
        np.testing.assert_array_equal(getattr(bins, field.name), getattr(apart_from, field.name))
    np.testing.assert_allclose(mean, apart_from.mean(off))
    np.testing.assert_allclose(through, apart_from.through(drawn, expected), atol=1e-12)


@given(st.data(), st.integers(1, 40))
def test_only_between_known_rows_there_is_something_to_average(
    data: st.DataObject, rows: int
) -> None:
    def chosen(count: int) -> Bools:
        return np.array(data.draw(st.lists(st.booleans(), min_size=count, max_size=count)))

    drawn = np.flatnonzero(chosen(rows) | (np.arange(rows) == data.draw(st.integers(0, rows - 1))))
    known, off = chosen(len(drawn)), np.where(chosen(rows), 1.0, np.nan)
    expected = np.zeros((len(drawn), 3))
    expected[~known, data.draw(st.integers(0, 2))] = np.nan  # one is enough
    lines = np.interp(np.arange(rows), drawn, known.astype(float), 0.0, 0.0)
    np.testing.assert_array_equal(_between(drawn, expected, off), np.isfinite(off) & (lines == 1.0))


def test_rows_are_kept_ever_farther_apart_from_a_bend_on() -> None:
    offsets = [0]
    while offsets[-1] < 700:
        offsets.append(offsets[-1] + min(max(offsets[-1] // SPARSE, 1), FARTHEST))
    begins = np.zeros(700, np.bool_)
    begins[[0, 400]] = True
    expected = {*(o for o in offsets if o < 400), *(400 + o for o in offsets if o < 300), 399, 699}
    assert sparse(begins).tolist() == sorted(expected)


@given(st.lists(st.integers(0, 900), max_size=4), st.integers(-1, 700), st.integers(1, 899))
def test_rows_are_kept_as_if_all_before_were_there(bends: list[int], since: int, cut: int) -> None:
    begins = np.zeros(901, np.bool_)
    begins[bends] = True
    whole = sparse(begins, since)
    ago = cut - 1 - max((bend for bend in bends if bend < cut), default=-1 - since)
    rest = cut + sparse(begins[cut:], ago)
    np.testing.assert_array_equal(rest, whole[whole >= cut])


def test_of_no_rows_none_are_kept_and_there_is_no_bin() -> None:
    nothing = np.empty(0, np.int64)
    assert not len(sparse(np.empty(0, np.bool_)))
    bins = binned(np.empty(0, np.uint8), np.empty(0, np.bool_), nothing)
    assert not len(bins.count)
    assert bins.through(nothing, np.empty((0, 3))).shape == (0, 3)
