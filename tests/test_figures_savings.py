"""What another setting would save, against the rig set so; what breaks H2 is not offered."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rigs
from nozzle_air import taken
from test_figures_costs import PRICE, logged

from twin.errors import ConfigError
from twin.figures.costs import NO_PRICE, Tariff
from twin.figures.key_figures import Unit
from twin.figures.savings import LEAST_MARGIN, MOST_CYCLES, Prediction, Savings, Setting, savings
from twin.figures.savings_text import NOT_KNOWN, UNCERTAIN, savings_plain, savings_table
from twin.figures.settings import FigureSettings
from twin.figures.simulated import Program, simulated, spread, whole_cycles
from twin.model.dataset import DataSet, coefficients
from twin.monitor.healthy import Healthy
from twin.signals import Command

Run = Callable[..., str]
SECONDS = 40.0


@cache
def program(name: str) -> Program:
    samples, _ = rigs.recorded(name, SECONDS)
    return Program.of_cycles(spread(whole_cycles(rigs.twin(name).over([samples])), MOST_CYCLES))


@cache
def predicted(name: str) -> Savings:
    config = rigs.config(name)
    return savings(Unit(config.data, 0.12), config.monitor.healthy, program(name))


def changed(name: str, **ejector: object) -> DataSet:
    """The data set of a unit with other values of its ejector."""
    tables = rigs.config(name).data.model_dump()
    return DataSet.model_validate(tables | {"ejector": tables["ejector"] | ejector})


def unknown(data: DataSet, commands: Program) -> Savings:
    """Predicted without an uncertainty, which is quicker."""
    return savings(Unit(data, 0.12), Healthy(), commands)


def of(found: Savings, h1: float, hysteresis: float, supply: float = 5.0) -> Prediction:
    setting = Setting(h1, hysteresis, supply)
    return next(prediction for prediction in found.others if prediction.setting == setting)


@pytest.mark.slow
@pytest.mark.parametrize("name", rigs.NAMES)
@pytest.mark.parametrize(("h1", "hysteresis"), [(710.0, 150.0), (700.0, 100.0)])
def test_the_rig_set_so_takes_as_much_less(name: str, h1: float, hysteresis: float) -> None:
    setting = {"h1_mbar": h1, "h1_hysteresis_mbar": hysteresis}
    now = np.mean([taken(name, SECONDS, seed=seed) for seed in (1, 2)])
    then = np.mean([taken(name, SECONDS, seed=seed, control=setting) for seed in (1, 2)])
    prediction = of(predicted(name), h1, hysteresis)
    assert not prediction.refused
    assert prediction.saved.is_sure
    assert prediction.saved.low95 <= now - then <= prediction.saved.high95


@pytest.mark.parametrize("name", rigs.NAMES)
def test_the_rig_takes_what_the_model_says_now(name: str) -> None:
    assert predicted(name).now.air == pytest.approx(taken(name, SECONDS), rel=0.02)
    assert predicted(name).now.saved == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("name", rigs.NAMES)
def test_what_is_offered_keeps_h2(name: str) -> None:
    offered = predicted(name).offered
    h2 = rigs.config(name).data.ejector.h2_mbar
    assert len(offered) >= 5
    for prediction in offered:
        assert prediction.margin.low95 >= LEAST_MARGIN
        assert prediction.setting.h1 - prediction.setting.hysteresis >= h2 + LEAST_MARGIN
        assert math.isfinite(prediction.t0 + prediction.t1)
    saved = [prediction.saved.value for prediction in offered]
    assert saved == sorted(saved, reverse=True)


def test_a_hold_that_would_come_below_h2_is_refused() -> None:
    refused = of(predicted("test_rig"), 670.0, 150.0).refused
    assert refused.startswith("in a longer hold the nozzle goes on again at 520 mbar")


def test_a_valve_that_would_wear_is_refused() -> None:
    refused = of(predicted("gripper"), 650.0, 50.0).refused
    assert refused.startswith("valve protection: ")


def test_a_supply_that_would_lose_h1_or_h2_is_refused() -> None:
    weak = changed("test_rig", end_pressure_mbar=200.0)
    refused = of(unknown(weak, program("test_rig")), 750.0, 150.0, 4.0).refused
    assert refused.startswith("H1 is not reached in ")
    short = changed("test_rig", h1_mbar=760.0, h2_mbar=600.0, air_saving="off", bulge=0.0)
    commands = shortened(program("test_rig"), short)
    refused = of(unknown(short, commands), 760.0, 150.0, 4.0).refused
    assert refused.startswith("H2 is not reached in ")


def shortened(commands: Program, data: DataSet) -> Program:
    """The program with suction that ends soon after H2."""
    cycles = simulated(coefficients(data), Unit(data, 0.12), commands)
    last = 1.15e-3 * max(cycle.figures["t0"] for cycle in cycles)  # gas stays warmer then
    bits = commands.commands.copy()
    for first, behind in zip(commands.starts[:-1], commands.starts[1:], strict=True):
        rows = slice(first, behind)
        late = np.cumsum(commands.steps[rows]) > last
        bits[rows][late] &= ~np.uint8(Command.SUCTION)
    return replace(commands, commands=bits)


def test_without_air_saving_only_the_supply_is_tried() -> None:
    found = unknown(changed("test_rig", air_saving="off"), program("test_rig"))
    settings = [prediction.setting for prediction in found.others]
    assert [(setting.h1, setting.hysteresis) for setting in settings] == [(750.0, 150.0)] * 2
    assert found.now.air > predicted("test_rig").now.air


def test_a_program_that_does_not_reach_h2_is_refused() -> None:
    idle = program("test_rig")
    idle = replace(idle, commands=np.zeros_like(idle.commands))
    with pytest.raises(ConfigError, match="does not reach H2"):
        unknown(rigs.config("test_rig").data, idle)


def test_of_a_unit_that_was_not_calibrated_no_uncertainty_is_told() -> None:
    found = unknown(rigs.config("gripper").data, program("gripper"))
    tariff = Tariff.of(FigureSettings(price_per_m3=0.036))
    text = savings_table(found, 1e6, tariff, [])
    assert math.isnan(found.others[0].saved.low95)
    assert NOT_KNOWN in text
    assert UNCERTAIN not in text
    assert "the log does not tell its own air" in text
    plain = savings_plain(found, 1e6, tariff, [])
    assert plain["offered"][0]["saved_nl"]["low95"] is None
    assert plain["uncertainty_is_known"] is False


def test_another_cadence_gives_the_same_air() -> None:
    samples, _ = rigs.recorded("test_rig", SECONDS)
    cycles = list(whole_cycles(rigs.twin("test_rig").over([samples])))
    slow = [replace(cycle, samples=cycle.samples[::5]) for cycle in cycles]
    unit = Unit(rigs.config("test_rig").data, 0.12)
    air = [
        [cycle.figures["air"] for cycle in simulated(coefficients(unit.data), unit, commands)]
        for commands in (Program.of_cycles(cycles), Program.of_cycles(slow))
    ]
    assert np.mean(air[1]) == pytest.approx(np.mean(air[0]), rel=0.01)


def test_of_many_cycles_some_are_taken_evenly() -> None:
    samples, _ = rigs.recorded("gripper", SECONDS)
    cycles = list(whole_cycles(rigs.twin("gripper").over([samples])))
    some = [cycle.index for cycle in spread(iter(cycles), 6)]
    assert 3 <= len(some) <= 6
    assert len(set(np.diff(some))) == 1
    assert spread(cycles[:3], 6) == cycles[:3]


# The command.


@pytest.mark.slow
def test_savings_are_told_with_how_sure_they_are(figures: Run, tmp_path: Path) -> None:
    out = figures("savings", logged(tmp_path / "run.mcap", PRICE), "--json", "s.json")
    head, now, *_ = out.splitlines()
    assert "saves (€ a year)" in head
    assert now.startswith("now: H1 750, hysteresis 150 mbar, 5 bar")
    assert "not offered: H1 670, hysteresis 150 mbar, 5 bar: in a longer hold" in out
    assert UNCERTAIN in out
    content = json.loads(Path("s.json").read_text())
    assert content["now"]["air_nl"] == pytest.approx(content["measured_air_nl"], rel=0.03)
    best = content["offered"][0]
    year = content["cycles_per_year"] * best["saved_nl"]["value"]
    assert best["saved_money"]["value"] == pytest.approx(year / 1e3 * 0.036, rel=1e-3)
    assert all(change["why_not"] for change in content["refused"])


def test_without_a_price_savings_are_in_air(figures: Run, tmp_path: Path) -> None:
    out = figures("savings", logged(tmp_path / "run.mcap", ""))
    assert "saves (m³ a year)" in out
    assert out.splitlines()[-1] == NO_PRICE


def test_a_log_without_a_complete_cycle_is_refused(figures: Run, tmp_path: Path) -> None:
    from twin.live import run as run_loop
    from twin.log.recorder import Recorder

    path = tmp_path / "idle.mcap"
    sinks = [Recorder(path, rigs.config("gripper").log_header())]
    rows = rigs.recorded("gripper", 6.0)[0][:400]
    run_loop([rows], rigs.twin("gripper"), rigs.monitor("gripper"), sinks)
    with pytest.raises(ConfigError, match="no complete cycle"):
        figures("savings", path)
    assert "a year: unknown, the log has fewer than two cycles" in figures("costs", path)
