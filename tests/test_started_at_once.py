"""A run on a new machine: rows are acquired while the model is compiled, and all reach the log."""

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rigs
from command_line import twin
from plc_process import PlcProcess
from test_cli import started
from test_run_many import two_on_one

from twin import acquisition
from twin.cli import compiling
from twin.cli.compiling import COMPILING, Models
from twin.events import Kind
from twin.log.reader import open_log
from twin.signals import Command, Phase, Samples, Ticks

GRIPPER = rigs.path_of("gripper")
PATIENCE_S = 280.0  # with a compiler on a busy machine
S = 1_000_000_000  # ns
WITHOUT_MODEL = "rows are logged without expected pressure"


def logged(path: Path) -> tuple[Samples, Ticks]:
    """All that a finished log has."""
    log = open_log(path)
    assert log.complete
    samples, ticks = zip(*log.blocks(), strict=True)
    return np.concatenate(samples), np.concatenate(ticks)


def missing(samples: Samples) -> int:
    return int((np.diff(samples["sequence"]) - 1).sum())


def told(path: Path) -> list[Kind]:
    return [event.kind for event in open_log(path).events()]


def expected_again(path: Path, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """What a replay of the log says to its rows, with everything compiled."""
    again = path.with_suffix(".again.mcap")
    assert twin(monkeypatch, "replay", path, "-o", again) == 0
    return logged(again)[1].tobytes()


# Runs, with another process in place of the one that compiles.


@pytest.fixture
def nothing_cached(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Models, "_made_from_cache", lambda _models: False)


def compiles_by(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Have a program stand in for the process that compiles."""
    monkeypatch.setattr(compiling, "COMMAND", (sys.executable, "-c", code))


def after(*logs: Path, then: str = "") -> str:
    """A program that does something half a second after logs have begun."""
    paths = [str(log) for log in logs]
    return (
        "import os, signal, sys, time\n"
        f"while not all(map(os.path.exists, {paths})): time.sleep(0.02)\n"
        f"time.sleep(0.5)\n{then}"
    )


def beside(plc: PlcProcess, log: Path, seconds: float) -> tuple[str | Path, ...]:
    address = f"127.0.0.1:{plc.port}"
    return "run", GRIPPER, "--address", address, "--log", log, "--duration", str(seconds)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("then", "complaint"),
    [
        ("", ""),
        ("sys.exit('no room')", "the process that compiles has failed (no room)"),
        ("os.kill(os.getpid(), signal.SIGKILL)", "has failed (it was killed)"),
    ],
)
@pytest.mark.usefixtures("nothing_cached")
def test_what_came_meanwhile_is_caught_up_however_it_is_compiled(
    then: str,
    complaint: str,
    plc: PlcProcess,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = tmp_path / "a.mcap"
    compiles_by(monkeypatch, after(log, then=then))
    assert twin(monkeypatch, *beside(plc, log, 2.5)) == 0
    said = capsys.readouterr().err.splitlines()
    assert said[0] == f"twin: {COMPILING}"
    assert len(said) == 1 + bool(complaint)
    assert complaint in said[-1]
    samples, ticks = logged(log)
    assert len(samples) > 2000
    assert missing(samples) == 0
    assert Kind.NO_MODEL not in told(log)
    assert ticks.tobytes() == expected_again(log, monkeypatch)


@pytest.mark.usefixtures("nothing_cached")
def test_where_no_process_can_be_started_it_is_compiled_beside_the_rows(
    plc: PlcProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiling, "COMMAND", ("/nowhere/python",))
    log = tmp_path / "a.mcap"
    assert twin(monkeypatch, *beside(plc, log, 1.0)) == 0
    assert logged(log)[1].tobytes() == expected_again(log, monkeypatch)


@pytest.mark.usefixtures("nothing_cached")
def test_a_time_that_is_over_before_it_is_compiled_is_logged_with_the_model(
    plc: PlcProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "a.mcap"
    compiles_by(monkeypatch, after(log))
    assert twin(monkeypatch, *beside(plc, log, 0.3)) == 0
    samples, ticks = logged(log)
    assert 200 < len(samples) < 900
    assert ticks.tobytes() == expected_again(log, monkeypatch)


INTERRUPT = "os.kill(os.getppid(), signal.SIGINT); time.sleep(60)"  # as a Ctrl-C would


@pytest.mark.usefixtures("nothing_cached")
def test_an_interrupt_meanwhile_leaves_a_whole_log_and_no_process(
    plc: PlcProcess,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = tmp_path / "a.mcap"
    compiles_by(monkeypatch, after(log, then=INTERRUPT))
    assert twin(monkeypatch, *beside(plc, log, 60.0)) == 130
    samples, ticks = logged(log)
    assert len(samples) > 300
    assert missing(samples) == 0
    assert np.isnan(ticks["expected"]).all()
    in_suction = samples["commands"] == Command.SUCTION
    assert (ticks["phase"][in_suction] == Phase.SUCTION).all()
    (event,) = open_log(log).events()
    assert event.kind is Kind.NO_MODEL
    assert event.time_ns == samples["time_ns"][0]
    assert WITHOUT_MODEL in event.text
    assert WITHOUT_MODEL in capsys.readouterr().out
    expected_again(log, monkeypatch)


@pytest.mark.usefixtures("nothing_cached")
def test_a_mistake_in_the_model_costs_no_row(
    plc: PlcProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def mistaken(_settings: object) -> None:
        raise ZeroDivisionError("of all things")

    log = tmp_path / "a.mcap"
    compiles_by(monkeypatch, after(log))
    monkeypatch.setattr(compiling, "pair_of", mistaken)
    with pytest.raises(ZeroDivisionError):
        twin(monkeypatch, *beside(plc, log, 60.0))
    samples, _ = logged(log)
    assert len(samples) > 300
    assert told(log) == [Kind.NO_MODEL]


@pytest.mark.slow
@pytest.mark.usefixtures("nothing_cached")
def test_rows_that_find_no_room_are_logged_without_the_model(
    plc: PlcProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acquisition, "MOST_ROWS", 200)
    log = tmp_path / "a.mcap"
    compiles_by(monkeypatch, after(log, then="time.sleep(0.5)"))
    assert twin(monkeypatch, *beside(plc, log, 4.0)) == 0
    samples, ticks = logged(log)
    assert missing(samples) == 0
    without = np.isnan(ticks["expected"])
    assert without[:300].all()
    assert not without[-300:].any()
    assert told(log).count(Kind.NO_MODEL) == 1


@pytest.mark.slow
@pytest.mark.parametrize("then", ["", INTERRUPT])
@pytest.mark.usefixtures("nothing_cached")
def test_several_ejectors_wait_for_one_compiler(
    then: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = [tmp_path / f"run.{name}.mcap" for name in ("test_rig", "gripper")]
    compiles_by(monkeypatch, after(*logs, then=then))
    with two_on_one(tmp_path) as (_, configs):
        options = ("--log", tmp_path / "run.mcap", "--duration", "2.5")
        assert twin(monkeypatch, "run", *configs, *options) == (130 if then else 0)
    assert capsys.readouterr().err == f"twin: {COMPILING}\n"
    for log in logs:
        samples, ticks = logged(log)
        assert len(samples) > 300
        assert missing(samples) == 0
        assert np.isnan(ticks["expected"]).all() == bool(then)
        if not then:
            assert ticks.tobytes() == expected_again(log, monkeypatch)


def test_the_plant_of_a_plc_is_there_before_it_is_asked() -> None:
    models = Models({"gripper": rigs.config("gripper")}, at_once=True)
    models.load()
    assert models.wait(0.0)
    models.take("gripper")


# A start with all compiled.


def test_rows_are_taken_while_a_compiled_model_is_loaded(
    plc: PlcProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    acquisitions: list[acquisition.Acquisition] = []
    at_once = acquisition.Acquisition.__init__
    from_cache = Models._made_from_cache

    def begins(self: acquisition.Acquisition, *args: Any, **kwargs: Any) -> None:
        at_once(self, *args, **kwargs)
        acquisitions.append(self)

    def takes_long(models: Models) -> bool:
        assert acquisitions, "the model is loaded before any row is taken"
        until = time.monotonic() + PATIENCE_S
        while acquisitions[0]._rows < 100 and time.monotonic() < until:
            time.sleep(0.01)
        rows.append(acquisitions[0]._rows)
        return from_cache(models)

    rows: list[int] = []
    monkeypatch.setattr(acquisition.Acquisition, "__init__", begins)
    monkeypatch.setattr(Models, "_made_from_cache", takes_long)
    log = tmp_path / "a.mcap"
    assert twin(monkeypatch, *beside(plc, log, 1.0)) == 0
    samples, _ = logged(log)
    assert len(samples) > rows[0] >= 100
    assert missing(samples) == 0


LATER = {  # what no start needs, by what does need it
    "scipy.stats": "trends",
    "scipy.optimize": "the naming of a deviation",
    "asyncua": "OPC UA",
    "matplotlib": "reports",
    "pyarrow": "tables",
    "starlette": "the page",
    "pandas": "notebooks",
}


def test_a_start_imports_nothing_that_it_does_not_need(
    plc: PlcProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPROFILEIMPORTTIME", "1")
    log = tmp_path / "a.mcap"
    with started(*beside(plc, log, 0.5)) as process:
        _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert len(logged(log)[0]) > 0
    imported = [line.rpartition("|")[2].strip() for line in said.splitlines()]
    assert {"numba", "scipy.special", "twin.log.recorder"} <= {*imported}
    assert {*imported} & {*LATER} == set()
    before_rows = imported[: imported.index("twin.acquisition")]
    assert {"drivers.modbus.driver", "numpy"} <= {*before_rows}
    assert not any(name.partition(".")[0] in ("numba", "llvmlite") for name in before_rows)
    assert "scipy.special" not in before_rows
