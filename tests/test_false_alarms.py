"""The rate of false alarms: measured as it is, and judged against the one that is set."""

import numpy as np
import pytest

from tools.false_alarms import (
    DAYS,
    PATH_OF,
    WANTED_CYCLE_S,
    WITHIN,
    Device,
    Rate,
    is_as_set,
    of_limits,
    table,
)
from tools.splitting import SETTLES, rate
from twin.alarms.rules import default_rules
from twin.figures.settings import LIMITED
from twin.monitor.change_detection import SHARES, SIZES, ChangeDetector, limit
from twin.monitor.false_alarm_budget import LIMITS, SINGLE_CYCLES, SUMS, cycles_between
from twin.monitor.isolation import looked_for
from twin.monitor.model_bank import SUSPECTS


def rates(times: float) -> list[Rate]:
    """Three paths with as many times the wanted number in all."""
    shares = {"sums over cycles": 0.9, "single cycles": 0.05, "limits of key figures": 0.05}
    return [Rate(what, share, times, times, times, "") for what, share in shares.items()]


@pytest.mark.parametrize(
    ("times", "kept"), [(0.0, False), (0.52, False), (0.68, True), (1.49, True), (1.6, False)]
)
def test_too_few_false_alarms_are_not_the_rate_that_is_set(times: float, kept: bool) -> None:
    assert is_as_set(rates(times)) is kept
    assert (": kept." in table(rates(times), 1000, 0)) is kept


def test_every_alarm_is_counted_or_no_judgement_of_cycles() -> None:
    assert set(PATH_OF) == {rule.name for rule in default_rules()}


def times_of_normal_scores(wanted: float, devices: int = 400, begins: int = 200) -> float:
    """Alarms of sums over the wanted number if scores are normal, by importance sampling.

    In each device a change of the detector's own sizes begins at a drawn cycle. An alarm counts as
    the inverse of its likelihood ratio to no change, which is the statistic itself. All suspects
    and signs are alike here, so it does not matter which of them change.
    """
    rng, changes = np.random.default_rng(1), looked_for()
    changes.weigh(np.eye(len(SUSPECTS)))
    changes.take(np.full((devices, len(SUSPECTS)), np.nan))
    suspect, first = rng.integers(len(SUSPECTS), size=devices), rng.integers(begins, size=devices)
    size = rng.choice(SIZES, size=devices, p=SHARES)
    times = np.zeros(devices)
    for cycle in range(begins + 300):
        scores = rng.standard_normal((devices, len(SUSPECTS)))
        scores[np.arange(devices), suspect] += size * (cycle >= first)
        changes.take(scores)
        sums = changes.log_sums
        times = np.where(
            (times == 0.0) & (sums >= limit(wanted)), np.exp(np.log(wanted) - sums), times
        )
    assert np.all(times > 0.0)
    return float(times.mean())


def test_the_shares_are_one_budget_that_sums_use_up() -> None:
    """Sums of normal scores alone raise about as many false alarms as are set."""
    times = times_of_normal_scores(cycles_between(DAYS, SUMS, WANTED_CYCLE_S))
    assert 1.0 / WITHIN < SUMS * times < WITHIN
    assert pytest.approx(1.0) == SUMS + SINGLE_CYCLES + LIMITS


def test_splitting_counts_as_many_alarms_as_come_without() -> None:
    rng, wanted, devices, cycles = np.random.default_rng(2), 500.0, 300, 600
    scores = rng.standard_normal((50_000, 4))
    changes = ChangeDetector(np.ones(4, bool), np.ones(4))
    found = rate(scores, changes, wanted, rng, devices=100, cycles=SETTLES + cycles)
    changes.begin()
    alarms = 0
    changes.take(np.full((devices, 4), np.nan))
    for cycle in range(SETTLES + cycles):
        changes.take(rng.standard_normal((devices, 4)))
        raised = changes.log_sums >= limit(wanted)
        alarms += int(raised.sum()) if cycle >= SETTLES else 0
        changes.begin_some(raised)
    assert found.times == pytest.approx(alarms * wanted / devices / cycles, rel=0.2)


def with_t1(limit_ms: float) -> Device:
    """A device whose t1 is 400 ms with a scatter of 20 ms."""
    t1 = np.random.default_rng(3).normal(400.0, 20.0, 20_000)
    others = np.full((len(t1), len(LIMITED) - 1), np.nan)
    limits = np.array([[-np.inf], [limit_ms]]) * np.ones(len(LIMITED))
    figures = np.column_stack([t1, others])
    return Device(np.empty((0, 0)), np.eye(0), np.empty(0), 0, figures, limits, 0)


def test_a_limit_that_healthy_cycles_come_up_to_is_seen() -> None:
    assert of_limits([with_t1(480.0)], seed=1, resamples=2).times > 100.0  # four sigmas
    assert of_limits([with_t1(600.0)], seed=1, resamples=2).times < 0.01
