"""The rate of false alarms: measured as it is, and judged against the one that is set."""

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from tools import false_alarms
from tools.false_alarms import (
    BEGIN,
    END,
    PATH_OF,
    WITHIN,
    Device,
    Rate,
    is_as_set,
    of_limits,
    of_sums,
    simulated,
    table,
)
from tools.fault_run import ROOT
from tools.importance_sampling import BEGINS, Weighing, times_wanted
from twin.alarms.rules import default_rules
from twin.figures.settings import LIMITED
from twin.monitor.change_detection import ChangeDetector, limit
from twin.monitor.false_alarm_budget import LIMITS, SINGLE_CYCLES, SUMS
from twin.monitor.model_bank import SUSPECTS


def rates(times: float) -> list[Rate]:
    """Three paths with as many times the wanted number in all."""
    shares = {"sums over cycles": 0.9, "single cycles": 0.05, "limits of key figures": 0.05}
    return [Rate(what, share, times, times, times, "") for what, share in shares.items()]


@pytest.mark.parametrize(
    ("times", "kept"), [(0.0, False), (0.52, False), (0.68, True), (1.49, True), (1.6, False)]
)
def test_too_few_false_alarms_are_not_the_rate_that_is_set(times: float, kept: bool) -> None:
    assert is_as_set(rates(times)) is kept
    assert (": kept." in table(rates(times), 8, 1000, 0)) is kept


def test_the_page_has_the_table_as_it_is_written_today() -> None:
    """Its words are the generator's, whatever the numbers and the result."""
    page = (ROOT / "docs" / "isolation.md").read_text(encoding="utf-8")
    block = page.split(BEGIN)[1].split(END)[0].strip()
    rows = [row.split(" | ") for row in block.splitlines() if row.startswith("|")][2:]
    named = [Rate(row[0][2:], 0.3, 1.0, 1.0, 1.0, row[4][:-2]) for row in rows]
    assert numberless(block) == numberless(table(named, 8, 1000, 0))


def numberless(text: str) -> str:
    """A table without the name of its commit, its numbers and its result."""
    nameless = re.sub(r"^\*\*[\w-]+, ", "", text)
    return re.sub(r"[\d.,]+(e-?\d+)?|not (?=kept)|none", "", nameless)


@pytest.mark.parametrize(
    ("sources", "used"), [("d843178", True), ("d843178-dirty", False), ("unknown", False)]
)
def test_devices_of_sources_without_a_commit_are_simulated_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sources: str, used: bool
) -> None:
    normal, simulated_anew = np.zeros((2, 2)), list[int]()
    device = Device(normal, np.eye(2), np.zeros(2), 1, normal, normal, 0)

    def keep(seed: int, cycles: int, file: Path) -> None:
        simulated_anew.append(seed)
        np.savez_compressed(file, **asdict(device))

    monkeypatch.setattr(false_alarms, "commit", lambda: sources)
    monkeypatch.setattr(false_alarms, "_keep", keep)
    monkeypatch.setattr(false_alarms, "ProcessPoolExecutor", lambda *_: ThreadPoolExecutor(1))
    for _ in range(2):
        assert len(simulated(range(3), 2, tmp_path, 1)) == 3
    assert simulated_anew == ([0, 1, 2] if used else [0, 1, 2] * 2)


def test_every_alarm_is_counted_or_no_judgement_of_cycles() -> None:
    assert set(PATH_OF) == {rule.name for rule in default_rules()}


def test_the_shares_are_one_budget_that_sums_use_up() -> None:
    """Sums of normal scores alone raise about as many false alarms as are set."""
    scores = np.random.default_rng(1).standard_normal((20_000, len(SUSPECTS)))
    alike = np.eye(len(SUSPECTS))
    normal = Device(scores, alike, np.empty(0), 0, np.empty((0, 0)), np.empty((0, 0)), 0)
    found = of_sums([normal], seed=1, runs=300, anew=1)
    assert 1.0 / WITHIN < SUMS * found.times < WITHIN
    assert pytest.approx(1.0) == SUMS + SINGLE_CYCLES + LIMITS


def test_importance_sampling_counts_as_many_alarms_as_come() -> None:
    """Scores with a short tail raise fewer alarms than normal ones, counted either way."""
    rng, wanted, devices, cycles = np.random.default_rng(2), 5000.0, 300, 2000
    scores = rng.uniform(-np.sqrt(3.0), np.sqrt(3.0), (20_000, 4))
    changes, weighing = (kind(np.ones(4, bool), np.ones(4)) for kind in (ChangeDetector, Weighing))
    found = times_wanted(scores, changes, weighing, wanted, rng, 500)
    changes.begin()
    changes.take(np.full((devices, 4), np.nan))
    alarms = 0
    for cycle in range(cycles):
        changes.take(scores[rng.integers(len(scores), size=devices)])
        raised = changes.log_sums >= limit(wanted)
        alarms += int(raised.sum()) if cycle >= BEGINS else 0
        changes.begin_some(raised)
    plain = alarms * wanted / devices / (cycles - BEGINS)
    assert found == pytest.approx(plain, rel=0.3)
    assert found < 0.8


def with_t1(limit_ms: float) -> Device:
    """A device whose t1 is 400 ms with a scatter of 20 ms."""
    t1 = np.random.default_rng(3).normal(400.0, 20.0, 20_000)
    others = np.full((len(t1), len(LIMITED) - 1), np.nan)
    limits = np.array([[-np.inf], [limit_ms]]) * np.ones(len(LIMITED))
    figures = np.column_stack([t1, others])
    return Device(np.empty((0, 0)), np.eye(0), np.empty(0), 0, figures, limits, 0)


def test_a_limit_that_healthy_cycles_come_up_to_is_seen() -> None:
    assert of_limits([with_t1(480.0)], seed=1, resamples=2).times > 100.0  # four sigmas
    assert of_limits([with_t1(600.0)], seed=1, resamples=2).times < 0.01
