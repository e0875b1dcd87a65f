"""The gain on another log: of the same leaky rig, with suction twice as long, never seen before."""

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rigs
from command_line import twin

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import with_truth
from twin.config import Config
from twin.diagnosis import another_log
from twin.diagnosis import answer as answer_module
from twin.diagnosis.another_log import (
    PHASES,
    _other_program,
    _phases,
    conditions,
    judged_on,
    program,
)
from twin.diagnosis.answer import Diagnosis
from twin.diagnosis.evidence import Evidence, collect
from twin.diagnosis.text import on_another_log
from twin.errors import ConfigError
from twin.live import Twin, run
from twin.log.header import LogHeader
from twin.log.recorder import Recorder
from twin.model.courses import Cause
from twin.model.dataset import DataSet, coefficients
from twin.model.effects import apply
from twin.model.plant import suction_at
from twin.model.term import Term
from twin.signals import MBAR, SAMPLE, Command, Samples


def recorded(longer: float, seed: int, *faults: str, supply_bar: float = 5.0) -> Samples:
    """The gripper with so many times its suction."""
    rig = rigs.config("gripper").document.section(PlcSettings, "plc")
    program = rig.program.model_copy(update={"suction_ms": longer * rig.program.suction_ms})
    ejector = rig.ejector.model_copy(update={"supply_bar": supply_bar})
    rig = rig.model_copy(update={"program": program, "ejector": ejector})
    parts = with_truth(rig, 20.0, [parse_fault(fault) for fault in faults], seed)
    return np.concatenate([samples for samples, _ in parts])


def logged(path: Path, samples: Samples, config: Config | None = None) -> Path:
    sinks = [Recorder(path, (config or rigs.config("gripper")).log_header())]
    run(rigs.cut(samples, 1000), rigs.twin("gripper"), rigs.monitor("gripper"), sinks)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    logged(folder / "one.mcap", recorded(1.0, 5, "leakage=2"))
    logged(folder / "longer.mcap", recorded(2.0, 6, "leakage=2"))
    logged(folder / "healthy.mcap", recorded(1.0, 7))
    logged(folder / "short.mcap", recorded(1.0, 8, "leakage=2")[:1500])
    return folder


@pytest.mark.slow
def test_what_was_found_holds_for_another_program(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("--judge-on", folder / "longer.mcap", "--json", folder / "answer.json")
    assert twin(monkeypatch, "diagnose", folder / "one.mcap", *asked) == 0
    judged = json.loads((folder / "answer.json").read_text())["judged_on"]
    assert judged["log"].endswith("longer.mcap")
    assert judged["cycles"] >= 5
    assert judged["gain"]["rms_reduction_pct"] > 80.0
    assert judged["gain"]["low95"] > 70.0
    assert judged["extended"]["leftover_sigma"] < 1.4 < judged["baseline"]["leftover_sigma"]
    said = capsys.readouterr().out
    assert f"longer.mcap, {judged['cycles']} cycles on which nothing was chosen" in said
    assert "gain there" in said


def test_of_a_unit_that_has_nothing_nothing_is_judged(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("--judge-on", folder / "longer.mcap", "--json", folder / "healthy.json")
    assert twin(monkeypatch, "diagnose", folder / "healthy.mcap", *asked) == 0
    assert json.loads((folder / "healthy.json").read_text())["judged_on"] is None
    assert "nothing is judged on it: the data set there is fits already" in capsys.readouterr().out


@pytest.mark.slow
def test_a_log_without_a_cycle_to_judge_by_is_told(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("diagnose", folder / "one.mcap", "--judge-on", folder / "short.mcap")
    assert twin(monkeypatch, *asked) == 3
    assert "short.mcap: nothing can be judged on it: " in capsys.readouterr().err


# --- under the conditions of the other log --------------------------------------------------------


@cache
def evidence() -> Evidence:
    """The leaky gripper in its usual program."""
    return collect(rigs.config("gripper"), [recorded(1.0, 5, "leakage=2")])


def found(*terms: Term, leak: float = 2.0) -> Diagnosis:
    """A diagnosis that found the leak, and curves from data."""
    size = {"value": leak, "unit": "sl/min", "low95": leak - 0.1, "high95": leak + 0.1}
    causes = (Cause("leakage", {"sonic_flow": leak}),) if leak else ()
    told = [{"effect": "leakage", "parameters": {"sonic_flow": size}} for _ in causes]
    answer = {"verdict": "explained", "causes": told}
    return Diagnosis(evidence(), "hash", None, causes, terms, None, None, [], answer)


def test_a_data_set_at_another_supply_is_as_after_a_drop_of_it() -> None:
    own, samples = rigs.config("gripper").data, rigs.recorded("gripper", 6.0)[0]
    for drop in (0.8, 1.5):
        dropped = apply(coefficients(own), "supply_pressure_drop", {"drop": drop})
        thetas = dropped, coefficients(own.at_supply(5.0 - drop)), coefficients(own)
        as_dropped, lower, before = (
            Twin(theta, rigs.detector("gripper")).advance(samples)[1]["expected"]
            for theta in thetas
        )
        assert np.nanmax(np.abs(as_dropped - lower)) < 0.01 * np.nanmax(np.abs(lower - before))
    assert own.at_supply(5.0) == own


def test_a_higher_supply_lowers_the_end_pressure_by_the_law_of_the_type() -> None:
    """The law that a diagnosis tries is that of a supply below nominal."""
    own = rigs.config("gripper").data
    steep = own.ejector.model_copy(update={"end_follows_supply": 6.0})
    tried = own.model_copy(update={"ejector": steep})

    def end(data: DataSet, supply: float) -> float:
        return data.at_supply(supply).ejector.end_pressure_mbar

    assert end(tried, 5.9) == end(own, 5.9) < own.ejector.end_pressure_mbar
    assert end(tried, 4.5) > end(own, 4.5) > own.ejector.end_pressure_mbar


def changed(**tables: Mapping[str, Any]) -> Config:
    """The gripper's configuration with other values in its data set."""
    config = rigs.config("gripper")
    data = config.data.model_dump()
    for table, values in tables.items():
        data[table] |= values
    return replace(config, data=DataSet.model_validate(data))


def under(other: Config, config: Config | None = None) -> Config:
    own = rigs.config("gripper")
    named = ("one.mcap", own.log_header()), ("other.mcap", other.log_header())
    return conditions(config or own, *named)


def smaller_cup() -> Config:
    parts = rigs.config("gripper").data.model_dump()["system"]["parts"]
    parts[-1]["volume_ml"] *= 0.7
    return changed(system={"parts": parts})


def test_the_other_logs_supply_parts_and_sensor_hold_for_it() -> None:
    own = rigs.config("gripper").data
    weaker = under(changed(supply={"pressure_bar": 4.0})).data
    assert weaker == own.at_supply(4.0)
    assert weaker.system == own.system
    assert under(smaller_cup()).data.system.parts == smaller_cup().data.system.parts
    gauge = {"sensor": {"reference": "gauge"}, "ambient": {"pressure_mbar": 963.0}}
    assert under(changed(**gauge)).is_gauge
    there = under(changed(**gauge)).data
    assert there.ambient.pressure_mbar == 963.0
    ratio = 963.0 / own.ambient.pressure_mbar  # the jet of that day, as in the model
    shifted = apply(
        coefficients(own), "ambient_pressure", {"shift": 963.0 - own.ambient.pressure_mbar}
    )
    assert suction_at(coefficients(there), 500.0 * MBAR) == pytest.approx(
        suction_at(shifted, 500.0 * MBAR), rel=0.02
    )
    assert there.ejector.end_pressure_mbar == pytest.approx(own.ejector.end_pressure_mbar * ratio)
    absolute = under(changed(ambient={"pressure_mbar": 963.0}))
    assert absolute.data.ambient == own.ambient  # it would only say that the weather differs


def test_what_both_logs_say_alike_does_not_undo_another_configuration() -> None:
    """Both were recorded with a wrong supply; --config has the right one."""
    right = changed(supply={"pressure_bar": 4.5})
    assert under(rigs.config("gripper"), right).data == right.data
    assert under(smaller_cup(), right).data.supply.pressure_bar == 4.5


def test_a_log_without_a_configuration_says_only_what_its_pressure_counts_from() -> None:
    own = rigs.config("gripper")
    bare = LogHeader("compact-ejector-35", "gripper-01", "", "", {"counted_from": "ambient"})
    there = conditions(own, ("one.mcap", own.log_header()), ("other.mcap", bare))
    assert there.is_gauge
    assert there.data.supply == own.data.supply


def test_a_supply_that_the_twin_cannot_have_is_refused() -> None:
    sagging = changed(supply={"droop_bar": 1.0})
    with pytest.raises(ConfigError, match=r"other\.mcap: the twin cannot have the supply"):
        under(changed(supply={"pressure_bar": 0.9}), sagging)


def test_on_another_supply_the_twin_is_judged_with_that_supply() -> None:
    """Without it the unchanged twin is off by the supply, and the leak seems to gain little."""
    log = recorded(1.0, 6, "leakage=2", supply_bar=4.2)
    log["supply"] = np.nan  # nobody measured it
    there = under(changed(supply={"pressure_bar": 4.2}))
    judged = judged_on(found(), rigs.config("gripper"), "other.mcap", [log], there)
    without = judged_on(found(), rigs.config("gripper"), "other.mcap", [log])
    assert judged is not None
    assert without is not None
    assert judged["extended"]["rms_mbar"] < 0.5 * without["extended"]["rms_mbar"]
    assert judged["gain"]["rms_reduction_pct"] > without["gain"]["rms_reduction_pct"]
    assert judged["left_out"] is None


def test_a_log_of_a_gauge_sensor_is_judged_as_one() -> None:
    """On a day of 963 mbar, which its configuration says."""
    log = recorded(1.0, 6, "leakage=2", "ambient_pressure=-50")
    gauge = {"sensor": {"reference": "gauge"}, "ambient": {"pressure_mbar": 963.0}}
    judged = judged_on(found(), rigs.config("gripper"), "o.mcap", [log], under(changed(**gauge)))
    without = judged_on(found(), rigs.config("gripper"), "o.mcap", [log])
    assert judged is not None
    assert without is not None
    assert judged["extended"]["rms_mbar"] < 0.5 * without["extended"]["rms_mbar"]


# --- curves from data -----------------------------------------------------------------------------

CURVE = Term(where="suction", over="vacuum", at=(0.0, 700.0), mbar=(0.0, 30.0))


def test_a_curve_is_not_carried_to_another_program() -> None:
    config = rigs.config("gripper")
    longer = judged_on(found(CURVE), config, "longer.mcap", [recorded(2.0, 6, "leakage=2")])
    plain = judged_on(found(), config, "longer.mcap", [recorded(2.0, 6, "leakage=2")])
    assert longer is not None
    assert plain is not None
    assert longer["extended"] == plain["extended"]
    (there, here) = re.findall(
        r"suction lasts (\d+) ms there and (\d+) ms here", longer["left_out"]
    )[0]
    told = rigs.config("gripper").document.section(PlcSettings, "plc").program.suction_ms
    assert (int(there), int(here)) == (pytest.approx(2.0 * told, abs=3), pytest.approx(told, abs=3))
    assert "idle" not in longer["left_out"]
    text = on_another_log({"judged_on": longer}, "")
    assert f"left out       {longer['left_out']}" in text
    assert "left out" not in on_another_log({"judged_on": plain}, "")


@pytest.mark.parametrize(("later_ms", "left_out"), [(10, False), (30, True)])
def test_a_command_that_is_seen_a_row_later_is_no_other_program(
    later_ms: int, left_out: bool
) -> None:
    """Rows come 10 ms apart."""
    rows = np.arange(0, 1000, 10)

    def of(end_ms: int) -> Any:
        samples = np.zeros(len(rows), SAMPLE)
        samples["time_ns"] = rows * 1_000_000
        samples["commands"][(rows >= 100) & (rows < end_ms)] = Command.SUCTION
        samples["commands"][(rows >= end_ms) & (rows < 700)] = Command.BLOW_OFF
        return SimpleNamespace(samples=samples, starts=np.array([0, len(rows)]), judged=[0])

    here = SimpleNamespace(evidence=of(400))
    assert bool(_other_program(here, of(400 + later_ms))) is left_out  # type: ignore[arg-type]


def test_a_curve_alone_gains_nothing_on_another_program() -> None:
    log = recorded(2.0, 6, "leakage=2")
    judged = judged_on(found(CURVE, leak=0.0), rigs.config("gripper"), "longer.mcap", [log])
    assert judged is not None
    assert judged["extended"] == judged["baseline"]
    assert judged["gain"]["rms_reduction_pct"] == 0.0
    assert judged["left_out"]


def test_a_curve_holds_on_the_same_program() -> None:
    config, log = rigs.config("gripper"), recorded(1.0, 6, "leakage=2")
    judged = judged_on(found(CURVE), config, "same.mcap", [log])
    plain = judged_on(found(), config, "same.mcap", [log])
    assert judged is not None
    assert plain is not None
    assert judged["left_out"] is None
    assert judged["extended"]["rms_mbar"] != plain["extended"]["rms_mbar"]


def test_a_program_is_how_long_each_command_lasts() -> None:
    told = rigs.config("gripper").document.section(PlcSettings, "plc").program
    wanted = [told.suction_ms, told.blow_off_ms, told.idle_ms]
    assert program(evidence()) == pytest.approx(wanted, abs=3.0)


# --- by the command line --------------------------------------------------------------------------


def test_the_log_of_another_unit_is_refused_before_the_work(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = rigs.config("gripper")
    asset = config.asset.model_copy(update={"id": "gripper-02"})
    other = tmp_path / "b.mcap"
    logged(other, recorded(1.0, 8)[:1500], replace(config, asset=asset))
    monkeypatch.setattr(answer_module, "diagnose", lambda *_, **__: pytest.fail("it ran"))
    assert twin(monkeypatch, "diagnose", folder / "one.mcap", "--judge-on", other) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "b.mcap is a log of compact-ejector-35 gripper-02, not of" in said
    assert "cannot be judged on another" in said
    with pytest.raises(
        pytest.fail.Exception, match="it ran"
    ):  # a person may say that it is the same
        twin(
            monkeypatch, "diagnose", folder / "one.mcap", "--judge-on", other, "--id", "gripper-01"
        )


def test_the_command_line_hands_on_what_the_other_log_says(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "weaker.mcap"
    logged(other, recorded(1.0, 8)[:1500], changed(supply={"pressure_bar": 4.2}))
    handed: list[Config] = []

    def judged(*given: Any) -> None:
        handed.append(given[4])

    monkeypatch.setattr(another_log, "judged_on", judged)
    assert twin(monkeypatch, "diagnose", folder / "short.mcap", "--judge-on", other) == 0
    assert [config.data.supply.pressure_bar for config in handed] == [4.2]


@pytest.mark.parametrize(("duty", "count"), [(2.0, 200), (3.1, 130), (40.0, PHASES)])
def test_a_short_pulse_is_tried_at_four_phases_in_it(duty: float, count: int) -> None:
    values = {"drop": 1.0, "period": 10.0, "shift": 0.0}
    assert _phases(Cause("supply_pulsed", {**values, "duty": duty})) == count
    assert _phases(Cause("supply_swinging", values)) == PHASES
