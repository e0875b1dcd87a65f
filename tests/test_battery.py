"""A draw of the battery in both worlds; the whole of it is `make battery`.

Each commit has seeds of its own, which nobody has looked at: its hash. They are printed.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from tools import battery_first
from tools.battery import SEEDS, line
from tools.battery_cases import Case, spread
from tools.battery_page import ASKED, expected, likely
from tools.battery_second import (
    CADENCES,
    CYCLES,
    Met,
    cases,
    commissioned,
    diagnosed,
    drawn,
    plan_cycles,
    record,
    truths,
    with_unit,
)
from tools.version import ROOT, commit
from twin.signals import MBAR, MS

PAGE = (ROOT / "docs" / "battery.md").read_text(encoding="utf-8")
CHANCE = 0.01  # of any count being so bad where what is expected holds just so
COUNTS = {"single": 10, "pair": 3, "healthy": 4, "unlisted": 3}
SLOW_ROWS = (5, 10)  # ms, by turns
LONGEST = 60.0  # s of a record: a big tank's takes ten times that, and so does its commissioning


def no_worse_than_chance(answered: Sequence[Case], world: str, page: str = PAGE) -> None:
    """What is expected is what is asked for, or what the page's run reached if that is short."""
    counted = [
        name for name, asked in ASKED.items() if asked.share < 1.0 and spread(answered, name)
    ]
    least = CHANCE / max(len(counted), 1)
    bad = [name for name in counted if likely(answered, name, expected(name, world, page)) < least]
    assert not bad, (bad, *map(line, answered))


def seed_of(commit: str) -> int:
    """The first seed of a commit, or of a folder that is none."""
    try:
        return int(commit.removesuffix("-dirty"), 16) % SEEDS
    except ValueError:
        return 0


@pytest.mark.slow
@pytest.mark.timeout(2400)  # 900 s alone on two cores, and a computer may do other things beside
def test_first_world() -> None:
    """Beside the page's newest run, which had five mechanisms outside the table.

    ``again`` draws from all of them.
    """
    first = seed_of(commit())
    counts = " ".join(f"--{kind} {count}" for kind, count in COUNTS.items())
    sys.stdout.write(
        f"again: python tools/battery.py --world first --first {first} --units 1 {counts}\n"
    )
    answered = [
        battery_first.answered(kind, seed, 1, battery_first.UNLISTED)
        for kind, seed in battery_first.keys(first, COUNTS)
    ]
    assert len(answered) == sum(COUNTS.values()) >= 20
    no_worse_than_chance(answered, "first")


def test_each_commit_has_seeds_of_its_own() -> None:
    assert seed_of("0e3a093") == seed_of("0e3a093-dirty") == 0x0E3A093 % SEEDS
    assert seed_of("unknown") == 0
    assert not (ROOT / ".git").exists() or commit() != "unknown"  # on the empty path of a test


def rig_from(seed: int, cadence_ms: int) -> Met:
    """The first rig from a seed on with such rows and a record that is not long."""
    while True:
        met = drawn(seed, [cadence_ms])
        if met and plan_cycles(met.rig, seed, CYCLES)[-1].end * MS <= LONGEST:
            return met
        seed += 1


def slow_rows(first: int) -> int:
    """Ms between the rows of the second rig, by turns."""
    return SLOW_ROWS[first % len(SLOW_ROWS)]


def answers(met: Met, kinds: Sequence[str]) -> list[Case]:
    """A rig's commissioning and, if it has a twin then, its first record of each kind."""
    sys.stdout.write(f"again: python tools/battery.py --world second --first {met.seed} --rigs 1\n")
    commissioning = commissioned(met)
    unit = with_unit(met, commissioning)
    wanted = [of for of in cases(met) if of[0] in kinds and of[1] == 0] if unit else []
    return [commissioning, *(diagnosed(unit, *of) for of in wanted if unit)]


@pytest.mark.slow
@pytest.mark.timeout(1200)  # two commissionings, on a computer that does other things beside
def test_second_world() -> None:
    """One rig with rows 1 ms apart, and one with rows 5 or 10 ms apart."""
    first = seed_of(commit())
    answered = answers(rig_from(first, 1), ["healthy", "single"])
    answered += answers(rig_from(first, slow_rows(first)), ["pair", "unlisted"])
    assert any(case.kind != "commissioning" for case in answered), "neither rig has its twin"
    no_worse_than_chance(answered, "second")


def test_rigs_of_the_second_world_take_turns() -> None:
    assert {slow_rows(first) for first in range(2)} == set(SLOW_ROWS)
    for cadence in (1, *SLOW_ROWS):
        met = rig_from(301, cadence)
        assert met.seed >= 301
        assert met.rig.sensor.cadence_ms == cadence
        assert plan_cycles(met.rig, met.seed, CYCLES)[-1].end * MS <= LONGEST


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
    all_reached = "<!-- newest run of the second world: x -->\n<!-- end -->"
    with pytest.raises(AssertionError, match="commissioned"):
        no_worse_than_chance(refused, "second", all_reached)
    no_worse_than_chance(refused[:1], "second", all_reached)


def test_a_draw_is_held_to_what_the_page_reached() -> None:
    """Where a run falls short of what is asked for, a draw may be as bad as that, by chance."""
    answered = [Case("healthy", seed, "gripper", error="no") for seed in range(2)]
    row = f"| {ASKED['consistent'].words} | {{}} | – |"
    with_row = "<!-- newest run of the second world: x -->\n{}\n<!-- end -->"
    no_worse_than_chance(answered, "second", with_row.format(row.format("1 of 2 (50%)")))
    with pytest.raises(AssertionError, match="consistent"):
        no_worse_than_chance(answered, "second", with_row.format(row.format("2 of 2 (100%)")))
