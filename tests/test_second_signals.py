"""A flow meter narrows the scale of a commissioning."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from calibrations import quiet
from second_rigs import config_of, with_signals
from second_world.draw import draw_rig
from second_world.records import Record, record

from twin.calibration import commission as module
from twin.calibration.commission import as_metered, commission
from twin.calibration.readings import Readings, read
from twin.config import Config
from twin.model.dataset import DataSet
from twin.model.system import Cups, Filter, Sensor, Tube, Vessel
from twin.signals import ML, Samples

# Seeds of the second world: a gripper, a tank without air saving, a closed tank.
RIGS = (80005, 80033, 80040)
SOFT_CUPS = 80003
SEED = RIGS[0]


@cache
def logged(seed: int) -> Record:
    return record(draw_rig(seed), seed, 7)


def evacuated(seed: int) -> float:
    """Volume (m³) behind the ejector, as it is at ambient pressure."""
    rig = logged(seed).truth.rig
    hose = np.pi / 4.0 * rig.line.line_diameter**2 * rig.line.line_length
    return float(rig.vessel.rigid_volume + rig.vessel.cup_volume + hose)


def temperature(seed: int) -> float:
    return logged(seed).truth.rig.surroundings.ambient_temperature


# The flow.


@pytest.mark.parametrize("slow_ms", [0.0, 5.0, 30.0])
@pytest.mark.parametrize("seed", RIGS)
def test_a_flow_meter_tells_the_evacuated_volume(seed: int, slow_ms: float) -> None:
    """With gas that cools, a wall that warms it, a leak, and a meter that is behind."""
    readings = read(with_signals(logged(seed), slow_ms))
    assert readings.evacuated(temperature(seed)) == pytest.approx(evacuated(seed), rel=0.1)


def test_a_reading_for_each_block_suffices_where_the_evacuation_takes_longer() -> None:
    seed = RIGS[2]
    samples = with_signals(logged(seed), 0.0)
    samples["reported"][np.arange(len(samples)) % 30 > 0] = 0
    assert read(samples).evacuated(temperature(seed)) == pytest.approx(evacuated(seed), rel=0.1)


def test_it_tells_none_where_the_volume_is_not_one_number() -> None:
    assert np.isnan(read(with_signals(logged(SOFT_CUPS), 0.0)).stored)


def test_nor_where_it_reads_something_else() -> None:
    samples = with_signals(logged(SEED))
    samples["flow"] = np.abs(np.random.default_rng(1).normal(0.0, 1e-3, len(samples)))
    assert np.isnan(read(samples).stored)
    samples["reported"] = 0
    assert np.isnan(read(samples).stored)


def told(*parts: Tube | Sensor | Filter | Vessel | Cups) -> DataSet:
    data = config_of(logged(SEED).truth.readable).data
    return data.model_copy(update={"system": data.system.model_copy(update={"parts": parts})})


HOSE = Tube(kind="tube", length_mm=1000.0, diameter_mm=6.0)  # 28.3 ml
REST = (Filter(kind="filter", pressure_drop_mbar=5.0, volume_ml=20.0), Sensor(kind="sensor"))
CUPS = Cups(kind="cups", volume_ml=30.0, count=6)


def metered(volume_ml: float) -> Readings:
    """Readings of a flow meter that tells so much, at 20 °C."""
    found = read(with_signals(logged(SEED)))
    return replace(found, stored=found.stored * volume_ml * ML / found.evacuated(293.15))


def test_what_is_no_tube_takes_the_volume_that_is_metered_and_the_line_is_said() -> None:
    data = told(*REST, HOSE, CUPS)
    found, (remark,) = as_metered(data, metered(328.3))
    filtering, _, hose, cups = found.system.parts
    assert (filtering.volume_ml, cups.volume_ml) == pytest.approx((30.0, 45.0), rel=1e-3)
    assert hose == HOSE
    assert remark.text == "by the flow meter 328 ml are evacuated; the configuration says 228"
    assert 'kind = "cups", volume_ml = 45' in remark.line
    again, remarks = as_metered(found, metered(328.3))
    assert (again, remarks) == (found, [])


@pytest.mark.parametrize("volume_ml", [202.0, 255.0, 35.0, float("nan")])
def test_a_volume_that_is_nearly_as_told_stays_and_one_that_tubes_alone_exceed(
    volume_ml: float,
) -> None:
    data = told(*REST, HOSE, CUPS)
    assert as_metered(data, metered(volume_ml)) == (data, [])


class FitReachedError(Exception):
    """What a commissioning would fit."""

    def __init__(self, samples: Samples, guess: DataSet) -> None:
        self.samples, self.guess = samples, guess


def fitted_on(monkeypatch: pytest.MonkeyPatch, config: Config, samples: Samples) -> FitReachedError:
    """What a commissioning hands to its fit."""

    def stop(used: Samples, guesses: list[DataSet], _: object) -> None:
        raise FitReachedError(used, guesses[0])

    monkeypatch.setattr(module, "_fit", stop)
    with pytest.raises(FitReachedError) as reached:
        commission(config, [samples], quiet)
    return reached.value


@pytest.mark.parametrize(("times", "used"), [(1.0, True), (10.0, False)])
def test_a_commissioning_goes_by_the_flow_unless_it_contradicts(
    times: float, used: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, samples = config_of(logged(SEED).truth.readable), with_signals(logged(SEED))
    *others, cups = config.data.system.parts
    cups = cups.model_copy(update={"volume_ml": 1.3 * evacuated(SEED) / ML})
    config = replace(config, data=told(*others, cups))
    samples["flow"] *= times
    last = fitted_on(monkeypatch, config, samples).guess.system.parts[-1]
    assert isinstance(last, Cups)
    assert (last.volume_ml < 0.9 * cups.volume_ml) == used
