"""Periods, duties and phases from answers to short pulses."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from twin.diagnosis.rhythms import (
    EARLIEST,
    PEAKS,
    PHASES,
    _Answers,
    _box_gains,
    _divided,
    _folded,
    _frequencies_of,
    _pulses,
    _spectra,
    _swings,
    _typical_cycle,
    _within,
)
from twin.model.mechanism import MECHANISMS
from twin.monitor.bins import Floats

WIDTH, COUNT = 0.05, 480  # s; pulses of 24 s
TIMES = WIDTH * np.arange(COUNT)
FREQUENCIES = _frequencies_of(24.0, 0.2, 120.0)


def answers(period: float, duty: float, shift: float, seed: int = 1) -> _Answers:
    """Answers that last for a third of a second, none while blown off, and noise of sigma 1."""
    rng = np.random.default_rng(seed)
    since = TIMES[:, None] - TIMES
    heard = np.where(since >= 0.0, np.exp(-since / 0.3), 0.0) * 3.0
    heard[(TIMES % 2.3) > 1.7] = 0.0
    empty = _Answers(np.zeros(COUNT), heard, TIMES, WIDTH)
    left = rng.normal(size=COUNT) - 0.7 * empty.of_rhythm(period, duty, shift)
    return _Answers(left, heard, TIMES, WIDTH)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_what_is_on_and_off_is_found_whatever_its_period_duty_and_phase(seed: int) -> None:
    rng = np.random.default_rng(seed)
    period, duty = float(np.exp(rng.uniform(*np.log([0.6, 6.0])))), float(rng.uniform(0.2, 0.6))
    shift = period * (EARLIEST + float(rng.random()))
    heard = answers(period, duty, shift, seed)
    found = _pulses(heard, _spectra(heard, FREQUENCIES))[0]
    assert found[0] == pytest.approx(period, rel=0.01)
    assert found[1] == pytest.approx(100.0 * duty, abs=4.0)
    late = (found[2] - shift + period / 2.0) % period - period / 2.0
    assert abs(late) < 0.1 * period
    assert EARLIEST * found[0] <= found[2] < (1.0 + EARLIEST) * found[0]


def test_what_swings_is_found_with_its_phase() -> None:
    heard = answers(1.0, 0.5, 0.0)
    wave = np.sin(2.0 * np.pi * (TIMES + WIDTH / 2.0 - 0.4) / 1.9)
    left = np.random.default_rng(5).normal(size=COUNT) - 0.7 * heard.answers @ wave
    swinging = _Answers(left, heard.answers, TIMES, WIDTH)
    period, shift = _swings(_spectra(swinging, FREQUENCIES))[0]
    assert period == pytest.approx(1.9, rel=0.03)
    assert shift == pytest.approx(0.4, abs=0.2)


def test_the_gain_of_a_box_is_that_of_least_squares() -> None:
    heard = answers(1.7, 0.4, 0.3)
    edges = np.arange(PHASES + 1) / PHASES
    folded = _folded(heard, 1.0 / 1.7, edges)
    assert folded.sum(axis=1) == pytest.approx(heard.answers.sum(axis=1))
    gains = _box_gains(folded.T @ folded, -folded.T @ heard.residuals)
    for first, number in ((0, 1), (5, 10), (20, 9)):  # the last one wraps
        box = folded[:, np.arange(first, first + number) % PHASES].sum(axis=1)
        expected = (box @ heard.residuals) ** 2 / (box @ box)
        assert gains[first, number - 1] == pytest.approx(expected)


def test_phases_that_no_bin_hears_gain_nothing() -> None:
    """Rounding is all that they have: it would divide by next to nothing."""
    heard = answers(1.7, 0.4, 0.3)
    folded = _folded(heard, 1.0 / 1.7, np.arange(PHASES + 1) / PHASES)
    folded[:, 5:8] *= 1e-13
    gains = _box_gains(folded.T @ folded, -folded.T @ heard.residuals)
    assert gains.max() <= heard.residuals @ heard.residuals
    assert gains[5, :3].max() < 1e-9


def test_a_pulse_beside_whose_peak_others_are_higher_comes_first_all_the_same() -> None:
    heard = answers(1.7, 0.4, 0.6)
    spectra = _spectra(heard, FREQUENCIES)
    gains = spectra.of_box.copy()
    right = int(np.argmax(gains))
    others = np.setdiff1d(np.arange(5, 60, 5), range(right - 2, right + 3))
    gains[others] += gains[right]
    found = _pulses(heard, replace(spectra, of_box=gains))
    assert found[0][0] == pytest.approx(1.7, rel=0.01)
    assert len(found) == PEAKS


def test_an_answer_belongs_to_the_last_pulse_before_it() -> None:
    """Two runs, with a pulse each in 1 s, the second one half a second later."""
    time = np.array([0.1, 0.6, 1.1, 1.6, 2.1])
    heard: Floats = np.array([[1.0, 0.0], [2.0, 3.0], [4.0, 5.0], [6.0, 7.0], [8.0, 9.0]])
    divided, numbers = _divided(heard, time, 1.0, np.arange(5))
    assert numbers.tolist() == [0, 1, 2, 3, 4, 5]
    assert divided.sum(axis=1) == pytest.approx(heard.sum(axis=1))
    assert divided[4, 4] == 8.0
    assert divided[3, 3] == 7.0
    assert not _divided(heard, time, 1.0, np.array([0]))[0][1:].any()


def test_cycles_that_wait_and_gaps_between_cycles_make_no_typical_cycle() -> None:
    """One of five judged cycles waits for a minute, and an hour is missing before the last one."""
    lasts = [2.4, 2.4, 62.4, 2.4, 2.3, 2.4]
    rows = [np.arange(0.0, seconds, 0.1) for seconds in lasts]
    begins = np.cumsum([0.0, *lasts[:-1]]) + 3600.0 * (np.arange(6) == 5)
    evidence = SimpleNamespace(
        clock=np.concatenate([begin + row for begin, row in zip(begins, rows, strict=True)]),
        starts=np.cumsum([0, *map(len, rows)]),
        judged=[1, 2, 3, 4, 5],
    )
    assert _typical_cycle(evidence) == pytest.approx(2.3)  # type: ignore[arg-type]


def test_pulses_of_a_gap_are_left_out() -> None:
    """An hour between two bins is 36000 pulses of 0.1 s, and two are heard in each run."""
    time, heard = np.array([0.45, 3600.45]), np.ones((2, 10))
    divided, numbers = _divided(heard, time, 1.0, np.arange(2))
    assert numbers.tolist() == [*range(6), *range(35996, 36006)]
    assert divided.sum(axis=1).tolist() == [6.0, 10.0]


def test_a_pulse_of_a_long_period_stays_where_it_is() -> None:
    """Its shift may be 120 s at most: then it begins one period earlier."""
    pulsed, swinging = MECHANISMS["supply_pulsed"], MECHANISMS["supply_swinging"]
    assert _within(pulsed, (110.0, 40.0, 130.0)) == pytest.approx((110.0, 40.0, 20.0))
    assert _within(pulsed, (110.0, 40.0, 115.0)) == pytest.approx((110.0, 40.0, 115.0))
    assert _within(swinging, (110.0, 30.0)) == pytest.approx((110.0, 30.0))


@pytest.mark.parametrize("end", [0, -1])
def test_a_box_is_refined_within_the_periods_that_are_searched(end: int) -> None:
    """The pulse itself is a step outside of them."""
    frequencies = _frequencies_of(24.0, 1.0, 6.0)
    step = frequencies[1] - frequencies[0]
    outside = float(frequencies[end]) + (step if end else -step)
    heard = answers(1.0 / outside, 0.4, 0.3)
    for period, *_ in _pulses(heard, _spectra(heard, frequencies)):
        assert 1.0 / frequencies[-1] <= period <= 1.0 / frequencies[0]
