"""What a gauge of the supply is used for: the data set, and as evidence of a drop of it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import rigs
from calibrations import calibrated, log_of, quiet, typed
from second_rigs import config_of, with_gauge
from second_world.draw import draw_rig
from second_world.faults import Fault
from second_world.records import record

from twin.calibration.calibrate import calibrate
from twin.calibration.commission import as_gauged, commission
from twin.config import Config
from twin.diagnosis.answer import diagnose
from twin.diagnosis.evidence import Evidence, collect
from twin.diagnosis.hypotheses import price
from twin.inference.priors import FARTHEST, by_gauge
from twin.model.courses import Cause, Course
from twin.model.dataset import DataSet
from twin.monitor.measured_supply import at_rest, supplied
from twin.signals import BAR, Samples

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
    without = calibrate(config, [blind(log_of("gripper"))], quiet)
    assert "supply" not in without.healthy.key_figures
    assert without.fitted.data.supply.pressure_bar == 5.0


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
