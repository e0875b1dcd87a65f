"""What a gauge of the supply is used for: the data set, and as evidence of a drop of it."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rigs
from calibrations import calibrated, log_of, quiet, typed
from second_rigs import config_of, with_gauge
from second_world.draw import draw_rig
from second_world.faults import Fault
from second_world.records import record

from twin.calibration.calibrate import calibrate, limited
from twin.calibration.commission import commission
from twin.calibration.page import calibration_summary
from twin.calibration.record_checks import as_gauged
from twin.calibration.report import as_json, in_words
from twin.calibration.save import record_of
from twin.config import Config
from twin.diagnosis.answer import diagnose
from twin.diagnosis.evidence import Evidence, collect
from twin.diagnosis.hypotheses import price
from twin.inference.priors import FARTHEST, by_gauge
from twin.model.courses import Cause, Course
from twin.model.dataset import DataSet
from twin.monitor.measured_supply import at_rest, supplied
from twin.signals import BAR, Command, Samples

SECOND = (80005, 80033, 80040)  # a gripper, a tank without air saving, a closed tank


def fed(samples: Samples, less: float) -> Samples:
    """The same with a gauge that reads ``less`` (bar)."""
    changed = samples.copy()
    changed["supply"] -= np.float32(less * BAR)
    return changed


def blind(samples: Samples) -> Samples:
    """The same without a gauge."""
    changed = samples.copy()
    changed["supply"] = np.nan
    return changed


@cache
def instance(name: str) -> Config:
    """The configuration with what a calibration found."""
    found = calibrated(name)
    monitor = typed(name).monitor.model_copy(update={"healthy": found.healthy})
    return replace(typed(name), data=found.fitted.data, monitor=monitor)


# --- the data set ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", rigs.NAMES)
def test_the_supply_at_rest_goes_into_the_data_set(name: str) -> None:
    data, samples = typed(name).data, log_of(name)
    assert supplied(data, samples) == data  # it is what was configured
    lower = supplied(data, fed(samples, 0.5))
    assert lower.supply.pressure_bar == 4.5
    assert lower.supply.optimum_bar == data.supply.optimum_bar  # that was configured
    assert supplied(data, blind(samples)) == data


def constant(samples: Samples, bar: float) -> Samples:
    """The same with a PLC that gives a constant in place of a gauge."""
    changed = samples.copy()
    changed["supply"] = np.float32(bar * BAR)
    return changed


def test_a_constant_is_no_gauge() -> None:
    samples = log_of("gripper")
    assert supplied(typed("gripper").data, constant(samples, 6.0)) == typed("gripper").data
    assert "supply" in limited(typed("gripper").data, samples)
    assert "supply" not in limited(typed("gripper").data, constant(samples, 5.0))


def test_a_gauge_behind_the_valve_is_remembered_with_the_nozzle_on_alone() -> None:
    data, behind = typed("gripper").data, log_of("gripper").copy()
    behind["supply"][behind["commands"] != Command.SUCTION] *= np.float32(0.001)
    assert supplied(data, behind) == data
    assert limited(data, behind)["supply"].mean == pytest.approx(4.8, abs=0.05)


def test_what_is_lost_before_the_nozzle_stays_below_the_supply() -> None:
    """Both to 0.05 bar: what no data set may have is not made of a reading that is a bit more."""
    data = DataSet.model_validate({"supply": {"pressure_bar": 5.0, "droop_bar": 1.0}})
    low = fed(log_of("gripper"), at_rest(log_of("gripper")) - 1.02)
    assert at_rest(low) == pytest.approx(1.02)
    assert supplied(data, low) == data


def test_an_optimum_that_nobody_configured_follows_the_gauge() -> None:
    data = DataSet.model_validate({"supply": {"pressure_bar": 5.0, "curvature": 2.0}})
    supply = supplied(data, fed(log_of("gripper"), 0.5)).supply
    assert (supply.pressure_bar, supply.optimum_bar, supply.curvature) == (4.5, 4.5, 2.0)


@pytest.mark.parametrize("less", [4.5, -6.0])
def test_a_gauge_that_no_ejector_is_run_at_is_not_taken(less: float) -> None:
    data = typed("gripper").data
    assert supplied(data, fed(log_of("gripper"), less)) == data


def test_a_commissioning_says_that_the_gauge_contradicts_the_configuration() -> None:
    data, samples = typed("gripper").data, log_of("gripper")
    assert as_gauged(data, samples)[1] == as_gauged(data, fed(samples, 0.15))[1] == []
    gauged, (remark,) = as_gauged(data, fed(samples, 0.5))
    assert remark.text == "the supply reads 4.5 bar; the configuration says 5"
    assert remark.line == "[data.supply] pressure_bar = 4.5"
    assert gauged.supply.pressure_bar == 4.5


@pytest.mark.parametrize("seed", SECOND)
def test_a_gauge_on_rigs_of_another_world_tells_their_supply(seed: int) -> None:
    logged = record(draw_rig(seed), seed, 4)
    truth = logged.truth.rig.supply.supply_gauge / BAR
    assert at_rest(with_gauge(logged)) == pytest.approx(truth, abs=0.15)
    gauged, _ = as_gauged(config_of(logged.truth.readable).data, with_gauge(logged))
    assert gauged.supply.pressure_bar == pytest.approx(truth, abs=0.2)


def test_a_calibration_remembers_what_the_gauge_read() -> None:
    found = calibrated("gripper").healthy.key_figures["supply"]
    assert found.mean == pytest.approx(4.8, abs=0.05)  # at the nozzle, while it is on
    config, samples = typed("gripper"), fed(log_of("gripper"), 0.5)
    lower = calibrate(config, [samples], quiet)
    assert lower.fitted.data.supply.pressure_bar == 4.5
    assert lower.healthy.key_figures["supply"].mean == pytest.approx(found.mean - 0.5, abs=0.01)
    assert [remark.line for remark in lower.remarks] == ["[data.supply] pressure_bar = 4.5"]
    without = calibrate(config, [blind(log_of("gripper"))], quiet)
    assert "supply" not in without.healthy.key_figures
    assert without.fitted.data.supply.pressure_bar == 5.0
    assert without.remarks == calibrated("gripper").remarks == ()


def test_a_calibration_says_what_the_gauge_corrected(tmp_path: Path) -> None:
    """On terminal, page and for programs."""
    _, (remark,) = as_gauged(typed("gripper").data, fed(log_of("gripper"), 0.5))
    found, unit = replace(calibrated("gripper"), remarks=(remark,)), typed("gripper")
    for line in (remark.text, remark.line):
        assert line in in_words(found)
        assert line not in in_words(calibrated("gripper"))
    assert "The supply reads 4.5 bar" in calibration_summary(found, unit.asset, log_of("gripper"))
    log = tmp_path / "log.mcap"
    log.write_bytes(b"a log")
    contradicts = as_json(found, unit.asset, record_of(found, unit, log))["contradicts"]
    assert contradicts == [{"what": remark.text, "line": remark.line}]


# --- a diagnosis ----------------------------------------------------------------------------------


def test_a_gauge_speaks_for_the_drop_that_it_reads_and_against_others() -> None:
    drops = np.array([0.0, 0.3, 0.6])
    nominal, lower = by_gauge(drops, np.zeros(3)), by_gauge(drops, np.full(3, 0.3))
    assert nominal == pytest.approx([0.0, 9.0, FARTHEST**2])
    assert lower == pytest.approx([0.0, -9.0, 0.0])
    assert by_gauge(drops, np.full(3, np.nan)).tolist() == [0.0, 0.0, 0.0]


def test_a_dead_gauge_says_nothing() -> None:
    assert by_gauge(np.array([0.0, 0.6, 3.0]), np.full(3, 4.8)).tolist() == [0.0, 0.0, 0.0]


@cache
def healthy() -> Evidence:
    return collect(instance("gripper"), [log_of("gripper", 51)])


def priced(evidence: Evidence, cause: Cause) -> float:
    """What the gauge adds to the price of a cause."""
    without = replace(evidence, samples=blind(evidence.samples))
    return price(evidence, (cause,)) - price(without, (cause,))


def test_it_counts_as_one_reading_however_long_the_log_is() -> None:
    drop, leak = (
        Cause("supply_pressure_drop", {"drop": 0.3}),
        Cause("leakage", {"sonic_flow": 1.0}),
    )
    assert priced(healthy(), drop) == pytest.approx(9.0, abs=1.0)
    assert priced(healthy(), leak) == 0.0
    lower = replace(healthy(), samples=fed(healthy().samples, 0.3))
    assert priced(lower, drop) == pytest.approx(-9.0, abs=1.0)


def test_a_constant_speaks_against_nothing() -> None:
    """As of a gauge that has got stuck, or of a PLC's program that is another by now."""
    stuck = replace(healthy(), samples=constant(healthy().samples, 4.8))
    assert priced(stuck, Cause("supply_pressure_drop", {"drop": 0.6})) == 0.0


def test_a_drop_within_the_log_is_compared_cycle_by_cycle() -> None:
    evidence = healthy()
    half = int(evidence.starts[len(evidence.starts) // 2])
    samples = evidence.samples.copy()
    samples["supply"][half:] -= np.float32(0.4 * BAR)
    fell = replace(evidence, samples=samples)
    step = Cause("supply_pressure_drop", {"drop": 0.4}, Course.STEP, float(evidence.seconds[half]))
    steady = Cause("supply_pressure_drop", {"drop": 0.4})
    assert priced(fell, step) < -6.0 < 0.0 <= round(priced(fell, steady))
    assert priced(evidence, step) > 6.0


def test_without_a_gauge_at_the_calibration_there_is_nothing_to_compare_with() -> None:
    evidence = healthy()
    figures = {name: f for name, f in evidence.healthy.key_figures.items() if name != "supply"}
    forgot = evidence.healthy.model_copy(update={"key_figures": figures})
    assert (
        priced(replace(evidence, healthy=forgot), Cause("supply_pressure_drop", {"drop": 0.6}))
        == 0.0
    )


def named(config: Config, samples: Samples) -> list[tuple[str, list[str]]]:
    """The causes of a log, each with what the log cannot tell it from."""
    causes = diagnose(config, [samples], "log", quiet).json["causes"]
    return [(cause["effect"], cause["not_separable_from"]) for cause in causes]


@pytest.mark.slow
@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_supply_drop_is_told_from_its_look_alikes_by_a_gauge(name: str) -> None:
    samples = log_of(name, 41, ("supply_pressure_drop=0.6",))
    assert named(instance(name), samples) == [("supply_pressure_drop", [])]
    ((effect, alike),) = named(instance(name), blind(samples))
    assert (effect, alike) == ("supply_pressure_drop", ["weak_blow_off"])


@pytest.mark.slow
@pytest.mark.timeout(600)  # a whole commissioning, on a computer that does other things beside
def test_beside_a_nominal_gauge_a_weak_ejector_is_no_supply_drop() -> None:
    rig = draw_rig(SECOND[0])
    healthy_log = record(rig, SECOND[0], 12)
    config = config_of(healthy_log.truth.readable)
    found = commission(config, [with_gauge(healthy_log)], quiet).calibration
    monitor = config.monitor.model_copy(update={"healthy": found.healthy})
    unit = replace(config, data=found.fitted.data, monitor=monitor)
    weak = Fault("end_vacuum_loss", {"end_pressure_rise": 100.0})
    samples = with_gauge(record(rig, 1_000_000 + SECOND[0], 12, [weak]))
    assert named(unit, samples) == [("end_vacuum_loss", [])]
    assert named(unit, blind(samples)) == [("end_vacuum_loss", ["supply_pressure_drop"])]
