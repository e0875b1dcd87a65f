"""``twin diagnose``: what it refuses or cannot answer is said, and nothing else happens."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import rigs
from command_line import twin

from twin.config import Config
from twin.live import run
from twin.log.header import LogHeader
from twin.log.recorder import Recorder
from twin.signals import Samples

GRIPPER = rigs.path_of("gripper")


def logged(path: Path, samples: Samples, header: LogHeader | None = None) -> Path:
    sinks = [Recorder(path, header or rigs.config("gripper").log_header())]
    run([samples], rigs.twin("gripper"), rigs.monitor("gripper"), sinks)
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Too short for an answer, which is quick."""
    samples, _ = rigs.recorded("gripper", 6.0)
    return logged(tmp_path_factory.mktemp("log") / "short.mcap", samples)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def other(folder: Path, old: str, new: str) -> Path:
    path = folder / "cell.toml"
    path.write_text(GRIPPER.read_text().replace(old, new, 1))
    return path


def test_a_report_is_in_the_language_that_was_asked_for(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert twin(monkeypatch, "diagnose", log, "--report", "a.html", "--language", "de") == 0
    page = (here / "a.html").read_text()
    assert '<html lang="de">' in page
    assert "Die Aufzeichnung reicht für keine Antwort: " in page


def test_a_language_without_texts_is_refused_before_the_work(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "diagnose", log, "-o", "a.html", "--language", "ed") == 2
    said = capsys.readouterr()
    assert 'twin: --language: there are no texts in "ed"' in said.err
    assert said.out == ""
    assert list(here.iterdir()) == []


# Files that cannot be written.


@pytest.mark.parametrize("where", ["nowhere/a.json", "."])
@pytest.mark.parametrize(
    "command",
    [
        ("replay",),
        ("diagnose",),
        ("calibrate", "--config", GRIPPER, "--id", "g-1"),
    ],
)
def test_a_json_file_that_cannot_be_written_is_said_before_the_work(
    command: tuple[str | Path, ...],
    where: str,
    log: Path,
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert twin(monkeypatch, command[0], log, *command[1:], "--json", where) == 3
    said = capsys.readouterr()
    assert said.err.startswith(f"twin: {where}: cannot be written: ")
    assert said.out == ""
    assert list(here.iterdir()) == []


def test_a_report_that_cannot_be_written_is_said_before_the_work(
    log: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "diagnose", log, "--report", "/nowhere/a.html") == 3
    assert "/nowhere/a.html: cannot be written" in capsys.readouterr().err


def test_a_disk_that_is_full_is_said(
    log: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs a disk that is always full")
    assert twin(monkeypatch, "diagnose", log, "--json", "/dev/full") == 3
    assert "/dev/full: cannot be written: No space left" in capsys.readouterr().err


@pytest.mark.slow
def test_an_answer_alone_needs_nothing_that_draws_or_stores(log: Path) -> None:
    """Importing that would take longer than reading a short log."""
    code = (
        "import atexit, sys; from twin.cli.main import main;"
        " unused = {'matplotlib', 'scipy.stats', 'sqlalchemy'};"
        " atexit.register(lambda: print(unused & sys.modules.keys()));"
        f" sys.argv = ['twin', 'diagnose', {str(log)!r}]; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("insufficient: ")
    assert done.stdout.endswith("set()\n")


# Logs that cannot answer.


def test_a_log_without_a_complete_cycle_is_insufficient(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = logged(here / "idle.mcap", rigs.recorded("gripper", 6.0)[0][:400])
    files = ("--json", "a.json", "--report", "a.html")
    assert twin(monkeypatch, "diagnose", log, *files) == 0
    said = capsys.readouterr()
    assert said.out.startswith("insufficient: ")
    assert "the log has no complete cycle" in said.out
    assert said.err == ""
    answer = json.loads((here / "a.json").read_text())
    assert (answer["verdict"], answer["causes"]) == ("insufficient", [])
    assert "no complete cycle" in (here / "a.html").read_text()


def test_a_log_of_another_asset_is_refused_unless_that_is_meant(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = other(here, 'id = "gripper-01"', 'id = "gripper-02"')
    assert twin(monkeypatch, "diagnose", log, "--config", config) == 2
    said = capsys.readouterr().err
    assert "is a log of compact-ejector-35 gripper-01, " in said
    assert "is for compact-ejector-35 gripper-02" in said
    assert "--id" in said
    assert twin(monkeypatch, "diagnose", log, "--config", config, "--id", "gripper-02") == 0
    assert twin(monkeypatch, "diagnose", log, "--config", GRIPPER) == 0


def test_a_log_that_names_no_unit_is_taken(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = GRIPPER.read_text()
    header = LogHeader("compact-ejector-35", "", "g.toml", text)
    log = logged(here / "nobody.mcap", rigs.recorded("gripper", 6.0)[0], header)
    assert twin(monkeypatch, "diagnose", log, "--config", GRIPPER) == 0


def test_without_a_calibration_there_is_no_diagnosis(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = other(here, 'id = "gripper-01"', 'id = "gripper-02"')
    assert twin(monkeypatch, "diagnose", log, "--config", config, "--id", "gripper-02") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.startswith("insufficient: The log cannot answer: not commissioned: causes are not")
    assert "twin commission HEALTHY.mcap --id gripper-02" in said


def test_the_answer_names_the_unit_that_the_log_is_of(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not the one of the configuration, where --id named another as it was recorded."""
    config = rigs.config("gripper")
    asset = config.asset.model_copy(update={"id": "gripper-09"})
    known = Config(config.document, asset, config.data, config.monitor, config.log).log_header()
    log = logged(here / "a.mcap", rigs.recorded("gripper", 6.0)[0], known)
    assert twin(monkeypatch, "diagnose", log, "--json", "a.json") == 0
    answer = json.loads((here / "a.json").read_text())
    assert answer["asset"] == {"type": "compact-ejector-35", "id": "gripper-09"}
