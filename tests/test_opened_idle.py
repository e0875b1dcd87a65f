"""Weather is followed by an opened idle, at its own pace; what is faster stays an alarm."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
import rigs
from second_rigs import config_of, samples_of
from second_world.draw import draw_rig
from second_world.records import record

from twin.calibration.commission import guessed
from twin.calibration.readings import read
from twin.diagnosis.evidence import collect
from twin.events import Kind
from twin.live import Twin, run
from twin.model import theta as c
from twin.model.dataset import coefficients
from twin.model.theta import Theta
from twin.monitor import isolation
from twin.monitor.surroundings import PACE, RANGE, OpenedIdle, Surroundings
from twin.quality import Quality
from twin.signals import MBAR, TICK, Command, Phase, Samples, Ticks

HOUR_NS = 3_600_000_000_000
CALM = 1013.0 * MBAR  # Pa, of the calibration
NOISE = 0.05 * MBAR  # Pa, of the mean of an idle
PER_HOUR = 3.75  # mbar, just slower than PACE
Hours = npt.NDArray[np.float64]


def wandering(hour: float) -> float:
    """mbar beside the calibration: down 15 in four hours, up 30 in eight."""
    return -PER_HOUR * hour if hour < 4.0 else PER_HOUR * (hour - 8.0)


# --- one idle after the other ---------------------------------------------------------------------


def followed(hours: Hours, mbar: Hours, idle: OpenedIdle | None = None) -> OpenedIdle:
    """After idles at some hours that read so many mbar more than the calibration."""
    idle = idle or OpenedIdle(CALM, CALM)
    noise = np.random.default_rng(1).normal(0.0, NOISE, len(hours))
    for hour, reading in zip(hours.tolist(), (CALM + mbar * MBAR + noise).tolist(), strict=True):
        idle.take(reading, NOISE, round(hour * HOUR_NS))
    return idle


def moved(idle: OpenedIdle) -> float:
    """mbar by which the followed ambient pressure is above the calibration's."""
    return (idle.ambient - CALM) / MBAR


def test_weather_is_followed_within_a_tenth_of_a_millibar() -> None:
    hours = np.arange(0.0, 12.0, 10.0 / 3600.0)
    mbar = np.array([wandering(hour) for hour in hours.tolist()])
    for until in (hours < 4.0, hours < 12.0):
        assert moved(followed(hours[until], mbar[until])) == pytest.approx(mbar[until][-1], abs=0.2)


@pytest.mark.parametrize("jump", [-15.0, 2.0, 15.0, 100.0])
def test_a_jump_is_no_weather_whatever_time_passes_and_weather_goes_on_beside_it(
    jump: float,
) -> None:
    hours = np.arange(0.0, 20.0, 0.01)
    weather = np.minimum(hours, 8.0)
    idle = followed(hours, weather + np.where(hours > 1.0, jump, 0.0))
    assert moved(idle) == pytest.approx(8.0, abs=0.5)
    mended = followed(20.0 + hours, np.full(len(hours), 8.0), idle)
    assert moved(mended) == pytest.approx(8.0, abs=0.5)


def test_what_drifts_faster_than_weather_is_followed_at_the_pace_of_weather() -> None:
    hours = np.arange(0.0, 5.0, 0.01)
    most = PACE * 3600.0 / MBAR * hours[-1]
    assert moved(followed(hours, 6.0 * hours)) == pytest.approx(most, abs=0.5)


def test_a_night_may_change_as_much_as_its_hours_allow() -> None:
    for hours, expected in ((12.0, 12.0), (1.0, PACE * 3600.0 / MBAR)):
        times = np.array([0.0, 0.01, 0.02, 0.02 + hours])
        idle = followed(times, np.array([0.0, 0.0, 0.0, 12.0]))
        assert moved(idle) == pytest.approx(expected, abs=0.2)


def test_no_night_forgives_a_jump_that_was_seen() -> None:
    hours = np.array([0.0, 0.01, 0.02, 12.0, 12.01])
    assert moved(followed(hours, np.array([0.0, 0.0, 15.0, 15.0, 15.0]))) == pytest.approx(
        0.0, abs=0.2
    )


def test_weather_stays_in_its_range() -> None:
    hours = np.arange(0.0, 30.0, 0.01)
    assert moved(followed(hours, -3.0 * hours)) == pytest.approx(-RANGE / MBAR)


def test_nothing_is_followed_before_an_idle_agrees_with_the_calibration() -> None:
    hours = np.arange(0.0, 3.0, 0.01)
    late = followed(hours, 10.0 - 2.0 * hours)
    assert moved(late) == 0.0
    assert moved(followed(hours + 3.0, 4.0 - 2.0 * hours, late)) == pytest.approx(-2.0, abs=0.2)


def test_a_calibration_may_leave_an_idle_a_little_beside_ambient() -> None:
    hours = np.arange(0.0, 2.0, 0.01)
    assert moved(followed(hours, np.full(len(hours), 0.7))) == pytest.approx(0.0, abs=0.2)


def test_a_clock_that_goes_back_moves_nothing() -> None:
    assert moved(followed(np.array([5.0, 1.0]), np.array([0.0, 0.9]))) == 0.0


# --- the rows of a stream -------------------------------------------------------------------------


def day(segments: Sequence[Samples], hours: Sequence[float]) -> Samples:
    """Segments that begin at some hours, and a gap before each."""
    parts, sequence = list[Samples](), 0
    for segment, hour in zip(segments, hours, strict=True):
        rows = segment.copy()
        shift = int(segments[0]["time_ns"][0] - rows["time_ns"][0]) + round(hour * HOUR_NS)
        rows["time_ns"] += shift
        rows["host_ns"] = rows["time_ns"]
        rows["sequence"] += sequence - rows["sequence"][0]
        rows["quality"][0] |= np.uint8(Quality.GAP if parts else 0)
        sequence = int(rows["sequence"][-1]) + 1000
        parts.append(rows)
    return np.concatenate(parts)


@cache
def clears_up() -> Samples:
    """An opened gripper in rising weather: 3 mbar an hour for three hours."""
    calm = rigs.recorded("gripper", 8.0)[0]
    hours = [0.0, 1.0, 2.0, 3.0]
    rows = day([calm] * len(hours), hours)
    rows["pressure"] += np.repeat(np.float32(3.0 * MBAR) * np.arange(4, dtype="f4"), len(calm))
    rows.flags.writeable = False
    return rows


def as_commanded(samples: Samples) -> Ticks:
    ticks = np.zeros(len(samples), TICK)
    blows, sucks = (samples["commands"] & bit != 0 for bit in (Command.BLOW_OFF, Command.SUCTION))
    ticks["phase"] = np.where(blows, Phase.BLOW_OFF, np.where(sucks, Phase.SUCTION, Phase.IDLE))
    return ticks


def ambient_of_rows(theta: Theta, samples: Samples, size: int = 1_000_000) -> Hours:
    """mbar by which ambient pressure is above that of ``theta``, row by row."""
    surroundings, ambient = Surroundings(theta), np.full(len(samples), np.nan)
    for begin in range(0, len(samples), size):
        surroundings.over(samples[:0], as_commanded(samples[:0]))  # no rows come for a while
        rows = samples[begin : begin + size]
        for part, here in surroundings.over(rows, as_commanded(rows)):
            ambient[begin : begin + len(rows)][part] = here[c.AMBIENT] - theta[c.AMBIENT]
    return ambient / MBAR


def test_ambient_is_that_of_the_last_opened_idle_from_the_next_suction_on() -> None:
    ambient = ambient_of_rows(rigs.theta("gripper"), clears_up())
    assert ambient[0] == 0.0
    assert ambient[-1] == pytest.approx(9.0, abs=0.2)
    samples = clears_up()
    changes = np.flatnonzero(np.diff(ambient)) + 1
    assert (samples["commands"][changes] & Command.SUCTION).all()
    assert not (samples["commands"][changes - 1] & Command.SUCTION).any()


@pytest.mark.parametrize("size", [1, 39, 40, 977])
def test_it_is_the_same_however_the_stream_is_cut(size: int) -> None:
    whole, cut = (
        ambient_of_rows(rigs.theta("gripper"), clears_up(), rows) for rows in (10**6, size)
    )
    assert whole.tobytes() == cut.tobytes()


def test_twin_expects_the_same_however_the_stream_is_cut() -> None:
    samples = clears_up()
    ticks = [
        rigs.expectation(rigs.twin("gripper"), rigs.cut(samples, rows))[1]
        for rows in (37, len(samples))
    ]
    assert ticks[0].tobytes() == ticks[1].tobytes()


@pytest.mark.parametrize(
    ("coefficient", "value"), [(c.GAUGE, 1.0), (c.RELEASE, np.nan)], ids=["gauge", "closed"]
)
def test_a_gauge_and_a_closed_tank_are_not_followed(coefficient: int, value: float) -> None:
    theta = rigs.theta("gripper")
    theta[coefficient] = value
    assert not ambient_of_rows(theta, clears_up()).any()


def test_beside_a_barometer_nothing_is_taken_from_the_idle() -> None:
    samples = clears_up().copy()
    samples["ambient"] = rigs.theta("gripper")[c.AMBIENT]
    assert not ambient_of_rows(rigs.theta("gripper"), samples).any()
    samples["ambient"][len(samples) // 8 :] = 0.0  # it has failed
    assert not ambient_of_rows(rigs.theta("gripper"), samples).any()


@pytest.mark.parametrize("spoils", ["rises", "bad", "unreadable", "short"])
def test_an_idle_that_tells_nothing_is_left_out(spoils: str) -> None:
    samples = clears_up().copy()
    idle = samples["commands"] == 0
    if spoils == "rises":
        ends = np.minimum.accumulate(np.where(idle, len(samples), np.arange(len(samples)))[::-1])
        rest = (ends[::-1] - np.arange(len(samples)))[idle]  # rows to the end of the idle
        samples["pressure"][idle] -= rest.astype("f4") * np.float32(0.04 * MBAR)
    elif spoils == "short":
        suction = np.flatnonzero(np.diff((samples["commands"] == Command.SUCTION).astype("i1")) > 0)
        for row in suction + 1:
            samples["commands"][row - 20 : row] = Command.SUCTION
            samples["commands"][row - 60 : row - 20] = 0
            samples["commands"][row - 30] = Command.BLOW_OFF
    elif spoils == "bad":
        samples["quality"][idle] |= np.uint8(Quality.BAD)
    else:
        samples["pressure"][idle] = np.nan
    assert not ambient_of_rows(rigs.theta("gripper"), samples).any()


def test_a_diagnosis_follows_no_idle() -> None:
    samples = clears_up()
    evidence = collect(rigs.config("gripper"), [samples])
    still = Twin(evidence.theta, rigs.twin("gripper").detector, rigs.twin("gripper").terms)
    still.advance(samples)
    ((_, theta),) = still._surroundings.over(samples[:0], as_commanded(samples[:0]))
    assert theta[c.AMBIENT] == evidence.theta[c.AMBIENT] == rigs.theta("gripper")[c.AMBIENT]


# --- another world --------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [3, 11])
def test_on_rigs_of_another_world_it_follows_the_weather(seed: int) -> None:
    """Their ambient pressure, their cups and their sensors share no equation with the model."""
    rig = draw_rig(seed, "gripper")
    assert rig.vessel.released
    rig = replace(rig, sensor=replace(rig.sensor, gauge=False))
    hours = [0.0, 1.0, 2.0, 3.0, 15.0]
    truth = np.array([0.0, -3.0, -6.0, -3.0, 9.0])
    segments = []
    for mbar in truth:
        here = rig.surroundings
        here = replace(here, ambient_pressure=here.ambient_pressure + mbar * MBAR)
        segments.append(record(replace(rig, surroundings=here), seed, 3))
    rows = [samples_of(segment) for segment in segments]
    data, _ = guessed(config_of(segments[0].truth.readable).data, read(rows[0]))
    ambient = ambient_of_rows(coefficients(data), day(rows, hours))
    lasts = np.cumsum([len(segment) for segment in rows]) - 1
    assert ambient[lasts] == pytest.approx(truth, abs=1.0)


# --- the loop -------------------------------------------------------------------------------------


def watched(samples: Samples, *, idle: bool = True) -> rigs.Collect:
    twin, monitor, seen = rigs.twin("gripper"), rigs.isolating("gripper"), rigs.Collect()
    if not idle:
        twin = Twin(twin.theta, twin.detector, twin.terms)
        monitor._surroundings = Surroundings(monitor.theta, idle=False)
    run(rigs.cut(samples, 5000), twin, monitor, [seen])
    return seen


@cache
def weather_day() -> Samples:
    """Twelve hours of weather, a stretch of the unit's cycles in each."""
    hours = [float(hour) for hour in range(13)]
    faults = [f"ambient_pressure={wandering(hour):g}" for hour in hours]
    segments = [
        rigs.recorded("gripper", 8.0, (fault,), seed)[0] for seed, fault in enumerate(faults)
    ]
    return day(segments, hours)


@pytest.mark.slow
def test_weather_of_a_day_is_no_alarm() -> None:
    assert watched(weather_day()).of(Kind.DEVIATION) == []
    assert watched(weather_day(), idle=False).of(Kind.DEVIATION)


@cache
def night(mbar: float, *, barometer: bool) -> Samples:
    """A day of calm weather and, after a night, the next in other weather."""
    hours = [*np.arange(0.0, 6.0, 0.5).tolist(), *np.arange(17.5, 21.5, 0.5).tolist()]
    here = [mbar if hour > 12.0 else 0.0 for hour in hours]
    segments = [
        rigs.recorded("gripper", 8.0, (f"ambient_pressure={other:g}",), seed)[0]
        for seed, other in enumerate(here)
    ]
    rows = day(segments, hours)
    if barometer:
        lasts = [len(segment) for segment in segments]
        rows["ambient"] = CALM + MBAR * np.repeat(np.array(here, "f4"), lasts)
    return rows


@pytest.mark.slow
@pytest.mark.parametrize(("mbar", "barometer"), [(-12.0, True), (12.0, True), (-12.0, False)])
def test_other_weather_in_the_morning_is_no_alarm_of_sums_over_cycles(
    mbar: float, barometer: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples = night(mbar, barometer=barometer)
    assert watched(samples).of(Kind.DEVIATION) == []
    monkeypatch.setattr(isolation, "DAY", 0.0)
    assert watched(samples).of(Kind.DEVIATION)


@pytest.mark.slow
def test_a_leak_in_the_morning_is_an_alarm_in_other_weather_too() -> None:
    samples = night(-12.0, barometer=True).copy()
    faulty = ("ambient_pressure=-12", "leakage=1.5")
    last, _ = rigs.recorded("gripper", 8.0, faulty, 77)
    begin = len(samples) - len(last)
    samples["pressure"][begin:] = last["pressure"]
    samples["commands"][begin:] = last["commands"]
    (first, *_) = watched(samples).of(Kind.DEVIATION)
    assert first.time_ns >= samples["time_ns"][begin]


@pytest.mark.slow
@pytest.mark.parametrize("jump", [-15.0, 15.0])
def test_a_sensor_that_jumps_keeps_its_alarm_for_hours_and_through_weather(jump: float) -> None:
    samples = weather_day().copy()
    begin = int(samples["time_ns"][0]) + 2 * HOUR_NS + 3_000_000_000
    samples["pressure"][samples["time_ns"] >= begin] += np.float32(jump * MBAR)
    seen = watched(samples)
    assert seen.of(Kind.DEVIATION_CLEARED) == []
    first, *_ = seen.of(Kind.DEVIATION)
    assert 0 <= first.time_ns - begin < 8_000_000_000
