"""How far healthy cycles are off, as a calibration learns it."""

from dataclasses import replace

import numpy as np
import pytest
import rigs

from twin.diagnosis.evidence import HEALTHY, Evidence, collect
from twin.diagnosis.healthy import learned, usual_leftover
from twin.diagnosis.residual_covariance import covariance
from twin.model import theta as c
from twin.monitor.scatter_covariance import as_left, by_contact
from twin.signals import MBAR, MS, Phase


def test_what_healthy_cycles_have_left_is_their_mean() -> None:
    left = np.array([0.4, 0.5, 0.6, 0.7, 0.8])
    assert usual_leftover(left) == pytest.approx(np.sqrt(0.6))


def test_one_odd_cycle_does_not_make_all_as_odd() -> None:
    left = np.array([0.56, 0.55, 1.22, 0.63, 37.95, 0.24, 0.11, 0.09, 0.13, 0.12, 0.18])
    assert usual_leftover(left) < 0.7
    assert usual_leftover(np.delete(left, 4)) < usual_leftover(left)


def test_what_is_left_shrinks_by_what_healthy_cycles_show_but_noise_does_not() -> None:
    noise = np.array([0.04, 0.01])
    scatter = np.array([[0.9, 0.3], [0.3, 0.5]])
    shrunk = as_left(scatter + np.diag(noise), 0.5, noise)
    assert shrunk == pytest.approx(0.25 * scatter + np.diag(noise))
    widened = as_left(scatter + np.diag(noise), 2.0, noise)
    assert widened == pytest.approx(4.0 * (scatter + np.diag(noise)))


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
