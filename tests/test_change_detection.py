"""Sums over cycles: false alarms come as seldom as asked for, changes are found nearly as soon."""

import numpy as np
import numpy.typing as npt
import pytest

from twin.monitor.change_detection import (
    MOST_WAITING,
    WAITS,
    ChangeDetector,
    LearningGuard,
    ScoreNormalizer,
    began,
    limit,
)

Floats = npt.NDArray[np.float64]
SUSPECTS = 12


def alike(rng: np.random.Generator, cycles: int, groups: int) -> Floats:
    """Standard normal scores; those of a group are nearly the same, as signatures are."""
    group = np.arange(SUSPECTS) % groups
    common = rng.standard_normal((cycles, groups))[:, group]
    return np.sqrt(0.95) * common + np.sqrt(0.05) * rng.standard_normal((cycles, SUSPECTS))


def cosines(groups: int) -> Floats:
    group = np.arange(SUSPECTS) % groups
    return np.where(np.eye(SUSPECTS) > 0, 1.0, 0.95 * (group[:, None] == group))


def run_length(scores: Floats, cycles: float, groups: int) -> float:
    """Cycles until the sums are beyond the limit for one false alarm in ``cycles``."""
    changes = ChangeDetector(np.arange(SUSPECTS) % 3 == 0, np.ones(SUSPECTS))
    changes.weigh(cosines(groups))
    for count, normal in enumerate(scores, 1):
        changes.take(normal)
        if changes.log_sum >= limit(cycles):
            return count
    return np.inf


@pytest.mark.parametrize("groups", [1, 4, SUSPECTS])
def test_false_alarms_come_as_seldom_as_asked_for_however_alike_the_suspects_are(
    groups: int,
) -> None:
    rng = np.random.default_rng(groups)
    lengths = [run_length(alike(rng, 3000, groups), 150.0, groups) for _ in range(150)]
    assert 75.0 < np.mean(lengths) < 300.0


@pytest.mark.parametrize(("sigmas", "optimum"), [(0.5, 84.0), (1.0, 24.0), (2.0, 6.8)])
def test_a_change_is_found_nearly_as_soon_as_by_who_knows_what_to_look_for(
    sigmas: float, optimum: float
) -> None:
    # The optimum is a CUSUM's for this suspect, sign and size alone, at the same false alarms: 1.4
    # is what looking for all of them costs (tools/bench.py measures it with real signatures).
    rng = np.random.default_rng(7)
    month = 30 * 86_400.0 / 3.0
    delays = []
    for _ in range(100):
        scores = alike(rng, 400, 6)
        scores[:, [0, 6]] += sigmas  # the first of them, and what is alike
        delays.append(run_length(scores, month, 6))
    assert np.mean(delays) < 1.4 * optimum


def test_a_change_to_less_is_found_only_where_it_can_be() -> None:
    changes = ChangeDetector(np.array([True, False]), np.ones(2))
    for _ in range(30):
        changes.take(np.array([-2.0, -2.0]))
    assert changes.log_sum > 20.0
    assert changes.foremost() == (0, -1)
    one_way = ChangeDetector(np.array([False, False]), np.ones(2))
    for _ in range(30):
        one_way.take(np.array([-2.0, -2.0]))
    assert one_way.log_sum < 1.0


def test_what_a_cycle_does_not_show_is_left_out() -> None:
    changes = ChangeDetector(np.array([False, False]), np.ones(2))
    changes.take(np.array([3.0, np.nan]))
    alone = ChangeDetector(np.array([False]), np.ones(1))
    alone.take(np.array([3.0]))
    assert changes.log_sum == pytest.approx(alone.log_sum - np.log(2.0))  # it has half the weight


def test_one_cycle_alone_is_no_change_however_far_out_it_is() -> None:
    changes = ChangeDetector(np.array([True, False]), np.ones(2))
    changes.take(np.array([0.0, 30.0]))
    assert changes.log_sum < limit(10_000.0)
    for _ in range(2):
        changes.take(np.array([0.0, 30.0]))
    assert changes.log_sum > limit(10_000.0)


@pytest.mark.parametrize("since", [1, 4, 30])
def test_when_it_began_is_found(since: int) -> None:
    scores = np.random.default_rng(since).standard_normal(100)
    scores[-since:] += 4.0
    assert abs(began(scores) - since) <= 1


def test_what_was_less_before_is_not_taken_for_what_is_more_now() -> None:
    scores = np.concatenate([np.full(400, -0.3), np.full(3, 4.2)])
    assert began(scores) == 3


def test_nothing_is_learned_until_it_is_clear_that_no_change_began() -> None:
    calm, strange = np.array([0.5, np.nan]), np.array([0.1, -4.0])
    patience = LearningGuard[int]()
    assert patience.take(0, calm) == [0]
    assert patience.take(1, strange) == []
    for cycle in range(2, 1 + WAITS):
        assert patience.take(cycle, calm) == []
    assert patience.take(1 + WAITS, calm) == list(range(1, 2 + WAITS))
    assert patience.take(9, strange) == []
    patience.forget()
    assert patience.take(10, calm) == [10]


def test_what_is_strange_again_and_again_is_learned_in_the_end() -> None:
    patience, strange = LearningGuard[int](), np.array([4.0])
    learned = [patience.take(cycle, strange) for cycle in range(3 * MOST_WAITING)]
    assert [cycle for some in learned for cycle in some] == list(range(3 * MOST_WAITING))


def shaped(rng: np.random.Generator, cycles: int) -> Floats:
    """Standard scores, the first of them skewed as a log-normal variable, the second as gas keeps
    some heat from cycle to cycle, the third neither."""
    draws = rng.standard_normal((cycles, 3))
    spread = 0.21  # a skewness of 0.65
    log_normal = np.exp(spread * draws[:, 0])
    mean, deviation = np.exp(0.5 * spread**2), np.sqrt(np.exp(spread**2) * np.expm1(spread**2))
    keeps, kept = 0.3, np.zeros(cycles)
    for cycle in range(1, cycles):
        kept[cycle] = keeps * kept[cycle - 1] + np.sqrt(1 - keeps**2) * draws[cycle, 1]
    return np.column_stack([(log_normal - mean) / deviation, kept, draws[:, 2]])


def test_scores_become_normal_and_independent() -> None:
    scores, shape = shaped(np.random.default_rng(1), 20_000), ScoreNormalizer(3)
    found = []
    for standard in scores:
        step = shape.take(standard)
        found.append(step.normal)
        shape.learn(step)
    late = np.array(found[2000:])
    cubes, products = np.mean(late**3, axis=0), np.mean(late[1:] * late[:-1], axis=0)
    assert np.mean(scores[:, 0] ** 3) > 0.5
    assert np.abs(cubes).max() < 0.15
    assert np.mean(scores[1:, 1] * scores[:-1, 1]) > 0.25
    assert np.abs(products).max() < 0.05
    assert late.std(axis=0) == pytest.approx(1.0, abs=0.03)
    # The likelihood ratio of a change is 1 on average: that is what the sums' limit follows from.
    for scores_of, within in ((late, 0.15), (scores[2000:], 0.0)):
        ratio = np.exp(2.0 * np.clip(scores_of[:, 0], -5, 5) - 2.0).mean()
        assert (abs(ratio - 1.0) < within) == bool(within)


def test_what_is_not_shown_stays_so_and_what_was_before_stands() -> None:
    shape = ScoreNormalizer(2)
    for first, second in ((1.0, np.nan), (-0.5, 0.3), (np.nan, 0.2)):
        step = shape.take(np.array([first, second]))
        assert np.isnan(step.normal).tolist() == [np.isnan(first), np.isnan(second)]
        shape.learn(step)
    assert np.isfinite(shape.take(np.zeros(2)).normal).all()


def test_scores_that_hardly_change_have_values_still() -> None:
    shape = ScoreNormalizer(1)
    for _ in range(400):
        shape.learn(shape.take(np.array([3.0])))
    assert np.isfinite(shape.take(np.array([3.0])).normal).all()


def test_far_scores_stay_far() -> None:
    shape = ScoreNormalizer(1)
    for standard in shaped(np.random.default_rng(2), 3000)[:, :1]:
        shape.learn(shape.take(standard))
    assert shape.take(np.array([12.0])).normal[0] > 5.0
    assert shape.take(np.array([-12.0])).normal[0] < -12.0


def test_sums_of_several_devices_are_those_of_each() -> None:
    scores = np.random.default_rng(3).standard_normal((30, 4, SUSPECTS))
    scores[7, 2, 5] = np.nan
    together, each = (ChangeDetector(np.ones(SUSPECTS, bool), np.ones(SUSPECTS)) for _ in range(2))
    for normal in scores:
        together.take(normal)
    for device in range(4):
        each.begin()
        for normal in scores[:, device]:
            each.take(normal)
        assert together.log_sums[device] == pytest.approx(each.log_sum)
    together.begin_some(np.array([True, False, False, False]))
    assert np.isneginf(together._log[0]).all()
    assert np.isfinite(together.log_sums[1:]).all()
