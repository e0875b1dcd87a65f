"""A small draw of the battery in both worlds; the whole of it is `make battery`."""

from collections.abc import Sequence

import pytest

from tools.battery import first_world, line, second_world
from tools.battery_cases import Case, CaseFile, spread
from tools.battery_page import ASKED, likely

CHANCE = 0.01  # of so bad a count where what is asked for holds just so
COUNTS = {"single": 2, "healthy": 1}


def no_worse_than_chance(cases: Sequence[Case]) -> None:
    by_chance = [name for name, asked in ASKED.items() if asked.share < 1.0 and spread(cases, name)]
    bad = [name for name in by_chance if likely(cases, name) < CHANCE]
    assert not bad, (bad, *map(line, cases))


@pytest.mark.timeout(600)  # two calibrations, on a computer that does other things beside
def test_first_world() -> None:
    no_worse_than_chance(list(first_world(CaseFile(None, {}), 0, COUNTS, 1)))


@pytest.mark.timeout(600)  # two commissionings, on a computer that does other things beside
def test_second_world() -> None:
    """Of the first five seeds those with rows 1 ms apart: a healthy record more, and one effect."""
    cases = list(second_world(CaseFile(None, {}), range(5), [1], 2))
    assert len(cases) >= 2
    no_worse_than_chance(cases)


def test_too_few_are_more_than_chance() -> None:
    refused = [Case("commissioning", seed, "micro", error="no") for seed in range(2)]
    with pytest.raises(AssertionError, match="commissioned"):
        no_worse_than_chance(refused)
    no_worse_than_chance(refused[:1])
