"""Scores of healthy cycles become standard normal and independent, also where air wanders."""

from copy import copy

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import kstest

from twin.monitor.change_detection import ChangeDetector, limit
from twin.monitor.score_prediction import SHARES, TIMES, ScorePredictor

Floats = npt.NDArray[np.float64]
CYCLE_S = 3.0
MONTH = 30 * 86_400.0 / CYCLE_S  # cycles


def wandering(
    rng: np.random.Generator, cycles: int, suspects: int, time: float, share: float
) -> Floats:
    """Scores of variance 1, of which a share wanders with a time constant (s)."""
    keeps = np.exp(-CYCLE_S / time)
    wander = np.empty((cycles, suspects))
    wander[0] = rng.standard_normal(suspects)
    for cycle in range(1, cycles):
        kick = rng.standard_normal(suspects)
        wander[cycle] = keeps * wander[cycle - 1] + np.sqrt(1.0 - keeps**2) * kick
    own = rng.standard_normal((cycles, suspects))
    return np.sqrt(share) * wander + np.sqrt(1.0 - share) * own


def told(scores: Floats, cosine: float = 1.0, doubts: Floats | None = None) -> Floats:
    """Normal values of scores that are learned one after another, with a doubt of each cycle."""
    predictor, values = ScorePredictor(scores.shape[1]), []
    predictor.expect_wander(np.full(scores.shape[1], cosine))
    for cycle, score in enumerate(scores):
        doubt = 0.0 if doubts is None else float(doubts[cycle])
        values.append(predictor.normal(score, cycle * CYCLE_S, doubt))
        predictor.learn(score, cycle * CYCLE_S)
    return np.array(values)


def alarms(values: Floats) -> int:
    """How many of the suspects, each by itself, raise an alarm of sums at one false one a month."""
    count = 0
    for column in values.T:
        changes = ChangeDetector(np.ones(1, bool), np.ones(1))
        sums = []
        for normal in column[2:]:
            changes.take(np.array([normal]))
            sums.append(changes.log_sum)
        count += max(sums) >= limit(MONTH)
    return count


def test_scores_of_unknown_mean_and_scatter_become_standard_normal_and_independent() -> None:
    scores = np.random.default_rng(3).normal(5.0, 3.0, (12, 6000))
    normal = told(scores, 0.0)
    assert np.isnan(normal[:2]).all()  # nothing is known yet
    assert kstest(normal[2:].ravel(), "norm").pvalue > 0.01
    assert np.abs(np.corrcoef(normal[2:]) - np.eye(10)).max() < 0.06


def test_scores_that_may_wander_are_normal_from_the_third_cycle_on() -> None:
    # Half of them wander, as the prior has it: each with one of the times and shares.
    rng, scores = np.random.default_rng(5), []
    for time in TIMES:
        for share in SHARES:
            scores.append(wandering(rng, 30, 60, time, share))
            scores.append(rng.standard_normal((30, 60)))
    drawn = np.concatenate(scores, axis=1)
    normal = told(7.0 + 0.3 * drawn)[2:]
    assert normal.std() == pytest.approx(1.0, abs=0.02)
    assert abs(np.mean(np.abs(normal) > 3.0) - 0.0027) < 0.0006
    for apart in (1, 2, 5, 10):
        assert abs(np.mean(normal[apart:] * normal[:-apart])) < 0.02
        assert np.mean(drawn[2 + apart :] * drawn[2:-apart]) > 0.1  # what was to be taken out


def test_air_that_wanders_is_no_change() -> None:
    scores = wandering(np.random.default_rng(6), 300, 60, 60.0, 0.8)
    assert alarms(told(scores)) == 0
    assert alarms(told(scores, 0.0)) > 30  # where a score is expected not to wander


def test_air_that_begins_to_wander_after_long_calm_is_seldom_a_change() -> None:
    rng = np.random.default_rng(8)
    calm = 0.6 * rng.standard_normal((600, 40))
    assert alarms(told(np.concatenate([calm, wandering(rng, 300, 40, 60.0, 0.7)]))) <= 4


def test_a_change_is_found_where_a_score_does_not_wander() -> None:
    scores = np.random.default_rng(9).standard_normal((140, 50))
    scores[120:] += 2.0
    assert alarms(told(scores, 0.0)) > 45


def test_a_wander_is_followed_while_nothing_is_learned() -> None:
    scores, predictor = wandering(np.random.default_rng(7), 430, 40, 60.0, 0.9), ScorePredictor(40)
    predictor.expect_wander(np.ones(40))
    for cycle, score in enumerate(scores[:400]):
        predictor.learn(score, cycle * CYCLE_S)
    waiting, values, stale = copy(predictor), [], []
    for cycle, score in enumerate(scores[400:], 400):
        values.append(waiting.normal(score, cycle * CYCLE_S))
        stale.append(predictor.normal(score, cycle * CYCLE_S))
        waiting.follow(score, cycle * CYCLE_S)
    next_to = [np.mean(np.array(normal)[1:] * np.array(normal)[:-1]) for normal in (values, stale)]
    assert abs(next_to[0]) < 0.1
    assert next_to[1] > 0.5
    assert waiting.mean == pytest.approx(predictor.mean, abs=0.3)


def test_what_another_day_may_do_beside_a_wander_is_no_change() -> None:
    scores = wandering(np.random.default_rng(10), 330, 40, 60.0, 0.8)
    for doubt in (0.5, 2.0):
        assert alarms(told(scores, doubts=np.where(np.arange(330) < 200, 0.0, doubt))) == 0


def test_odd_cycles_that_were_learned_hide_no_later_change() -> None:
    scores = np.random.default_rng(11).standard_normal((330, 50))
    scores[[100, 150, 200]] += 40.0
    healthy = told(scores[:250], 0.0)
    assert alarms(np.delete(healthy, [100, 150, 200], axis=0)) <= 1
    scores[250:] += 1.5
    assert alarms(np.delete(told(scores, 0.0), [100, 150, 200], axis=0)) > 45


def test_the_sigma_of_a_score_grows_to_all_of_its_wander_while_nothing_is_learned() -> None:
    scores = 3.0 * wandering(np.random.default_rng(12), 500, 30, 60.0, 0.9)
    predictor = ScorePredictor(30)
    assert predictor.sigma(0.0).tolist() == [1.0] * 30
    predictor.expect_wander(np.ones(30))
    for cycle, score in enumerate(scores):
        predictor.learn(score, cycle * CYCLE_S)
    soon, later = (predictor.sigma(499 * CYCLE_S + wait).mean() for wait in (3.0, 36_000.0))
    assert soon < 1.7
    assert later == pytest.approx(3.0, rel=0.15)


def test_a_wander_is_forgotten_in_a_night() -> None:
    scores, predictor = wandering(np.random.default_rng(4), 400, 1, 60.0, 0.9), ScorePredictor(1)
    predictor.expect_wander(np.ones(1))
    for cycle, score in enumerate(scores):
        predictor.learn(score, cycle * CYCLE_S)
    usual = predictor.mean
    for cycle in range(400, 410):
        predictor.learn(usual + 2.0, cycle * CYCLE_S)
    soon, later = (predictor.normal(usual, 409 * CYCLE_S + wait)[0] for wait in (3.0, 36_000.0))
    assert soon < -2.0
    assert abs(later) < 0.5


def test_a_score_that_never_varied_says_nothing() -> None:
    assert np.isnan(told(np.zeros((6, 2)))).all()


def test_what_cycles_do_not_show_is_left_out() -> None:
    scores = np.random.default_rng(2).normal(3.0, 2.0, (40, 2))
    some, each = ScorePredictor(2), ScorePredictor(1)
    for cycle, (first, second) in enumerate(scores):
        is_shown = cycle % 4 == 0
        some.learn(np.array([first, second if is_shown else np.nan]), cycle * CYCLE_S)
        if is_shown:
            each.learn(np.array([second]), cycle * CYCLE_S)
    assert some.count.tolist() == [40.0, 10.0]
    seen = some.normal(np.array([np.nan, 5.0]), 120.0)
    assert np.isnan(seen[0])
    assert seen[1] == each.normal(np.array([5.0]), 120.0)[0]


def test_far_off_is_a_number_still() -> None:
    predictor = ScorePredictor(1)
    for cycle, score in enumerate(np.random.default_rng(1).normal(0.0, 1.0, (500, 1))):
        predictor.learn(score, cycle * CYCLE_S)
    assert 20.0 < predictor.normal(np.array([1e6]), 1500.0)[0] <= 30.0
