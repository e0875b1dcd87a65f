"""A commissioning from the PLC: its cycles are logged first, and the log is what counts."""

import json
import os
import signal
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rigs
from calibrations import log_of
from command_line import edited, twin
from plc_process import PlcProcess
from written_pages import commissioned

import drivers.sources
from drivers.reconnect import EMPTY
from twin import files
from twin.assets.database_url import open_chosen
from twin.calibration.commission import Commissioned
from twin.calibration.record_checks import FEWEST
from twin.cli import recording
from twin.cli.recording import (
    FEWEST_CYCLES,
    NO_END,
    NO_ROWS,
    NO_SUCTION,
    enough,
    log_beside,
    record_cycles,
)
from twin.config import Config
from twin.log.reader import open_log
from twin.signals import Command, Samples

UNIT = "gripper/new"


def rows_in(log: Path) -> Samples:
    return np.concatenate([rows for rows, _ in open_log(log).blocks()])


def suctions(samples: Samples) -> int:
    return int(np.count_nonzero(np.diff((samples["commands"] & Command.SUCTION).astype(int)) == 1))


def ends_as(word: str, monkeypatch: pytest.MonkeyPatch) -> list[Samples]:
    """Let the fit end with a verdict; gives the rows that it was made of."""
    fitted = list[Samples]()

    def fit(_config: Config, blocks: Iterable[Samples], _say: object) -> Commissioned:
        fitted.append(np.concatenate(list(blocks)))
        return replace(commissioned(word), samples=fitted[0])

    monkeypatch.setattr("twin.calibration.commission.commission", fit)
    return fitted


def plays(monkeypatch: pytest.MonkeyPatch, samples: Samples, *, interrupted: bool = False) -> None:
    """Let the PLC give these rows, and a person stop it in the midst of them."""

    def blocks(*_arguments: object) -> Iterator[Samples]:
        for number, block in enumerate(rigs.cut(samples, 500)):
            if interrupted and number == 10:
                os.kill(os.getpid(), signal.SIGINT)
            yield block

    monkeypatch.setattr(drivers.sources, "open_source", blocks)


def cell(folder: Path) -> tuple[Path, str]:
    path, _ = edited(folder, "port = 5021", "port = 5021", "gripper")
    return path, f"sqlite:///{folder}/assets.sqlite"


@pytest.mark.slow
def test_a_plc_is_recorded_and_the_log_is_commissioned(
    plc: PlcProcess,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, _ = edited(tmp_path, "port = 5021", f"port = {plc.port}", "gripper")
    url, fitted = f"sqlite:///{tmp_path}/assets.sqlite", ends_as("usable", monkeypatch)
    command = ("commission", path, "--cycles", "5", "--id", UNIT, "--assets", url)
    assert twin(monkeypatch, *command) == 0
    (log,) = tmp_path.glob("gripper_new_*Z.mcap")
    assert f"recording in {log}" in capsys.readouterr().err
    assert open_log(log).header.asset_id == UNIT
    assert np.array_equal(rows_in(log)["pressure"], fitted[0]["pressure"])
    # The first may be partial, and in one the twin settles; the last block may begin another.
    assert suctions(rows_in(log)) >= 7
    config = Config.of(rigs.config("gripper").document)
    with open_chosen(url, config.document, write=False) as database:
        (record,) = database.records("instance", UNIT)
    assert record.provenance["log"] == log.name


@pytest.mark.parametrize(("word", "code"), [("good", 0), ("refused", 2)])
def test_the_log_stays_however_the_fit_ends(
    word: str,
    code: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (path, url), log = cell(tmp_path), tmp_path / "mine.mcap"
    ends_as(word, monkeypatch)
    plays(monkeypatch, log_of("gripper"))
    command = ("commission", path, "--cycles", "5", "--assets", url, "--log", log)
    assert twin(monkeypatch, *command) == code
    assert suctions(rows_in(log)) == 7
    capsys.readouterr()
    assert twin(monkeypatch, *command) == 3  # it is not written over
    said = capsys.readouterr().err
    assert "choose another name with --log" in said
    assert "--force" not in said  # which the command does not have
    assert suctions(rows_in(log)) == 7


def test_a_folder_that_may_not_be_written_to_is_told_before_the_plc_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, url = cell(tmp_path)
    monkeypatch.setattr(drivers.sources, "open_source", pytest.fail)
    monkeypatch.setattr(files.os, "access", lambda folder, _mode: folder != tmp_path)
    assert twin(monkeypatch, "commission", path, "--assets", url, "--id", UNIT) == 3
    assert "--log FILE" in capsys.readouterr().err


def test_a_record_from_the_plc_that_is_refused_leaves_log_answer_and_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (path, url), log = cell(tmp_path), tmp_path / "mine.mcap"
    swapped = log_of("gripper").copy()
    swapped["pressure"] = 202_600.0 - swapped["pressure"]  # its sign is wrong
    plays(monkeypatch, swapped)
    answer, page = tmp_path / "a.json", tmp_path / "a.html"
    command = ("commission", path, "--assets", url, "--log", log, "--json", answer, "-o", page)
    assert twin(monkeypatch, *command, "--cycles", "5") == 2
    stored = json.loads(answer.read_text(encoding="utf-8"))
    assert "its sign is wrong" in stored["reason"]
    assert 'set reference = "gauge"' in stored["do"]
    assert "its sign is wrong. Set reference" in page.read_text(encoding="utf-8")
    assert suctions(rows_in(log)) == 7


def test_an_interrupted_recording_leaves_its_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (path, url), log = cell(tmp_path), tmp_path / "mine.mcap"
    fitted = ends_as("good", monkeypatch)
    plays(monkeypatch, log_of("gripper"), interrupted=True)
    assert twin(monkeypatch, "commission", path, "--assets", url, "--log", log) == 130
    assert fitted == []
    assert len(rows_in(log)) >= 10 * 500


def test_too_few_cycles_are_a_mistake_before_the_plc_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, url = cell(tmp_path)
    monkeypatch.setattr(drivers.sources, "open_source", pytest.fail)
    assert twin(monkeypatch, "commission", path, "--cycles", "4", "--assets", url) == 2
    assert "Input should be greater than or equal to 5" in capsys.readouterr().err
    assert FEWEST_CYCLES == FEWEST


def test_a_log_is_not_logged_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "a.mcap"
    assert twin(monkeypatch, "commission", log, "--log", tmp_path / "b.mcap") == 2
    assert "is a log already" in capsys.readouterr().err


def silent() -> Samples:
    """A thousand rows without a command."""
    rows = log_of("gripper")[:1000].copy()
    rows["commands"] = 0
    return rows


def held() -> Samples:
    """A thousand rows with suction on."""
    rows = silent()
    rows["commands"] = Command.SUCTION
    return rows


def told_over(
    stretches: Iterable[tuple[float, Samples]], monkeypatch: pytest.MonkeyPatch
) -> list[tuple[float, str]]:
    """When (s) what is told over stretches: each is a length (s) and the block of each half second.

    A whole record ends them.
    """
    seconds, told = [0.0], list[tuple[float, str]]()
    monkeypatch.setattr(recording, "complain", lambda text: told.append((seconds[0], text)))

    def played() -> Iterator[Samples]:
        for length, block in stretches:
            for _ in range(round(2 * length)):
                seconds[0] += 0.5
                yield block
        yield log_of("gripper")

    for _ in enough(played(), 12, lambda _what: None, lambda: seconds[0]):
        pass
    return told


def test_without_suction_the_tag_to_check_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    assert told_over([(150.0, silent())], monkeypatch) == [(60.5, NO_SUCTION)]


def test_a_plc_that_is_away_is_not_one_without_suction(monkeypatch: pytest.MonkeyPatch) -> None:
    stretches = [(1.0, held()), (200.0, EMPTY), (50.0, silent()), (30.0, EMPTY)]
    assert told_over(stretches, monkeypatch) == [(11.5, NO_ROWS), (261.5, NO_ROWS)]
    # Suction that is on as the PLC comes back ends the wait for it.
    back = [(50.0, silent()), (20.0, EMPTY), (0.5, held()), (50.0, silent())]
    assert told_over(back, monkeypatch) == [(60.5, NO_ROWS)]
    # A pause between blocks is no outage: the time counts as that without suction.
    slow = [(5.0, EMPTY), (0.5, silent())] * 20
    assert told_over(slow, monkeypatch) == [(60.5, NO_SUCTION)]


def test_a_suction_that_does_not_end_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    assert told_over([(500.0, held())], monkeypatch) == [(300.5, NO_END)]
    minutes = [(1.0, silent()), (240.0, held())] * 3
    assert told_over(minutes, monkeypatch) == []


def test_rows_reach_the_file_while_the_plc_is_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, rows = tmp_path / "mine.mcap", log_of("gripper")
    found = list[int]()

    def blocks(*_arguments: object) -> Iterator[Samples]:
        yield rows[:500]
        yield EMPTY
        found.append(len(rows_in(log)))
        yield rows[500:]

    monkeypatch.setattr(drivers.sources, "open_source", blocks)
    record_cycles(Config.of(rigs.config("gripper").document), 5, log)
    assert found == [500]


def test_a_log_is_named_by_unit_and_time(tmp_path: Path) -> None:
    log = log_beside(tmp_path / "cell.toml", UNIT)
    assert log.parent == tmp_path
    assert log.name.startswith("gripper_new_20")
    assert log.name.endswith("Z.mcap")
