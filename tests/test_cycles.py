"""Cycles cut out of a stream, and the figures each one gives."""

from collections.abc import Sequence

import numpy as np
import pytest
import rigs
from hypothesis import given
from hypothesis import strategies as st

from twin.model import theta as c
from twin.monitor.cycles import (
    BATCH,
    FEWEST_ROWS,
    LONGEST_PIECE,
    Cycle,
    CycleCutter,
    figures,
    whole,
)
from twin.quality import BREAK, Quality
from twin.signals import MBAR, SAMPLE, TICK, Phase, Samples, Ticks

AMBIENT = 1e5
THETA = rigs.theta("test_rig")
THETA[[c.AMBIENT, c.H2]] = AMBIENT, 550 * MBAR
IDLE, SUCTION, HOLD, BLOW_OFF = Phase
CYCLE = [(SUCTION, 50), (HOLD, 30), (BLOW_OFF, 20), (IDLE, 40)]


def rows(*phases: tuple[Phase, int]) -> tuple[Samples, Ticks]:
    """Rows of 1 ms with these phases; measured and expected are 100 and 110 mbar below ambient."""
    phase = np.concatenate([np.full(n, value, "u1") for value, n in phases])
    samples, ticks = np.zeros(len(phase), SAMPLE), np.zeros(len(phase), TICK)
    samples["sequence"] = np.arange(len(phase))
    samples["time_ns"] = samples["sequence"] * 1_000_000
    samples["pressure"] = AMBIENT - 100 * MBAR
    ticks["expected"] = AMBIENT - 110 * MBAR
    ticks["level"] = np.nan
    ticks["phase"] = phase
    return samples, ticks


def cycles(samples: Samples, ticks: Ticks, cuts: Sequence[int] = ()) -> list[Cycle]:
    cutter, found = CycleCutter(), []
    for part in zip(np.split(samples, cuts), np.split(ticks, cuts), strict=True):
        found += cutter.push(*part)
    return [*found, *cutter.flush()]


def lengths(found: list[Cycle]) -> list[tuple[int, int, bool]]:
    return [(cycle.index, len(cycle.samples), cycle.complete) for cycle in found]


# Cutting.


def test_a_cycle_runs_from_one_suction_edge_to_the_next() -> None:
    found = cycles(*rows((IDLE, 25), *CYCLE, *CYCLE))
    assert lengths(found) == [(-1, 25, False), (0, 140, True), (1, 140, True)]
    assert found[1].end_ns == 164_000_000


def test_the_nozzle_on_again_begins_no_cycle() -> None:
    found = cycles(*rows((IDLE, 5), (SUCTION, 9), (HOLD, 9), (SUCTION, 9), (HOLD, 9), (IDLE, 9)))
    assert lengths(found) == [(-1, 5, False), (0, 45, True)]


def test_a_cycle_without_pause_begins_after_blow_off() -> None:
    found = cycles(*rows((IDLE, 5), (SUCTION, 9), (BLOW_OFF, 9), (SUCTION, 9), (BLOW_OFF, 9)))
    assert lengths(found) == [(-1, 5, False), (0, 18, True), (1, 18, True)]


def test_what_begins_or_ends_in_the_middle_is_not_complete() -> None:
    found = cycles(*rows((SUCTION, 30), (IDLE, 9), (SUCTION, 30)))
    assert lengths(found) == [(-1, 39, False), (0, 30, False)]


@pytest.mark.parametrize("flag", Quality(BREAK))
def test_a_break_ends_a_cycle(flag: Quality) -> None:
    samples, ticks = rows((IDLE, 10), *CYCLE, *CYCLE)
    samples["quality"][10 + 30] = flag
    found = cycles(samples, ticks)
    assert lengths(found) == [(-1, 10, False), (0, 30, False), (0, 110, False), (1, 140, True)]


def test_a_long_cycle_comes_in_pieces() -> None:
    found = cycles(*rows((IDLE, 5), (SUCTION, 25_000), (IDLE, 10)))
    assert lengths(found) == [
        (-1, 5, False),
        (0, LONGEST_PIECE, False),
        (0, LONGEST_PIECE, False),
        (0, 5010, False),
    ]


def test_a_record_is_judged_in_whole_cycles_however_long_a_part_is_held() -> None:
    held = [(SUCTION, 1000), (HOLD, 3 * LONGEST_PIECE), (BLOW_OFF, 20), (IDLE, 40)]
    found = whole([rows((IDLE, 5), *held, *held, *held, (SUCTION, 9))])
    assert [(cycle.index, len(cycle.samples)) for cycle in found] == [(n, 31_060) for n in range(3)]
    assert [cycle.settled for cycle in found] == [False, True, True]


def test_rows_of_an_unfinished_piece_are_given_when_a_batch_is_new() -> None:
    samples, ticks = rows((IDLE, 5), (SUCTION, 3 * BATCH))
    cutter, given_rows = CycleCutter(), []
    for begin in range(0, len(samples), 100):
        part = slice(begin, begin + 100)
        list(cutter.push(samples[part], ticks[part]))
        if begun := cutter.begun():
            piece_samples, piece_ticks, at_edge = begun
            assert at_edge
            end = 5 + len(piece_samples)
            assert piece_samples.tobytes() == samples[5:end].tobytes()
            assert piece_ticks.tobytes() == ticks[5:end].tobytes()
            given_rows.append(len(piece_samples))
    assert given_rows == [295, 595]
    (cycle,) = cutter.flush()
    assert cycle.samples.tobytes() == samples[5:].tobytes()
    list(cutter.push(*rows((IDLE, BATCH))))
    assert cutter.begun() is not None  # the count begins anew with the next piece


phases = st.lists(st.tuples(st.sampled_from(Phase), st.integers(1, 60)), min_size=1, max_size=25)


@given(phases, st.lists(st.integers(0, 900), max_size=12), st.lists(st.integers(0, 900)))
def test_every_row_is_in_one_cycle_however_it_comes(
    steps: list[tuple[Phase, int]], cuts: list[int], breaks: list[int]
) -> None:
    samples, ticks = rows(*steps)
    samples["quality"][[row for row in breaks if row < len(samples)]] = Quality.GAP
    whole, parts = cycles(samples, ticks), cycles(samples, ticks, sorted(cuts))
    assert lengths(whole) == lengths(parts)
    for found in (whole, parts):
        assert np.concatenate([cycle.samples for cycle in found]).tobytes() == samples.tobytes()
        assert np.concatenate([cycle.ticks for cycle in found]).tobytes() == ticks.tobytes()


@pytest.mark.parametrize(("name", "period_s"), [("test_rig", 3.2), ("gripper", 2.0)])
def test_the_simulated_rig_gives_its_cycles(name: str, period_s: float) -> None:
    samples, ticks = rigs.expectation(rigs.twin(name), [rigs.recorded(name, 20.0)[0]])
    found = [cycle for cycle in cycles(samples, ticks) if cycle.complete]
    assert abs(len(found) - int(19.5 / period_s)) <= 1  # the program jitters
    assert [cycle.index for cycle in found] == list(range(len(found)))


# Figures.


def one_cycle() -> Cycle:
    return cycles(*rows((IDLE, 5), *CYCLE, *CYCLE))[1]


def test_deviations_are_measured_minus_expected_in_mbar_by_phase() -> None:
    cycle = one_cycle()
    cycle.samples["pressure"][:25] += 20 * MBAR  # half of suction reads 30 over expected
    found = figures(cycle, THETA)
    assert found["suction_mean"] == pytest.approx(20.0)
    assert found["suction_rms"] == pytest.approx(np.sqrt((30**2 + 10**2) / 2))
    for phase in ("hold", "blow_off", "idle"):
        assert found[f"{phase}_mean"] == found[f"{phase}_rms"] == pytest.approx(10.0)


def test_rows_that_cannot_be_compared_are_left_out() -> None:
    cycle = one_cycle()
    cycle.samples["pressure"][10:15] = 5e5
    cycle.samples["quality"][10:15] = Quality.BAD
    cycle.ticks["expected"][15:20] = np.nan
    cycle.samples["pressure"][20:25] = np.nan
    found = figures(cycle, THETA)
    assert found["suction_mean"] == pytest.approx(10.0)
    assert found["max_vacuum"] == pytest.approx(100.0)


def test_a_phase_of_few_rows_is_not_judged() -> None:
    cycle = cycles(*rows((IDLE, 5), (SUCTION, 50), (BLOW_OFF, 19), *CYCLE))[1]
    assert "suction_mean" in figures(cycle, THETA)
    assert "blow_off_mean" not in figures(cycle, THETA)


def test_a_phase_that_was_cut_short_is_not_judged() -> None:
    cycle = cycles(*rows((IDLE, 5), *CYCLE))[1]
    assert cycle.cut_short
    assert "blow_off_mean" in figures(cycle, THETA)
    assert "idle_mean" not in figures(cycle, THETA)


@pytest.mark.parametrize("quality", [Quality.BAD, Quality(0)])
def test_a_cycle_without_one_reading_says_nothing(quality: Quality) -> None:
    cycle = one_cycle()
    cycle.samples["pressure"] = np.nan
    cycle.samples["quality"] = quality
    found = figures(cycle, THETA)
    assert not {name for name in found if name.endswith(("mean", "rms"))}
    assert "t0_measured" not in found
    assert "max_vacuum" not in found


def test_evacuation_is_timed_to_h2() -> None:
    cycle = one_cycle()
    cycle.samples["pressure"][33:80] = AMBIENT - 551 * MBAR
    cycle.samples["pressure"][20] = AMBIENT - 700 * MBAR
    cycle.samples["quality"][20] = Quality.OVERFLOW
    cycle.ticks["expected"][41:80] = AMBIENT - 600 * MBAR
    found = figures(cycle, THETA)
    assert found["t0_measured"] == pytest.approx(33.0)
    assert found["t0_expected"] == pytest.approx(41.0)
    assert found["max_vacuum"] == pytest.approx(551.0)


def test_evacuation_is_timed_to_the_h2_of_the_unit() -> None:
    cycle = one_cycle()
    cycle.samples["pressure"][22:33] = AMBIENT - 420 * MBAR
    cycle.samples["pressure"][33:80] = AMBIENT - 551 * MBAR
    cycle.ticks["expected"][25:80] = AMBIENT - 430 * MBAR
    theta = THETA.copy()
    theta[c.H2] = 400 * MBAR
    found = figures(cycle, theta)
    assert found["t0_measured"] == pytest.approx(22.0)
    assert found["t0_expected"] == pytest.approx(25.0)


def test_h2_that_is_not_reached_has_no_time() -> None:
    assert not {"t0_measured", "t0_expected"} & figures(one_cycle(), THETA).keys()


def test_the_levels_of_the_air_saving_are_its_breakpoints() -> None:
    samples, ticks = rows(
        (IDLE, 5), (SUCTION, 30), (HOLD, 30), (SUCTION, 30), (HOLD, 30), (IDLE, 9)
    )
    for row, vacuum in ((5, 3), (36, 750), (66, 600), (97, 752)):  # the first is the cycle's sync
        ticks["level"][row] = AMBIENT - vacuum * MBAR
    found = figures(cycles(samples, ticks)[1], THETA)
    assert found["h1_level"] == pytest.approx(751.0)
    assert found["h1_low_level"] == pytest.approx(600.0)


@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_healthy_cycle_of_the_rig(name: str) -> None:
    samples, ticks = rigs.expectation(rigs.twin(name), [rigs.recorded(name, 20.0)[0]])
    found = [figures(cycle, rigs.theta(name)) for cycle in cycles(samples, ticks) if cycle.complete]
    for cycle in found[1:]:
        assert cycle["t0_measured"] == pytest.approx(cycle["t0_expected"], rel=0.03)
        assert cycle["h1_level"] == pytest.approx(750, abs=10)
        assert cycle["max_vacuum"] == pytest.approx(750, abs=15)
        assert cycle["suction_rms"] < 8


@given(st.integers(0, 2**32 - 1), st.integers(1, 300), st.sampled_from([0.0, 0.3, 1.0]))
def test_deviations_by_phase_are_numpys(seed: int, rows: int, missing: float) -> None:
    random = np.random.default_rng(seed)
    samples, ticks = np.zeros(rows, SAMPLE), np.zeros(rows, TICK)
    ticks["phase"] = random.integers(0, len(Phase), rows)
    ticks["level"] = np.nan
    ticks["expected"] = random.uniform(1e4, 1e5, rows)
    samples["pressure"] = ticks["expected"] + random.normal(size=rows) * MBAR
    ticks["expected"][random.random(rows) < missing] = np.nan
    cycle = Cycle(0, samples, ticks, complete=False)
    found = figures(cycle, THETA)
    for phase in Phase:
        off = cycle.off[np.isfinite(cycle.off) & (ticks["phase"] == phase)]
        name = phase.name.lower()
        assert (f"{name}_mean" in found) == (len(off) >= FEWEST_ROWS)
        if f"{name}_mean" in found:
            assert found[f"{name}_mean"] == pytest.approx(off.mean())
            assert found[f"{name}_rms"] == pytest.approx(np.sqrt(np.mean(off**2)))
