"""What the founding paper's model leaves out is found from cycles (docs/founding-model.md)."""

from dataclasses import dataclass
from functools import cache

import pytest

from tools.founding_model import EXTENSIONS, Patient, extended, larger, off, paper_rig, rms


@cache
def rig() -> Patient:
    return paper_rig()


@dataclass(frozen=True)
class Left:
    """What an extension leaves on another record and on another volume (mbar rms)."""

    unseen: float
    other_volume: float
    leak: tuple[float, float]  # sl/min, as told
    film: tuple[float, float]  # W/(m²·K)


@cache
def left(name: str) -> Left:
    fitted = extended(rig(), EXTENSIONS[name])
    film = "system.film_coefficient"
    return Left(
        rms(off(fitted.data, rig().unseen)),
        rms(off(larger(fitted.data), rig().other_volume)),
        fitted.interval("system.leak_sl_min"),
        fitted.interval(film) if film in [free.name for free in fitted.free] else (0.0, 0.0),
    )


def test_the_papers_model_misses_cycles_by_far() -> None:
    assert rms(off(rig().nominal, rig().unseen)) > 40.0


@pytest.mark.slow
@pytest.mark.parametrize("alone", ["fitted, wall heat", "fitted, bends"])
def test_wall_heat_and_bends_are_both_needed(alone: str) -> None:
    both, one = left("fitted, both"), left(alone)
    assert both.unseen < 1.0
    assert both.other_volume < 1.3
    assert one.unseen > 3.0 * both.unseen
    assert one.other_volume > 3.0 * both.other_volume


def test_without_wall_heat_a_leak_is_told_that_is_not_there() -> None:
    low, high = left("fitted, both").leak
    assert low <= 0.3 <= high  # sl/min, of the simulated rig
    assert left("fitted, bends").leak[0] > 4.0 * 0.3


def test_the_walls_film_coefficient_is_told() -> None:
    low, high = left("fitted, both").film
    assert low <= 10.0 <= high < 1.3 * low
