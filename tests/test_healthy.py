"""How far healthy cycles are off, as a calibration learns it."""

from dataclasses import replace

import numpy as np
import pytest
import rigs
from calibrations import quiet
from second_rigs import config_of, samples_of
from second_world.draw import draw_rig
from second_world.records import record

from twin.calibration.calibrate import rounding
from twin.calibration.commission import commission
from twin.diagnosis.answer import diagnose
from twin.diagnosis.evidence import HEALTHY, Evidence, collect
from twin.diagnosis.healthy import learned, usual_leftover
from twin.diagnosis.residual_covariance import covariance
from twin.model import theta as c
from twin.monitor.bins import Floats, binned
from twin.monitor.breakpoints import converter_step, rounding_error
from twin.monitor.scatter_covariance import Reading, by_contact, from_cycle_to_cycle, lasting
from twin.monitor.uncertain_data import scattered
from twin.signals import MBAR, MS, Phase


def test_what_healthy_cycles_have_left_is_their_mean() -> None:
    left = np.array([0.4, 0.5, 0.6, 0.7, 0.8])
    assert usual_leftover(left) == pytest.approx(np.sqrt(0.6))


def test_one_odd_cycle_does_not_make_all_as_odd() -> None:
    left = np.array([0.56, 0.55, 1.22, 0.63, 37.95, 0.24, 0.11, 0.09, 0.13, 0.12, 0.18])
    assert usual_leftover(left) < 0.7
    assert usual_leftover(np.delete(left, 4)) < usual_leftover(left)


def test_what_is_left_shrinks_by_what_healthy_cycles_show_but_noise_does_not() -> None:
    bins = binned(np.full(200, Phase.IDLE, np.uint8), np.ones(200, bool), np.zeros(1, np.int64))
    rows = np.arange(len(bins.count))
    moves = np.random.default_rng(1).normal(size=(len(rows), 3))
    noise = np.diag(0.3**2 / bins.count)
    persistent = lasting(bins, rows, np.full(len(rows), 0.4))

    def scaled(leftover: float) -> Floats:
        return from_cycle_to_cycle(bins, rows, persistent, moves, Reading(0.3), leftover)

    assert scaled(0.5) == pytest.approx(0.25 * (scaled(1.0) - noise) + noise)
    assert scaled(2.0) == pytest.approx(4.0 * scaled(1.0))
    coarse = Reading(0.3, rounding=0.2)
    rounded = from_cycle_to_cycle(bins, rows, persistent, moves, coarse, 0.5)
    assert rounded - scaled(0.5) == pytest.approx(0.2**2)  # all readings are off alike


def _of_contact(jitter_ms: float, seed: int) -> Evidence:
    """Cycles of a gripper that meets the part 60 ms after suction began, give or take."""
    config = rigs.config("gripper")
    system = config.data.system.model_copy(update={"part_meets_ms": 60.0})
    data = config.data.model_copy(update={"system": system})
    samples, _ = rigs.recorded("gripper", 20.0)
    evidence = collect(replace(config, data=data), [samples])
    rng = np.random.default_rng(seed)
    measured = rng.normal(0.0, 0.3 * MBAR, len(evidence.samples))
    for cycle, row in enumerate(evidence.starts[:-1]):
        theta = evidence.theta.copy()
        theta[c.CONTACT] += rng.normal(0.0, jitter_ms * MS)
        rows = slice(row, evidence.starts[cycle + 1])
        measured[rows] += replace(evidence, theta=theta).expected(HEALTHY)[rows]
    as_measured = evidence.samples.copy()
    as_measured["pressure"] = measured
    return replace(evidence, samples=as_measured)


def test_when_cups_meet_the_part_differs_from_cycle_to_cycle_and_is_learned() -> None:
    evidence = _of_contact(jitter_ms=2.0, seed=3)
    healthy = learned(evidence)
    assert 1.0 < healthy.meets_ms < 4.0
    weights = covariance(replace(evidence, healthy=healthy)).of(evidence.judged)
    white = weights.white(evidence.off([HEALTHY]))
    assert np.abs(white).max() < 6.0
    surer = healthy.model_copy(update={"meets_ms": 0.1})
    weights = covariance(replace(evidence, healthy=surer)).of(evidence.judged)
    assert np.abs(weights.white(evidence.off([HEALTHY]))).max() > 15.0


def test_what_follows_contact_comes_later_as_a_whole() -> None:
    evidence = _of_contact(jitter_ms=0.0, seed=4)
    rows, bins = np.arange(len(evidence.samples)), evidence.bins
    expected = evidence.expected(HEALTHY) / MBAR
    here = np.arange(len(bins.count))
    later = by_contact(bins, here, rows, expected, evidence.theta, MS)[:, 0]
    sooner, late = evidence.theta.copy(), evidence.theta.copy()
    sooner[c.CONTACT] -= 0.5 * MS
    late[c.CONTACT] += 0.5 * MS
    off = evidence.off([HEALTHY, HEALTHY], [sooner, late])
    change = off[:, 0] - off[:, 1]
    of_suction = (bins.kind == Phase.SUCTION) & (bins.cycle >= 1)
    apart = np.linalg.norm(later[of_suction] - change[of_suction])
    assert apart < 0.2 * np.linalg.norm(change[of_suction])
    assert np.abs(change).max() > 3.0
    assert (later[bins.kind == Phase.IDLE] == 0.0).all()
    on_the_part = evidence.theta.copy()
    on_the_part[c.CONTACT] = 0.0
    assert by_contact(bins, here, rows, expected, on_the_part, MS).shape == (len(here), 0)


@pytest.mark.slow
@pytest.mark.timeout(1200)  # a commissioning, on a computer that does other things beside
def test_a_rig_of_another_world_that_meets_the_part_late_is_healthy() -> None:
    """Cups come upon the part 60 ms after suction began; one sigma of that is 2 ms.

    Readings are whole mbar with little noise, so that rounding shows as well.
    """
    rig = draw_rig(198100, "gripper")
    vessel = replace(rig.vessel, contact_delay=0.06, contact_jitter=2e-3)
    sensor = replace(rig.sensor, cadence_ms=1, step=1.0 * MBAR, noise=0.07 * MBAR)
    rig = replace(rig, vessel=vessel, sensor=sensor)
    first, second = record(rig, 1, 12), record(rig, 2, 12)
    config = config_of(first.truth.readable)
    commissioned = commission(config, [samples_of(first)], quiet)
    healthy = commissioned.calibration.healthy
    assert commissioned.verdict.word == "good"
    assert 0.7 < healthy.meets_ms < 6.0

    def verdict(meets_ms: float) -> str:
        known = healthy.model_copy(update={"meets_ms": meets_ms})
        unit = replace(
            config,
            data=commissioned.calibration.fitted.data,
            monitor=config.monitor.model_copy(update={"healthy": known}),
        )
        return str(diagnose(unit, [samples_of(second)], "log", quiet).json["verdict"])

    assert verdict(healthy.meets_ms) == "consistent"
    assert verdict(1e-6) == "unlisted"


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.3, 0.6])
def test_rounding_leaves_an_error_that_no_number_of_readings_takes_away(noise: float) -> None:
    rng = np.random.default_rng(7)
    truth = rng.uniform(-0.5, 0.5, 400)
    read = np.round(truth[:, None] + rng.normal(0.0, noise, (400, 5000)))
    errors = np.sqrt(np.mean((read.mean(axis=1) - truth) ** 2))
    of_all = np.sqrt(np.mean((read - truth[:, None]) ** 2))
    chance = noise / np.sqrt(5000)
    assert rounding_error(1.0, of_all) == pytest.approx(errors, rel=0.35, abs=2.0 * chance)
    assert converter_step(np.repeat(np.arange(30.0), 3)) == 1.0


def test_repeated_readings_are_as_coarse_as_others() -> None:
    data, samples = rigs.config("gripper").data, rigs.recorded("gripper", 6.0)[0].copy()
    samples["pressure"] = np.round(samples["pressure"] / MBAR) * MBAR
    for renewed_ms in (0.0, 5.0):
        sensor = data.sensor.model_copy(update={"noise_mbar": 0.29, "renewed_ms": renewed_ms})
        left = rounding(data.model_copy(update={"sensor": sensor}), samples)
        assert left == pytest.approx(0.285, abs=0.01)


def test_readings_without_steps_have_no_rounding_error() -> None:
    assert rounding_error(0.0, 0.3) == 0.0
    assert converter_step(np.array([7.0, 7.0])) == 0.0


def test_a_drawn_cycle_meets_the_part_at_another_time_and_what_it_is_drawn_from_stays() -> None:
    healthy = rigs.config("gripper").monitor.healthy.model_copy(
        update={"meets_ms": 2.0, "scatter": {}}
    )
    theta = rigs.theta("gripper").copy()
    theta[c.CONTACT] = 60.0 * MS
    rng = np.random.default_rng(5)
    times = [scattered(theta, healthy, rng)[c.CONTACT] / MS for _ in range(200)]
    assert theta[c.CONTACT] == 60.0 * MS
    assert np.mean(times) == pytest.approx(60.0, abs=1.0)
    assert np.std(times) == pytest.approx(2.0, rel=0.3)
    theta[c.CONTACT] = 0.0  # cups are on the part
    assert scattered(theta, healthy, rng)[c.CONTACT] == 0.0
