"""Thresholds of the control, from when it acts in a record of a nozzle that closes slowly."""

from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
import rigs
from calibrations import quiet, typed

from twin.calibration.commission import _shown, as_switched, commission, guessed, switching_as
from twin.calibration.cycles import Cycles
from twin.calibration.fit import Fitted
from twin.calibration.parameters import Free
from twin.calibration.readings import read
from twin.calibration.thresholds import decided
from twin.model import dense_solver
from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.model.parts import Cups, Tube
from twin.monitor.detector_window import detector_of
from twin.monitor.healthy import Scatter
from twin.monitor.switching_detector import PhaseFinder
from twin.signals import MBAR, MS, SAMPLE, Command, Phase, Samples

SEEDS = range(3)
NOISE = 0.5 * MBAR


def slowly_closing(seed: int) -> DataSet:
    """A small gripper that leaks, whose jet goes on drawing for a while after the nozzle is off."""
    rng = np.random.default_rng(seed)
    data = rigs.config("gripper").data
    h1 = float(rng.integers(640, 700))
    ejector = data.ejector.model_copy(
        update={
            "h1_mbar": h1,
            "h1_hysteresis_mbar": float(rng.integers(60, 90)),
            "ramp_down_ms": float(rng.uniform(60.0, 90.0)),
            "response_off_ms": float(rng.uniform(8.0, 16.0)),
            "end_pressure_mbar": float(rng.uniform(200.0, 230.0)),
            "suction_capacity_sl_min": float(rng.uniform(35.0, 45.0)),
        }
    )
    parts = tuple(
        part.model_copy(update={"volume_ml": 15.0}) if isinstance(part, Cups) else part
        for part in data.system.parts
    )
    tube = next(part for part in parts if isinstance(part, Tube))
    parts = tuple(
        tube.model_copy(update={"length_mm": 1000.0}) if part is tube else part for part in parts
    )
    system = data.system.model_copy(update={"parts": parts, "leak_sl_min": 0.6})
    return data.model_copy(update={"ejector": ejector, "system": system})


@cache
def recorded(seed: int) -> tuple[DataSet, Samples, tuple[tuple[int, bool], ...]]:
    """The gripper, a record of it, and rows at which its nozzle acts, and whether it goes on."""
    data = slowly_closing(seed)
    samples, phase = simulated(data, seed)
    theta = coefficients(data)
    inside = np.isin(phase, (Phase.SUCTION, Phase.HOLD))
    rows = np.flatnonzero((np.diff(phase) != 0) & inside[1:] & inside[:-1]) + 1
    response = np.where(phase[rows] == Phase.SUCTION, theta[c.RESPONSE], theta[c.RESPONSE_OFF])
    acts = rows + np.rint(response / MS).astype(int)
    return (
        data,
        samples,
        tuple(zip(acts.tolist(), (phase[rows] == Phase.SUCTION).tolist(), strict=True)),
    )


def simulated(data: DataSet, seed: int) -> tuple[Samples, npt.NDArray[np.uint8]]:
    """A record of a unit with ``data``, and the phase of each row."""
    theta, rng = coefficients(data), np.random.default_rng([seed, 1])
    cycle = [(0, 400), (Command.SUCTION, 2000), (Command.BLOW_OFF, 300), (0, 300)]
    pieces = [np.full(rows + int(rng.integers(200)), int(command)) for command, rows in 8 * cycle]
    samples = np.zeros(sum(map(len, pieces)), SAMPLE)
    samples["commands"] = np.concatenate(pieces)
    samples["sequence"] = np.arange(len(samples))
    samples["time_ns"] = samples["host_ns"] = 1_000_000 * samples["sequence"]
    phase, expected = dense_solver.simulate(
        theta, np.full(len(samples), MS), np.ascontiguousarray(samples["commands"])
    )
    samples["pressure"] = expected + NOISE * rng.standard_normal(len(samples))
    return samples, phase


def with_turns(data: DataSet, samples: Samples) -> DataSet:
    """``data`` with its thresholds where the pressure turns, as a commissioning first has it."""
    return switching_as(guessed(data, read(samples))[0], data)


def fitted(data: DataSet, samples: Samples) -> DataSet:
    """``data`` with a characteristic that ends where the pressure turns, as on a shared rig.

    The nozzle has begun to close there, so the record does not show how suction goes on.
    """
    turned = with_turns(data, samples).ejector
    end = data.ambient.pressure_mbar - turned.h1_mbar + 1.0
    return data.model_copy(
        update={"ejector": data.ejector.model_copy(update={"end_pressure_mbar": end})}
    )


def as_commissioned(data: DataSet, samples: Samples) -> DataSet:
    """``data`` with its thresholds by the fitted twin, here ``data`` itself."""
    cycles = Cycles.found(samples, data)
    decisions = decided(read(samples), cycles, coefficients(data))
    return switching_as(guessed(data, decisions)[0], data)


def not_seen(data: DataSet, samples: Samples, acts: tuple[tuple[int, bool], ...]) -> int:
    """How many switchings the twin of ``data`` does not see within 15 ms while it runs."""
    finder = PhaseFinder(detector_of(data))
    phase = np.concatenate([finder.push(samples)[1], finder.flush()[1]])
    suction = samples["commands"] == Command.SUCTION
    on = phase == Phase.SUCTION
    rows = [row for row in np.flatnonzero(np.diff(on)) + 1 if suction[row - 1] and suction[row]]
    return sum(
        not any(on[near] == goes_on and abs(near - row) <= 15 for near in rows)
        for row, goes_on in acts
        if suction[row]
    )


def test_a_supply_that_sags_is_no_air_saving() -> None:
    """It gives way by 0.7 bar within 0.3 s, so that the vacuum falls again from its highest."""
    data = slowly_closing(0)
    ejector = data.ejector.model_copy(update={"air_saving": "off"})
    supply = data.supply.model_copy(update={"droop_bar": 0.7, "lag_ms": 300.0})
    samples = simulated(data.model_copy(update={"ejector": ejector, "supply": supply}), 0)[0]
    readings = read(samples)
    assert readings.saves_air, "by the turns of the pressure alone"
    guess = guessed(data, readings)[0]
    readings = as_switched(readings, Cycles.found(samples, guess))
    assert not readings.saves_air
    without = switching_as(guessed(data, readings)[0], guess).ejector
    assert (without.air_saving, without.h1_mbar) == ("off", data.ejector.h1_mbar)
    _, saving, _ = recorded(0)
    readings = read(saving)
    assert as_switched(readings, Cycles.found(saving, guess)) == readings


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_the_threshold_is_where_the_control_decided_and_not_where_the_pressure_turns(
    seed: int,
) -> None:
    data, samples, _ = recorded(seed)
    turned, ejector = with_turns(data, samples).ejector, as_commissioned(data, samples).ejector
    beyond = turned.h1_mbar - data.ejector.h1_mbar
    assert beyond > 30.0
    assert abs(ejector.h1_mbar - data.ejector.h1_mbar) < 0.6 * beyond
    low, true_low = (each.h1_mbar - each.h1_hysteresis_mbar for each in (ejector, data.ejector))
    assert low == pytest.approx(true_low, abs=4.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_a_nozzle_that_closes_slowly_is_seen_while_the_twin_runs(seed: int) -> None:
    data, samples, acts = recorded(seed)
    data = fitted(data, samples)
    assert not_seen(with_turns(data, samples), samples, acts) > 0.3 * len(acts) > 5.0
    assert not_seen(as_commissioned(data, samples), samples, acts) == 0


@pytest.mark.slow
def test_a_commissioned_unit_has_these_thresholds(monkeypatch: pytest.MonkeyPatch) -> None:
    data, samples, _ = recorded(0)

    def fit(_: Samples, __: object, free: tuple[Free, ...], ___: object) -> Fitted:
        certain = 1e-6 * np.eye(len(free))
        nothing = np.zeros(len(free))
        return Fitted(data, free, certain, certain, nothing + 1.0, 0.0, nothing > 0.0)

    monkeypatch.setattr("twin.calibration.commission.market_fit", fit)
    commissioned = commission(replace(typed("gripper"), data=data), [samples], quiet)
    ejector = commissioned.calibration.fitted.data.ejector
    expected = as_commissioned(data, commissioned.samples).ejector
    assert ejector == expected
    assert ejector.h1_mbar < with_turns(data, samples).ejector.h1_mbar - 15.0


def test_a_turn_that_the_record_does_not_show_stays_unknown() -> None:
    data, samples, _ = recorded(0)
    readings = replace(read(samples), on=np.nan)
    decisions = decided(readings, Cycles.found(samples, data), coefficients(data))
    assert np.isnan(decisions.on)
    assert decisions.off > readings.off


def test_a_turn_by_a_wave_in_the_hose_is_no_threshold() -> None:
    data, samples, _ = recorded(0)
    readings, cycles = read(samples), Cycles.found(samples, data)
    rows, goes_on = cycles.switchings
    phase = cycles.phase.copy()
    for row in rows[goes_on]:
        stays_on = phase[row:] == Phase.SUCTION
        phase[row : row + int(np.argmin(stays_on))] = Phase.HOLD
    never_on = replace(cycles, phase=phase)
    assert goes_on.any()
    assert not never_on.switchings[1].any()
    assert np.isfinite(readings.on)
    decisions = decided(readings, never_on, coefficients(data))
    assert np.isnan(decisions.on)
    seen = Scatter(mean=530.0, sigma=0.6, cycles=10)  # while the twin runs
    figures = {"h1_level": seen, "h1_low_level": seen}
    assert _shown(figures, readings) == figures
    assert [*_shown(figures, decisions)] == ["h1_level"]
