"""The soak run in short, and that it would see what it looks for."""

import json
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import rigs

from drivers.plc.settings import PlcSettings
from tools import soak
from twin.signals import Command, Samples

HOURS = np.linspace(0.0, 24.0, 3000)


def seen(growth: float) -> list[float]:
    """Memory (MB) that fills for two hours, wanders by a megabyte, and grows in each hour."""
    rng = np.random.default_rng(1)
    wanders = np.convolve(rng.normal(0.0, 0.1, len(HOURS) + 99), np.ones(100) / 10.0, "valid")
    return list(300.0 + 60.0 * (1 - np.exp(-HOURS)) + wanders + growth * HOURS)


def test_a_leak_of_ten_megabytes_a_day_is_seen_and_caches_that_fill_are_none() -> None:
    steady, leaking = (soak.fitted(list(HOURS), seen(growth), 0.1) for growth in (0.0, 0.4))
    assert steady.is_good
    assert steady.low95 < 0.0 < steady.high95
    assert not leaking.is_good
    assert leaking.low95 < 0.4 < leaking.high95


def test_one_handle_more_an_hour_is_seen() -> None:
    handles = [9.0 + int(hour) for hour in HOURS]
    assert not soak.fitted(list(HOURS), handles, 0.0).is_good
    assert soak.fitted(list(HOURS), [9.0] * len(HOURS), 0.0).is_good


@pytest.mark.parametrize("looks", [1, 2, 5, 19])
def test_a_fast_machine_gives_few_looks(looks: int) -> None:
    line = soak.fitted(list(HOURS[:looks]), [9.0] * looks, 0.0)
    assert line.is_good
    assert (line.low95, line.high95) == (-np.inf, np.inf) or looks > 3


@pytest.fixture(scope="module")
def cycles() -> Samples:
    return soak.stretch(rigs.config("test_rig").document.section(PlcSettings, "plc"))


@pytest.mark.slow
def test_rows_go_on_for_ever(cycles: Samples) -> None:
    told: list[float] = []
    blocks = soak.endless(cycles, told.append, lambda: True)
    rows = np.concatenate([*islice(blocks, 2 * len(cycles) // soak.BLOCK + 4)])
    assert len(rows) > 2 * len(cycles)
    assert (np.diff(rows["sequence"]) == 1).all()
    assert len(set(np.diff(rows["time_ns"]).tolist())) == 1
    seam = rows[len(cycles) - 1 : len(cycles) + 1]
    assert abs(float(np.diff(seam["pressure"])[0])) < 500.0  # Pa
    assert (seam["commands"] & Command.SUCTION).tolist() == [0, 1]
    assert told == sorted(told)


@pytest.mark.slow
def test_two_minutes_of_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(soak, "LEAST_S", 0.001)
    fills = {"handles": 1e4, "threads": 1e4, "database_mb": 1e4}
    monkeypatch.setattr(soak, "ALLOWED", soak.ALLOWED | fills)
    with soak.compressed(tmp_path) as (process, so_far):
        looks = soak.soak(process, so_far, 0.03, tmp_path)
    answer = soak.judged(looks, tmp_path)
    assert json.loads(json.dumps(answer))["problems"] == []
    assert answer["rows"] > 100_000
    assert answer["last"]["log_mb"] > 0.1
    assert answer["last"]["database_mb"] > 0.01
