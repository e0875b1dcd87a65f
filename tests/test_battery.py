"""A draw of the battery in both worlds; the whole of it is `make battery`.

Of the first world each commit has seeds of its own, which nobody has looked at: its hash.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from tools.battery import SEEDS, first_world, line, second_world
from tools.battery_cases import Case, CaseFile, spread
from tools.battery_page import ASKED, likely
from tools.battery_second import CADENCES, drawn, record, truths
from tools.version import ROOT, commit
from twin.signals import MBAR

CHANCE = 0.01  # of so bad a count where what is asked for holds just so
COUNTS = {"single": 10, "pair": 3, "healthy": 4, "unlisted": 3}


def no_worse_than_chance(cases: Sequence[Case]) -> None:
    by_chance = [name for name, asked in ASKED.items() if asked.share < 1.0 and spread(cases, name)]
    bad = [name for name in by_chance if likely(cases, name) < CHANCE]
    assert not bad, (bad, *map(line, cases))


def seed_of(commit: str) -> int:
    """The first seed of a commit, or of a folder that is none."""
    try:
        return int(commit.removesuffix("-dirty"), 16) % SEEDS
    except ValueError:
        return 0


@pytest.mark.slow
@pytest.mark.timeout(1200)  # two calibrations, on a computer that does other things beside
def test_first_world() -> None:
    cases = list(first_world(CaseFile(None, {}), seed_of(commit()), COUNTS, 1))
    assert len(cases) == sum(COUNTS.values()) >= 20
    no_worse_than_chance(cases)


def test_each_commit_has_seeds_of_its_own() -> None:
    assert seed_of("0e3a093") == seed_of("0e3a093-dirty") == 0x0E3A093 % SEEDS
    assert seed_of("unknown") == 0
    assert not (ROOT / ".git").exists() or commit() != "unknown"  # on the empty path of a test


@pytest.mark.slow
@pytest.mark.timeout(1200)  # two commissionings, on a computer that does other things beside
def test_second_world() -> None:
    """Of the first five seeds those with rows 1 ms apart: a healthy record more, and one effect."""
    cases = list(second_world(CaseFile(None, {}), range(5), [1], 2))
    assert len(cases) >= 2
    no_worse_than_chance(cases)


@pytest.mark.parametrize("seed", [105002, 113001])
def test_the_true_end_pressure_is_what_a_long_suction_comes_to(seed: int) -> None:
    """Regulator and suction valve take from the supply: without the valve 16 and 39 mbar less."""
    met = drawn(seed, CADENCES)
    tight = replace(
        met.rig,
        program=replace(met.rig.program, suction_s=20.0),
        vessel=replace(met.rig.vessel, leak=0.0),
    )
    logged = record(tight, seed, 1)
    last = int(np.flatnonzero(logged.suction)[-1])
    read = met.person.samples(logged)["pressure"][last - 200 : last] / MBAR
    true = truths(met, 1.0)["ejector.end_pressure_mbar"]
    assert float(np.mean(read)) == pytest.approx(true, abs=2.0)


def test_too_few_are_more_than_chance() -> None:
    refused = [Case("commissioning", seed, "micro", error="no") for seed in range(2)]
    with pytest.raises(AssertionError, match="commissioned"):
        no_worse_than_chance(refused)
    no_worse_than_chance(refused[:1])
