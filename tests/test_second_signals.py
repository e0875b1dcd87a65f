"""A flow meter narrows the scale of a commissioning, a second pressure its line."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from calibrations import quiet
from second_rigs import config_of, with_signals
from second_world.draw import draw_rig
from second_world.records import Record, record

from twin.calibration import commission as module
from twin.calibration import fit as fitting
from twin.calibration.commission import as_metered, commission, guessed, starts
from twin.calibration.cycles import LAG, SPAN, ZERO, Cycles
from twin.calibration.fit import Fitted, Round, fit_from_afar, second_noise
from twin.calibration.flow_meter import stored
from twin.calibration.readings import Readings, read
from twin.calibration.residual_covariance import plain, weighted
from twin.config import Config
from twin.model import kernel
from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients, sensor_place
from twin.model.parts import Cups, Filter, Sensor, Tube, Vessel
from twin.signals import MBAR, ML, MS, Reported, Samples

# Seeds of the second world: a gripper, a tank without air saving, a closed tank.
RIGS = (80005, 80033, 80040)
SOFT_CUPS = 80003
SEED = RIGS[0]


@cache
def logged(seed: int) -> Record:
    return record(draw_rig(seed), seed, 6)


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


@pytest.mark.parametrize("wall", [0.0, 0.5, 2.0])
def test_gas_that_cools_and_gas_that_a_wall_warms_tell_the_same_volume(wall: float) -> None:
    """A litre in steps of 0.1 ms; ``wall`` is in W/K, and warms up for half a second at the end."""
    pressure, temperature, air = 100e3, 293.15, 287.05
    rows = []
    for step in range(10_000):
        draws = max(pressure / 100e3 - 0.3, 0.0) if step < 5000 else 0.0
        flow, mass = 5e-3 * draws, pressure * 1e-3 / (air * temperature)
        rows.append((step * 1e-4, pressure, flow))
        heat = 0.4 * wall * (293.15 - temperature)
        pressure += 1e-4 / 1e-3 * (heat - 1.4 * air * temperature * flow)
        temperature = pressure * 1e-3 / (air * (mass - 1e-4 * flow))
    suction = np.array(rows[::10]).T
    found = stored([(suction[0], suction[1], suction[2])] * 3)
    assert found == pytest.approx(1e-3 / (air * 293.15), rel=0.05)


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


@pytest.mark.parametrize(("told_within", "within"), [(1.25, 1.15), (1.02, 1.02)])
@pytest.mark.parametrize("volume_ml", [230.0, 328.3])
def test_with_a_flow_meter_volumes_are_at_least_as_exact_as_it(
    volume_ml: float, told_within: float, within: float
) -> None:
    data = told(*REST, HOSE, CUPS)
    system = data.system.model_copy(update={"volumes_within_factor": told_within})
    found, _ = as_metered(data.model_copy(update={"system": system}), metered(volume_ml))
    assert found.system.volumes_within_factor == within


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

    def stop(used: Samples, guesses: list[DataSet], *_: object) -> None:
        raise FitReachedError(used, guesses[0])

    monkeypatch.setattr(module, "market_fit", stop)
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
    assert last.volume_ml < 0.9 * cups.volume_ml if used else last == cups


@pytest.mark.parametrize("apart", [0.0, 40.0])
def test_a_second_pressure_that_contradicts_is_not_followed(
    apart: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, samples = config_of(logged(SEED).truth.readable), with_signals(logged(SEED))
    samples["pressure_2"] += apart * MBAR
    used = fitted_on(monkeypatch, config, samples).samples
    assert bool(used["pressure_2"].any()) == (apart == 0.0)
    assert (used["reported"] & np.uint8(Reported.FLOW_KNOWN)).all()


# The second pressure.

LONG_LINE = 80021  # a gripper with its sensor at the ejector, 52 mbar from its cups in suction


def with_sensor_at(data: DataSet, place: float) -> DataSet:
    """The same with the sensor that the PLC reads elsewhere along the line."""
    shift = data.system.sensor_shift + place - sensor_place(data)
    system = data.system.model_copy(update={"sensor_shift": shift})
    return data.model_copy(update={"system": system})


@cache
def first_guess(seed: int) -> DataSet:
    readings = read(with_signals(logged(seed)))
    data, _ = as_metered(config_of(logged(seed).truth.readable).data, readings)
    return guessed(data, readings)[0]


def modelled(seed: int, place: float, slow_ms: float | None = None) -> tuple[Samples, DataSet]:
    """A record whose second pressure is what the model of the first guess has at a place."""
    samples, data = with_signals(logged(seed)), first_guess(seed)
    cycles = Cycles.found(samples, data)
    expected = np.empty((len(samples), 1))
    theta = coefficients(with_sensor_at(data, place)).reshape(-1, 1)
    if slow_ms is not None:
        theta[c.SENSOR_LAG] = slow_ms * MS
    kernel.advance(
        kernel.new_state(1), theta, cycles.dt, cycles.phase, cycles.level, expected, tolerance=1.0
    )
    samples["pressure_2"] = np.nan_to_num(expected[:, 0])
    return samples, data


def test_the_second_pressure_is_that_of_the_end_where_it_is_measured() -> None:
    for end, place in (("port", 0.0), ("vessel", 1.0)):
        samples, data = modelled(LONG_LINE, place)
        second = Cycles.found(samples, data).of_second(end)
        other = Cycles.found(samples, data).of_second("vessel" if end == "port" else "port")
        theta = coefficients(data).reshape(-1, 1)
        right, wrong = (np.abs(evidence.residuals(theta)).max() for evidence in (second, other))
        assert right < 1.0 * MBAR < 5.0 * MBAR < wrong


@pytest.mark.parametrize("slow_ms", [1.0, 5.0])
def test_a_second_sensor_may_be_slower_than_the_first(slow_ms: float) -> None:
    samples, data = modelled(LONG_LINE, 1.0, slow_ms)
    second = Cycles.found(samples, data).of_second("vessel").as_slow(coefficients(data))
    assert second.lag == pytest.approx(slow_ms * MS)
    assert np.abs(second.residuals(coefficients(data).reshape(-1, 1))).max() < 1.0 * MBAR


def test_rows_without_a_second_pressure_are_in_none_of_its_bins() -> None:
    samples, data = modelled(LONG_LINE, 1.0)
    whole = Cycles.found(samples, data).of_second("vessel")
    samples["pressure_2"][5::7] = 0.0
    holes = Cycles.found(samples, data).of_second("vessel")
    assert (holes.bins.number[5::7] == -1).all()
    assert holes.bins.count.sum() < whole.bins.count.sum()
    theta = coefficients(data).reshape(-1, 1)
    assert np.abs(holes.residuals(theta)).max() < 1.0 * MBAR
    assert np.abs(holes.unsure).max() == pytest.approx(np.abs(whole.unsure).max(), rel=0.3)


def test_what_a_second_sensor_may_be_off_by_costs_little() -> None:
    """Its zero, its span and its lag are nobody's finding: one sigma of each costs one at most.

    A drop along the line is a finding.
    """
    samples, data = modelled(LONG_LINE, 1.0)
    first = Cycles.found(samples, data)
    second = first.of_second("vessel")
    sure = replace(second, unsure=second.unsure[:, :0])
    later, sooner = (
        replace(first, samples=np.roll(samples, rows)).of_second("vessel") for rows in (1, -1)
    )
    lagging = LAG / np.median(first.dt) * (later.measured - sooner.measured) / 2.0
    vacuum = second.measured.max() - second.measured
    drop = np.where(second.bins.kind == 1, 10.0 * MBAR, 0.0)  # in suction alone
    theta = coefficients(data)
    for weigh in (
        lambda cycles: plain(cycles, 0.4 * MBAR, 3.0 * MBAR, 0.0),
        lambda cycles: weighted(cycles, theta, 0.4 * MBAR, fitted=False),
    ):

        def cost(cycles: Cycles, off: np.ndarray) -> float:
            white = weigh(cycles).white(off[:, None])  # noqa: B023
            return float(np.sum(np.concatenate(white) ** 2))

        for own in (np.full(len(drop), ZERO), SPAN * vacuum, lagging):
            assert cost(second, own) < 1.0 + 1e-6 < 5.0 < cost(sure, own)
        assert cost(second, drop) > 0.2 * cost(sure, drop)


def test_it_is_followed_where_most_rows_have_one() -> None:
    samples = with_signals(logged(SEED))
    (noise,) = second_noise(samples)
    assert noise == pytest.approx(0.4 * MBAR, rel=0.3)
    samples["pressure_2"][np.arange(len(samples)) % 30 > 0] = 0.0  # one for each block
    assert second_noise(samples) == []


def quickly(samples: Samples, steps: int, monkeypatch: pytest.MonkeyPatch) -> tuple[Fitted, str]:
    """One round, from a guess that has the sensor where it is, and what was told of it."""
    monkeypatch.setattr(fitting, "NARROWING", (Round(1, 1.0, 1.5 * MBAR, steps, 1e-3),))
    monkeypatch.setattr(fitting, "AGAIN", ())
    start = next(
        start for start in starts(first_guess(LONG_LINE), np.nan) if sensor_place(start) < 0.5
    )
    told_of: list[str] = []
    fitted = fit_from_afar(samples, [start], told_of.append)
    return fitted, next((said for said in reversed(told_of) if "second" in said), "")


@pytest.mark.slow
def test_a_second_pressure_narrows_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """The ejector of another world: the chamber at the port and the hose are not the model's."""
    samples = with_signals(logged(LONG_LINE))
    two, said = quickly(samples, 8, monkeypatch)
    samples["pressure_2"] = 0.0
    one, _ = quickly(samples, 8, monkeypatch)
    assert said == "following the second pressure as well"
    number = [free.name for free in two.free].index("system.line_factor")
    before, now = (float(fit.spread[number] / fit.data.system.line_factor) for fit in (one, two))
    assert now < 0.9 * before
    low, high = two.interval("ejector.port_volume_ml")
    assert low < logged(LONG_LINE).truth.rig.ejector.head_volume / ML < high


@pytest.mark.slow
def test_it_is_left_out_where_the_first_would_be_followed_less_well(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    samples = with_signals(logged(LONG_LINE))
    monkeypatch.setattr(fitting, "MOST_WORSE", 0.0)
    two, said = quickly(samples, 2, monkeypatch)
    assert said.startswith("the second pressure is left out")
    samples["pressure_2"] = 0.0
    one, _ = quickly(samples, 2, monkeypatch)
    assert two.data == one.data
    assert (two.spread == one.spread).all()
