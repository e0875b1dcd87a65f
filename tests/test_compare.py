"""``twin compare``: what two logs of a simulated gripper say, and how sure it is."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rigs
from command_line import twin

from twin.compare.compare import (
    FEWEST,
    WRONGLY,
    Comparison,
    Quantity,
    Values,
    chance,
    compare,
    interval,
)
from twin.compare.side import BIN_S, Curve, Side, bins, difference, side_of, whole
from twin.compare.text import conclusion, in_words, plain, remarks
from twin.figures.cycle import KeyFigures
from twin.figures.key_figures import FIGURES
from twin.live import run as run_loop
from twin.log.header import LogHeader
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.quality import Quality
from twin.signals import MBAR, SAMPLE, TICK, Phase, Samples, Ticks

LEAK = "leakage=2.0@0"


def write_log(
    path: Path, name: str = "gripper", faults: tuple[str, ...] = (), seed: int = 1, **changes: Any
) -> Path:
    config = rigs.config(name)
    metadata = {"data": config.data.model_dump_json(), "data_set": config.data.hash}
    header = LogHeader(
        config.asset.type, config.asset.id, f"{name}.toml", config.document.text, metadata
    )
    samples, _ = rigs.recorded(name, 20.0, faults, seed)
    samples = samples[: changes.pop("rows", None)]
    sinks = [Recorder(path, replace(header, **changes))]
    run_loop(rigs.cut(samples, 1000), rigs.twin(name), rigs.monitor(name), sinks)
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("logs")
    return {
        "well": write_log(folder / "well.mcap"),
        "again": write_log(folder / "again.mcap", seed=2),
        "leaks": write_log(folder / "leaks.mcap", faults=(LEAK,), seed=3),
    }


def side(path: Path) -> Side:
    config = rigs.config("gripper")
    return side_of(open_log(path), config, KeyFigures(config.data))


@pytest.fixture(scope="module")
def sides(logs: dict[str, Path]) -> dict[str, Side]:
    return {name: side(path) for name, path in logs.items()}


def by_name(found: Comparison) -> dict[str, Quantity]:
    return {figure.name: figure for figure in (*found.figures, *found.deviations)}


# What differs.


def test_a_leak_is_what_differs(sides: dict[str, Side]) -> None:
    found = compare(sides["well"], sides["leaks"])
    quantities = by_name(found)
    for name in ("t0", "t1", "leakage", "hold_rms", "suction_mean"):
        one = quantities[name]
        assert one.differs, name
        assert 0.0 < one.low < one.difference < one.high, name
    assert quantities["leakage"].b.expected == pytest.approx(quantities["leakage"].a.expected, 0.05)
    assert quantities["supply"].differs is False
    assert conclusion(found).startswith("B against A: leakage ")
    assert "deviation from the twin: " in conclusion(found)


def test_two_logs_of_the_same_do_not_differ(sides: dict[str, Side]) -> None:
    found = compare(sides["well"], sides["again"])
    assert found.different == []
    assert conclusion(found).startswith("B does not differ from A beyond chance: 21 figures")


def test_other_way_round_is_the_same_with_other_signs(sides: dict[str, Side]) -> None:
    one = by_name(compare(sides["well"], sides["leaks"]))["t0"]
    other = by_name(compare(sides["leaks"], sides["well"]))["t0"]
    assert other.difference == -one.difference
    assert (other.low, other.high) == pytest.approx((-one.high, -one.low), rel=0.02)
    assert (one.a, one.b) == (other.b, other.a)


def test_figures_are_those_of_the_cycles(sides: dict[str, Side]) -> None:
    """Mean and spread by hand, of all cycles but the first, which the gas makes another one."""
    well = sides["well"]
    assert well.cycles == list(range(1, 10))
    t0 = np.array([cycle["t0"] for cycle in well.measured])
    values = by_name(compare(well, sides["leaks"]))["t0"].a
    assert values == Values(9, t0.mean(), t0.std(ddof=1), values.expected)
    assert values.expected == pytest.approx(189.4, abs=0.5)


# How sure it is.


def draw(rng: np.random.Generator, count: int, kind: str) -> Any:
    return rng.normal(size=count) if kind == "normal" else rng.exponential(size=count)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["normal", "skewed"])
@pytest.mark.parametrize("count", [5, 20])
def test_intervals_hold_the_truth_as_often_as_they_say(count: int, kind: str) -> None:
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(300):
        low, high = interval(draw(rng, count, kind), draw(rng, count, kind) + 3.0, rng)
        held += low <= 3.0 <= high
    assert 0.92 <= held / 300 <= 0.985


def test_interval_is_as_narrow_as_many_cycles_allow() -> None:
    rng = np.random.default_rng(1)
    low, high = interval(rng.normal(size=3000), rng.normal(size=3000) + 1.0, rng)
    assert high - low == pytest.approx(2 * 1.96 * np.sqrt(2 / 3000), rel=0.1)


def test_of_few_cycles_nothing_is_said() -> None:
    few, many = np.arange(FEWEST - 1.0), np.arange(50.0)
    assert np.isnan(interval(few, many, np.random.default_rng(1))).all()
    assert np.isnan(chance(many, few))


def test_chance_is_uniform_where_nothing_differs() -> None:
    rng = np.random.default_rng(2)
    chances = np.array([chance(rng.normal(size=8), rng.normal(size=12)) for _ in range(1000)])
    assert np.mean(chances < 0.05) == pytest.approx(0.05, abs=0.02)
    assert np.mean(chances < 0.5) == pytest.approx(0.5, abs=0.05)


def test_counts_that_never_vary_differ_by_how_many_cycles_say_so() -> None:
    one, two = np.ones(8), np.full(8, 2.0)
    assert chance(one, one) == 1.0
    assert chance(one, two) == pytest.approx(2 / 12870)


def of_numbers(rng: np.random.Generator, count: int = 10, **shifts: float) -> Side:
    """A side whose figures are all noise, some moved by as many spreads."""
    rows = [{name: rng.normal() + shifts.get(name, 0.0) for name in FIGURES} for _ in range(count)]
    nothing = [dict[str, float]() for _ in rows]
    header = LogHeader("ejector", "7", "a.toml", "")
    return Side("a.mcap", header, "hash", list(range(count)), rows, nothing, nothing)


@pytest.mark.slow
def test_same_with_the_same_is_called_different_as_seldom_as_promised(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without looking at all figures together it would be more than every second time."""
    monkeypatch.setattr("twin.compare.compare.RESAMPLED", 10)  # the intervals are not looked at
    rng = np.random.default_rng(3)
    many = [compare(of_numbers(rng), of_numbers(rng)) for _ in range(300)]
    assert (
        0.2 * WRONGLY
        <= np.mean([bool(comparison.different) for comparison in many])
        <= 1.8 * WRONGLY
    )


def test_the_clearest_is_said_first_and_what_follows_from_others_last() -> None:
    rng = np.random.default_rng(4)
    found = compare(of_numbers(rng), of_numbers(rng, leakage=9.0, t0=30.0, quality=60.0))
    assert [figure.name for figure in found.different] == ["quality", "t0", "leakage"]
    said = conclusion(found)
    assert said.index("t0 ") < said.index("leakage ") < said.index("quality ")


def test_too_few_cycles_are_said() -> None:
    rng = np.random.default_rng(5)
    found = compare(of_numbers(rng), of_numbers(rng, 3, t0=30.0))
    assert conclusion(found).startswith("Too few cycles to say whether they differ: 10 and 3")
    assert found.different == []
    assert plain(found)["figures"][0]["low95"] is None


def test_a_figure_that_one_side_cannot_tell_is_a_dash(sides: dict[str, Side]) -> None:
    untold = [{**cycle, "leakage": np.nan} for cycle in sides["well"].measured]
    found = compare(replace(sides["well"], measured=untold), sides["leaks"])
    (line,) = (line for line in in_words(found).splitlines() if line.startswith("leakage "))
    assert line.split()[2:3] == ["-"]
    assert line.split()[-2:] == ["-", "-"]
    json.dumps(plain(found), allow_nan=False)


# Cycles, and their course.


def rows(*phases: tuple[Phase, int]) -> tuple[Samples, Ticks]:
    phase = np.concatenate([np.full(count, phase) for phase, count in phases])
    samples, ticks = np.zeros(len(phase), SAMPLE), np.zeros(len(phase), TICK)
    samples["time_ns"] = np.arange(len(phase)) * 1_000_000
    samples["sequence"] = np.arange(len(phase))
    ticks["phase"] = phase
    return samples, ticks


IDLE, SUCTION, HOLD = (Phase.IDLE, 500), (Phase.SUCTION, 300), (Phase.HOLD, 25_000)


def test_a_long_cycle_stays_in_one_piece() -> None:
    cycles = list(whole([rows(IDLE, SUCTION, HOLD, IDLE, SUCTION, IDLE)]))
    assert [len(cycle.samples) for cycle in cycles] == [500, 25_800, 800]
    assert [cycle.complete for cycle in cycles] == [False, True, True]


def test_a_cycle_with_a_gap_is_none() -> None:
    samples, ticks = rows(IDLE, SUCTION, HOLD, IDLE, SUCTION, IDLE)
    samples["quality"][15_000] = Quality.GAP
    cycles = list(whole([(samples, ticks)]))
    assert sum(len(cycle.samples) for cycle in cycles) == len(samples)
    assert [cycle.complete for cycle in cycles][-1]
    assert sum(cycle.complete for cycle in cycles) == 1


def test_mean_and_spread_by_time_since_the_edge() -> None:
    rng = np.random.default_rng(6)
    curve, values = Curve(), rng.normal(size=(50, 400))
    since = np.arange(400) * 1e-3
    for value in values:
        curve.add(since, value)
    there = np.isfinite(curve.mean)
    pairs = values.reshape(50, 200, 2).mean(axis=2)  # of 1 ms in a bin
    assert there.sum() == 200
    np.testing.assert_allclose(curve.mean[there], pairs.mean(axis=0))
    np.testing.assert_allclose(curve.spread[there], pairs.std(axis=0, ddof=1))
    assert bins()[there][[0, -1]] == pytest.approx([BIN_S / 2, 0.4 - BIN_S / 2])


def test_where_few_cycles_come_no_mean_is_shown() -> None:
    curve = Curve()
    for length in (100, 100, 100, 300):
        curve.add(np.arange(length) * 1e-3, np.ones(length))
    curve.add(np.arange(100) * 1e-3, np.full(100, np.nan))
    assert np.flatnonzero(np.isfinite(curve.mean))[-1] == 49
    assert (curve.mean[:50] == 1.0).all()


def test_difference_is_of_the_means_where_both_are(sides: dict[str, Side]) -> None:
    a, b = sides["well"].measured_vacuum, sides["leaks"].measured_vacuum
    time, mean, half = difference(a, b)
    at = int(np.searchsorted(time, 0.3))  # evacuating: the leak costs some 30 mbar
    assert mean[at] == pytest.approx(-30.0, abs=8.0)
    assert 0.0 < half[at] < 2.0
    expected = difference(sides["well"].expected_vacuum, sides["leaks"].expected_vacuum)[1]
    assert abs(expected[at]) < 1.0


def test_vacuum_is_below_ambient_and_deviation_is_the_pressures(sides: dict[str, Side]) -> None:
    leaks = sides["leaks"]
    at = round(0.3 / BIN_S)
    gap = leaks.expected_vacuum.mean[at] - leaks.measured_vacuum.mean[at]
    assert leaks.deviation_curve.mean[at] == pytest.approx(gap, abs=1e-3)
    assert 600.0 < leaks.measured_vacuum.mean[at] < 750.0
    assert rigs.config("gripper").data.ambient.pressure_mbar * MBAR > 90_000.0


# What people and programs get.


def test_the_command_says_writes_and_draws(
    logs: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    outputs = [tmp_path / name for name in ("c.json", "c.png")]
    given = ("--json", outputs[0], "--picture", outputs[1])
    assert twin(monkeypatch, "compare", logs["well"], logs["leaks"], *given) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert said.out.startswith("A  well.mcap: compact-ejector-35 gripper-01, 9 cycles\nB  leaks")
    document = json.loads(outputs[0].read_text())
    assert document["format"] == "ejector-twin-compare/1"
    assert document["conclusion"] == said.out.strip().splitlines()[-1]
    figures = {figure["name"]: figure for figure in document["figures"]}
    leakage = figures["leakage"]
    assert leakage["differs"] is True
    assert leakage["low95"] < leakage["b"]["mean"] - leakage["a"]["mean"] < leakage["high95"]
    assert outputs[1].read_bytes().startswith(b"\x89PNG")


def test_pictures_as_svg_are_the_same_every_time(
    logs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for option, name in (("--picture", "1.svg"), ("-o", "2.svg")):
        given = (logs["well"], logs["again"], option, tmp_path / name)
        assert twin(monkeypatch, "compare", *given) == 0
    text = (tmp_path / "1.svg").read_text()
    assert text == (tmp_path / "2.svg").read_text()
    for words in ("does not differ from A", "B − A, measured vacuum", "A: expected"):
        assert words in text


@pytest.mark.slow
def test_the_recording_has_both_and_the_difference(sides: dict[str, Side], tmp_path: Path) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    from twin.compare.recording import TIMELINE, record

    target = tmp_path / "c.rrd"
    found = compare(sides["well"], sides["leaks"])
    record(found, target)
    lines = dict[str, int]()
    for piece in chunk.RrdReader(target).stream():
        if not piece.is_static and TIMELINE in piece.to_record_batch().schema.names:
            lines[piece.entity_path] = piece.to_record_batch().num_rows
    assert lines.keys() == {
        *(f"/vacuum/{side}/{kind}" for side in "ab" for kind in ("measured", "expected")),
        *(f"/difference/{kind}" for kind in ("measured", "expected")),
        *(f"/deviation/{side}" for side in "ab"),
    }
    assert lines["/difference/measured"] == len(difference_of(found))


def difference_of(found: Comparison) -> Any:
    return difference(found.a.measured_vacuum, found.b.measured_vacuum)[0]


def test_another_type_and_data_set_are_said_and_compared(sides: dict[str, Side]) -> None:
    other = replace(sides["leaks"].header, asset_type="else")
    found = compare(sides["well"], replace(sides["leaks"], header=other, data_set="else"))
    kind, data = remarks(found)
    assert kind.startswith("different types of asset, compact-ejector-35 and else")
    assert data.startswith("the logs were made beside different data sets")
    unit = replace(sides["leaks"].header, asset_id="")
    found = compare(sides["well"], replace(sides["leaks"], header=unit))
    assert remarks(found) == ["different units, gripper-01 and none"]
    assert remarks(compare(sides["well"], sides["leaks"])) == []


def test_a_log_without_a_whole_cycle_is_exit_code_3(
    logs: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    short = write_log(tmp_path / "short.mcap", rows=3000)
    assert twin(monkeypatch, "compare", logs["well"], short) == 3
    said = capsys.readouterr().err
    assert "short.mcap: no cycle to compare" in said
    assert "record at least two cycles" in said


@pytest.mark.parametrize(
    ("option", "name", "code"),
    [
        ("--picture", "c.pdf", 2),
        ("-o", "c.pdf", 2),
        ("--json", "nowhere/c.json", 3),
        ("--picture", "nowhere/c.png", 3),
        ("-o", "nowhere/c.rrd", 3),
    ],
)
def test_what_cannot_be_written_is_said_before_the_work(
    option: str, name: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = tmp_path / "a.mcap"  # would be exit code 3, with another message
    path = tmp_path / name
    assert twin(monkeypatch, "compare", missing, missing, option, path) == code
    assert not path.exists()
