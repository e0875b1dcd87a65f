"""Key figures of hand-made courses, whose answers are known."""

import math
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tools.readme import filled
from twin.figures import expected
from twin.figures.cycle_view import (
    LAST_S,
    LEAK_WINDOW_S,
    LEAST_WINDOW_S,
    LONGEST_HOLE,
    Floats,
    Rows,
    find_in_cycle,
)
from twin.figures.expected import leakage_from_rest, t1_from_rest
from twin.figures.key_figures import FIGURES, Unit, figures, table
from twin.figures.settings import FigureSettings, Limits, limits
from twin.figures.text import limit_of
from twin.figures.warnings import CAUTIONS, in_words, warnings
from twin.model.dataset import DataSet, Ejector, Supply, System, Vessel
from twin.model.safeguards import LEAK_SETTLE_S, PROTECTED_S, PROTECTED_SWITCHES
from twin.monitor.healthy import Healthy
from twin.monitor.healthy import Scatter as Seen
from twin.monitor.settings import MonitorSettings
from twin.signals import Phase

ROOT = Path(__file__).parents[1]
IDLE, SUCTION, HOLD, BLOW_OFF = Phase
DATA = DataSet(
    supply=Supply(pressure_bar=5.0, droop_bar=0.2, optimum_bar=4.8),
    ejector=Ejector(air_consumption_sl_min=60.0, blow_off_sl_min=120.0),
)
UNIT = Unit(DATA, energy_kwh_m3=0.12)
LIMITS = limits(FigureSettings(permitted_t1_ms=2000.0), DATA, MonitorSettings())


def course(
    *stretches: tuple[Phase, float, float],
    supply: float = 4.8,
    off_lag: float = 0.0,
    on_lag: float = 0.0,
) -> Rows:
    """Rows of 1 ms: of each stretch its phase, its length (s) and the vacuum it leads to (mbar)."""
    phase, vacuum = [], [np.zeros(1)]
    for kind, seconds, target in stretches:
        rows = round(seconds * 1000)
        phase += [kind] * rows
        vacuum.append(np.linspace(vacuum[-1][-1], target, rows + 1)[1:])
    values = np.concatenate(vacuum)[:-1]
    return Rows(
        time=np.arange(len(phase)) * 1e-3,
        vacuum=values,
        supply=np.full(len(phase), supply),
        phase=np.array(phase, np.uint8),
        ended=phase[-1] in (IDLE, BLOW_OFF),
        blown=phase[-1] in (IDLE, BLOW_OFF),
        off_lag=off_lag,
        on_lag=on_lag,
    )


# Evacuated at 1000 mbar/s to 750, where the nozzle goes off; 100 mbar/s are lost; blown off.
PICK = ((SUCTION, 0.75, 750.0), (HOLD, 1.25, 625.0), (BLOW_OFF, 0.3, 0.0), (IDLE, 0.7, 0.0))


def unknown(found: dict[str, float], *names: str) -> bool:
    return all(math.isnan(found[name]) for name in names)


def of(shape: Rows) -> dict[str, float]:
    return figures(shape, UNIT)


def changed(shape: Rows, rows: slice, vacuum: float) -> Rows:
    values = shape.vacuum.copy()
    values[rows] = vacuum
    return replace(shape, vacuum=values)


# A whole cycle.


def test_a_pick_whose_figures_are_known() -> None:
    found = of(course(*PICK))
    assert found["t0"] == pytest.approx(550.0, abs=0.01)
    assert found["t1"] == pytest.approx(200.0, abs=0.01)
    assert found["leakage"] == pytest.approx(100.0, abs=0.01)
    assert found["leakage_band"] == 1
    assert found["quality"] == pytest.approx(80.0, abs=0.01)
    assert found["max_vacuum"] == pytest.approx(750.0, abs=2.0)  # the peak's median of five
    assert found["h1_not_reached"] == 0
    assert found["nozzle_share"] == pytest.approx(100 * 0.75 / 2.0)
    assert found["air"] == pytest.approx((0.75 * 60 + 0.3 * 120) / 60)
    assert found["energy"] == pytest.approx(found["air"] * 0.12)  # Wh: 0.12 kWh/m³ is 0.12 Wh/l
    assert (found["switchings"], found["quick_switchings"]) == (1, 1)
    for name in ("supply", "lowest_supply", "highest_supply"):
        assert found[name] == pytest.approx(4.8)
    assert unknown(found, "free_flow", "performance")


def test_the_levels_are_those_of_the_data_set() -> None:
    ejector = DATA.ejector.model_copy(update={"h1_mbar": 700.0, "h2_mbar": 300.0})
    unit = replace(UNIT, data=DATA.model_copy(update={"ejector": ejector}))
    found = figures(course((SUCTION, 0.72, 720.0), (IDLE, 1.0, 0.0)), unit)
    assert found["t0"] == pytest.approx(300.0, abs=0.01)
    assert found["t1"] == pytest.approx(400.0, abs=0.01)  # no air saving: as the sensor reads H1


def test_the_valves_lags_are_taken_from_where_the_pressure_shows_a_switching() -> None:
    again = ((SUCTION, 0.75, 750.0), (HOLD, 0.5, 600.0), (SUCTION, 0.25, 750.0), (HOLD, 0.5, 740.0))
    shape = course(*again, (IDLE, 1.0, 0.0), off_lag=0.012, on_lag=0.007)
    assert of(shape)["nozzle_share"] == pytest.approx(100 * (0.738 + 1.488 - 1.243) / 2.0)
    assert of(shape)["t1"] == pytest.approx(188.0, abs=0.01)
    assert of(shape)["switchings"] == 2
    assert of(shape)["quick_switchings"] == 3


def test_a_hold_shorter_than_the_lags_takes_no_time_twice() -> None:
    blip = ((SUCTION, 0.1, 100.0), (HOLD, 0.002, 100.0), (SUCTION, 0.1, 200.0))
    shape = course(*blip, (IDLE, 1.0, 0.0), on_lag=0.02)
    assert of(shape)["nozzle_share"] == pytest.approx(100.0)


def test_h1_is_where_the_nozzle_went_off_and_not_what_another_sensor_reads() -> None:
    """The ejector's own sensor sees more vacuum than one behind a long line."""
    found = of(course((SUCTION, 0.7, 700.0), (HOLD, 0.5, 690.0), (IDLE, 1.0, 0.0)))
    assert found["t1"] == pytest.approx(150.0, abs=0.01)
    assert found["h1_not_reached"] == 0


def test_a_sensor_too_slow_to_see_h2_before_h1_says_nothing_of_t1() -> None:
    found = of(course((SUCTION, 0.5, 500.0), (HOLD, 0.5, 600.0), (IDLE, 1.0, 0.0)))
    assert found["t0"] == pytest.approx(750.0, abs=0.01)
    assert unknown(found, "t1")


@pytest.mark.parametrize(
    ("rate", "band"), [(66, 0), (68, 1), (132, 1), (134, 2), (199, 2), (201, 3)]
)
def test_the_bands_of_leakage(rate: float, band: int) -> None:
    found = of(course((SUCTION, 0.75, 750.0), (HOLD, 0.7, 750 - 0.7 * rate), (IDLE, 1.0, 0.0)))
    assert found["leakage"] == pytest.approx(rate, abs=0.01)
    assert found["leakage_band"] == band


def test_leakage_settles_first_and_is_that_of_the_first_second() -> None:
    quick, slow = (HOLD, 0.049, 700.0), (HOLD, 1.0, 690.0)
    found = of(course((SUCTION, 0.75, 750.0), quick, slow, (HOLD, 5.0, 100.0), (IDLE, 1.0, 0.0)))
    assert found["leakage"] == pytest.approx(10.0, abs=0.1)


def test_a_hold_too_short_tells_no_leakage() -> None:
    found = of(course((SUCTION, 0.75, 750.0), (HOLD, 0.095, 700.0), (BLOW_OFF, 0.3, 0.0)))
    assert unknown(found, "leakage", "quality", "leakage_band")


def test_quality_ends_at_nothing() -> None:
    found = of(course((SUCTION, 0.75, 750.0), (HOLD, 0.2, 600.0), (IDLE, 1.0, 0.0)))
    assert found["leakage"] == pytest.approx(750.0, abs=0.1)
    assert found["quality"] == 0


# What is not reached.


def test_h1_that_is_not_reached() -> None:
    found = of(course((SUCTION, 0.6, 600.0), (SUCTION, 1.0, 740.0), (IDLE, 1.0, 0.0)))
    assert found["h1_not_reached"] == 1
    assert found["t0"] == pytest.approx(550.0, abs=0.01)
    assert unknown(found, "t1", "leakage", "free_flow")
    assert found["nozzle_share"] == 100


@pytest.mark.parametrize("level", [5.1, 80.0, 745.0])
def test_free_flow_is_where_a_second_of_suction_stands_still(level: float) -> None:
    found = of(course((SUCTION, 0.1, level), (SUCTION, 0.95, level), (IDLE, 1.0, 0.0)))
    assert found["free_flow"] == pytest.approx(level)
    assert found["performance"] == pytest.approx(100 * (1 - level / 750))


@pytest.mark.parametrize(
    "stretches",
    [
        ((SUCTION, 0.1, 80.0), (SUCTION, 0.85, 80.0), (IDLE, 1.0, 0.0)),  # not a second
        ((SUCTION, 0.5, 80.0), (SUCTION, 1.0, 95.0), (IDLE, 1.0, 0.0)),  # still rising
        ((SUCTION, 1.2, 4.0), (IDLE, 1.0, 0.0)),  # nothing
        ((SUCTION, 0.1, 760.0), (SUCTION, 0.95, 760.0), (IDLE, 1.0, 0.0)),  # beyond H1
        ((SUCTION, 0.1, 760.0), (SUCTION, 0.1, 80.0), (SUCTION, 0.9, 80.0), (IDLE, 1.0, 0.0)),
        ((SUCTION, 0.1, 80.0), (SUCTION, 0.95, 80.0)),  # nobody knows how it ended
    ],
)
def test_no_free_flow(stretches: tuple[tuple[Phase, float, float], ...]) -> None:
    found = of(course(*stretches))
    assert unknown(found, "free_flow", "performance")


# Air.


def test_air_follows_absolute_operating_pressure() -> None:
    """A sonic nozzle: its flow is proportional to the absolute pressure before it."""
    nominal, more = of(course(*PICK))["air"], of(course(*PICK, supply=5.8))["air"]
    assert more / nominal == pytest.approx((5.8 + 1.013) / (4.8 + 1.013))
    assert of(course(*PICK, supply=math.nan))["air"] == pytest.approx(nominal)


def test_air_of_a_nozzle_is_what_the_field_computes() -> None:
    """Nl/min ≈ 9.36·Cd·d²·p_abs: 1 mm, Cd 0.9 and 5.8 bar absolute are 49 Nl/min."""
    field = 9.36 * 0.9 * 1.0**2 * 5.813
    ejector = DATA.ejector.model_copy(update={"air_consumption_sl_min": field})
    unit = replace(UNIT, data=DATA.model_copy(update={"ejector": ejector}))
    found = figures(course((SUCTION, 1.0, 600.0), (IDLE, 1.0, 0.0)), unit)
    assert found["air"] == pytest.approx(field / 60)


def test_the_supply_is_that_while_the_nozzle_is_on() -> None:
    shape = course(*PICK)
    supply = np.where(shape.phase == SUCTION, 4.5, 5.0)
    supply[100:120] = 2.5
    found = of(replace(shape, supply=supply))
    assert found["lowest_supply"] == 2.5
    assert found["highest_supply"] == 4.5
    assert found["supply"] == pytest.approx(4.5 - 2.0 * 20 / 750)


def test_single_readings_of_the_supply_are_no_extremes() -> None:
    shape = course(*PICK)
    supply = shape.supply.copy()
    supply[[10, 20]] = 0.0, 9.0
    found = of(replace(shape, supply=supply))
    assert (found["lowest_supply"], found["highest_supply"]) == (4.8, 4.8)


# Valve protection.


def swinging(times: int, half_s: float) -> Rows:
    swings = [(HOLD, half_s, 600.0), (SUCTION, half_s, 750.0)] * times
    return course((SUCTION, 0.75, 750.0), *swings, (IDLE, 1.0, 0.0))


def test_switchings_within_the_time_of_valve_protection_are_counted() -> None:
    assert of(swinging(2, 0.4))["quick_switchings"] == 4
    assert of(swinging(5, 0.7))["quick_switchings"] == 5  # 0, 0.7, ... 2.8 s of ten
    assert of(swinging(5, 0.4))["quick_switchings"] == 8
    assert of(swinging(5, 0.4))["switchings"] == 6
    assert of(swinging(3, 1.499))["quick_switchings"] == 3
    assert of(swinging(3, 1.5))["quick_switchings"] == 2


def test_a_cycle_that_never_saves_air_switches_once() -> None:
    found = of(course((SUCTION, 0.7, 700.0), (IDLE, 1.0, 0.0)))
    assert (found["switchings"], found["quick_switchings"]) == (1, 0)


# What cannot be told is missing, not wrong.

NEEDS_ALL = ("t1", "leakage", "max_vacuum", "h1_not_reached", "nozzle_share", "air", "switchings")


def test_a_hole_in_the_readings_may_hide_a_switching() -> None:
    hole = changed(course(*PICK), slice(300, 300 + round(LONGEST_HOLE * 1000)), math.nan)
    found = of(hole)
    assert found["t0"] == pytest.approx(550.0, abs=0.01)  # it is not in the hole
    for name in NEEDS_ALL:
        assert unknown(found, name), name


def test_so_may_one_at_the_end_of_the_suction() -> None:
    shape = course((SUCTION, 0.7, 700.0), (IDLE, 1.0, 0.0))
    assert unknown(of(changed(shape, slice(689, 800), math.nan)), *NEEDS_ALL)
    assert of(changed(shape, slice(695, 800), math.nan))["switchings"] == 1


def test_a_few_bad_readings_hide_nothing() -> None:
    whole, holed = of(course(*PICK)), of(changed(course(*PICK), slice(300, 305), math.nan))
    for name, value in whole.items():
        assert holed[name] == pytest.approx(value, nan_ok=True), name


def test_suction_of_which_nothing_was_read_tells_nothing() -> None:
    short = course((SUCTION, 0.005, 5.0), (BLOW_OFF, 0.3, 0.0), (IDLE, 0.7, 0.0))
    found = of(changed(short, slice(0, 5), math.nan))
    assert unknown(found, *FIGURES.keys() - {"supply", "lowest_supply", "highest_supply"})


def test_h2_within_a_hole_has_no_time() -> None:
    found = of(changed(course(*PICK), slice(540, 560), math.nan))
    assert unknown(found, "t0")


def test_one_reading_alone_reaches_nothing() -> None:
    spiked = of(changed(course(*PICK), slice(100, 102), 990.0))
    assert spiked["t0"] == pytest.approx(550.0, abs=0.01)
    assert spiked["max_vacuum"] == of(course(*PICK))["max_vacuum"]


def test_a_cycle_whose_end_was_not_seen_tells_what_came_before() -> None:
    found = of(course(*PICK[:2]))
    assert found["t0"] == pytest.approx(550.0, abs=0.01)
    assert found["t1"] == pytest.approx(200.0, abs=0.01)
    assert found["leakage"] == pytest.approx(100.0, abs=0.01)
    assert found["h1_not_reached"] == 0  # that is sure already
    for name in ("max_vacuum", "nozzle_share", "air", "energy", "switchings", "quick_switchings"):
        assert unknown(found, name), name


def test_a_blow_off_cut_short_tells_no_air() -> None:
    found = of(replace(course(*PICK[:3]), blown=False))
    assert unknown(found, "air")
    assert found["nozzle_share"] == pytest.approx(37.5)


phases = st.lists(
    st.tuples(st.sampled_from([SUCTION, HOLD, BLOW_OFF, IDLE]), st.integers(1, 400)), max_size=8
)
holes = st.lists(st.tuples(st.integers(0, 900), st.integers(0, 60)), max_size=4)


@given(phases, holes, st.floats(-50.0, 1000.0), st.booleans())
def test_any_course_gives_finite_figures_or_none(
    stretches: list[tuple[Phase, int]],
    missing: list[tuple[int, int]],
    target: float,
    measured: bool,
) -> None:
    rows = [(SUCTION, 0.001, 0.0), *((kind, n / 1000, target) for kind, n in stretches)]
    lags = {"off_lag": 0.012, "on_lag": 0.007} if measured else {}
    shape = course(*rows, supply=4.8 if measured else math.nan, **lags)
    for first, length in missing:
        shape = changed(shape, slice(first, first + length), math.nan)
    found = of(shape)
    assert set(found) == set(FIGURES)
    assert not [name for name, value in found.items() if math.isinf(value)]
    for name in ("quality", "performance", "nozzle_share"):
        assert math.isnan(found[name]) or -1e-6 < found[name] < 100.0 + 1e-6


# As NumPy has it.


@st.composite
def any_rows(draw: st.DrawFn) -> Rows:
    """Of any phases, with noise and holes in both signals, and a supply that may fall."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = course((SUCTION, 0.001, 0.0), *((phase, n / 1000, 600.0) for phase, n in draw(phases)))
    count = len(shape.time)
    swing = 300.0 * np.sin(np.arange(count) / draw(st.integers(20, 2000)))
    vacuum = 500.0 + swing + rng.normal(0.0, draw(st.floats(0.0, 100.0)), count)
    supply = 4.8 + np.round(rng.normal(0.0, 0.1, count), draw(st.integers(0, 3)))
    supply -= draw(st.floats(0.0, 1e-3)) * np.arange(count)
    for values in (vacuum, supply):
        for first, length in draw(holes):
            values[first : first + length] = math.nan
    return replace(shape, vacuum=vacuum, supply=supply)


def about(expected: float, *, scale: float = 1.0) -> object:
    return pytest.approx(expected, rel=1e-9, abs=1e-9 * scale, nan_ok=True)


def line_through(time: Floats, values: Floats) -> tuple[float, float]:
    """Mean and slope."""
    if len(time) < 2:
        return float(values.mean()) if len(time) else math.nan, math.nan
    return float(values.mean()), float(np.polyfit(time - time.mean(), values, 1)[0])


@given(any_rows())
def test_how_the_nozzle_was_switched_is_as_numpy_has_it(rows: Rows) -> None:
    found = find_in_cycle(rows, 550.0, 750.0)
    over = np.flatnonzero(~np.isin(rows.phase, (SUCTION, HOLD)))
    suction = rows.phase[: over[0]] if len(over) else rows.phase
    on = suction == SUCTION
    edges = np.flatnonzero(np.diff(on, prepend=False, append=False)) * 1e-3
    times = edges[1:-1] if on[-1] else edges[1:]
    within = [np.sum((times >= t) & (times < t + PROTECTED_S)) for t in times]
    if len(rows.time) > 1:
        assert found.suction_s == about(len(suction) * 1e-3)
        assert found.blow_off_s == about(np.sum(rows.phase == BLOW_OFF) * 1e-3)
        assert found.nozzle.on_s == about(on.sum() * 1e-3)
        assert found.nozzle.off_s == about(edges[1])
    assert found.nozzle.switchings == len(edges) / 2
    assert found.nozzle.quick_switchings == max(within, default=0)
    assert found.nozzle.went_off == (HOLD in suction)


@given(any_rows())
def test_what_the_vacuum_did_is_as_numpy_has_it(rows: Rows) -> None:
    course = find_in_cycle(rows, 550.0, 750.0)
    found = course.vacuum
    over = np.flatnonzero(~np.isin(rows.phase, (SUCTION, HOLD)))
    suction = slice(over[0] if len(over) else None)
    there = np.isfinite(rows.vacuum[suction])
    time, vacuum = rows.time[suction][there], rows.vacuum[suction][there]
    hole = np.diff([0.0, *time, course.suction_s]).max()
    assert found.seamless == (len(time) > 0 and bool(hole <= LONGEST_HOLE))
    if not len(time):
        assert unknown(found._asdict(), "h2_s", "h1_s", "highest", "last", "last_slope", "leakage")
        return
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(vacuum, 2, "edge"), 5)
    smooth = np.median(windows, axis=1)
    assert found.highest == smooth.max()
    for level, reached in ((550.0, found.h2_s), (750.0, found.h1_s)):
        row = int(np.argmax(smooth >= level))
        ends = max(row - 1, 0), row + 1
        before = time[row - 1] if row else 0.0
        if smooth[row] < level or time[row] - before > LONGEST_HOLE:
            assert math.isnan(reached)
        else:
            assert reached == about(np.interp(level, smooth[slice(*ends)], time[slice(*ends)]))
    last = time >= course.suction_s - LAST_S
    mean, slope = line_through(time[last], smooth[last])
    assert (found.last, found.last_slope) == (about(mean), about(slope, scale=1e6))
    held = np.flatnonzero(rows.phase[suction] == HOLD)
    if not len(held) or not found.seamless:
        assert math.isnan(found.leakage)
        return
    longest = np.flatnonzero(np.diff(held, append=len(rows.phase) + 1) > 1)[0] + 1
    first = slice(held[0], held[0] + longest)
    since = rows.time[first] - rows.time[held[0]] - LEAK_SETTLE_S
    judged = (since >= 0.0) & (since <= LEAK_WINDOW_S) & np.isfinite(rows.vacuum[first])
    if not judged.any() or since[judged][-1] < LEAST_WINDOW_S:
        assert math.isnan(found.leakage)
    else:
        _, slope = line_through(since[judged], rows.vacuum[first][judged])
        assert found.leakage == about(-slope, scale=1e3)


@given(any_rows())
def test_the_supply_is_as_numpy_has_it(rows: Rows) -> None:
    found = find_in_cycle(rows, 550.0, 750.0).supply
    read = rows.supply[(rows.phase == SUCTION) & np.isfinite(rows.supply)]
    if not len(read):
        assert unknown(found._asdict(), *found._fields)
        return
    assert found.mean == about(read.mean())
    ends = np.sort(read)[[round(0.01 * (len(read) - 1)), round(0.99 * (len(read) - 1))]]
    assert [found.lowest, found.highest] == ends.tolist()


def test_the_mean_of_a_supply_that_stands_still_is_that_supply() -> None:
    assert of(course(*PICK, supply=4.7))["supply"] == 4.7


def test_one_row_is_a_course() -> None:
    found = of(course((SUCTION, 0.001, 0.0)))
    assert unknown(found, *FIGURES.keys() - {"supply", "lowest_supply", "highest_supply"})
    assert found["lowest_supply"] == found["highest_supply"] == 4.8


@given(st.floats(20.0, 400.0), st.floats(0.05, 0.5), st.integers(0, 2**32 - 1))
def test_noise_moves_the_figures_by_what_it_must(rate: float, noise: float, seed: int) -> None:
    hold = round(min(1.25, 140.0 / rate), 3)
    shape = course((SUCTION, 0.75, 750.0), (HOLD, hold, 750 - rate * hold), (IDLE, 1.0, 0.0))
    read: Floats = shape.vacuum + np.random.default_rng(seed).normal(0.0, noise, len(shape.time))
    found = of(replace(shape, vacuum=read))
    seen = min(hold - 0.05, 1.0)
    sigma = noise * math.sqrt(12.0 / (seen**3 * 1000))
    assert found["leakage"] == pytest.approx(rate, abs=6 * sigma + 0.01)
    assert found["t0"] == pytest.approx(550.0, abs=4.0)


# Warnings.


def test_a_slow_unit_has_a_limit_of_its_own() -> None:
    """A tank that needs more than two seconds is healthy."""
    hose = DATA.system.parts[0]
    parts = (hose, Vessel(kind="vessel", volume_ml=3000.0))
    tank = DATA.model_copy(update={"system": System(parts=parts)})
    needs = t1_from_rest(tank)
    assert needs > 2000.0
    assert limits(FigureSettings(), tank, MonitorSettings()).t1 == pytest.approx(1.25 * needs)
    assert limits(FigureSettings(permitted_t1_ms=2000.0), tank, MonitorSettings()).t1 == 2000.0


def test_a_unit_that_cannot_reach_h1_has_no_limit_of_t1() -> None:
    weak = DATA.model_copy(update={"effects": {"end_vacuum_loss": {"end_pressure_rise": 300.0}}})
    assert limits(FigureSettings(), weak, MonitorSettings()).t1 == math.inf
    assert limit_of("t1", limits(FigureSettings(), weak, MonitorSettings())) is None


def test_a_suction_that_is_to_end_before_h1_is_not_warned_of() -> None:
    unknown = dict.fromkeys(FIGURES, math.nan)
    short = unknown | {"h1_not_reached": 1.0, "max_vacuum": 600.0}
    assert warnings(short, unknown | {"h1_not_reached": 0.0}, LIMITS) == ("h1_not_reached",)
    assert warnings(short, short, LIMITS) == ()


def beyond(**measured: float) -> tuple[str, ...]:
    unknown = dict.fromkeys(FIGURES, math.nan)
    return warnings(unknown | measured, unknown, LIMITS)


def test_limits_are_the_units_where_nothing_is_set() -> None:
    t1 = 1.25 * t1_from_rest(DATA)
    assert Limits(t1, 250.0, 540.0, (0.75 * 4.8, 1.25 * 4.8)) == limits(
        FigureSettings(), DATA, MonitorSettings()
    )
    own = FigureSettings(
        permitted_leakage_mbar_s=90.0, permitted_free_flow_mbar=40.0, supply_low_bar=3.0
    )
    found = limits(own, DATA, MonitorSettings())
    assert (found.leakage, found.free_flow, found.supply) == (90.0, 40.0, (3.0, 6.0))
    assert found.configured == {"leakage", "free_flow", "lowest_supply"}


def commissioned(scatter: float) -> MonitorSettings:
    """A monitor of a unit whose commissioning showed its figures, with a share as their scatter."""
    means = {"t1": 400.0, "leakage": 60.0, "lowest_supply": 4.5, "highest_supply": 4.7}
    seen = {name: Seen(mean=mean, sigma=scatter * mean) for name, mean in means.items()}
    return MonitorSettings(healthy=Healthy(key_figures=seen))


def test_limits_come_from_the_commissioned_unit_where_it_showed_the_figure() -> None:
    """A tight unit leaks far less than any ejector permits: its limit is as near to that."""
    found = limits(FigureSettings(), DATA, commissioned(scatter=0.001))
    assert (found.t1, found.leakage) == (500.0, 75.0)
    assert found.supply == pytest.approx((0.75 * 4.5, 1.25 * 4.7))
    assert found.free_flow == 540.0  # no cycle showed it
    wider = limits(FigureSettings(), DATA, commissioned(scatter=0.1))
    assert wider.leakage > 2.0 * 60.0
    assert wider.t1 > 2.0 * 400.0
    set_here = limits(FigureSettings(permitted_t1_ms=900.0), DATA, commissioned(scatter=0.001))
    assert set_here.t1 == 900.0


def warned(limit: Limits, measured: float, expected: float, figure: str = "leakage") -> bool:
    """Whether a cycle with this figure is warned of, where the model expects another one."""
    unknown = dict.fromkeys(FIGURES, math.nan)
    return bool(warnings(unknown | {figure: measured}, unknown | {figure: expected}, limit))


def test_beyond_its_limit_the_expected_figure_does_not_hide_a_larger_one() -> None:
    """The commissioned cycles leaked less than the model says: limits do not follow from it."""
    tight = {"leakage": Seen(mean=4.0, sigma=0.01)}
    found = limits(FigureSettings(), DATA, MonitorSettings(healthy=Healthy(key_figures=tight)))
    assert found.leakage == 14.0
    assert warned(found, measured=300.0, expected=15.0)
    assert not warned(found, measured=24.0, expected=15.0)  # what the model expects, and 10 mbar/s
    assert warned(found, measured=16.0, expected=13.0)
    set_here = limits(FigureSettings(permitted_leakage_mbar_s=14.0), DATA, MonitorSettings())
    assert warned(set_here, measured=15.0, expected=15.0)


def test_where_cycles_scatter_the_expected_figure_has_that_scatter_about_it() -> None:
    wide = {"leakage": Seen(mean=40.0, sigma=10.0)}
    found = limits(FigureSettings(), DATA, MonitorSettings(healthy=Healthy(key_figures=wide)))
    margin = found.leakage - 40.0
    assert margin > 50.0
    assert not warned(found, measured=199.0 + margin, expected=200.0)
    assert warned(found, measured=201.0 + margin, expected=200.0)


def test_each_side_of_the_supply_is_judged_for_itself() -> None:
    """The expected supply is below the commissioned range: too high a one is still warned of."""
    found = limits(FigureSettings(), DATA, commissioned(scatter=0.001))
    unknown = dict.fromkeys(FIGURES, math.nan)
    expected = unknown | dict.fromkeys(("lowest_supply", "highest_supply"), 3.0)

    def at(bar: float) -> tuple[str, ...]:
        supply = dict.fromkeys(("lowest_supply", "highest_supply"), bar)
        return warnings(unknown | supply, expected, found)

    assert found.supply == pytest.approx((3.375, 5.875))
    assert at(3.0) == at(2.5) == ()
    assert at(2.0) == at(6.5) == ("supply_out_of_range",)


def test_a_supply_side_that_is_set_leaves_the_source_of_the_other() -> None:
    found = limits(FigureSettings(supply_high_bar=6.0), DATA, commissioned(scatter=0.001))
    high = {"lowest_supply": 4.0, "highest_supply": 7.0}
    (words,) = in_words(["supply_out_of_range"], high, found)
    assert words.endswith("bar, set in [figures])")
    (words,) = in_words(["supply_out_of_range"], high | {"lowest_supply": 2.0}, found)
    assert words.endswith("bar, from its commissioning)")


def test_limits_that_are_known_need_no_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def noted(name: str) -> float:
        asked.append(name)
        return 100.0

    monkeypatch.setattr(expected, "t1_from_rest", lambda _: noted("t1"))
    monkeypatch.setattr(expected, "leakage_from_rest", lambda _: noted("leakage"))
    limits(FigureSettings(), DATA, commissioned(scatter=0.001))
    limits(
        FigureSettings(permitted_t1_ms=900.0, permitted_leakage_mbar_s=90.0),
        DATA,
        MonitorSettings(),
    )
    assert asked == []
    limits(FigureSettings(permitted_t1_ms=900.0), DATA, MonitorSettings())
    assert asked == ["leakage"]


def test_a_porous_part_has_a_limit_of_its_own() -> None:
    """It loses more in hold than any ejector permits, and is healthy."""
    parts = (DATA.system.parts[0], Vessel(kind="vessel", volume_ml=50.0))
    effects = {"porous_leakage": {"flow_at_600mbar": 1.0}}
    porous = DATA.model_copy(update={"system": System(parts=parts), "effects": effects})
    usual = leakage_from_rest(porous)
    assert usual > 250.0
    assert limits(FigureSettings(), porous, MonitorSettings()).leakage == pytest.approx(
        1.25 * usual
    )


def test_nothing_is_lost_where_no_hold_comes() -> None:
    busy = DATA.ejector.model_copy(update={"air_saving": "off"})
    assert leakage_from_rest(DATA.model_copy(update={"ejector": busy})) == 0.0
    weak = DATA.model_copy(update={"effects": {"end_vacuum_loss": {"end_pressure_rise": 300.0}}})
    assert leakage_from_rest(weak) == 0.0


def test_a_unit_on_a_high_supply_has_a_range_of_its_own() -> None:
    high = DATA.model_copy(update={"supply": Supply(pressure_bar=6.8)})
    assert limits(FigureSettings(), high, MonitorSettings()).supply == pytest.approx((5.1, 8.5))


def test_words_say_where_a_limit_comes_from() -> None:
    over = {"t1": 9000.0, "leakage": 400.0}
    set_here = limits(FigureSettings(permitted_t1_ms=2000.0), DATA, MonitorSettings())
    t1, leakage = in_words(["t1_over_limit", "leakage_over_limit"], over, set_here)
    assert t1 == "t1 over limit (9000 of 2000 ms, set in [figures])"
    assert leakage == "leakage over limit (400 of 250 mbar/s, from the unit's data set)"
    seen = limits(FigureSettings(), DATA, commissioned(scatter=0.001))
    (leakage,) = in_words(["leakage_over_limit"], over, seen)
    assert leakage == "leakage over limit (400 of 75 mbar/s, from its commissioning)"


def test_what_the_data_set_expects_is_warned_of_only_beyond_a_limit_that_is_set() -> None:
    often = dict.fromkeys(FIGURES, math.nan) | {"quick_switchings": 7.0, "t1": 2100.0}
    assert warnings(often, often, LIMITS) == ("t1_over_limit",)
    seldom = often | {"quick_switchings": 2.0}
    assert warnings(often, seldom, LIMITS) == ("valve_protection", "t1_over_limit")


@pytest.mark.parametrize(
    ("name", "within", "over"),
    [
        ("valve_protection", {"quick_switchings": 5}, {"quick_switchings": PROTECTED_SWITCHES}),
        ("t1_over_limit", {"t1": 2000.0}, {"t1": 2001.0}),
        ("leakage_over_limit", {"leakage": 250.0}, {"leakage": 250.1}),
        ("h1_not_reached", {"h1_not_reached": 0}, {"h1_not_reached": 1, "max_vacuum": 700.0}),
        ("free_flow_too_high", {"free_flow": 540.0}, {"free_flow": 541.0}),
        (
            "supply_out_of_range",
            {"lowest_supply": 3.61},
            {"lowest_supply": 3.59, "highest_supply": 5},
        ),
        (
            "supply_out_of_range",
            {"highest_supply": 5.99},
            {"lowest_supply": 5, "highest_supply": 6.1},
        ),
    ],
)
def test_a_warning_stands_beyond_its_limit(
    name: str, within: dict[str, float], over: dict[str, float]
) -> None:
    assert beyond(**within) == ()
    assert beyond(**over) == (name,)
    (words,) = in_words([name], over, LIMITS)
    assert "nan" not in words


def test_what_is_not_known_warns_of_nothing() -> None:
    assert beyond() == ()
    assert len(CAUTIONS) == 6
    assert {caution.figure for caution in CAUTIONS.values()} <= set(FIGURES)


def test_the_table_names_every_figure() -> None:
    rows = table().splitlines()[2:]
    assert [row.split("`")[1] for row in rows] == list(FIGURES)


def test_the_page_has_the_tables_and_every_key() -> None:
    page = (ROOT / "docs" / "key-figures.md").read_text()
    assert filled(page) == page, "run: python tools/readme.py"
    assert all(f"`{name}`" in page for name in (*FIGURES, *CAUTIONS))
    (example,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    keys = tomllib.loads(example)["figures"]
    given = FigureSettings.model_validate(keys)
    assert "\n# password = " in example  # without a user in the URL there is none
    assert "\n# price_per_m3 = " in example  # of two prices one is set
    assert "\n# keep_days = " in example  # by default all are kept
    assert {*keys, "password", "price_per_m3", "keep_days"} == set(FigureSettings.model_fields)
    found = limits(given, DATA, MonitorSettings())
    assert (found.t1, found.leakage, found.free_flow) == (2000.0, LIMITS.leakage, LIMITS.free_flow)
    assert found.supply == pytest.approx(LIMITS.supply)  # the defaults, as the page says


def test_the_supply_range_is_one() -> None:
    with pytest.raises(ValueError, match="supply_low_bar must be below"):
        FigureSettings(supply_low_bar=6.0, supply_high_bar=5.0)


def test_a_title_for_people_does_not_call_h1_the_hysteresis() -> None:
    assert FIGURES["h1_not_reached"].title == "H1 not reached"
    assert FIGURES["free_flow"].title == "free flow"
