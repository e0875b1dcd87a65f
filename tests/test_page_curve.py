"""The curve of any time: from logs by their indexes, no peak lost, gaps shown, in bounded steps."""

import dataclasses
import os
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from log_rows import HEADER, course
from page_site import AMBIENT, NOW, Run, S, config, write_config

from twin.alarms import writer as keeper_module
from twin.cli.serve import live_rows_of
from twin.events import Kind
from twin.log.header import RECORDED, LogHeader
from twin.log.index import read_index
from twin.log.part import part_path
from twin.log.recorder import Recorder
from twin.page import curve as curve_module
from twin.page import recorded as recorded_module
from twin.page.curve import MOST_COLUMNS, Curve, Curves
from twin.page.ejector import Ejector
from twin.page.log_folders import remember, remembered
from twin.page.recorded import RecordedRows
from twin.page.settings import folder_of
from twin.signals import Samples, Ticks

UNIT = ("SCPSi 15", "robot 7, left")
OURS = dataclasses.replace(HEADER, ambient=AMBIENT, metadata={RECORDED: "twin run"})
BEGIN = NOW - 3600 * S


def rows(seconds: float, begin_ns: int = BEGIN) -> tuple[Samples, Ticks]:
    """Cycles of 2.5 s, received from ``begin_ns`` on."""
    samples, ticks = course(round(seconds * 1000))
    shift = begin_ns - int(samples["time_ns"][0])
    samples["host_ns"] += shift
    samples["time_ns"] += shift - 77 * S  # the PLC's clock is another one
    return samples, ticks


def begin_log(path: Path, block: tuple[Samples, Ticks], header: LogHeader = OURS) -> Recorder:
    """A log as a run writes it: a chunk each quarter of a second."""
    now = [0.0]
    recorder = Recorder(path, header, clock=lambda: now[0])
    samples, ticks = block
    for at in range(0, len(samples), 125):
        now[0] = at / 1000
        recorder.write(samples[at : at + 125], ticks[at : at + 125])
    return recorder


def write_log(path: Path, block: tuple[Samples, Ticks], header: LogHeader = OURS) -> Path:
    begin_log(path, block, header).close()
    return path


@pytest.fixture
def curves(tmp_path: Path) -> Curves:
    folder = tmp_path / "page"
    remember(folder, tmp_path)
    return Curves(folder, UNIT)


def read(curves: Curves, begin_s: float, end_s: float) -> Curve:
    """The whole curve between two times after ``BEGIN``."""
    share = -1.0
    while True:
        curve = curves.read(BEGIN + round(begin_s * S), BEGIN + round(end_s * S), NOW)
        if curve.share == 1.0:
            return curve
        assert curve.share > share
        share = curve.share


def test_a_peak_of_one_row_is_kept_in_every_width(curves: Curves, tmp_path: Path) -> None:
    samples, ticks = rows(300.0)
    samples["pressure"][123_456] = AMBIENT - 950e2
    ticks["expected"][200_001] = AMBIENT - 970e2
    write_log(tmp_path / "run.mcap", (samples, ticks))
    for begin, end in ((0.0, 300.0), (100.0, 210.0), (0.0, 86_400.0), (-40_000.0, 100_000.0)):
        columns = read(curves, begin, end).columns
        assert len(columns) <= MOST_COLUMNS
        assert np.nanmax(columns["measured_high"]) == pytest.approx(950.0, abs=0.01)
        assert np.nanmax(columns["expected_high"]) == pytest.approx(970.0, abs=0.01)
        low = (AMBIENT - samples["pressure"].max()) / 100.0
        assert np.nanmin(columns["measured_low"]) == pytest.approx(low, abs=0.01)


def test_the_closest_look_has_each_row_at_the_time_of_its_measurement(
    curves: Curves, tmp_path: Path
) -> None:
    samples, ticks = rows(20.0)
    write_log(tmp_path / "run.mcap", (samples, ticks))
    curve = read(curves, 10.0, 10.5)
    assert len(curve.columns) == pytest.approx(500, abs=2)
    assert set(np.diff(curve.columns["first_ns"]).tolist()) == {1_000_000}  # no steps of receipt
    late = (samples["host_ns"] - samples["time_ns"] - 77 * S).max()
    assert curve.columns["first_ns"][0] == pytest.approx(BEGIN + 10 * S, abs=float(late))


def test_phases_are_intervals_until_they_are_too_narrow(
    curves: Curves, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(curve_module, "MOST_PHASES", 40)
    write_log(tmp_path / "run.mcap", rows(60.0))
    phases = read(curves, 0.0, 25.0).phases
    assert phases is not None
    assert [phase for _, _, phase in phases[:4]] == [0, 1, 3, 0]
    assert phases[1][1] - phases[1][0] == pytest.approx(1.5 * S, abs=0.05 * S)
    assert all(one[1] == other[0] for one, other in pairwise(phases))
    assert read(curves, 0.0, 60.0).phases is None


def test_gaps_are_shown_as_gaps(curves: Curves, tmp_path: Path) -> None:
    samples, ticks = rows(60.0)
    kept = np.r_[0:20_000, 20_700:60_000]
    write_log(tmp_path / "run.mcap", (samples[kept], ticks[kept]))
    write_log(tmp_path / "later.mcap", rows(60.0, BEGIN + 90 * S))
    curve = read(curves, -10.0, 160.0)
    bounds = [(round((a - BEGIN) / S, 1), round((b - BEGIN) / S, 1)) for a, b in curve.gaps]
    assert bounds == [(-10.0, 0.0), (20.0, 20.7), (60.0, 90.0), (150.0, 160.0)]
    assert read(curves, 0.0, 3000.0).gaps[0][1] > BEGIN + 80 * S  # 0.7 s are less than a column


def test_the_log_of_a_run_is_read_as_it_grows(curves: Curves, tmp_path: Path) -> None:
    samples, ticks = rows(40.0)
    recorder = begin_log(tmp_path / "run.mcap", (samples[:20_000], ticks[:20_000]))
    assert read(curves, 0.0, 60.0).columns["last_ns"][-1] > BEGIN + 19 * S
    recorder.write(samples[20_000:], ticks[20_000:])
    recorder._clock = lambda: 1e9
    recorder.write(samples[:0], ticks[:0])
    assert read(curves, 0.0, 60.0).columns["last_ns"][-1] > BEGIN + 39 * S
    recorder.close()
    assert read(curves, 0.0, 60.0).columns["last_ns"][-1] > BEGIN + 39 * S


def test_broken_files_give_what_they_have_and_say_so(curves: Curves, tmp_path: Path) -> None:
    path = write_log(tmp_path / "run.mcap", rows(60.0))
    at = int(read_index(path).places["position"][120])
    content = bytearray(path.read_bytes())
    content[at + 200 : at + 220] = bytes(20)
    path.write_bytes(content)
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "other.mcap").write_bytes(b"no log")
    curve = read(curves, 0.0, 60.0)
    assert curve.damaged == 1
    ((begin, end),) = curve.gaps
    assert (begin - BEGIN) / S == pytest.approx(30.0, abs=1.0)
    assert 0.1 * S < end - begin < 0.5 * S
    content[at : at + 9] = b"\xff" * 9  # no record any more, and no summary
    path.write_bytes(content[:-20])
    assert read(Curves(tmp_path / "page", UNIT), 0.0, 60.0).columns["last_ns"][-1] > BEGIN + 59 * S


def test_only_parts_with_rows_in_the_range_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for hour in range(12):
        begin = BEGIN - hour * 3600 * S
        path = write_log(tmp_path / f"{hour:02}.mcap", rows(5.0, begin))
        os.utime(path, (begin / 1e9 + 5, begin / 1e9 + 5))
    foreign = dataclasses.replace(OURS, asset_id="another")
    write_log(tmp_path / "foreign.mcap", rows(5.0), foreign)
    write_log(tmp_path / "replayed.mcap", rows(5.0), dataclasses.replace(OURS, metadata={}))
    opened: list[Path] = []

    def counted(path: Path, before: object = None) -> object:
        opened.append(path)
        return read_index(path, before)  # type: ignore[arg-type]

    monkeypatch.setattr(recorded_module, "read_index", counted)
    found = RecordedRows(lambda: [tmp_path], UNIT).read(BEGIN - 3610 * S, BEGIN - 3590 * S, S)
    assert [path.name for path in opened] == ["01.mcap"]
    assert len(found.bins) in (5, 6)


def test_the_parts_of_a_log_are_one_curve(curves: Curves, tmp_path: Path) -> None:
    samples, ticks = rows(60.0)
    with Recorder(tmp_path / "run.mcap", OURS, rotate_bytes=50_000) as recorder:
        for at in range(0, len(samples), 2000):
            recorder.write(samples[at : at + 2000], ticks[at : at + 2000])
            recorder._flush(recorder._clock())
    assert part_path(tmp_path / "run.mcap", 2).exists()
    curve = read(curves, 0.5, 59.5)
    assert curve.gaps == []
    assert curve.share == 1.0


def test_a_long_range_is_read_in_steps_and_kept(tmp_path: Path) -> None:
    write_log(tmp_path / "run.mcap", rows(120.0))
    seconds = [0.0]

    def clock() -> float:
        seconds[0] += 0.3
        return seconds[0]

    reader, shares = RecordedRows(lambda: [tmp_path], UNIT, clock), [0.0]
    while shares[-1] < 1.0:
        shares.append(reader.read(BEGIN, BEGIN + 120 * S, S // 2).share)
        assert shares[-1] > shares[-2]
    assert len(shares) > 3


def test_what_is_kept_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_module, "MOST_KEPT", 100_000)
    write_log(tmp_path / "run.mcap", rows(120.0))
    reader = RecordedRows(lambda: [tmp_path], UNIT)
    for width in (S // 1000, S // 100, S // 10):
        reader.read(BEGIN, BEGIN + 120 * S, width)
        assert reader._kept_bytes == sum(bins.nbytes for bins, _ in reader._kept.values())
        assert reader._kept_bytes < 100_000 or len(reader._kept) == 1


@pytest.mark.slow
def test_a_million_rows_answer_within_about_a_second(curves: Curves, tmp_path: Path) -> None:
    write_log(tmp_path / "run.mcap", rows(1000.0))
    read(curves, 0.0, 1.0)  # compiled once
    begin = time.monotonic()
    curve = read(Curves(tmp_path / "page", UNIT), 0.0, 1000.0)
    assert time.monotonic() - begin < 3.0  # on a busy machine; the budget is below a second
    assert MOST_COLUMNS / 2 <= len(curve.columns) <= MOST_COLUMNS


def test_folders_of_logs_are_remembered_once_each_newest_last(tmp_path: Path) -> None:
    for name in ("a", "b", "a"):
        remember(tmp_path / "page", tmp_path / name)
    assert remembered(tmp_path / "page") == [tmp_path / "b", tmp_path / "a"]
    assert remembered(tmp_path / "nowhere") == []


def test_a_run_says_where_its_log_lies(tmp_path: Path) -> None:
    settings = config(write_config(tmp_path))
    opened = live_rows_of(settings, pytest.fail, tmp_path / "logs" / "run.mcap")
    assert opened is not None
    opened().close()
    folder = folder_of(settings.document, settings.asset)
    assert remembered(folder) == [tmp_path / "logs"]
    without = live_rows_of(settings, pytest.fail)
    assert without is not None
    without().close()
    assert remembered(folder) == [tmp_path / "logs"]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    monkeypatch.setattr(keeper_module, "POLL_S", 0.01)
    now = [NOW]
    run = Run(config(write_config(tmp_path)), lambda: now[0])
    run.at = lambda seconds: now.__setitem__(0, NOW + round(seconds * S))  # type: ignore[attr-defined]
    yield run
    run.close()


def test_without_a_log_the_live_rows_are_there(run: Run) -> None:
    run.suck(2.0)
    run.suck(0.1)
    ejector = Ejector(run.config, lambda: NOW)
    deadline = time.monotonic() + 10.0
    while not (found := ejector.curve(NOW - 10 * S, NOW))["time"]:
        assert time.monotonic() < deadline
    assert not found["logged"]
    assert found["measured_high"][0] == pytest.approx(600.0)
    assert found["expected_low"][0] == pytest.approx(650.0)


def test_alarms_of_a_range_have_all_their_times(run: Run) -> None:
    at = run.at  # type: ignore[attr-defined]
    at(10.0)
    run.leak()
    at(20.0)
    run.say(Kind.DEVIATION_CLEARED)
    run.alarms.close()
    ejector = Ejector(run.config, lambda: NOW + 60 * S)
    (mark,) = ejector.curve(NOW, NOW + 60 * S)["alarms"]
    assert mark["what"] == "Leakage"
    assert (mark["raised"], mark["cleared"]) == (NOW / S + 10, NOW / S + 20)
    assert mark["seen"] is None
    assert ejector.curve(NOW + 15 * S, NOW + 60 * S)["alarms"] == [mark]  # it ended there
    assert ejector.curve(NOW + 30 * S, NOW + 60 * S)["alarms"] == []
