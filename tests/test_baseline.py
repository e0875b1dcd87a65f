"""One wanted rate of false alarms: single cycles and limits keep their share of it."""

import numpy as np
import pytest
import rigs

from twin.figures.settings import SHORTEST_CYCLE_S, healthy_reach
from twin.monitor.baseline import LEARNED, Baseline
from twin.monitor.false_alarm_budget import (
    LIMITS,
    SINGLE_CYCLES,
    SUMS,
    cycles_between,
    normal_limit,
    student_limit,
)
from twin.monitor.healthy import Healthy, Scatter, sure

NAMES = ("idle_mean", "suction_mean", "hold_mean", "h1_level")
MEAN, SIGMA = 3.0, 2.0
SMALLEST = 0.0


def commissioned(rng: np.random.Generator, cycles: int, names: tuple[str, ...] = NAMES) -> Baseline:
    """A unit whose figures are independent and normal, known by so many cycles."""
    seen = rng.normal(MEAN, SIGMA, (cycles, len(names)))
    if names[0].endswith("_rms"):
        seen = np.abs(seen - MEAN)
    known = zip(names, seen.mean(axis=0), seen.std(axis=0, ddof=1), strict=True)
    figures = {
        name: Scatter(mean=mean, sigma=sigma * sure(cycles), cycles=cycles)
        for name, mean, sigma in known
    }
    return Baseline(Healthy(figures=figures))


def test_the_shares_are_of_one_budget() -> None:
    assert pytest.approx(1.0) == SUMS + SINGLE_CYCLES + LIMITS
    assert cycles_between(30.0, 0.5, 2.0) == pytest.approx(2 * 30 * 86_400 / 2.0)


@pytest.mark.parametrize("cycles", [6, 12, 40])
def test_single_cycles_are_out_as_often_as_wanted_however_few_are_known(cycles: int) -> None:
    rng, wanted, out, units = np.random.default_rng(cycles), 50.0, 0, 400
    limit = normal_limit(wanted, len(NAMES))
    for _ in range(units):
        unit = commissioned(rng, cycles)
        for values in rng.normal(MEAN, SIGMA, (10, len(NAMES))):
            figures = dict(zip(NAMES, values, strict=True))
            normal = unit.normal(figures, SMALLEST, {})
            out += bool((np.abs(normal) >= limit).any())
            unit.learn(figures, normal)
    asked = units * 10 / wanted  # 80: two standard deviations are 0.22 of it
    assert asked / 1.3 < out < asked * 1.3


def test_an_rms_is_out_no_more_often_than_wanted() -> None:
    """As the size of one normal value it has the longest tail that it can have."""
    rng, names, wanted, out = np.random.default_rng(1), ("hold_rms", "idle_rms"), 50.0, 0
    limit = normal_limit(wanted, len(names))
    for _ in range(400):
        unit = commissioned(rng, 12, names)
        for values in np.abs(rng.normal(0.0, SIGMA, (10, len(names)))):
            normal = unit.normal(dict(zip(names, values, strict=True)), SMALLEST, {})
            assert (normal >= 0.0).all()
            out += bool((normal >= limit).any())
    assert 80 / 1.4 < out < 80 * 1.4


def test_what_is_smaller_than_an_alarm_is_worth_is_nothing() -> None:
    unit = commissioned(np.random.default_rng(2), 40)
    at = dict.fromkeys(NAMES, MEAN)
    near, far = (unit.normal({**at, "hold_mean": MEAN + by}, 5.0, {})[2] for by in (4.5, 30.0))
    assert near == 0.0
    assert far > 4.0


def test_what_another_day_may_do_to_a_figure_is_nothing_and_no_other_figure_is_excused() -> None:
    unit = commissioned(np.random.default_rng(2), 40)
    figures = dict.fromkeys(NAMES, MEAN + 15.0)
    in_doubt = unit.normal(figures, SMALLEST, {"hold_mean": 18.0})
    assert in_doubt[2] == 0.0
    every_day = unit.normal(figures, SMALLEST, {})
    assert every_day[2] > 4.0
    assert (np.delete(in_doubt, 2) == np.delete(every_day, 2)).all()


def test_a_figure_that_a_cycle_does_not_show_is_not_judged() -> None:
    unit = commissioned(np.random.default_rng(3), 40)
    normal = unit.normal({"idle_mean": MEAN}, SMALLEST, {})
    assert np.isfinite(normal).tolist() == [True, False, False, False]
    unit.learn({"idle_mean": MEAN}, normal)
    assert np.isfinite(unit.sigma).all()


def test_after_the_first_cycles_nothing_is_learned_so_a_slow_change_shows() -> None:
    rng = np.random.default_rng(4)
    unit = commissioned(rng, 12)
    limit = normal_limit(1e6, len(NAMES))
    for cycle in range(LEARNED + 4000):
        drift = 0.005 * SIGMA * max(cycle - LEARNED, 0)
        figures = dict(zip(NAMES, rng.normal(MEAN + drift, SIGMA, len(NAMES)), strict=True))
        normal = unit.normal(figures, SMALLEST, {})
        if (np.abs(normal) >= limit).any():
            break
        unit.learn(figures, normal)
    assert LEARNED + 300 < cycle < LEARNED + 1500


def test_a_limit_of_a_key_figure_is_beyond_what_healthy_cycles_reach() -> None:
    rng, days = np.random.default_rng(5), 0.002
    wanted = cycles_between(days, LIMITS, SHORTEST_CYCLE_S)
    beyond, units = 0, 4000
    for _ in range(units):
        seen = rng.normal(500.0, 8.0, 12)
        one = Scatter(mean=seen.mean(), sigma=seen.std(ddof=1) * sure(12), cycles=12)
        reach = healthy_reach(Healthy(key_figures={"t1": one}), days)["t1"]
        later = rng.normal(500.0, 8.0, 200)
        beyond += int((later > one.mean + reach).sum())
        assert one.mean - reach < seen.min()
    # One of five figures, one way: a fifth of the wanted rate.
    asked = units * 200 / wanted / 5
    assert asked / 1.5 < beyond < asked * 1.5


def test_few_cycles_make_a_limit_wider() -> None:
    assert student_limit(1e6, 5, 6) > 2.0 * student_limit(1e6, 5, 40) > 10.0


@pytest.mark.parametrize("name", rigs.NAMES)
def test_the_shipped_units_say_how_many_cycles_they_know(name: str) -> None:
    figures = rigs.config(name).monitor.healthy.figures
    assert {figure.cycles >= 30 for figure in figures.values()} == {True}
