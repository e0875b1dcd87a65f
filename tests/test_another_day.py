"""What another day does to a healthy rig is weather, and what cannot act is no cause."""

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import rigs

from twin.config import Config
from twin.diagnosis.answer import diagnose
from twin.diagnosis.evidence import HEALTHY, Evidence, collect
from twin.diagnosis.experiments import MOSTLY, beside_weather
from twin.diagnosis.hypotheses import often, price
from twin.diagnosis.linear_screening import columns, linear_gains, signatures
from twin.diagnosis.residual_covariance import covariance
from twin.model import theta as c
from twin.model.courses import Cause, Course
from twin.model.effects import EFFECTS
from twin.model.theta import Theta
from twin.monitor.another_day import KELVINS_AN_HOUR, MOST_KELVINS, Day, unsure
from twin.monitor.detector_window import expected_detector, select_window
from twin.monitor.switching_detector import PhaseFinder
from twin.settings import Document
from twin.signals import MBAR, Phase, Samples

NOBODY: frozenset[str] = frozenset()
BOTH = frozenset({"ambient", "temperature"})


def moved(calibrated: Theta, here: Theta, ambient: float, told: frozenset[str]) -> list[list[str]]:
    """Names of the coefficients that each way moves."""
    names = list(c.COEFFICIENTS)
    ways = unsure(calibrated, here, ambient, told)
    return [[names[i] for i in np.flatnonzero(up != here)] for up, _ in ways]


def test_on_the_day_of_the_calibration_only_what_nobody_measures_is_unsure() -> None:
    theta = rigs.theta("gripper")
    ambient = float(theta[c.AMBIENT])
    assert moved(theta, theta, ambient, NOBODY) == [["TEMPERATURE"]]
    assert moved(theta, theta, ambient, BOTH) == [["AMBIENT"], ["SENSOR_OFFSET"]]


def test_what_is_unsure_grows_in_proportion_to_how_other_the_day_is() -> None:
    theta = rigs.theta("gripper")

    def sizes(mbar: float, kelvin: float) -> list[float]:
        here = theta.copy()
        here[c.TEMPERATURE] += kelvin
        ambient = float(theta[c.AMBIENT]) + mbar * MBAR
        ways = list(unsure(theta, here, ambient, BOTH))[2:]
        changed = [(up[up != here], here[up != here]) for up, _ in ways]
        return [float(np.abs(after / before - 1.0).max()) for after, before in changed]

    assert np.divide(sizes(-20.0, 0.0), sizes(-10.0, 0.0)) == pytest.approx(2.0, rel=0.05)
    assert np.divide(sizes(0.0, 20.0), sizes(0.0, 10.0)) == pytest.approx(2.0, rel=0.05)
    end = sizes(-10.0, 0.0)[0] * float(theta[c.END_RATIO] * theta[c.AMBIENT])
    assert end == pytest.approx((1.0 - float(theta[c.END_RATIO])) * 10.0 * MBAR, rel=0.1)


# --- weather or sensor ----------------------------------------------------------------------------


@cache
def reads_lower() -> Samples:
    """An opened gripper that reads 10 mbar less all through, idle and hold."""
    return rigs.recorded("gripper", 40.0, ("sensor_offset=-10",), seed=7)[0]


def causes(samples: Samples) -> list[dict[str, Any]]:
    found = diagnose(rigs.config("gripper"), [samples], "log", lambda _: None)
    return list(found.json["causes"])


@pytest.mark.slow
def test_all_readings_lower_is_weather_or_the_sensor_and_weather_is_likelier() -> None:
    (cause,) = causes(reads_lower())
    assert cause["effect"] == "ambient_pressure"
    assert cause["parameters"]["shift"]["value"] == pytest.approx(-10.0, abs=2.0)
    assert cause["not_separable_from"] == ["sensor_offset"]


@pytest.mark.slow
def test_beside_a_barometer_it_is_the_sensor() -> None:
    samples = reads_lower().copy()
    samples["ambient"] = rigs.theta("gripper")[c.AMBIENT]
    (cause,) = causes(samples)
    assert cause["effect"] == "sensor_offset"
    assert "ambient_pressure" not in cause["not_separable_from"]


def test_weather_that_somebody_measures_is_no_cheap_cause() -> None:
    evidence = collected()
    followed = replace(evidence, told=BOTH)
    weather = (Cause("ambient_pressure", {"shift": -10.0}),)
    leak = (Cause("leakage", {"sonic_flow": 1.0}),)
    assert price(evidence, weather) < price(evidence, leak) == price(followed, leak)
    effect = EFFECTS["ambient_pressure"]
    unlikely = (10.0 / effect.parameters[0].typical) ** 2 + 2.0 * math.log(len(effect.laws()))
    assert price(followed, weather) == pytest.approx(price(followed, leak) + unlikely)
    assert often(evidence, Cause("sensor_offset", {"offset": 5.0})) < 1.0


def test_weather_seldom_changes_while_a_log_is_recorded() -> None:
    """Twenty millibars within a minute are more likely a sensor that drifts."""
    samples, _ = rigs.recorded("gripper", 12.0)
    evidence = collect(rigs.config("gripper"), [samples])
    weather = Cause("ambient_pressure", {"shift": -8.0})
    assert often(evidence, weather) > 1.0
    for course in (Course.STEP, Course.RAMP, Course.INTERMITTENT):
        assert often(evidence, replace(weather, course=course)) == 1.0
    leak = Cause("leakage", {"sonic_flow": 1.0})
    assert often(evidence, replace(leak, course=Course.STEP)) == often(evidence, leak)


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["gripper", "test_rig"])
def test_weather_moves_h1_where_the_ejector_s_own_sensor_counts_from_zero(rig: str) -> None:
    """What the rig shows then, its levels in vacuum moved as the weather did, is one cause."""
    moved = ("threshold_drift.h1_shift=-25", "threshold_drift.h2_shift=-25")
    samples, _ = rigs.recorded(rig, 24.0, ("ambient_pressure=-25", *moved), seed=7)
    diagnosis = diagnose(rigs.config(rig), [samples], "log", lambda _: None)
    (cause,) = diagnosis.json["causes"]
    assert cause["effect"] == "ambient_pressure"
    shift = cause["parameters"]["shift"]
    assert shift["low95"] < -25.0 < shift["high95"]


def test_what_another_weather_leaves_open_counts_wholly_in_mbar() -> None:
    """It grows from the first mbar on, however small beside the scatter; temperature adds to it."""
    evidence = collected()

    def open_squared(shift: float) -> float:
        about = (Cause("ambient_pressure", {"shift": shift}),)
        return covariance(evidence, about).of(evidence.judged).unmeasured ** 2

    same_day = open_squared(0.0)
    small, large = open_squared(2.0) - same_day, open_squared(8.0) - same_day
    assert large / small == pytest.approx(16.0, rel=0.3)


# --- gauge sensors --------------------------------------------------------------------------------


@cache
def collected() -> Evidence:
    return collect(rigs.config("gripper"), [rigs.recorded("gripper", 12.0)[0]])


def test_a_gauge_sensor_reads_ambient_as_it_was_assumed() -> None:
    lower = (Cause("ambient_pressure", {"shift": -20.0}),)

    def change_in_idle(*, is_gauge: bool) -> float:
        config = rigs.config("gripper").with_sensor(is_gauge=is_gauge)
        evidence = collect(config, [rigs.recorded("gripper", 12.0)[0]])
        apart = evidence.expected(lower) - evidence.expected(HEALTHY)
        return float(np.median(apart[evidence.ticks["phase"] == Phase.IDLE])) / MBAR

    assert change_in_idle(is_gauge=False) == pytest.approx(-20.0, abs=1.0)
    assert change_in_idle(is_gauge=True) == pytest.approx(0.0, abs=1.0)


def test_a_log_that_weather_alone_may_explain_asks_for_a_barometer() -> None:
    """A fault that looks like 12 mbar less weather could be there, though nothing is named."""
    samples = rigs.recorded("gripper", 30.0, ("ambient_pressure=-12",), seed=9)[0].copy()
    samples["pressure"] += 12.0 * MBAR  # a gauge sensor counts from the ambient pressure of then
    evidence = collect(rigs.config("gripper").with_sensor(is_gauge=True), [samples])
    sentence = beside_weather(evidence, covariance(evidence))
    assert sentence is not None
    assert "record ambient pressure as well: " in sentence
    assert beside_weather(evidence, covariance(evidence), share=MOSTLY) == sentence
    assert beside_weather(evidence, covariance(evidence), share=2.0) is None
    told = replace(evidence, told=BOTH)
    assert beside_weather(told, covariance(told)) is None
    assert beside_weather(collected(), covariance(collected())) is None


@pytest.mark.parametrize(
    ("text", "gauge"),
    [
        ('[driver.tags.pressure]\nreference = "gauge"', True),
        ('[driver.tags.pressure]\nreference = "vacuum"', True),
        ('[driver.tags.pressure]\nreference = "absolute"', False),
        ('[import.columns]\nvacuum_mbar = "p"', True),
        ('[import.columns]\npressure_mbar = "p"', False),
        ("", False),
    ],
)
def test_the_configuration_says_what_the_sensor_counts_from(text: str, gauge: bool) -> None:
    text = f"{text}\n[data.supply]\npressure_bar = 5.0"
    assert Config.of(Document.parse(text, "x.toml"), calibrated=False).is_gauge == gauge


# --- what cannot act ------------------------------------------------------------------------------


def test_an_effect_that_does_nothing_on_a_unit_is_no_hypothesis() -> None:
    evidence = collected()
    assert "threshold_drift" in offered(evidence)
    theta = evidence.theta.copy()
    theta[c.AIR_SAVING] = c.OFF
    unit = replace(evidence, theta=theta, calibrated=theta, _detected_switchings={})
    assert offered(unit) == offered(evidence) - {"threshold_drift"}


def offered(evidence: Evidence) -> set[str]:
    weights = covariance(evidence).of(evidence.judged)
    moved = signatures(evidence, weights.cycles)
    found = linear_gains(evidence, weights, columns(evidence, weights, moved), each=1)
    return {fit.hypothesis[0].effect for fit in found}


def test_where_no_air_is_saved_no_switching_is_looked_for() -> None:
    theta, samples = rigs.theta("gripper").copy(), rigs.recorded("gripper", 12.0)[0]

    def hold(theta: Theta) -> int:
        detector = select_window(expected_detector(theta, 0.3 * MBAR), [samples])
        finder = PhaseFinder(detector)
        phase = np.concatenate([finder.push(samples)[1], finder.flush()[1]])
        return int(np.count_nonzero(phase == Phase.HOLD))

    assert hold(theta) > 0
    theta[c.AIR_SAVING] = c.OFF
    assert hold(theta) == 0


# --- while the loop runs --------------------------------------------------------------------------


def test_how_far_two_days_are_apart() -> None:
    evening, morning = Day(0.0, 1e5, 300.0), Day(12.0, 1.01e5, 297.0)
    higher, denser = evening.until(morning, temperature_is_measured=True)
    assert higher == 1e3
    assert denser == pytest.approx(math.hypot(0.01, 0.005))
    assert evening.until(evening, temperature_is_measured=True) == (0.0, 0.0)


@pytest.mark.parametrize(("hours", "kelvins"), [(0.0, 0.0), (2.0, 2.0 * KELVINS_AN_HOUR), (-2, 2)])
def test_without_a_thermometer_it_may_be_warmer_the_longer_ago_it_was(
    hours: float, kelvins: float
) -> None:
    now, later = Day(0.0, 1e5, 300.0), Day(hours, 1e5, 300.0)
    _, denser = now.until(later, temperature_is_measured=False)
    assert denser == pytest.approx(kelvins / 600.0)


def test_a_hall_is_never_much_warmer() -> None:
    now, later = Day(0.0, 1e5, 300.0), Day(1e4, 1e5, 300.0)
    assert now.until(later, temperature_is_measured=False)[1] == MOST_KELVINS / 600.0
