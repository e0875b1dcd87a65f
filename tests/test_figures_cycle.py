"""Key figures of cycles as they come: from the simulated rig, in pieces, broken, in the loop."""

import json
import math
import re
from collections.abc import Iterable, Sequence
from functools import cache

import numpy as np
import pytest
import rigs
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from twin.events import Event, Kind
from twin.figures.cycle import MOST_PIECES, CycleFigures, KeyFigures
from twin.figures.expected import Expectation
from twin.figures.key_figures import FIGURES
from twin.figures.settings import FigureSettings
from twin.live import run
from twin.model.dataset import DataSet
from twin.model.term import Term
from twin.monitor.cycles import LONGEST_PIECE, CycleCutter
from twin.monitor.cycles import figures as old_figures
from twin.monitor.monitor import Monitor
from twin.quality import BREAK, Quality
from twin.signals import MBAR, ML, SAMPLE, SL_MIN, TICK, Command, Phase, Samples, Ticks

GAS, KELVIN = 287.05, 293.15
ROOM = {"test_rig": 755 * ML, "gripper": 150 * ML}


@cache
def seen(name: str, *faults: str, seconds: float = 20.0) -> tuple[Samples, Ticks]:
    recorded = rigs.cut(rigs.recorded(name, seconds, faults)[0], 1000)
    return rigs.expectation(rigs.twin(name), recorded)


def told(
    samples: Samples,
    ticks: Ticks,
    data: DataSet,
    wanted: FigureSettings | None = None,
    cuts: Sequence[int] = (),
) -> list[CycleFigures]:
    key, cutter = KeyFigures(data, wanted or FigureSettings()), CycleCutter()
    found = []
    for part in zip(np.split(samples, cuts), np.split(ticks, cuts), strict=True):
        found += [key.take(piece) for piece in cutter.push(*part)]
        if begun := cutter.begun():
            key.run_ahead(*begun)  # as the monitor does
    found += [key.take(piece) for piece in cutter.flush()]
    return [cycle for cycle in found if cycle is not None]


@cache
def healthy(name: str) -> list[CycleFigures]:
    return told(*seen(name), rigs.config(name).data)


def whole(cycles: Iterable[CycleFigures]) -> list[CycleFigures]:
    """Those beside which the model had swung in, and whose end was seen."""
    return [cycle for cycle in list(cycles)[1:] if math.isfinite(cycle.measured["nozzle_share"])]


def mean(found: Iterable[CycleFigures], figure: str, side: str = "measured") -> float:
    values = [getattr(cycle, side)[figure] for cycle in found]
    return float(np.mean(values))


# Measured and expected.


@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_healthy_rig_is_as_expected(name: str) -> None:
    """Its scatter, 0.02 bar and 0.03 sl/min, is in what single cycles may be off."""
    cycles = whole(healthy(name))
    assert len(cycles) >= 5
    within = {"t0": 0.01, "t1": 0.03, "leakage": 0.2, "nozzle_share": 0.02, "air": 0.025}
    for cycle in cycles:
        for figure, share in within.items():
            expected = cycle.expected[figure]
            assert cycle.measured[figure] == pytest.approx(expected, rel=share), figure
        assert cycle.measured["max_vacuum"] == pytest.approx(cycle.expected["max_vacuum"], abs=3)
        assert cycle.measured["switchings"] == cycle.expected["switchings"] == 1
        assert cycle.measured["h1_not_reached"] == cycle.expected["h1_not_reached"] == 0
        assert cycle.warnings == ()
    for figure in ("t0", "t1", "leakage"):
        usual = mean(cycles, figure, "expected")
        assert mean(cycles, figure) == pytest.approx(
            usual, rel=0.07 if figure == "leakage" else 0.015
        )


@pytest.mark.parametrize("name", rigs.NAMES)
def test_t0_is_expected_as_the_twin_beside_the_cycle_has_it(name: str) -> None:
    samples, ticks = seen(name)
    pieces = [piece for piece in CycleCutter().push(samples, ticks) if piece.index >= 0]
    for piece, cycle in list(zip(pieces, healthy(name), strict=False))[1:]:
        beside = old_figures(piece, rigs.theta(name))["t0_expected"]
        assert cycle.expected["t0"] == pytest.approx(beside, abs=1.5)


@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_leak_raises_leakage_by_what_volume_and_flow_say(name: str) -> None:
    """ṁ·R·T/V where the gas stays as warm as the wall, up to γ times that where it has no time."""
    flow = 2.0
    leaky = whole(told(*seen(name, f"leakage={flow}"), rigs.config(name).data))
    more = mean(leaky, "leakage") - mean(whole(healthy(name)), "leakage")
    isothermal = flow * SL_MIN * GAS * KELVIN / ROOM[name] / MBAR
    assert isothermal < more < 1.4 * isothermal
    assert mean(leaky, "quality") < mean(whole(healthy(name)), "quality")
    assert mean(leaky, "leakage", "expected") == pytest.approx(
        mean(whole(healthy(name)), "leakage", "expected"), rel=0.05
    )


def test_the_fields_number_250_mbar_per_second_in_150_ml_are_2_25_litres_a_minute() -> None:
    assert 250 * MBAR * ROOM["gripper"] / (GAS * KELVIN) / SL_MIN == pytest.approx(2.25, rel=0.005)


@pytest.mark.parametrize("name", rigs.NAMES)
def test_what_is_known_of_a_leak_is_expected_too(name: str) -> None:
    data = rigs.config(name).data.model_copy(update={"effects": {"leakage": {"sonic_flow": 2.0}}})
    cycles = whole(told(*seen(name, "leakage=2.0"), data))
    assert len(cycles) >= 4
    for figure, share in (("t0", 0.01), ("t1", 0.04), ("leakage", 0.07), ("air", 0.03)):
        assert mean(cycles, figure) == pytest.approx(mean(cycles, figure, "expected"), rel=share)


def test_more_than_the_permitted_leakage_is_warned_of() -> None:
    cycles = told(*seen("gripper", "leakage=2.0"), rigs.config("gripper").data)
    assert {cycle.warnings for cycle in cycles} == {("t1_over_limit", "leakage_over_limit")}
    assert "leakage over limit (" in cycles[3].words
    own = FigureSettings(permitted_leakage_mbar_s=500.0, permitted_t1_ms=300.0)
    assert told(*seen("gripper", "leakage=2.0"), rigs.config("gripper").data, own)[1].warnings == (
        "t1_over_limit",
    )


def test_h1_that_the_rig_does_not_reach_is_warned_of_and_costs_air() -> None:
    cycles = whole(told(*seen("gripper", "leakage=6.0"), rigs.config("gripper").data))
    assert len(cycles) > 5
    for cycle in cycles:
        assert cycle.measured["h1_not_reached"] == 1
        assert cycle.expected["h1_not_reached"] == 0
        assert "h1_not_reached" in cycle.warnings
        assert cycle.measured["nozzle_share"] == 100
        assert cycle.measured["air"] > 2 * cycle.expected["air"]
        assert math.isnan(cycle.measured["leakage"])


def test_a_threshold_of_the_unseen_control_moves_t1_and_not_t0() -> None:
    found = told(*seen("test_rig", "threshold_drift.h1_shift=-50"), rigs.config("test_rig").data)
    moved = whole(found)
    # Cycles that end earlier leave the gas of the next one another warmth, about 1.5 % of t0.
    assert mean(moved, "t0") == pytest.approx(mean(moved, "t0", "expected"), rel=0.03)
    assert mean(moved, "t1") < 0.75 * mean(moved, "t1", "expected")
    assert {cycle.measured["h1_not_reached"] for cycle in moved} == {0.0}  # it was, where it is now


def test_air_saving_that_is_off_is_judged_by_the_sensor() -> None:
    rows = rigs.recorded("gripper", 12.0, (), 1, False)[0]
    samples, ticks = rigs.expectation(rigs.twin("gripper"), rigs.cut(rows, 1000))
    cycles = whole(told(samples, ticks, rigs.config("gripper").data))
    assert len(cycles) > 3
    for cycle in cycles:
        assert cycle.measured["t1"] == pytest.approx(cycle.expected["t1"], rel=0.06)
        assert cycle.measured["h1_not_reached"] == 0
        assert cycle.measured["nozzle_share"] == 100
        assert math.isnan(cycle.measured["leakage"])


def test_an_open_cup_gives_the_free_flow_vacuum_beside_that_of_the_model() -> None:
    """The rig's cup opens by 600 sl/min at sonic flow: about 5 mbar, and what the hose takes."""
    data = rigs.config("gripper").data
    samples, ticks = seen("gripper")
    pieces = [piece for piece in CycleCutter().push(samples, ticks) if piece.complete]
    still = Expectation(data).free_flow
    assert 50 < still < 400  # 2 m of 4 mm hose
    piece = pieces[2]
    rows = np.flatnonzero(np.isin(piece.ticks["phase"], (Phase.SUCTION, Phase.HOLD)))
    piece.samples["pressure"][rows] = (data.ambient.pressure_mbar - 1.3 * still) * MBAR
    piece.ticks["phase"][rows] = Phase.SUCTION
    key = KeyFigures(data)
    cycle = [key.take(piece) for piece in pieces[:3]][2]
    assert cycle is not None
    assert cycle.measured["free_flow"] == pytest.approx(1.3 * still, rel=1e-4)
    assert cycle.expected["free_flow"] == still
    assert cycle.expected["performance"] == pytest.approx(100 * (1 - still / 750))


def test_a_cycle_that_is_cut_off_says_that_it_is_incomplete() -> None:
    samples, ticks = seen("gripper")
    idle, suction = samples["commands"] == 0, samples["commands"] == Command.SUCTION
    end = np.flatnonzero(idle[:-1] & suction[1:])[3] + 100
    *_, last = told(samples[:end], ticks[:end], rigs.config("gripper").data)
    assert last.words == f"cycle {last.cycle}: incomplete, not evaluated"


def test_a_cycle_that_does_not_come_to_h2_says_so() -> None:
    """The vacuum still rises when suction ends: no open cup."""
    data = rigs.config("gripper").data
    samples, ticks = seen("gripper")
    pieces = [piece for piece in CycleCutter().push(samples, ticks) if piece.complete]
    piece = pieces[2]
    rows = np.flatnonzero(np.isin(piece.ticks["phase"], (Phase.SUCTION, Phase.HOLD)))
    vacuum = np.linspace(0.0, 300.0, len(rows))  # mbar
    piece.samples["pressure"][rows] = (data.ambient.pressure_mbar - vacuum) * MBAR
    piece.ticks["phase"][rows] = Phase.SUCTION
    key = KeyFigures(data)
    cycle = [key.take(piece) for piece in pieces[:3]][2]
    assert cycle is not None
    assert re.fullmatch(
        r"cycle \d+: H2 not reached \(expected in \d+ ms\); H1 not reached \(highest 300 mbar\)",
        cycle.words,
    )


def test_a_vessel_opens_nowhere() -> None:
    assert math.isnan(Expectation(rigs.config("test_rig").data).free_flow)


def test_what_data_added_to_the_model_is_in_what_is_expected() -> None:
    """A term of a diagnosis: 20 mbar less vacuum than the physics have it."""
    term = Term(where="suction", over="vacuum", at=(0.0, 1000.0), mbar=(20.0, 20.0))
    data = rigs.config("test_rig").data
    with_term = whole(told(*seen("test_rig"), data.model_copy(update={"terms": (term,)})))
    usual = mean(whole(healthy("test_rig")), "t0", "expected")
    assert mean(with_term, "t0", "expected") > usual + 10


# However the rows come.


def test_the_figures_do_not_depend_on_the_blocks() -> None:
    samples, ticks = seen("test_rig")
    data = rigs.config("test_rig").data
    at_once = told(samples, ticks, data)
    parts = told(samples, ticks, data, cuts=range(30, 20000, 30))
    assert [cycle.plain() for cycle in at_once] == [cycle.plain() for cycle in parts]


def test_before_it_has_swung_in_the_model_expects_nothing() -> None:
    first, second = healthy("test_rig")[:2]
    assert all(math.isnan(value) for value in first.expected.values())
    assert math.isfinite(first.measured["t0"])
    assert math.isfinite(second.expected["t0"])


def program(
    suction_ms: float, idle_ms: float, seconds: float, *faults: str
) -> tuple[Samples, Ticks]:
    rig = rigs.config("test_rig").document.section(PlcSettings, "plc")
    times = {"start_ms": 500.0, "suction_ms": suction_ms, "idle_ms": idle_ms, "jitter_ms": 0.0}
    rig = rig.model_copy(update={"program": rig.program.model_copy(update=times)})
    parsed = [parse_fault(text) for text in faults]
    return rigs.expectation(rigs.twin("test_rig"), blocks(rig, seconds, parsed))


def test_a_long_cycle_is_told_whole() -> None:
    """Suction of 13 s comes in two pieces; the figures are those of both."""
    samples, ticks = program(13_000, 600, 45.0, "leakage=1")
    cycles = told(samples, ticks, rigs.config("test_rig").data)
    assert [cycle.cycle for cycle in cycles] == [0, 1, 2, 3]
    for cycle in cycles[1:3]:
        assert cycle.end_ns - cycle.begin_ns > 13e9
        assert cycle.measured["switchings"] >= 2
        assert 10 < cycle.expected["nozzle_share"] < cycle.measured["nozzle_share"] < 40
    assert math.isnan(cycles[3].measured["air"])  # the end of the log was in its suction
    assert math.isfinite(cycles[3].measured["leakage"])


def test_a_long_idle_is_not_waited_for_and_is_known_to_the_model() -> None:
    samples, ticks = program(2300, 13_000, 50.0, "leakage=1")
    key, cutter = KeyFigures(rigs.config("test_rig").data), CycleCutter()
    found = [key.take(piece) for piece in cutter.push(samples, ticks)]
    assert [cycle.cycle if cycle else None for cycle in found[:6]] == [None, 0, None, 1, None, 2]
    last = found[5]
    assert last is not None
    assert last.end_ns - last.begin_ns < 1.1e10
    assert last.measured["t0"] == pytest.approx(last.expected["t0"], rel=0.12)  # with its leak


def test_what_is_left_of_a_cycle_after_it_was_told_keeps_the_gas_warm() -> None:
    """Ten seconds end in its idle time; half a second of that comes later."""
    samples, ticks = program(9_200, 1_000, 45.0)
    cycles = whole(told(samples, ticks, rigs.config("test_rig").data))
    assert len(cycles) >= 2
    for cycle in cycles:
        assert cycle.end_ns - cycle.begin_ns == (LONGEST_PIECE - 1) * 1_000_000
        assert cycle.measured["t0"] == pytest.approx(cycle.expected["t0"], rel=0.01)


def test_a_break_just_between_two_pieces_ends_a_long_cycle() -> None:
    samples, ticks = (rows.copy() for rows in program(13_000, 600, 30.0, "leakage=1"))
    begin = int(np.flatnonzero(samples["commands"] == 1)[0])
    samples["quality"][begin + LONGEST_PIECE] = Quality.GAP
    cut, following = told(samples, ticks, rigs.config("test_rig").data)[:2]
    assert (cut.cycle, following.cycle) == (0, 1)
    assert cut.end_ns - cut.begin_ns == (LONGEST_PIECE - 1) * 1_000_000
    assert not cut.plain()["complete"]
    assert math.isnan(cut.measured["nozzle_share"])
    assert math.isfinite(cut.measured["leakage"])


def test_suction_without_end_is_told_after_a_while() -> None:
    rows = MOST_PIECES * LONGEST_PIECE + 25_000
    samples, ticks = np.zeros(rows, SAMPLE), np.zeros(rows, TICK)
    samples["sequence"] = np.arange(rows)
    samples["time_ns"] = samples["sequence"] * 1_000_000
    samples["pressure"], samples["supply"] = 1e5, np.nan
    samples["commands"][100:], ticks["phase"][100:] = 1, Phase.SUCTION
    ticks["level"] = ticks["expected"] = np.nan
    (cycle,) = told(samples, ticks, rigs.config("test_rig").data)
    assert cycle.end_ns - cycle.begin_ns == (MOST_PIECES * LONGEST_PIECE - 1) * 1_000_000
    assert math.isnan(cycle.measured["nozzle_share"])


# What breaks a cycle.


@pytest.mark.parametrize("flag", Quality(BREAK))
def test_a_break_leaves_what_was_known_before_it(flag: Quality) -> None:
    samples, ticks = (rows.copy() for rows in seen("test_rig"))
    begin = int(np.flatnonzero(samples["commands"] == 1)[0])
    samples["quality"][begin + 1200] = flag  # in the suction of the first cycle, after H2
    cycles = told(samples, ticks, rigs.config("test_rig").data)
    cut = cycles[0]
    assert (cut.cycle, cut.end_ns) == (0, int(samples["time_ns"][begin + 1199]))
    assert cut.measured["t0"] == pytest.approx(healthy("test_rig")[0].measured["t0"])
    for name in ("t1", "leakage", "max_vacuum", "air", "h1_not_reached"):
        assert math.isnan(cut.measured[name]), name
    assert [cycle.cycle for cycle in cycles] == list(range(len(healthy("test_rig"))))
    for one, usual in zip(cycles[1:], healthy("test_rig")[1:], strict=True):
        assert one.measured == pytest.approx(usual.measured, nan_ok=True)
    assert math.isnan(cycles[1].expected["t0"])  # what the gas was before is not known
    assert math.isfinite(cycles[2].expected["t0"])


def test_a_blow_off_that_was_not_seen_to_its_end_tells_no_air() -> None:
    samples, ticks = seen("test_rig")
    end = int(np.flatnonzero(ticks["phase"] == Phase.BLOW_OFF)[100])
    (cycle,) = told(samples[:end], ticks[:end], rigs.config("test_rig").data)
    assert cycle.plain()["complete"]
    assert math.isnan(cycle.measured["air"])
    assert math.isfinite(cycle.measured["nozzle_share"])


@pytest.mark.parametrize("flag", [Quality.BAD, Quality.OVERFLOW, Quality.STALE])
def test_bad_readings_are_no_figures(flag: Quality) -> None:
    samples, ticks = (rows.copy() for rows in seen("test_rig"))
    begin = int(np.flatnonzero(np.diff((samples["commands"] & 1).astype(int)) == 1)[2]) + 1
    bad = slice(begin + 600, begin + 1200)
    samples["quality"][bad] = flag
    samples["pressure"][bad] = 0.0
    cycle, following = told(samples, ticks, rigs.config("test_rig").data)[2:4]
    for name in ("t0", "t1", "leakage", "max_vacuum", "air", "h1_not_reached", "switchings"):
        assert math.isnan(cycle.measured[name]), name
    assert cycle.warnings == ()
    is_known = math.isfinite(cycle.expected["t0"])
    assert is_known == (flag is not Quality.STALE)  # then nobody knows what was commanded
    assert is_known == math.isfinite(following.expected["t0"])


steps = st.lists(
    st.tuples(st.sampled_from([0, 1, 2, 3]), st.integers(1, 700)), min_size=1, max_size=12
)
marks = st.lists(
    st.tuples(st.integers(0, 3000), st.integers(1, 80), st.sampled_from(Quality)), max_size=4
)


@settings(max_examples=40, deadline=None)
@given(steps, marks, st.integers(0, 2**32 - 1), st.lists(st.integers(0, 3000), max_size=6))
def test_any_stream_gives_finite_figures_or_none(
    commands: list[tuple[int, int]],
    flags: list[tuple[int, int, Quality]],
    seed: int,
    cuts: list[int],
) -> None:
    told_of = np.concatenate([np.full(rows, value, "u1") for value, rows in commands])
    samples, rng = np.zeros(len(told_of), SAMPLE), np.random.default_rng(seed)
    samples["commands"], samples["sequence"] = told_of, np.arange(len(told_of))
    samples["time_ns"] = samples["sequence"] * 1_000_000
    samples["pressure"] = 1e5 + 3e4 * np.cumsum(rng.normal(0.0, 0.05, len(told_of)))
    samples["supply"] = rng.choice([np.nan, 4.8e5])
    for first, rows, flag in flags:
        samples["quality"][first : first + rows] |= np.uint8(flag)
        samples["pressure"][first : first + rows] = rng.choice([np.nan, 0.0, 1e9])
    samples, ticks = rigs.expectation(rigs.twin("gripper"), np.split(samples, sorted(cuts)))
    for cycle in told(samples, ticks, rigs.config("gripper").data):
        json.dumps(cycle.plain(), allow_nan=False)
        assert cycle.words.startswith(f"cycle {cycle.cycle}: ")
        assert "nan" not in cycle.words
        values = [*cycle.measured.values(), *cycle.expected.values()]
        assert not any(math.isinf(value) for value in values)


# Beside the loop.


def events(
    name: str, key_figure_source: KeyFigures | None, rows: Samples | None = None
) -> list[Event]:
    collect = rigs.Collect()
    monitor = Monitor(rigs.config(name).monitor, rigs.theta(name), key_figure_source)
    recorded = rigs.recorded(name, 20.0)[0] if rows is None else rows
    run(rigs.cut(recorded, 30), rigs.twin(name), monitor, [collect])
    return collect.of(Kind.CYCLE)


def test_the_loops_cycles_carry_the_key_figures() -> None:
    data = rigs.config("gripper").data
    with_key, without = events("gripper", KeyFigures(data)), events("gripper", None)
    direct = [cycle.plain() for cycle in healthy("gripper")]
    for event, plain in zip(with_key, direct, strict=True):
        assert event.data.items() >= plain.items()
        assert json.loads(json.dumps(dict(event.data), allow_nan=False)) == event.data
        assert "leakage_measured" in event.data
    by_cycle = {event.data["cycle"]: event for event in with_key}
    for event in without:  # nothing else changes
        beside = by_cycle[event.data["cycle"]]
        assert beside.time_ns == event.time_ns
        for name in set(event.data) - {"t0_measured", "t0_expected"}:
            assert beside.data[name] == event.data[name]
    leakage = with_key[3].data["leakage_measured"]
    assert f"leakage {leakage:.0f} mbar/s (expected " in with_key[3].text


def test_a_long_cycle_has_one_event_with_nothing_of_its_last_piece_alone() -> None:
    samples, _ = program(13_000, 600, 30.0)
    data = rigs.config("test_rig").data
    found = events("test_rig", KeyFigures(data), samples)
    assert [event.data["cycle"] for event in found] == [0, 1, 2]
    for event in found[:2]:
        assert event.time_ns == event.data["end_ns"]
        assert "nozzle_share_measured" in event.data
        assert "hold_mean" not in event.data
    assert events("test_rig", None, samples) == []


def test_plain_names_each_side_and_leaves_out_what_is_not_known() -> None:
    plain = healthy("test_rig")[0].plain()
    assert "t0_measured" in plain
    assert "t0_expected" not in plain
    assert {name.rsplit("_", 1)[0] for name in plain if name.endswith("_measured")} < set(FIGURES)
