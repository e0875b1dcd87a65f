"""What nobody listed is found in the second world, too, on a rig that was commissioned first."""

from functools import cache

import numpy as np
import pytest
from test_hidden_mechanisms import found_alone, is_told

from tools import battery_second

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
