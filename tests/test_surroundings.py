"""Ambient pressure and temperature that somebody measures are followed, and name no cause."""

from functools import cache
from typing import Any

import numpy as np
import pytest
import rigs
from calibrations import typed
from second_rigs import samples_of
from second_world.draw import draw_rig
from second_world.records import record

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import with_truth
from twin.calibration.commission import guessed
from twin.calibration.readings import read
from twin.diagnosis.answer import diagnose
from twin.diagnosis.evidence import collect
from twin.events import Kind
from twin.live import run
from twin.model import theta as c
from twin.monitor.surroundings import following, medians_of, taken_in, told
from twin.signals import MBAR, Samples, deviation

WEATHER = ("ambient_pressure=-23",)  # mbar, beside the data set; and it is 35 °C instead of 20
NAMES = ["test_rig", "gripper"]


@cache
def another_day(name: str) -> Samples:
    tables: dict[str, Any] = rigs.config(name).document.section(PlcSettings, "plc").model_dump()
    tables["reports"] = {"values": True}
    tables["rig"]["temperature_c"] = 35.0
    tables["program"]["start_ms"] = 500.0
    hidden = [parse_fault(fault) for fault in WEATHER]
    parts = with_truth(PlcSettings.model_validate(tables), 40.0, hidden, seed=5)
    samples: Samples = np.concatenate([block for block, _ in parts])
    samples.flags.writeable = False
    return samples


def blind(samples: Samples) -> Samples:
    samples = samples.copy()
    samples["ambient"] = samples["temperature"] = 0.0
    return samples


def watched(name: str, samples: Samples) -> rigs.Collect:
    seen = rigs.Collect()
    run(rigs.cut(samples, 500), rigs.twin(name), rigs.isolating(name), [seen])
    return seen


def off(seen: rigs.Collect) -> float:
    """Deviation (mbar rms) behind the first cycles."""
    samples, ticks = np.concatenate(seen.samples), np.concatenate(seen.ticks)
    return float(np.sqrt(np.nanmean(deviation(samples, ticks)[8000:] ** 2))) / MBAR


@pytest.mark.parametrize("name", NAMES)
def test_another_day_is_no_deviation(name: str) -> None:
    seen = watched(name, another_day(name))
    assert seen.of(Kind.DEVIATION) == []
    assert off(seen) < 3.0
    unseen = watched(name, blind(another_day(name)))
    assert unseen.of(Kind.DEVIATION)
    assert off(unseen) > 10.0


@pytest.mark.parametrize("size", [1, 37, 20_000])
def test_it_is_followed_the_same_however_the_stream_is_cut(size: int) -> None:
    samples = another_day("gripper")[:9000].copy()
    samples["ambient"] += np.arange(9000, dtype=np.float32) * 0.2  # Pa, it clears up
    ticks = [
        rigs.expectation(rigs.twin("gripper"), rigs.cut(samples, rows))[1] for rows in (500, size)
    ]
    assert ticks[0].tobytes() == ticks[1].tobytes()


def test_where_nobody_tells_them_the_data_set_says_what_they_are() -> None:
    samples, theta = blind(another_day("gripper")), rigs.theta("gripper")
    assert told(samples) == {}
    assert following(theta, samples) is theta
    data = typed("gripper").data
    assert taken_in(data, samples) == data


def test_a_stream_tells_the_same_surroundings_as_all_its_rows() -> None:
    samples = another_day("gripper").copy()
    samples["ambient"][:4000] = 0.0  # not measured yet
    assert medians_of(rigs.cut(samples, 37)) == told(samples)
    assert set(told(samples)) == {"ambient", "temperature"}


@pytest.mark.parametrize("name", NAMES)
def test_a_diagnosis_goes_by_the_day_of_its_log(name: str) -> None:
    evidence = collect(rigs.config(name), [another_day(name)])
    assert evidence.theta[c.AMBIENT] == pytest.approx(990 * MBAR, abs=20.0)
    assert evidence.theta[c.TEMPERATURE] == pytest.approx(308.15, abs=0.1)
    beside = collect(rigs.config(name), [blind(another_day(name))])
    followed, unseen = (np.sqrt(np.nanmean(log.off([()]) ** 2)) for log in (evidence, beside))
    assert followed < 0.5 * unseen


@pytest.mark.slow
def test_a_log_of_another_day_is_consistent() -> None:
    found = diagnose(rigs.config("test_rig"), [another_day("test_rig")], "log.mcap", lambda _: None)
    assert found.json["verdict"] == "consistent"


def test_a_calibration_has_the_surroundings_of_its_record() -> None:
    data = taken_in(typed("test_rig").data, another_day("test_rig"))
    assert data.ambient.pressure_mbar == pytest.approx(990.0, abs=0.2)
    assert data.ambient.temperature_c == pytest.approx(35.0)


@pytest.mark.parametrize("offset", [0.0, 6.0])
def test_a_barometer_beside_an_opened_idle_tells_the_sensors_offset(offset: float) -> None:
    samples = another_day("gripper").copy()
    samples["pressure"] += np.float32(offset * MBAR)
    guess, remarks = guessed(typed("gripper").data, read(samples))
    assert guess.ambient.pressure_mbar == pytest.approx(990.0, abs=0.2)
    assert guess.effects.get("sensor_offset", {}).get("offset", 0.0) == pytest.approx(
        offset, abs=0.6
    )
    assert remarks == []


def test_a_barometer_that_contradicts_is_not_gone_by() -> None:
    samples = another_day("gripper").copy()
    samples["ambient"] += np.float32(30.0 * MBAR)
    guess, remarks = guessed(typed("gripper").data, read(samples))
    assert guess.ambient.pressure_mbar == pytest.approx(990.0, abs=1.0)
    assert "sensor_offset" not in guess.effects
    assert [remark.line.split(" =")[0] for remark in remarks] == ["[data.ambient] pressure_mbar"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("renewed", [1, 2, 5])
def test_rows_that_repeat_a_reading_are_recognised(name: str, renewed: int) -> None:
    samples = another_day(name).copy()
    rows = np.arange(len(samples)) // renewed * renewed
    samples["pressure"] = samples["pressure"][rows]
    sensor = taken_in(typed(name).data, samples).sensor
    assert sensor.renewed_ms == pytest.approx(renewed if renewed > 1 else 0.0, rel=0.15)
    in_means = sensor.noise_mbar * np.sqrt(renewed)
    assert sensor.noise_in_means() == pytest.approx(in_means, rel=0.1)
    assert sensor.noise_in_means(10.0) == sensor.noise_mbar


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "renewed_ms"), [(198205, 2.0), (198215, 5.0), (198203, 0.0)])
def test_on_rigs_of_another_world_it_is_found_as_well(seed: int, renewed_ms: float) -> None:
    samples = samples_of(record(draw_rig(seed), seed, 6))
    sensor = taken_in(typed("test_rig").data, samples).sensor
    assert sensor.renewed_ms == pytest.approx(renewed_ms, rel=0.1)
