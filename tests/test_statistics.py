"""What a cycle says: between rows that are known, and whatever cycles were heard before it."""

from dataclasses import fields, replace

import numpy as np
import numpy.typing as npt
import pytest
import rigs

from twin.monitor.cycles import Cycle, cut, figures
from twin.monitor.model_bank import SUSPECTS, ModelBank
from twin.monitor.statistics import PLACES, WEAK, CycleResidual, ScoreExtractor

Floats = npt.NDArray[np.float64]
CycleInput = tuple[Cycle, npt.NDArray[np.int64], Floats, dict[str, float]]


def extractor() -> ScoreExtractor:
    return ScoreExtractor.of(rigs.config("gripper").data, rigs.config("gripper").monitor.healthy)


@pytest.fixture(scope="module")
def heard() -> list[CycleInput]:
    """Cycles that have swung in, with what a bank and the monitor say of them."""
    rows = rigs.expectation(rigs.twin("gripper"), [rigs.recorded("gripper", 20.0)[0]])
    theta = rigs.theta("gripper")
    bank = ModelBank(theta)
    found = [(cycle, *bank.take(cycle), figures(cycle, theta)) for cycle in cut([rows])]
    return [heard for heard in found if heard[0].complete and heard[0].settled]


def without(heard: CycleInput, rows: slice) -> CycleInput:
    """The same cycle with no deviation in some rows."""
    cycle, drawn, expected, found = heard
    ticks = cycle.ticks.copy()
    ticks["expected"][rows] = np.nan
    return Cycle(0, cycle.samples, ticks, complete=True), drawn, expected, found


def test_scores_and_sizes_are_those_of_the_inverse_covariance(heard: list[CycleInput]) -> None:
    said = extractor().extract(*heard[0])
    assert said
    inverse = np.linalg.inv(said.alone)
    power = np.diag(said.signatures.T @ inverse @ said.signatures)
    along = said.off @ inverse @ said.signatures
    shown = np.isfinite(said.scores())
    np.testing.assert_array_equal(shown, power >= WEAK)
    np.testing.assert_allclose(said.scores()[shown], (along / np.sqrt(power))[shown], rtol=1e-9)
    np.testing.assert_allclose(said.sizes()[shown], (along / power)[shown], rtol=1e-9)
    np.testing.assert_allclose(np.diag(said.alike())[shown], 1.0)


def test_a_change_moves_scores_as_if_it_were_the_residual(heard: list[CycleInput]) -> None:
    said = extractor().extract(*heard[0])
    assert said
    changes = np.random.default_rng(1).normal(size=(len(said.off), 2))
    moved = [replace(said, off=change).scores() for change in changes.T]
    shown = np.isfinite(said.scores())
    np.testing.assert_allclose(said.moved_by(changes)[shown], np.hypot(*moved)[shown])


def assert_same(residual: CycleResidual | None, other: CycleResidual | None) -> None:
    assert residual
    assert other
    for name in (field.name for field in fields(CycleResidual)):
        np.testing.assert_array_equal(getattr(residual, name), getattr(other, name), err_msg=name)


def test_of_what_a_cycle_does_not_depend_on_it_says_nothing(heard: list[CycleInput]) -> None:
    """Else its scores are what steps make of nothing, and false alarms are three times as many."""
    names = [suspect.parameter.name for suspect in SUSPECTS]
    for cycle in heard:
        assert "h1_low_level" not in cycle[3]  # the nozzle stays off
        said = extractor().extract(*cycle)
        assert said
        shown = np.isfinite(said.scores())
        assert [names[i] for i in np.flatnonzero(~shown)] == ["h2_shift"]


@pytest.mark.slow
def test_a_cycle_says_the_same_whichever_were_heard_before(heard: list[CycleInput]) -> None:
    old = extractor()
    for cycle in heard * 2:
        for other in (cycle, without(cycle, slice(300, 350)), without(cycle, slice(0, 3))):
            assert_same(old.extract(*other), extractor().extract(*other))


def test_where_bins_are_is_remembered_of_few_cycles(heard: list[CycleInput]) -> None:
    old = extractor()
    for gap in range(2 * PLACES):
        old.extract(*without(heard[0], slice(0, 10 * gap)))
        assert 1 <= len(old._seen) <= PLACES


def test_what_no_hypothesis_knows_is_not_heard(heard: list[CycleInput]) -> None:
    cycle, drawn, expected, found = heard[0]
    all_there = extractor().extract(cycle, drawn, expected, found)
    expected = expected.copy()
    expected[:, 3] = np.nan
    assert extractor().extract(cycle, drawn, expected, found) is None
    expected[:, 3] = expected[:, 4]
    expected[drawn < 400, 3] = np.nan  # one hypothesis, for a while
    said = extractor().extract(cycle, drawn, expected, found)
    assert all_there
    assert said
    assert 0 < len(said.place) < len(all_there.place)
    assert set(said.place) <= set(all_there.place)
    assert np.isfinite(said.signatures).all()
