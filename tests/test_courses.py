"""Every effect with every course: one entry each, and the same rules for all."""

import numpy as np
import numpy.typing as npt
import pytest
import rigs

from twin.errors import ConfigError
from twin.model import kernel
from twin.model import theta as c
from twin.model.courses import HOUR, MEANING, Cause, Course, schedule
from twin.model.effects import EFFECTS, Effect
from twin.signals import MBAR, MS, Phase

CYCLES = 4
PHASES = ((Phase.SUCTION, 500), (Phase.HOLD, 300), (Phase.BLOW_OFF, 150), (Phase.IDLE, 250))
PHASE = np.concatenate([np.full(rows, phase, "u1") for phase, rows in PHASES * CYCLES])
ROWS = len(PHASE) // CYCLES
SECONDS = np.arange(len(PHASE)) * MS
CYCLE = np.arange(len(PHASE)) // ROWS
ONSET = 1.5 * ROWS * MS  # in mid-cycle

every_effect = pytest.mark.parametrize("effect", EFFECTS.values(), ids=EFFECTS)
every_rig = pytest.mark.parametrize("rig", rigs.NAMES)

Rows = npt.NDArray[np.float64]


def sizes(effect: Effect, theta: c.Theta, times: float = 1.0) -> dict[str, float]:
    return {p.name: p.neutral(theta) + times * p.typical for p in effect.parameters}


def expected(theta: c.Theta, *causes: Cause) -> Rows:
    """What the sensor should read, cycle by cycle, while coefficients run like the causes."""
    result = np.empty(len(PHASE))
    state = kernel.at_rest(theta)
    level, dt = np.full(len(PHASE), np.nan), np.full(len(PHASE), MS)
    course = schedule(theta, causes, SECONDS, CYCLE)
    ends = [row for row, _ in course[1:]] + [len(PHASE)]
    before = theta
    for (first, now), last in zip(course, ends, strict=True):
        part = slice(first, last)
        kernel.take_over(state, before, now)
        kernel.advance(state, now, dt[part], PHASE[part], level[part], result[part])
        before = now
    return result.reshape(CYCLES, ROWS)


def acts_here(effect: Effect) -> bool:
    return effect.name != "threshold_drift"  # it acts on what switches the nozzle, not on the gas


@every_effect
@every_rig
def test_a_step_changes_nothing_before_its_onset(effect: Effect, rig: str) -> None:
    theta = rigs.theta(rig)
    healthy = expected(theta).ravel()
    stepped = expected(theta, Cause(effect.name, sizes(effect, theta), Course.STEP, ONSET)).ravel()
    onset = round(ONSET / MS)
    assert stepped[:onset].tobytes() == healthy[:onset].tobytes()
    assert (np.abs(stepped[onset:] - healthy[onset:]).max() > 0.05 * MBAR) == acts_here(effect)


@every_effect
@every_rig
def test_a_step_from_the_start_is_constant(effect: Effect, rig: str) -> None:
    theta = rigs.theta(rig)
    values = sizes(effect, theta)
    constant = expected(theta, Cause(effect.name, values))
    assert expected(theta, Cause(effect.name, values, Course.STEP)).tobytes() == constant.tobytes()


@every_effect
@every_rig
def test_an_intermittent_one_acts_in_its_cycles(effect: Effect, rig: str) -> None:
    theta = rigs.theta(rig)
    cause = Cause(effect.name, sizes(effect, theta), Course.INTERMITTENT, cycles=frozenset({2}))
    off = np.abs(expected(theta, cause) - expected(theta)).max(axis=1)
    assert off[0] == off[1] == 0.0
    assert (off[2] > 0.05 * MBAR) == acts_here(effect)
    course = schedule(theta, [cause], SECONDS, CYCLE)
    assert [row for row, _ in course] == [0, 2 * ROWS, 3 * ROWS]  # where it begins and ends
    acting = [now.tobytes() != theta.tobytes() for _, now in course]
    assert acting == [False, True, False]  # though the gas may remember it


@every_effect
@every_rig
def test_a_ramp_grows_to_what_a_constant_one_is(effect: Effect, rig: str) -> None:
    theta = rigs.theta(rig)
    neutral = sizes(effect, theta, 0.0)
    rate = {
        name: (v - neutral[name]) * HOUR / SECONDS[-1] for name, v in sizes(effect, theta).items()
    }
    grown = np.abs(expected(theta, Cause(effect.name, rate, Course.RAMP)) - expected(theta))
    full = np.abs(expected(theta, Cause(effect.name, sizes(effect, theta))) - expected(theta))
    cycles, all_of_it = grown.max(axis=1), full[-1].max()
    if acts_here(effect):
        assert cycles[0] < 0.5 * all_of_it
        assert cycles[-1] == pytest.approx(all_of_it, rel=0.35)
        assert (np.diff(cycles) > -0.1 * all_of_it).all()


def test_two_causes_are_there_at_once() -> None:
    theta = rigs.theta("test_rig")
    leak = Cause("leakage", {"sonic_flow": 2.0}, Course.STEP, ONSET)
    worn = Cause("suction_loss", {"loss": 20.0})
    last = schedule(theta, [leak, worn], SECONDS, CYCLE)[-1][1]
    assert last[c.LEAK] > theta[c.LEAK]
    assert last[c.SUCTION] == pytest.approx(0.8 * theta[c.SUCTION])


def test_a_ramp_stops_at_its_bound() -> None:
    theta = rigs.theta("test_rig")
    ramp = Cause("suction_loss", {"loss": 1e7}, Course.RAMP)
    last = schedule(theta, [ramp], SECONDS, CYCLE)[-1][1]
    assert last[c.SUCTION] == pytest.approx(0.1 * theta[c.SUCTION])


def test_what_is_not_known_is_refused() -> None:
    theta = rigs.theta("test_rig")
    with pytest.raises(ConfigError, match="unknown effect 'rust'"):
        schedule(theta, [Cause("rust", {})], SECONDS, CYCLE)
    with pytest.raises(ConfigError, match="no parameter"):
        schedule(theta, [Cause("leakage", {"size": 1.0})], SECONDS, CYCLE)
    with pytest.raises(ConfigError, match="out of bounds"):
        schedule(theta, [Cause("leakage", {"sonic_flow": -1.0})], SECONDS, CYCLE)


def test_every_course_is_said_in_words() -> None:
    assert set(MEANING) == set(Course)


@pytest.mark.parametrize("volume", [50.0, 2000.0])
def test_added_volume_joins_with_gas_in_the_vessels_own_state(volume: float) -> None:
    theta = rigs.theta("test_rig")
    state = kernel.at_rest(theta)
    grown = schedule(theta, [Cause("added_volume", {"volume": volume})], SECONDS, CYCLE)[0][1]
    kernel.take_over(state, theta, grown)
    read = np.empty(50)
    dt, phase, level = np.full(50, MS), np.zeros(50, "u1"), np.full(50, np.nan)
    kernel.advance(state, grown, dt, phase, level, read)
    assert read == pytest.approx(theta[c.AMBIENT], abs=1e-3)  # no jump in temperature either


@pytest.mark.parametrize("span_s", [5.0, 3600.0])
def test_a_ramp_grows_in_small_steps_however_long_the_log_is(span_s: float) -> None:
    """Also in a log of seconds: each step would otherwise look like a switching of something."""
    theta, rows = rigs.theta("test_rig"), 20_000
    seconds = np.linspace(0.0, span_s, rows)
    wrong = Cause("sensor_gain", {"error": 5.0 * HOUR / span_s}, Course.RAMP)
    course = schedule(theta, [wrong], seconds, np.zeros(rows, np.int64))
    gains = np.array([coefficients[c.SENSOR_GAIN] for _, coefficients in course])
    reached = 0.05 * theta[c.SENSOR_GAIN]
    assert gains[-1] - theta[c.SENSOR_GAIN] == pytest.approx(reached, rel=0.005)
    assert np.diff(gains).max() < 0.006 * reached
