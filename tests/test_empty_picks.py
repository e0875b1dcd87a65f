"""Suctions that met no part: in commissioning, in a diagnosis and live."""

import numpy as np
import pytest
import rigs
from calibrations import log_of, typed

from twin.calibration.empty_picks import without_empty_picks
from twin.calibration.readings import Stretch, stretches
from twin.calibration.record_checks import picked
from twin.diagnosis.evidence import read_cycles
from twin.events import Event, Kind
from twin.signals import Command, Samples

NAME = "gripper"


def suctions_of(samples: Samples) -> list[Stretch]:
    return [
        stretch for stretch in stretches(samples["commands"]) if stretch.command == Command.SUCTION
    ]


def with_empty_picks(name: str, numbers: tuple[int, ...]) -> Samples:
    """A record in some of whose suctions the vacuum is a tenth of what it was."""
    return emptied(log_of(name), numbers)


def emptied(record: Samples, numbers: tuple[int, ...]) -> Samples:
    """The same of any record."""
    samples = record.copy()
    suctions = suctions_of(samples)
    ends = [*(suction.first for suction in suctions[1:]), len(samples)]
    for number in numbers:
        part = slice(suctions[number].first, ends[number])
        pressure = samples["pressure"][part]
        samples["pressure"][part] = pressure[0] + 0.1 * (pressure - pressure[0])
    return samples


@pytest.mark.parametrize("numbers", [(2,), (0, 3), (1, 2)])
def test_cycles_without_a_part_are_left_out_and_time_runs_on(numbers: tuple[int, ...]) -> None:
    samples = with_empty_picks(NAME, numbers)
    suctions = suctions_of(samples)
    with_part, empty = without_empty_picks(typed(NAME).data, samples)
    assert empty == len(numbers)
    rows = sum(suctions[number + 1].first - suctions[number].first for number in numbers)
    assert len(with_part) == len(samples) - rows
    assert np.ptp(np.diff(with_part["time_ns"])) == np.ptp(np.diff(samples["time_ns"]))
    assert (np.diff(with_part["sequence"]) == 1).all()
    assert len(suctions_of(with_part)) == len(suctions) - len(numbers)
    assert without_empty_picks(typed(NAME).data, with_part)[1] == 0


def test_the_last_cycle_may_be_one() -> None:
    samples = with_empty_picks(NAME, (len(suctions_of(log_of(NAME))) - 1,))
    with_part, empty = without_empty_picks(typed(NAME).data, samples)
    assert empty == 1
    assert (with_part == samples[: len(with_part)]).all()


def test_a_short_suction_with_a_part_is_none() -> None:
    """Its command ends at a tenth of the time, while the pressure still falls."""
    samples = log_of(NAME).copy()
    third = suctions_of(samples)[2]
    short = third.first + (third.last - third.first) // 10
    samples["commands"][short : third.last] = 0
    samples["pressure"][short : third.last] = samples["pressure"][third.first]
    assert without_empty_picks(typed(NAME).data, samples)[1] == 0


def test_a_healthy_record_and_a_vessel_stay_as_they_are() -> None:
    samples = log_of(NAME)
    assert without_empty_picks(typed(NAME).data, samples)[0] is samples
    vessel = with_empty_picks("test_rig", (2,))
    assert without_empty_picks(typed("test_rig").data, vessel)[0] is vessel


@pytest.mark.parametrize(("numbers", "said"), [((2,), "1 suction met"), ((1, 3), "2 suctions met")])
def test_it_is_said_how_many_were_left_out(numbers: tuple[int, ...], said: str) -> None:
    _, (remark,) = picked(typed(NAME).data, with_empty_picks(NAME, numbers))
    assert remark.text.startswith(said)


# In a log that is diagnosed.


@pytest.mark.parametrize("numbers", [(4,), (3, 6), (8,)])
def test_cycles_without_a_part_are_not_judged(numbers: tuple[int, ...]) -> None:
    usual = read_cycles(typed(NAME), [log_of(NAME)])
    assert usual.without_part == []
    log = read_cycles(typed(NAME), [with_empty_picks(NAME, numbers)])
    begins = [suction.first for suction in suctions_of(log_of(NAME))]
    first = begins.index(int(usual.rows(0)[0]["sequence"][0] - log_of(NAME)["sequence"][0]))
    assert log.without_part == [number - first for number in numbers]
    assert log.judged == [cycle for cycle in usual.judged if cycle not in log.without_part]


@pytest.mark.parametrize("numbers", [(2, 4, 5, 7), (7, 8)])
def test_little_vacuum_in_many_cycles_or_until_the_end_is_a_fault(numbers: tuple[int, ...]) -> None:
    """As when a hose has come off."""
    log = read_cycles(typed(NAME), [with_empty_picks(NAME, numbers)])
    assert log.without_part == []
    assert log.judged == read_cycles(typed(NAME), [log_of(NAME)]).judged


def test_a_vessel_meets_no_part_in_any_cycle() -> None:
    log = read_cycles(typed("test_rig"), [with_empty_picks("test_rig", (3,))])
    assert log.without_part == []


@pytest.mark.parametrize("numbers", [(2, 4, 5, 7), (-2, -1)])
def test_little_vacuum_in_many_suctions_or_until_the_end_is_told_otherwise(
    numbers: tuple[int, ...],
) -> None:
    """As a unit of measurement that changes within the record."""
    suctions = len(suctions_of(log_of(NAME)))
    samples = with_empty_picks(NAME, tuple(number % suctions for number in numbers))
    assert without_empty_picks(typed(NAME).data, samples)[0] is samples


# Live.


@pytest.mark.parametrize(
    ("numbers", "is_fault"), [((), False), ((12,), False), ((9, 12), False), ((12, 13), True)]
)
def test_a_cycle_without_a_part_raises_no_alarm_unless_another_follows(
    numbers: tuple[int, ...], is_fault: bool
) -> None:
    record, _ = rigs.recorded(NAME, 40.0, (), 11)
    twin, monitor, told = rigs.twin(NAME), rigs.isolating(NAME), list[Event]()
    for block in rigs.cut(emptied(record, numbers), 1000):
        told += monitor.update(*twin.advance(block))
    told += monitor.update(*twin.flush()) + monitor.close()
    assert any(event.kind is Kind.DEVIATION for event in told) is is_fault
