"""On a commissioned rig of the second world what nobody listed is found; a night is no alarm."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import rigs
from test_hidden_mechanisms import found_alone, is_told
from test_opened_idle import day

from tools import battery_second
from twin.events import Kind
from twin.live import Twin, run
from twin.model import theta as c
from twin.model.dataset import coefficients
from twin.monitor import isolation
from twin.monitor.isolation import Isolation
from twin.monitor.monitor import Monitor
from twin.signals import MBAR, Samples

CYCLES = 12
SEED = 280002  # of a rig, the first of the trial's that has no other doubts
# One program does not tell how these act: that must be among the look-alikes that are named.
AMONG = {"filling_silencer", "sensor_thermal_drift"}


@cache
def commissioned() -> battery_second.Met:
    """The rig with the twin that a person gets of it."""
    met = battery_second.drawn(SEED, battery_second.CADENCES)
    assert met is not None
    unit = battery_second.with_unit(met, battery_second.commissioned(met))
    assert unit is not None
    return unit


@pytest.mark.slow
@pytest.mark.timeout(1200)  # a commissioning, on a computer that does other things beside
@pytest.mark.parametrize(
    "effect", ["filling_silencer", "blow_off_valve_leak", "sensor_thermal_drift"]
)
def test_what_is_hidden_is_found_with_its_place_and_its_way_of_acting(effect: str) -> None:
    met = commissioned()
    rng = np.random.default_rng([SEED, list(battery_second.OUTSIDE).index(effect)])
    size = battery_second.draw_size(rng, met.rig, effect)
    (size_name, *_) = battery_second.faults.OUTSIDE[effect]
    fault = battery_second.Fault(effect, {size_name: size})
    logged = battery_second.record(met.rig, 100 * SEED + 2_000_000, CYCLES, [fault])
    assert met.unit is not None
    is_told(effect, found_alone(met.unit, met.person.samples(logged)), AMONG)


@cache
def morning(mbar: float, kelvins: float) -> Samples:
    """Five hours of healthy cycles, and after a night five in other weather, with a barometer."""
    met, segments = commissioned(), list[Samples]()
    assert met.unit is not None
    calibrated = float(coefficients(met.unit.data)[c.AMBIENT])
    hours = [*np.arange(0.0, 5.0, 0.5).tolist(), *np.arange(16.0, 21.0, 0.5).tolist()]
    for number, hour in enumerate(hours):
        shift, warmer = (mbar * MBAR, kelvins) if hour > 10.0 else (0.0, 0.0)
        here = met.rig.surroundings
        here = replace(
            here,
            ambient_pressure=here.ambient_pressure + shift,
            ambient_temperature=here.ambient_temperature + warmer,
        )
        rig = replace(met.rig, surroundings=here)
        rows = met.person.samples(battery_second.record(rig, SEED + number, 4)).copy()
        if rig.sensor.gauge:
            rows["pressure"] += np.float32(shift)  # its ambient pressure was the calibration's
        rows["ambient"] = calibrated + shift
        segments.append(rows)
    return day(segments, hours)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize(("mbar", "kelvins"), [(-12.0, 0.0), (0.0, -8.0)])
def test_other_weather_in_the_morning_is_no_alarm(
    mbar: float, kelvins: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rig follows pressure and temperature of the air in another way than the model."""
    unit = commissioned().unit
    assert unit is not None

    def alarms() -> int:
        days, healthy = unit.monitor.false_alarm_days, unit.monitor.healthy
        judging = Isolation.of(unit.data, healthy, days)
        monitor = Monitor(unit.monitor, coefficients(unit.data), isolation=judging)
        seen = rigs.Collect()
        run(rigs.cut(morning(mbar, kelvins), 5000), Twin.of(unit.data), monitor, [seen])
        return len(seen.of(Kind.DEVIATION))

    assert alarms() == 0
    monkeypatch.setattr(isolation, "DAY", 0.0)
    assert alarms() > 0
