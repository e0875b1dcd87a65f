"""The fault run in short, and that it would see what it looks for."""

import os
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import rigs
from log_rows import HEADER

from drivers.plc.live import WITNESSED
from tools import fault_run
from twin.events import Event, Kind
from twin.log.recorder import Recorder
from twin.quality import Quality
from twin.signals import MBAR, TICK, Samples


@pytest.mark.slow
def test_after_every_disturbance_the_log_is_true_and_the_twin_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fault_run, "SETTLED_S", 5.0)
    monkeypatch.setattr(fault_run, "GROWTH_MB", 60.0)  # this short it is still filling its buffers
    verdict, done = fault_run.run("modbus", 50.0, 6, 5, tmp_path)
    assert verdict.problems == []
    assert len(done) == len(set(done)) == 6
    assert verdict.counts["rows"] > 15_000


def test_a_lie_does_not_put_a_value_into_three_records() -> None:
    """They are as long as the header, and nothing could tell a false pressure from a true one."""
    random = np.random.default_rng(2)
    mbap, head = b"\0\1\0\0\0\x1b\1", b"\3\x18"
    records = b"".join(struct.pack(">HHf", number, 1, 400.0) for number in range(3))
    header = struct.pack(">IqHHHHHH", 7, 10**18, 1, 1000, 4096, 4, 6000, 0)
    changed = {
        name: any(
            lie[9:] != data and lie[:2] == mbap[:2] and lie[7:9] == head
            for lie in (fault_run.lie_by_modbus(mbap + head + data, random) for _ in range(200))
        )
        for name, data in (("records", records), ("header", header))
    }
    assert changed == {"records": False, "header": True}


# Logs that are not true.

SCANS = 12_000


def sampled() -> tuple[Samples, np.ndarray]:
    samples = rigs.recorded("test_rig", SCANS / 1000)[0].copy()
    theirs = np.zeros(SCANS, WITNESSED)
    theirs["sequence"], theirs["time_ns"] = samples["sequence"], samples["time_ns"]
    theirs["pressure"] = samples["pressure"].astype(np.float64) / MBAR
    theirs["status"] = samples["commands"]
    samples["pressure"] = (theirs["pressure"].astype(np.float64) * MBAR).astype(np.float32)
    return samples, theirs


def judged(
    folder: Path, samples: Samples, *boots: np.ndarray, happened: Sequence[Event] = ()
) -> list[str]:
    paths = [folder / f"boot{number}.bin" for number in range(len(boots))]
    for path, theirs in zip(paths, boots, strict=True):
        theirs.tofile(path)
    twin, monitor = rigs.twin("test_rig"), rigs.monitor("test_rig")
    with Recorder(folder / "a.mcap", HEADER) as recorder:
        recorder.write(samples[:0], np.empty(0, TICK), happened)
        for block in rigs.cut(samples, 1000):
            rows, ticks = twin.advance(block)
            recorder.write(rows, ticks, monitor.update(rows, ticks))
        rows, ticks = twin.flush()
        recorder.write(rows, ticks, monitor.update(rows, ticks))
    verdict = fault_run.Verdict()
    fault_run.judge(folder / "a.mcap", paths, verdict)
    return list(verdict.problems)


def test_a_true_log_has_no_problems(tmp_path: Path) -> None:
    samples, theirs = sampled()
    rows = np.delete(samples, np.s_[300:400])
    rows["quality"][300] = Quality.GAP
    assert judged(tmp_path, rows, theirs) == []


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda rows: rows["pressure"].__setitem__(5000, 101_324.0), "other pressures"),
        (lambda rows: rows["commands"].__setitem__(5000, 3), "other commands"),
        (lambda rows: rows["quality"].__setitem__(50, Quality.GAP), "gaps are not where"),
        (lambda rows: rows["sequence"].__setitem__(np.s_[50:], rows["sequence"][49:-1]), "twice"),
        (lambda rows: rows["time_ns"].__iadd__(10**9), "of the times are wrong"),
    ],
)
def test_what_is_not_true_is_seen(change: object, problem: str, tmp_path: Path) -> None:
    samples, theirs = sampled()
    change(samples)  # type: ignore[operator]
    assert problem in "; ".join(judged(tmp_path, samples, theirs))


def test_a_hole_without_a_mark_is_seen(tmp_path: Path) -> None:
    samples, theirs = sampled()
    rows = np.delete(samples, np.s_[300:301])
    assert "gaps are not where rows are missing" in "; ".join(judged(tmp_path, rows, theirs))


def test_an_outage_without_an_end_is_seen(tmp_path: Path) -> None:
    samples, theirs = sampled()
    told = [Event(0, Kind.OUTPUT_DOWN, "log: no space", {"output": "log"})]
    assert judged(tmp_path, samples, theirs, happened=told) == [
        "log: was down 1 times, and back 0 times"
    ]


def test_a_part_without_an_end_is_seen(tmp_path: Path) -> None:
    samples, theirs = sampled()
    judged(tmp_path, samples, theirs)
    path = tmp_path / "a.mcap"
    os.truncate(path, path.stat().st_size - 1)
    verdict = fault_run.Verdict()
    fault_run.judge(path, [tmp_path / "boot0.bin"], verdict)
    assert verdict.problems == [
        "not finished and not told of: ['a.mcap']",
        "the log is not complete",
    ]


@pytest.mark.slow
def test_disk_faults_cost_no_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("the disk is full", "the folder of the log is deleted")
    monkeypatch.setattr(fault_run, "SETTLED_S", 5.0)
    monkeypatch.setattr(fault_run, "GROWTH_MB", 60.0)
    monkeypatch.setattr(
        fault_run, "DISTURBANCES", {name: fault_run.DISTURBANCES[name] for name in names}
    )
    verdict, done = fault_run.run("modbus", 20.0, len(names), 1, tmp_path)
    assert verdict.problems == []
    assert {text.partition(" (")[0] for text in done} == set(names)
    assert verdict.counts["log_down"] == len(names)
    assert verdict.counts["parts"] == len(names) + 1


def test_rows_of_no_plc_are_seen(tmp_path: Path) -> None:
    samples, theirs = sampled()
    samples["pressure"] += 100
    assert "are of no PLC" in "; ".join(judged(tmp_path, samples, theirs))


def test_growth_is_seen() -> None:
    seen = [{"threads": 5.0, "files": 9.0, "sockets": 1.0, "mb": 200.0 + i} for i in range(30)]
    verdict = fault_run.Verdict()
    fault_run.judge_growth(seen, verdict)
    assert verdict.problems == ["mb grew from 205 to 224"]
    seen = [row | {"files": 9.0 + (i > 5)} for i, row in enumerate(seen[:12])]
    verdict = fault_run.Verdict()
    fault_run.judge_growth(seen, verdict)
    assert verdict.problems == ["files grew from 9 to 10"]
