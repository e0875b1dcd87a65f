"""Trends: lines that are known, scatter that is not a trend, and when a limit comes."""

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from twin.figures.key_figures import FIGURES
from twin.figures.settings import FigureSettings, limits
from twin.figures.text import _give_or_take, in_words, limit_of, trend_plain
from twin.figures.trend import FARTHEST, Line, Trend, line_through, reach, trend_of
from twin.instants import DAY_NS
from twin.model.dataset import DataSet
from twin.monitor.settings import MonitorSettings

TRIALS = 150


def times(days: float, cycles: int) -> "np.ndarray[tuple[int], np.dtype[np.int64]]":
    return (np.linspace(0.0, days, cycles) * DAY_NS).astype(np.int64)


def through(days: float, values: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> Line:
    line = line_through(times(days, len(values)), values)
    assert line is not None
    return line


def kept(correlation: float, count: int, rng: np.random.Generator) -> "np.ndarray":  # type: ignore[type-arg]
    """Scatter of 1 whose neighbours correlate."""
    steps = rng.normal(size=count + 500) * math.sqrt(1 - correlation**2)
    return lfilter([1.0], [1.0, -correlation], steps)[500:]


# The line.


@settings(max_examples=30, deadline=None)
@given(st.floats(-50, 50), st.floats(-5, 5), st.floats(0.01, 100.0))
def test_a_line_without_scatter_is_found(level: float, slope: float, days: float) -> None:
    line = through(days, level + slope * (times(days, 500) / DAY_NS - days))
    assert line.level == pytest.approx(level, abs=1e-6 * (1 + abs(slope) * days))
    assert line.slope == pytest.approx(slope, rel=1e-4, abs=1e-6 / days)
    assert line.span == pytest.approx(days, rel=0.05)


def test_a_tenth_of_the_cycles_gone_wrong_moves_nothing() -> None:
    rng = np.random.default_rng(3)
    values = 40 + 2 * np.linspace(-10, 0, 3000) + rng.normal(size=3000)
    wrong = values.copy()
    wrong[rng.choice(3000, 300, replace=False)] += 500
    assert through(10, wrong).slope == pytest.approx(through(10, values).slope, abs=0.1)
    assert through(10, wrong).level == pytest.approx(through(10, values).level, abs=0.5)


def test_hours_that_went_wrong_move_little() -> None:
    rng = np.random.default_rng(4)
    values = 40 + 2 * np.linspace(-10, 0, 3000) + rng.normal(size=3000)
    values[1000:1200] += 200
    assert through(10, values).slope == pytest.approx(2.0, abs=0.2)


@pytest.mark.parametrize("cycles", [0, 1, 11])
def test_few_cycles_are_no_record(cycles: int) -> None:
    assert line_through(times(5, cycles), np.ones(cycles)) is None


def test_cycles_that_do_not_tell_are_left_out() -> None:
    values = np.where(np.arange(900) % 3 == 0, np.linspace(0, 9, 900), np.nan)
    assert through(9, values).slope == pytest.approx(1.0, rel=0.01)
    assert line_through(times(9, 900), np.full(900, np.nan)) is None


def test_a_week_of_shifts_has_empty_nights() -> None:
    days = np.arange(0, 7, 0.002)
    days = days[days % 1 < 0.33]
    line = line_through((days * DAY_NS).astype(np.int64), 5 + days)
    assert line is not None
    assert line.slope == pytest.approx(1.0)
    assert len(line.days) < 40


# Whether it is one, and how sure.


@pytest.mark.parametrize(("correlation", "most"), [(0.0, 0.04), (0.9, 0.05), (0.99, 0.07)])
def test_scatter_is_seldom_called_a_trend(correlation: float, most: float) -> None:
    """One in a hundred is what is asked for; the last has a memory of two bins."""
    rng = np.random.default_rng(1)
    found = [through(7, kept(correlation, 3000, rng)).is_trend for _ in range(TRIALS)]
    assert np.mean(found) <= most


def test_the_temperature_of_the_day_is_no_trend() -> None:
    rng = np.random.default_rng(2)
    days = times(5, 2000) / DAY_NS
    for phase in np.linspace(0, 6, 12):
        line = through(5, 3 * np.sin(2 * math.pi * days + phase) + rng.normal(size=2000))
        assert not line.is_trend


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_intervals_hold_what_they_promise(correlation: float) -> None:
    rng = np.random.default_rng(5)
    days = times(10, 3000) / DAY_NS - 10
    slopes, levels, comes = [], [], []
    for _ in range(TRIALS):
        line = through(10, 60 + 0.5 * days + kept(correlation, 3000, rng))
        slopes.append(abs(line.slope - 0.5) < line.slope_half())
        levels.append(abs(line.level - 60) < line.half(np.zeros(1))[0])
        when = reach(line, 65.0)
        assert when is not None
        comes.append(when.earliest <= 10.0 <= when.latest)
    for name, held in (("slope", slopes), ("level", levels), ("days", comes)):
        assert np.mean(held) > 0.87, name  # of 0.95, in 150 trials


def test_a_band_is_wider_away_from_the_record() -> None:
    line = through(10, np.random.default_rng(6).normal(size=1000))
    middle, end, ahead = line.half(np.array([-5.0, 0.0, 10.0]))
    assert middle < end < ahead


# When the limit comes.


def test_the_limit_comes_when_the_line_says() -> None:
    rng = np.random.default_rng(7)
    line = through(10, 200 + 2 * np.linspace(-10, 0, 2000) + rng.normal(size=2000))
    when = reach(line, 220.0)
    assert when is not None
    assert when.expected == pytest.approx(10.0, rel=0.05)
    assert when.earliest < when.expected < when.latest < 12


def test_no_limit_comes_where_there_is_no_trend_or_it_falls_or_is_over() -> None:
    rng = np.random.default_rng(8)
    flat, slope = rng.normal(size=1000), np.linspace(-5, 0, 1000)
    assert reach(through(10, flat), 5.0) is None
    assert reach(through(10, flat - 3 * slope), 50.0) is None
    assert reach(through(10, flat + 3 * slope), -2.0) is None


def test_a_limit_far_ahead_is_not_dated() -> None:
    line = through(10, 2 * np.linspace(-10, 0, 1000))
    when = reach(line, 2 * 10 * FARTHEST * 1.5)
    assert when is not None
    assert when.expected == math.inf


# In words.

LIMITS = limits(FigureSettings(), DataSet(), MonitorSettings())
LEAKAGE = FIGURES["leakage"]


def said(values: "np.ndarray[tuple[int], np.dtype[np.float64]]", limit: float | None) -> str:
    trend = trend_of(times(10, len(values)), values, limit)
    plain = trend_plain(LEAKAGE, trend)
    assert (plain["days_to_limit"] is not None) == (trend.comes is not None)
    return in_words(LEAKAGE, trend, 0)


def test_trends_in_words() -> None:
    noise, days = np.random.default_rng(9).normal(size=1000), np.linspace(-10, 0, 1000)
    assert said(np.ones(3), 250.0).startswith("leakage: not enough to say")
    assert "no trend (" in said(noise, 250.0)
    rising = said(200 + 5 * days + noise, 250.0)
    words = (
        r"leakage: 200\S* mbar/s, \+[45]\S* ± 0.0\S+ mbar/s per day over 10 days; its limit of 250"
    )
    assert re.match(words + r" mbar/s in (9.9|10.0|10.1) days \(9\.\d to 10\.\d\)$", rising)
    assert said(200 - 5 * days + noise, 250.0).endswith("away from its limit of 250 mbar/s")
    assert said(300 + 5 * days + noise, 250.0).endswith("over its limit of 250 mbar/s")
    assert "more than 29" in said(10 + 2 * days + noise, 250.0)
    assert said(200 + 5 * days + noise, None).endswith("days")


BEGIN_NS = 1_790_000_000 * 10**9  # 2026-09-21 14:13:20 UTC


def minutes(values: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> Trend:
    """A cycle each three seconds."""
    return trend_of(BEGIN_NS + 3 * 10**9 * np.arange(len(values)), values, 250.0)


@pytest.mark.parametrize("cycles", [40, 200, 2000])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_a_step_is_told_with_its_levels_its_time_and_how_sure_that_is(
    cycles: int, share: float
) -> None:
    """A hose that tears between two cycles."""
    at = round(share * cycles)
    rng = np.random.default_rng(cycles + at)
    values = np.where(np.arange(cycles) < at, 75.0, 465.0) + rng.normal(0.0, 6.0, cycles)
    trend = minutes(values)
    assert trend.step is not None
    assert trend.step.host_ns == BEGIN_NS + at * 3 * 10**9
    assert trend.step.latest_ns - trend.step.earliest_ns == 3 * 10**9
    assert trend.step.before == pytest.approx(75.0, abs=2.0 * trend.step.before_half)
    assert trend.step.after == pytest.approx(465.0, abs=2.0 * trend.step.after_half)
    plain = trend_plain(LEAKAGE, trend)
    assert plain["step"]["from_95"][0] < trend.step.before < plain["step"]["from_95"][1]
    assert plain["days_to_limit"] is None


@pytest.mark.slow
def test_the_intervals_of_a_step_hold_what_they_promise() -> None:
    rng = np.random.default_rng(18)
    held = []
    for _ in range(TRIALS):
        values = np.where(np.arange(300) < 120, 75.0, 100.0) + rng.normal(0.0, 6.0, 300)
        step = minutes(values).step
        assert step is not None
        at_ns = BEGIN_NS + 120 * 3 * 10**9
        held.append(
            (
                abs(step.before - 75.0) < step.before_half,
                abs(step.after - 100.0) < step.after_half,
                step.earliest_ns < at_ns <= step.latest_ns,
            )
        )
    assert (np.mean(held, axis=0) > 0.87).all()  # of 0.95, in 150 trials


@pytest.mark.parametrize("after", [5, 100])
def test_a_step_is_drawn_as_one(after: int) -> None:
    """With a line after it or not; between two cycles, and no time twice."""
    values = np.repeat([75.0, 465.0], [100, after])
    trend = minutes(values + np.random.default_rng(19).normal(0.0, 6.0, 100 + after))
    assert trend.step is not None
    assert (trend.line is None) == (after < 12)
    days, middle, half = trend.shape(trend.ahead(0.25))
    assert (np.diff(days) > 0.0).all()
    (row,) = np.flatnonzero(np.diff(middle) > 200.0)
    assert (days[row + 1] - days[row]) * DAY_NS == pytest.approx(3e9, rel=1e-3)
    assert middle[row] == pytest.approx(75.0, abs=5.0)
    assert middle[row + 1] == pytest.approx(465.0, abs=15.0)
    assert (half > 0.0).all()


def test_a_step_in_words() -> None:
    values = np.where(np.arange(100) < 40, 75.0, 465.0)
    values += np.random.default_rng(12).normal(0.0, 6.0, 100)
    said = in_words(LEAKAGE, minutes(values), BEGIN_NS + 600 * 10**9)
    assert re.fullmatch(
        r"leakage: stepped from 7\d\S* ± \d\S* to 46\d\S* ± \d\S* mbar/s at 14:15:20, 8 min ago"
        r" \(95 %: 14:15:17 to 14:15:20\); no trend since then \(\S+ ± \S+ mbar/s"
        r" over 3 min\); over its limit of 250 mbar/s",
        said,
    )


def test_minutes_have_no_rate_per_day() -> None:
    noise = np.random.default_rng(13).normal(size=300)
    for values in (75.0 + noise, 75.0 + np.linspace(0.0, 30.0, 300) + noise):
        trend = minutes(values)
        said = in_words(LEAKAGE, trend, BEGIN_NS)
        assert "per day" not in said
        assert "mbar/s over 15 min" in said
        assert trend_plain(LEAKAGE, trend)["line"]["per_day"] is None
    assert "no trend" not in said  # the last one rises
    assert trend.comes is None


def test_of_two_steps_the_newest_is_told() -> None:
    levels = np.repeat([75.0, 465.0, 75.0], [60, 80, 60])
    trend = minutes(levels + np.random.default_rng(14).normal(0.0, 6.0, 200))
    assert trend.step is not None
    assert trend.step.host_ns == BEGIN_NS + 140 * 3 * 10**9
    assert trend.step.after < trend.step.before


def test_what_follows_a_step_is_a_record_of_its_own() -> None:
    """And a limit comes by what it rises since then."""
    rng, days = np.random.default_rng(15), np.linspace(-10, 0, 2000)
    values = np.where(days < -6.0, 75.0, 200.0 + 2.0 * days) + rng.normal(size=2000)
    trend = trend_of(times(10, 2000), values, 220.0)
    assert trend.step is not None
    assert trend.line is not None
    assert trend.line.slope == pytest.approx(2.0, abs=0.2)
    assert trend.line.span == pytest.approx(6.0, abs=0.2)
    assert trend.comes is not None
    assert trend.comes.expected == pytest.approx(10.0, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("correlation", "most"), [(0.0, 0.04), (0.9, 0.05), (0.99, 0.07)])
def test_scatter_is_seldom_called_a_step(correlation: float, most: float) -> None:
    """One in a hundred is what is asked for."""
    rng = np.random.default_rng(16)
    record = times(7, 3000)
    found = [trend_of(record, kept(correlation, 3000, rng)).step for _ in range(TRIALS)]
    assert np.mean([slope is not None for slope in found]) <= most


@pytest.mark.parametrize("rise", [1.0, 3.0, 10.0, 100.0])
def test_what_grows_steadily_is_no_step(rise: float) -> None:
    rng = np.random.default_rng(17)
    for grown in (np.linspace(0.0, rise, 2000), rise * np.exp(np.linspace(-6.0, 0.0, 2000))):
        assert trend_of(times(7, 2000), grown + rng.normal(size=2000)).step is None


def ending(values: "np.ndarray[tuple[int], np.dtype[np.float64]]", lacking: int) -> Trend:
    """And then cycles that cannot tell."""
    return minutes(np.concatenate([values, np.full(lacking, np.nan)]))


def test_a_figure_that_can_be_measured_no_more_has_no_trend_but_an_end() -> None:
    """Leakage, once the vacuum does not come to H1 any more."""
    noise = np.random.default_rng(21).normal(size=100)
    trend = ending(75.0 + noise, 12)
    now = BEGIN_NS + 600 * 10**9
    assert re.fullmatch(
        r"leakage: last measured at 14:18:17, 5 min ago, and not in the 12 cycles since; 7[45]\S*"
        r" mbar/s",
        in_words(LEAKAGE, trend, now),
    )
    plain = trend_plain(LEAKAGE, trend)
    assert plain["ended"] == {"host_ns": BEGIN_NS + 99 * 3 * 10**9, "cycles": 12}
    assert trend.ahead(0.25) == 0.0
    torn = ending(np.where(np.arange(100) < 40, 75.0, 465.0) + noise, 12)
    said = in_words(LEAKAGE, torn, now)
    assert "no trend" not in said
    assert "12 cycles since; stepped from 7" in said
    assert said.endswith("over its limit of 250 mbar/s")
    rising = in_words(LEAKAGE, ending(np.linspace(75.0, 105.0, 100) + noise, 12), now)
    assert re.search(r"since; 105\S* mbar/s, \+\S+ ± \S+ mbar/s over 5 min$", rising)
    few = in_words(LEAKAGE, ending(noise[:3], 12), now)
    assert few.endswith("and not in the 12 cycles since")


def test_no_limit_comes_once_a_figure_is_not_measured() -> None:
    rising = 200.0 + np.linspace(0.0, 40.0, 1000)
    ended = trend_of(times(10, 1012), np.concatenate([rising, np.full(12, np.nan)]), 250.0)
    assert trend_of(times(10, 1000), rising, 250.0).comes is not None
    assert ended.comes is None
    assert "its limit" not in in_words(LEAKAGE, ended, 0)


@pytest.mark.parametrize(
    ("every", "lacking", "ends"), [(1, 2, False), (1, 3, True), (6, 5, False), (6, 6, True)]
)
def test_a_figure_that_is_seldom_measured_has_not_ended(
    every: int, lacking: int, ends: bool
) -> None:
    values = np.full(300 * every, np.nan)
    values[::every] = np.random.default_rng(22).normal(75.0, 1.0, 300)
    values[10:40] = np.nan  # once it was not measured for long, and then it was again
    trend = minutes(np.concatenate([values[: len(values) - every + 1], np.full(lacking, np.nan)]))
    assert trend.lacking == (lacking if ends else 0)
    assert ("no trend" in in_words(LEAKAGE, trend, BEGIN_NS)) == (not ends)


def test_limits_are_of_the_figures_that_have_one() -> None:
    found = {name: limit_of(name, LIMITS) for name in FIGURES}
    assert {name for name, limit in found.items() if limit is not None} == {
        "t1",
        "leakage",
        "free_flow",
    }
    assert found["t1"] == LIMITS.t1


def test_values_without_scatter_have_no_interval_of_zero_width() -> None:
    assert _give_or_take(9e-10, 0.0) == ""
    assert _give_or_take(0.0, 75.0) == ""
    assert _give_or_take(0.82, 75.69) == " ± 0.82"
