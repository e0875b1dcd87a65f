"""What is reported, checked against the pressure: wrong wires, wrong scales, sticking valves."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import rigs
from calibrations import typed

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import with_truth
from twin.alarms.watch import evidence, values
from twin.calibration.calibrate import calibrate
from twin.calibration.commission import commission, guessed
from twin.calibration.readings import read
from twin.calibration.report import commissioned_as_json, commissioned_in_words
from twin.cli.setup import pair_of
from twin.config import Asset
from twin.diagnosis.answer import diagnose
from twin.diagnosis.report import in_words
from twin.errors import ConfigError
from twin.events import Event, Kind
from twin.live import run
from twin.monitor.cycles import Cycle, whole
from twin.monitor.healthy import Scatter
from twin.monitor.signal_checks import ReportWatch, check, standing
from twin.quality import Quality
from twin.signals import BAR, MBAR, Command, Phase, Reported, Samples

TAGS = {"nozzle", "part_present", "pressure_2", "flow", "supply"}
OPENED = TAGS | {"ambient"}
Change = Callable[[Samples], None]


@cache
def simulated(
    name: str, late_ms: float = 0.0, h2_mbar: float = 550.0, faults: tuple[str, ...] = ()
) -> Samples:
    tables: dict[str, Any] = rigs.config(name).document.section(PlcSettings, "plc").model_dump()
    tables["reports"] = {"bits": True, "bits_delay_ms": late_ms, "values": True}
    tables["program"]["start_ms"] = 500.0
    tables["control"]["h2_mbar"] = h2_mbar
    hidden = [parse_fault(fault) for fault in faults]
    parts = with_truth(PlcSettings.model_validate(tables), 30.0, hidden, seed=5)
    samples: Samples = np.concatenate([block for block, _ in parts])
    samples.flags.writeable = False
    return samples


def changed(samples: Samples, change: Change) -> Samples:
    samples = samples.copy()
    change(samples)
    return samples


def cycles(name: str, samples: Samples) -> Sequence[Cycle]:
    found = whole(rigs.twin(name).over(rigs.cut(samples, 5000)))
    assert len(found) > 5
    return found


def told(name: str, samples: Samples, *, gauged: bool = True) -> dict[str, str]:
    """What each signal that contradicts says; with ``gauged`` the unit's supply was measured."""
    detector, theta = rigs.detector(name), rigs.theta(name)
    return {
        contradiction.signal: contradiction.what
        for contradiction in standing(cycles(name, samples), theta, detector, gauged=gauged)
    }


@pytest.mark.parametrize(("name", "tags"), [("test_rig", TAGS), ("gripper", OPENED)])
@pytest.mark.parametrize("late_ms", [0.0, 20.0])
def test_what_is_right_agrees_in_every_cycle(name: str, tags: set[str], late_ms: float) -> None:
    for cycle in cycles(name, simulated(name, late_ms)):
        outcomes = check(cycle, rigs.theta(name), rigs.detector(name), gauged=True)
        assert outcomes == dict.fromkeys(tags)


@pytest.mark.parametrize("name", ["test_rig", "gripper"])
@pytest.mark.parametrize(
    "fault",
    [
        "leakage=4.0",
        "suction_loss=30",
        "response_delay=30",
        "ambient_pressure=-20",
        "supply_pressure_drop=0.7",
        "supply_pressure_drop=2.5",
    ],
)
def test_a_fault_of_the_ejector_is_none_of_its_signals(name: str, fault: str) -> None:
    assert told(name, simulated(name, faults=(fault,))) == {}


def test_where_nothing_is_reported_nothing_is_checked() -> None:
    samples = rigs.recorded("gripper", 20.0)[0].copy()
    samples["supply"] = np.nan
    cycle = cycles("gripper", samples)[1]
    assert check(cycle, rigs.theta("gripper"), rigs.detector("gripper")) == {}


def never_saves(samples: Samples) -> None:
    suction = samples["commands"] == Command.SUCTION
    samples["reported"][suction] |= np.uint8(Reported.NOZZLE)


def inverted(samples: Samples) -> None:
    samples["reported"] ^= np.uint8(Reported.NOZZLE)


def sticks(samples: Samples) -> None:
    """The vacuum goes on rising behind H1: reported off from half of it on."""
    suction = samples["commands"] == Command.SUCTION
    early = suction & (samples["pressure"] > 500 * MBAR)
    samples["reported"][suction] &= ~np.uint8(Reported.NOZZLE)
    samples["reported"][early] |= np.uint8(Reported.NOZZLE)


def no_part(samples: Samples) -> None:
    samples["reported"] &= ~np.uint8(Reported.PART)


def barometer(samples: Samples) -> None:
    samples["ambient"] -= np.float32(20 * MBAR)


def second(samples: Samples) -> None:
    samples["pressure_2"] *= np.float32(1.05)


def reversed_flow(samples: Samples) -> None:
    samples["flow"] *= np.float32(-1.0)


def flow_in_another_unit(samples: Samples) -> None:
    samples["flow"] *= np.float32(60.0)


def gauge_lower(samples: Samples) -> None:
    samples["supply"] -= np.float32(1.0 * BAR)


def gauge_absolute(samples: Samples) -> None:
    samples["supply"] += np.float32(1013.0 * MBAR)


def gauge_in_another_unit(samples: Samples) -> None:
    samples["supply"] *= np.float32(0.1)


@pytest.mark.parametrize(
    ("name", "change", "signal", "words"),
    [
        ("test_rig", never_saves, "nozzle", "goes off at 75"),
        ("gripper", never_saves, "nozzle", "and the ejector reports it on"),
        ("test_rig", inverted, "nozzle", "on while nothing is commanded"),
        ("test_rig", sticks, "nozzle", "the vacuum goes on rising by"),
        ("test_rig", no_part, "part_present", "reports no part, though"),
        ("gripper", barometer, "ambient", "the barometer reads 20 mbar less"),
        ("gripper", second, "pressure_2", "reads 51 mbar more"),
        ("test_rig", reversed_flow, "flow", "by the flow -0.4"),
        ("gripper", flow_in_another_unit, "flow", "the pressure shows 0.1"),
        ("test_rig", gauge_lower, "supply", "the supply reads 4.0 bar; the data set has 5.0"),
        ("gripper", gauge_absolute, "supply", "the supply reads 6.0 bar; the data set has 5.0"),
        ("gripper", gauge_in_another_unit, "supply", "reads 0.5 bar, and the ejector evacuates"),
    ],
)
def test_a_signal_that_is_wrong_is_told_of_alone(
    name: str, change: Change, signal: str, words: str
) -> None:
    found = told(name, changed(simulated(name), change))
    assert set(found) - {"part_present"} == {signal} - {"part_present"}
    assert words in found[signal]


@pytest.mark.parametrize("name", ["test_rig", "gripper"])
def test_a_gauge_is_compared_with_a_supply_that_was_measured_alone(name: str) -> None:
    """A data set without a gauge has what somebody wrote down: a right gauge may read another."""
    assert told(name, changed(simulated(name), gauge_lower), gauged=False) == {}
    scaled = changed(simulated(name), gauge_in_another_unit)
    assert set(told(name, scaled, gauged=False)) == {"supply"}


@pytest.mark.parametrize("bar", [0.0, 5.0, 6.0])
def test_a_constant_is_no_gauge(bar: float) -> None:
    def constant(samples: Samples) -> None:
        samples["supply"] = np.float32(bar * BAR)

    for cycle in cycles("gripper", changed(simulated("gripper"), constant)):
        outcomes = check(cycle, rigs.theta("gripper"), rigs.detector("gripper"), gauged=True)
        assert set(outcomes) == OPENED - {"supply"}


def test_a_gauge_between_valve_and_nozzle_reads_nothing_at_rest() -> None:
    for cycle in cycles("gripper", simulated("gripper")):
        samples = cycle.samples.copy()
        samples["supply"][cycle.ticks["phase"] != Phase.SUCTION] *= np.float32(0.001)
        behind = replace(cycle, samples=samples)
        outcomes = check(behind, rigs.theta("gripper"), rigs.detector("gripper"), gauged=True)
        assert outcomes == dict.fromkeys(OPENED)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_cycle_without_a_usable_pressure_contradicts_no_gauge() -> None:
    cycle = cycles("gripper", changed(simulated("gripper"), gauge_in_another_unit))[1]
    samples = cycle.samples.copy()
    samples["quality"] |= np.uint8(Quality.OVERFLOW)
    samples["reported"] = 0
    lost = replace(cycle, samples=samples)
    outcomes = check(lost, rigs.theta("gripper"), rigs.detector("gripper"), gauged=True)
    assert outcomes.get("supply") is None


def test_the_loop_knows_whether_the_units_supply_was_measured() -> None:
    config = rigs.config("gripper")
    scatter = {"supply": Scatter(mean=4.8, sigma=0.1)}
    healthy = config.monitor.healthy.model_copy(update={"key_figures": scatter})
    monitor = config.monitor.model_copy(update={"healthy": healthy})
    for settings, gauged in ((config, False), (replace(config, monitor=monitor), True)):
        _, watching = pair_of(settings)
        assert watching.reports
        assert watching.reports.gauged is gauged


@pytest.mark.parametrize("name", ["test_rig", "gripper"])
def test_another_h2_than_configured_is_told_with_its_value(name: str) -> None:
    found = told(name, simulated(name, h2_mbar=450.0))
    assert set(found) == {"part_present"}
    assert re.search(r"part present comes at (449|45\d) mbar", found["part_present"])
    assert told(name, simulated(name, h2_mbar=545.0)) == {}


def test_one_cycle_alone_raises_nothing_and_agreement_is_told_too() -> None:
    samples = simulated("gripper").copy()
    parts = list(whole(rigs.twin("gripper").over([samples])))
    wrong = [replace(piece, samples=changed(piece.samples, barometer)) for piece in parts]
    watch = ReportWatch(rigs.theta("gripper"), rigs.detector("gripper"))
    stream = [parts[0], wrong[1], parts[2], wrong[3], wrong[4], wrong[5], *parts[6:9]]
    events = [[event.kind for event in watch.take(cycle)] for cycle in stream]
    against, agrees = Kind.SIGNAL_CONTRADICTS, Kind.SIGNAL_AGREES
    assert events == [[], [], [], [], [against], [], [], [agrees], []]


def test_the_loop_says_it_and_an_alarm_stands_until_all_agree() -> None:
    samples = changed(simulated("gripper"), barometer)
    monitor, beside = rigs.monitor("gripper"), rigs.twin("gripper")
    monitor.reports = ReportWatch(beside.theta, beside.detector)
    seen = rigs.Collect()
    run(rigs.cut(samples, 500), beside, monitor, [seen])
    (event,) = seen.of(Kind.SIGNAL_CONTRADICTS)
    assert event.data["signal"] == "ambient"
    assert event.data["action"] in event.text
    assert values(event) == {"signal_contradicts": 1.0}
    assert evidence(event)["signal_contradicts"]["words"] == event.text
    still = Event(0, Kind.SIGNAL_AGREES, "", {"standing": ["flow"]})
    assert values(still) == {"signal_contradicts": 1.0}
    assert values(replace(still, data={"standing": []})) == {"signal_contradicts": 0.0}


# --- while a unit is commissioned -----------------------------------------------------------------


def quiet(_: str) -> None:
    pass


def test_the_part_that_is_reported_tells_h2() -> None:
    data = typed("gripper").data
    guess, remarks = guessed(data, read(simulated("gripper", h2_mbar=450.0)))
    (remark,) = remarks
    assert remark.line.startswith("[data.ejector] h2_mbar = 45")
    assert guess.ejector.h2_mbar == pytest.approx(450.0, abs=10.0)
    assert guessed(data, read(simulated("gripper")))[1] == []


def test_air_saving_is_known_of_a_tank_that_holds() -> None:
    """The pressure never turns: without a report nothing tells that the nozzle went off."""
    samples = simulated("test_rig").copy()
    suction = samples["commands"] == Command.SUCTION
    edges = np.flatnonzero(np.diff(suction)) + 1
    for part, sucks in zip(
        np.split(samples["pressure"], edges), np.split(suction, edges), strict=True
    ):
        if sucks[0]:
            part[:] = np.minimum.accumulate(part)
    samples["reported"] &= np.uint8(Reported.NOZZLE_KNOWN | Reported.NOZZLE)
    assert read(samples).saves_air
    silent = samples.copy()
    silent["reported"] = 0
    assert not read(silent).saves_air


@pytest.mark.slow
@pytest.mark.timeout(400)  # a whole commissioning, on a computer that does other things beside
def test_a_commissioning_goes_by_the_pressure_where_the_report_is_wrong() -> None:
    config = typed("gripper")
    samples = changed(simulated("gripper", h2_mbar=450.0), never_saves)[:15_000]
    samples["pressure_2"] = 0.0  # which would be followed as well
    found = commission(config, [samples], quiet)
    assert [contradiction.signal for contradiction in found.contradictions] == ["nozzle"]
    assert found.readings.saves_air
    words = commissioned_in_words(found)
    assert found.contradictions[0].what in words
    assert "h2_mbar = 45" in words
    asset = Asset(type="a", id="b")
    assert commissioned_as_json(found, asset, None)["signals"][0]["signal"] == "nozzle"


def test_a_calibration_refuses_what_contradicts() -> None:
    samples = changed(simulated("test_rig"), never_saves)
    with pytest.raises(ConfigError, match="goes off at 75") as error:
        calibrate(typed("test_rig"), [samples], quiet)
    assert "leave the tag out" in str(error.value.hint)


@pytest.mark.slow
def test_a_diagnosis_tells_it_beside_its_answer() -> None:
    samples = changed(simulated("test_rig"), reversed_flow)
    gauge_lower(samples)  # nothing to compare with: the unit was calibrated without
    diagnosis = diagnose(rigs.config("test_rig"), [samples], "log", quiet)
    (one,) = diagnosis.json["signals"]
    assert one["signal"] == "flow"
    assert f"flow           {one['what']}" in in_words(diagnosis)
    assert diagnosis.json["verdict"] == "consistent"
