"""The nozzle as the ejector reports it: it says that it switched, the pressure says when."""

from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
import rigs

from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import with_truth
from twin.monitor.offline_switching import noise_of, switchings
from twin.monitor.switching_detector import PhaseFinder, commanded
from twin.signals import Command, Phase, Reported, Samples

NEAR = 60  # rows within which a switching found is that of the valve
SMALL = {  # switches every few tens of milliseconds: more often than the finder can look
    "rig": {"vessel_ml": 40.0, "opening_sl_min": 200.0},
    "control": {"h1_hysteresis_mbar": 40.0},
}
Rows = npt.NDArray[np.int64]


@cache
def simulated(name: str, late_ms: float, *, small: bool) -> tuple[Samples, Rows]:
    """Samples with reports, and the rows at which the nozzle's valve moved while suction held."""
    tables = rigs.config(name).document.section(PlcSettings, "plc").model_dump()
    tables["reports"] = {"bits": True, "bits_delay_ms": late_ms}
    tables["program"]["start_ms"] = 500.0
    for table, values in SMALL.items() if small else ():
        tables[table] |= values
    parts = with_truth(PlcSettings.model_validate(tables), 15.0, seed=3)
    samples, truth = (np.concatenate(column) for column in zip(*parts, strict=True))
    moved = np.flatnonzero(np.diff(truth["nozzle"].astype(int))) + 1
    suction = np.pad(samples["commands"] == Command.SUCTION, NEAR)
    within = suction[moved] & suction[moved + NEAR] & suction[moved + 2 * NEAR]
    within &= moved < len(samples) - 5 * NEAR  # the finder needs rows behind them
    samples.flags.writeable = False
    return samples, moved[within]


def silent(samples: Samples) -> Samples:
    samples = samples.copy()
    samples["reported"] = 0
    return samples


def phases(samples: Samples, size: int = 500) -> npt.NDArray[np.uint8]:
    finder = PhaseFinder(rigs.detector("gripper"))
    parts = [finder.push(block)[1] for block in rigs.cut(samples, size)]
    return np.concatenate([*parts, finder.flush()[1]])


def switched(phase: npt.NDArray[np.uint8]) -> Rows:
    inside = np.isin(phase, (Phase.SUCTION, Phase.HOLD))
    return np.flatnonzero((np.diff(phase) != 0) & inside[1:] & inside[:-1]) + 1


def off_by(found: Rows, true: Rows) -> Rows:
    """Rows from each true switching to the one found nearest."""
    apart = found[None, :] - true[:, None]
    return apart[np.arange(len(true)), np.abs(apart).argmin(axis=1)]


@pytest.mark.parametrize("late_ms", [0.0, 10.0])
def test_none_is_missed_where_the_pressure_alone_is_too_quick(late_ms: float) -> None:
    samples, moved = simulated("gripper", late_ms, small=True)
    assert len(moved) > 30
    found = switched(phases(samples))
    assert np.abs(off_by(found, moved)).max() < 20
    unaided = switched(phases(silent(samples)))
    assert np.mean(np.abs(off_by(unaided, moved)) < 20) < 0.5


def test_where_the_pressure_shows_them_nothing_changes() -> None:
    samples, moved = simulated("gripper", 0.0, small=False)
    assert len(moved) > 3
    assert (phases(samples) == phases(silent(samples))).all()
    late, _ = simulated("gripper", 20.0, small=False)
    assert (phases(late) == phases(silent(samples))).all()


@pytest.mark.parametrize("size", [1, 7, 64, 5000])
def test_it_is_the_same_however_the_stream_is_cut(size: int) -> None:
    samples, _ = simulated("gripper", 10.0, small=True)
    assert (phases(samples[:6000], size) == phases(samples[:6000])).all()


def test_a_report_just_before_suction_ends_counts() -> None:
    """Its breakpoint has no rows after it; the valve acts a response later, if suction lasts."""
    samples, moved = simulated("gripper", 0.0, small=False)
    samples, end = samples.copy(), int(moved[0]) - 100
    closing, _ = rigs.detector("gripper").acts
    samples["commands"][end : moved[0] + 400] = 0
    for reported, acts in ((end - closing - 8, True), (end - closing + 2, False)):
        samples["reported"][reported:end] &= ~np.uint8(Reported.NOZZLE)
        phase = phases(samples)
        assert (phase[end - 1] == Phase.HOLD) == acts
        assert not (phase[end - 40 : reported] == Phase.HOLD).any()
        samples["reported"][reported:end] |= np.uint8(Reported.NOZZLE)


def test_a_nozzle_that_is_reported_on_stays_on() -> None:
    samples, moved = simulated("gripper", 0.0, small=False)
    samples = samples.copy()
    samples["reported"] |= np.uint8(Reported.NOZZLE)
    assert len(moved)
    assert not len(switched(phases(samples)))
    assert not found_in_record(samples)


def found_in_record(samples: Samples) -> list[int]:
    rows, told, _ = commanded(samples, (0.0, 0.0))
    return [switching.row for switching in switchings(rows, told, noise_of(rows, told))]


@pytest.mark.parametrize("late_ms", [0.0, 15.0])
def test_a_record_has_the_switchings_that_are_reported(late_ms: float) -> None:
    samples, moved = simulated("gripper", late_ms, small=True)
    found = np.array(found_in_record(samples))
    assert np.abs(off_by(found, moved)).max() < 20


def test_one_that_the_pressure_does_not_show_is_as_late_as_the_others() -> None:
    samples, moved = simulated("test_rig", 0.0, small=False)
    before = np.array(found_in_record(samples))
    usual = np.median(off_by(before, moved))
    samples = samples.copy()
    said = slice(moved[0] - 400, moved[0] - 200)  # off, while the pressure falls on
    samples["reported"][said] &= ~np.uint8(Reported.NOZZLE)
    after = np.array(found_in_record(samples))
    assert len(after) == len(before) + 2
    acts = 9  # ms, of the suction valve as it closes
    assert abs(after[0] - said.start - acts - usual) < 15


def test_a_report_that_is_mostly_missing_is_not_used() -> None:
    samples, moved = simulated("gripper", 0.0, small=False)
    samples = samples.copy()
    samples["reported"][::2] = 0
    samples["reported"][1::2] |= np.uint8(Reported.NOZZLE)
    assert len(found_in_record(samples)) >= len(moved)
