"""The gain on another log: of the same leaky rig, with suction twice as long, never seen before."""

import json
from pathlib import Path

import numpy as np
import pytest
import rigs
from command_line import twin

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import with_truth
from twin.live import run
from twin.log.recorder import Recorder
from twin.signals import Samples


def recorded(longer: float, seed: int, *faults: str) -> Samples:
    """The gripper with so many times its suction."""
    rig = rigs.config("gripper").document.section(PlcSettings, "plc")
    program = rig.program.model_copy(update={"suction_ms": longer * rig.program.suction_ms})
    rig = rig.model_copy(update={"program": program})
    parts = with_truth(rig, 20.0, [parse_fault(fault) for fault in faults], seed)
    return np.concatenate([samples for samples, _ in parts])


def logged(path: Path, samples: Samples) -> Path:
    sinks = [Recorder(path, rigs.config("gripper").log_header())]
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
