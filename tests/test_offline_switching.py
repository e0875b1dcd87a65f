"""When the nozzle switched, from commands and pressure alone: on rigs that nobody tuned to."""

from collections.abc import Callable
from functools import cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
import rigs
from nozzle_found import Score, leaky, scored, told, true
from second_rigs import samples_of
from second_world.draw import draw_rig
from second_world.faults import Fault
from second_world.records import record

from twin.calibration.cycles import Cycles
from twin.monitor.breakpoints import Noise, beside_parabolas
from twin.monitor.offline_switching import Switching, noise_of, switchings
from twin.quality import Quality
from twin.signals import MBAR, MS, SAMPLE, Command, Phase, Samples

Floats = npt.NDArray[np.float64]
IDLE_MS, SUCTION_MS, CYCLES = 300, 1500, 4


@cache
def score(seed: int, kind: str, *, leaks: bool = False) -> Score:
    rig = draw_rig(seed, kind)
    rig = (leaky(rig, seed) or rig) if leaks else rig
    return scored(f"{kind} {seed}", record(rig, seed, 6))


def switched(samples: Samples) -> list[Switching]:
    phase = told(samples)
    return switchings(samples, phase, noise_of(samples, phase))


def stream(of_suction: Callable[[Floats], Floats], noise: float = 0.3, every: int = 1) -> Samples:
    """Cycles of idle at 1000 mbar and a suction that is given over its ms; ``noise`` in mbar."""
    ms = np.arange(0.0, SUCTION_MS)
    one = np.concatenate([np.full(IDLE_MS, 1000.0), of_suction(ms)])
    mbar = np.tile(one, CYCLES) + np.random.default_rng(3).normal(0.0, noise, CYCLES * len(one))
    samples = np.zeros(len(mbar), SAMPLE)
    samples["time_ns"] = np.arange(len(mbar)) * 1_000_000
    suction = np.tile(np.arange(len(one)) >= IDLE_MS, CYCLES)
    samples["commands"] = suction * np.uint8(Command.SUCTION)
    samples["pressure"] = mbar * MBAR
    samples = samples[::every]
    samples["sequence"] = np.arange(len(samples))
    return samples


def falls(ms: Floats, end: float = 150.0, by: float = 250.0) -> Floats:
    """As the nozzle's suction lets the pressure fall (mbar)."""
    return end + (1000.0 - end) * np.exp(-ms / by)


def off_at(ms: Floats, at: float, rises: float = 0.02) -> Floats:
    """The nozzle goes off ``at`` so many ms; from then on it rises so much (mbar/ms)."""
    return np.where(ms < at, falls(ms), falls(np.array(at)) + rises * (ms - at))


def times(found: list[Switching], on: bool) -> Floats:
    """Ms since suction began in each cycle."""
    length = IDLE_MS + SUCTION_MS
    return np.array(
        [1e3 * switching.time % length - IDLE_MS for switching in found if switching.on == on]
    )


# Kinds that the old finder was lost on; seeds of the second world that no one designed with.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "kind"),
    [(7101, "closed_tank"), (7102, "micro"), (7103, "held_part"), (7101, "long_hose")],
)
def test_each_switching_of_a_foreign_rig_is_found_and_no_other(seed: int, kind: str) -> None:
    for leaks in (False, True):
        found = score(seed, kind, leaks=leaks)
        assert not found.missed
        assert not found.false


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "kind"), [(198144, "gripper"), (198322, "long_hose"), (198347, "held_part")]
)
def test_a_line_that_rings_breaks_in_each_cycle_at_the_same_time(seed: int, kind: str) -> None:
    """The slope breaks again and again as it rings; in all cycles the same break is meant."""
    rig = draw_rig(seed)
    assert rig.kind == kind
    found = scored("ringing", record(rig, seed, 12))
    late = [seconds for seconds, _ in found.late]
    assert np.std(late) < 2.0 * MS
    assert abs(np.mean(late)) < 8.0 * MS  # where the fall ends, and not where the line swings back


@pytest.mark.parametrize(
    ("seed", "kind"), [(7101, "no_air_saving"), (7102, "porous_part"), (7103, "no_air_saving")]
)
def test_without_air_saving_nothing_is_found(seed: int, kind: str) -> None:
    found = score(seed, kind)
    assert not found.late
    assert not found.false


@pytest.mark.parametrize("name", rigs.NAMES)
@pytest.mark.parametrize("faults", [(), ("leakage=2",), ("sensor_lag=20",)])
def test_on_the_shipped_rigs_it_is_found_as_well(name: str, faults: tuple[str, ...]) -> None:
    samples, truth = rigs.recorded(name, 12.0, faults)
    found = switched(samples)
    suction = samples["commands"] == Command.SUCTION
    on = truth["nozzle"] == 1
    rows = np.flatnonzero(np.diff(on.astype(int)) != 0) + 1
    rows = np.array([row for row in rows if suction[row - 40 : row + 1].all()])
    seen = [row for row in rows if suction[row : row + 60].all()]
    assert len(seen) >= 2
    for kind in (False, True):
        shown = np.array([switching.row for switching in found if switching.on == kind] or [-1000])
        assert all(np.abs(shown - row).min() <= 20 for row in seen if on[row] == kind)
        true = np.array([row for row in rows if on[row] == kind] or [-1000])
        assert all(np.abs(true - row).min() <= 20 for row in shown)


@pytest.mark.parametrize("every", [1, 2, 5, 10])
@pytest.mark.parametrize("rises", [0.0, 0.02])
def test_a_tight_vessel_shows_only_that_the_fall_ends(every: int, rises: float) -> None:
    found = switched(stream(lambda ms: off_at(ms, 450.0, rises), every=every))
    assert times(found, on=False) == pytest.approx([450.0] * CYCLES, abs=5.0)
    assert not len(times(found, on=True))


def test_a_fall_towards_the_end_pressure_is_no_switching() -> None:
    assert switched(stream(falls)) == []


def test_a_small_vessel_that_switches_every_40_ms_is_followed() -> None:
    """As slow as it fell at first, the pressure falls again."""

    def saw(ms: Floats) -> Floats:
        off = 100.0
        since = (ms - off) % 40.0
        level = float(falls(np.array(off), by=60.0))
        teeth = np.where(since < 20.0, 2.5 * since, 50.0 - 2.5 * (since - 20.0))
        return np.where(ms < off, falls(ms, by=60.0), level + teeth)

    found = switched(stream(saw))
    off = times(found, on=False)
    assert len(found) == pytest.approx(2 * CYCLES * (SUCTION_MS - 100) / 40, abs=2 * CYCLES)
    assert np.abs((off - 100.0 + 20.0) % 40.0 - 20.0).max() < 5.0
    assert all(a.on != b.on for a, b in pairwise(found) if not a.on)


@pytest.mark.parametrize("lag", [2.5, 10.0])
def test_a_slow_sensor_shows_it_later_but_not_by_more_than_its_lag(lag: float) -> None:
    def felt(ms: Floats) -> Floats:
        course, reading = off_at(ms, 450.0, 0.2), np.empty(len(ms))
        reading[0] = course[0]
        for row in range(1, len(ms)):
            reading[row] = reading[row - 1] + (course[row] - reading[row - 1]) / lag
        return reading

    late = times(switched(stream(felt)), on=False) - 450.0
    assert late.min() > 0.0
    assert late.max() < lag + 2.0


def test_a_nozzle_that_closes_slowly_is_timed_by_the_pressure_at_which_it_does() -> None:
    def rounded(ms: Floats) -> Floats:
        closed = np.maximum(ms - 100.0, 0.0)
        falls_to = 200.0 + 800.0 * np.exp(-np.cumsum(np.exp(-closed / 20.0)) / 45.0)
        return falls_to + 90.0 * (1.0 - np.exp(-closed / 40.0)) ** 2

    off = times(switched(stream(rounded, noise=1.0)), on=False)
    assert len(off) == CYCLES
    assert np.ptp(off) <= 2.0


def test_a_line_that_rings_is_off_at_its_first_swing_and_not_on_again() -> None:
    def rings(ms: Floats) -> Floats:
        since = np.maximum(ms - 450.0, 0.0)
        swing = 30.0 * np.exp(-since / 25.0) * np.sin(2.0 * np.pi * since / 18.0)
        return off_at(ms, 450.0) + np.where(ms < 450.0, 0.0, swing)

    found = switched(stream(rings))
    assert times(found, on=False) == pytest.approx([450.0] * CYCLES, abs=5.0)
    assert not len(times(found, on=True))


def test_rows_that_are_missing_or_bad_say_nothing() -> None:
    samples = stream(lambda ms: off_at(ms, 450.0))
    rng = np.random.default_rng(0)
    bad = rng.random(len(samples)) < 0.05
    samples["pressure"][bad], samples["quality"][bad] = 5e5, Quality.BAD
    samples = samples[rng.random(len(samples)) > 0.05]
    found = switched(samples)
    assert times(found, on=False) == pytest.approx([450.0] * CYCLES, abs=5.0)
    assert [samples["time_ns"][switching.row] for switching in found] == pytest.approx(
        [1e9 * switching.time for switching in found], abs=2e6
    )


def test_where_a_known_unit_goes_off_decides_what_a_record_does_not() -> None:
    """A fault may let the slope break less than that of a healthy unit anywhere in the market."""
    rig = draw_rig(198130)
    fault = Fault("heat_exchange", {"film_coefficient": 25.5})
    logged = record(rig, 26_813_000, 12, [fault])
    samples = samples_of(logged)
    phase = told(samples)
    noise = noise_of(samples, phase)
    vacuum = rig.air_saving.h1 * (1.0 + rig.sensor.gain_error)
    usual = rig.surroundings.ambient_pressure - vacuum
    known = switchings(samples, phase, noise, usual)
    assert len(known) == len(true(logged)) > len(switchings(samples, phase, noise))
    at = np.array([switching.time for switching in known])
    assert at == pytest.approx([at for at, *_ in true(logged)], abs=0.02)
    elsewhere = switchings(samples, phase, noise, usual + 0.2 * vacuum)
    assert len(elsewhere) < len(known)


def test_a_line_that_steps_as_the_nozzle_goes_on_is_timed_by_its_step() -> None:
    """A slow rise, then a step down at once: the mean course alone would place it far off."""

    def course(ms: Floats) -> Floats:
        off, on = 400.0, 1100.0
        low = falls(np.array(off))
        held = low + 8.0 + 0.02 * (ms - off)
        again = low + 8.0 + 0.02 * (on - off) - 12.0 - 0.02 * (ms - on)
        return np.where(ms < off, falls(ms), np.where(ms < on, held, again))

    found = switched(stream(course, noise=0.6))
    assert times(found, on=True) == pytest.approx(np.full(CYCLES, 1100.0), abs=4.0)


def test_noise_is_read_with_hum_and_the_converters_steps() -> None:
    ms = np.arange(20_000.0)
    rng = np.random.default_rng(1)
    white = rng.normal(0.0, 30.0, len(ms))
    hum = 200.0 * np.sin(2.0 * np.pi * ms / 20.0)
    quiet, loud = (
        Noise.of(1e5 + noise, np.empty(0), 1e-3, np.empty(0)) for noise in (white, white + hum)
    )
    assert quiet.single == pytest.approx(30.0, rel=0.15)
    assert not quiet.hum
    assert loud.hum
    assert quiet.density < loud.density < 0.1 * loud.single**2 * 20e-3
    steps = Noise.of(100.0 * np.round((1e5 + white) / 100.0), np.empty(0), 1e-3, np.empty(0))
    assert steps.steps > 1000.0 * quiet.steps
    assert beside_parabolas(ms**2, 16) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("name", rigs.NAMES)
def test_the_model_runs_on_where_the_nozzle_was_found_to_switch(name: str) -> None:
    """It is set on nothing that was measured there."""
    samples, _ = rigs.recorded(name, 12.0)
    found, cycles = switched(samples), Cycles.found(samples, rigs.config(name).data)
    inside = np.isin(cycles.phase, (Phase.SUCTION, Phase.HOLD))
    changes = (np.diff(cycles.phase) != 0) & inside[1:] & inside[:-1]
    rows = np.flatnonzero(changes) + 1
    assert rows.tolist() == [switching.row for switching in found]
    assert not np.isfinite(cycles.level[rows]).any()


@pytest.mark.parametrize("name", rigs.NAMES)
def test_where_no_air_is_saved_the_nozzle_never_goes_off_by_itself(name: str) -> None:
    samples, _ = rigs.recorded(name, 12.0)
    data = rigs.config(name).data
    ejector = data.ejector.model_copy(update={"air_saving": "off"})
    without = data.model_copy(update={"ejector": ejector})
    assert (Cycles.found(samples, data).phase == Phase.HOLD).any()
    assert not (Cycles.found(samples, without).phase == Phase.HOLD).any()
