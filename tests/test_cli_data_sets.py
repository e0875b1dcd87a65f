"""The commands that carry data sets and tables: what one writes, the next one takes up."""

import json
import sqlite3
from contextlib import closing
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import rigs
import tomli_w
from command_line import edited, twin

from twin.assets import database_url as place
from twin.assets.database import open_assets
from twin.assets.record import Record
from twin.log.header import LogHeader
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.signals import Samples, Ticks

GRIPPER = rigs.path_of("gripper")
UNIT = "gripper-77"
SECONDS = 15.0  # six cycles that count: one more than a calibration needs


def record(path: Path, samples: Samples, ticks: Ticks) -> Path:
    """A log as an earlier program wrote it: without the data set."""
    document = rigs.config("gripper").document
    recorder = Recorder(path, LogHeader("compact-ejector-35", "", "g.toml", document.text))
    recorder.write(samples, ticks, [])
    recorder.close()
    return path


def rows(log: Path) -> tuple[Samples, Ticks]:
    samples, ticks = zip(*open_log(log).blocks(), strict=True)
    return np.concatenate(samples), np.concatenate(ticks)


def same(one: Path, other: Path) -> bool:
    return [part.tobytes() for part in rows(one)] == [part.tobytes() for part in rows(other)]


def about(log: Path, what: str) -> str:
    return open_log(log).header.metadata[what]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    samples, _ = rigs.recorded("gripper", SECONDS)
    path = tmp_path_factory.mktemp("log") / "gripper.mcap"
    return record(path, *rigs.expectation(rigs.twin("gripper"), [samples]))


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to work in: databases that nobody names lie there."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def add_unit(monkeypatch: pytest.MonkeyPatch, suction: float, *database: str) -> None:
    """Put a unit into the database that is the gripper but for its suction capacity."""
    data = rigs.config("gripper").data
    ejector = data.ejector.model_copy(update={"suction_capacity_sl_min": suction})
    data = data.model_copy(update={"ejector": ejector})
    healthy = rigs.config("gripper").monitor.healthy.model_dump(mode="json")
    unit = {"kind": "instance", "name": UNIT, "type": "compact-ejector-35"}
    Path("unit.toml").write_text(
        tomli_w.dumps({**unit, "data": data.model_dump(exclude_none=True), "healthy": healthy})
    )
    assert twin(monkeypatch, "assets", "add", "unit.toml", *database) == 0


# The data set of a log.


def test_a_log_replays_with_the_data_set_it_was_made_with(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_unit(monkeypatch, 30.0, "--assets", "elsewhere.sqlite")
    chosen = ("--id", UNIT, "--assets", "elsewhere.sqlite")
    assert twin(monkeypatch, "replay", log, *chosen, "-o", "unit.mcap") == 0
    assert "instance-specific data of gripper-77" in about(here / "unit.mcap", "origin")
    assert not same(log, here / "unit.mcap")

    (here / "elsewhere.sqlite").unlink()
    assert twin(monkeypatch, "replay", "unit.mcap", "-o", "again.mcap") == 0
    assert same(here / "unit.mcap", here / "again.mcap")
    for what in ("data_set", "origin", "data", "healthy"):
        assert about(here / "unit.mcap", what) == about(here / "again.mcap", what)


def test_another_configuration_or_unit_takes_the_place_of_the_data_set_in_the_log(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_unit(monkeypatch, 30.0)
    assert twin(monkeypatch, "replay", log, "--id", UNIT, "-o", "unit.mcap") == 0
    assert twin(monkeypatch, "replay", "unit.mcap", "--config", GRIPPER, "-o", "file.mcap") == 0
    assert same(log, here / "file.mcap")
    assert twin(monkeypatch, "replay", "file.mcap", "--id", UNIT, "-o", "back.mcap") == 0
    assert same(here / "unit.mcap", here / "back.mcap")


def said(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What the program had to say of its work, but for the monitor."""
    return capsys.readouterr().err.splitlines()


@pytest.mark.parametrize("command", ["replay", "diagnose", "import"])
def test_a_unit_that_is_named_and_not_known_is_refused_with_the_nearest(
    command: str,
    log: Path,
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    add_unit(monkeypatch, 30.0)
    before = sorted(here.iterdir())
    capsys.readouterr()
    of = ("none.csv", "--config", GRIPPER, "-o", "out.mcap") if command == "import" else (log,)
    options = ("--id", "gripper-7", "--assets", "assets.sqlite")
    assert twin(monkeypatch, command, *of, *options) == 2
    message = capsys.readouterr().err
    assert "assets.sqlite: no unit is called 'gripper-7'" in message
    assert "did you mean 'gripper-77'?" in message
    assert "a new unit is named by [asset] id" in message
    assert sorted(here.iterdir()) == before


def test_what_nobody_mistyped_is_not_missed(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    add_unit(monkeypatch, 30.0)
    capsys.readouterr()
    for known in (("--id", UNIT), (), ("--config", GRIPPER)):
        assert twin(monkeypatch, "replay", log, *known) == 0
        assert said(capsys) == []
    config, _ = edited(here, 'id = "gripper-01"', 'id = "gripper-02"', "gripper")
    assert twin(monkeypatch, "replay", log, "--config", config, "--id", "gripper-02") == 0
    (line,) = said(capsys)  # the configuration names it, too
    assert "no instance-specific data set of 'gripper-02' in " in line
    assert "using the type's 'compact-ejector-35'" in line


def test_without_a_database_no_unit_is_known_but_those_shipped(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "replay", log, "--id", UNIT) == 2
    message = capsys.readouterr().err
    assert f"the shipped data sets: no unit is called '{UNIT}'" in message
    assert list(here.iterdir()) == []


def test_a_unit_of_a_type_nobody_knows_is_what_the_configuration_says_or_refused(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config, _ = edited(here, 'type = "compact-ejector-35"', 'type = "other"', "gripper")
    config.write_text(config.read_text().replace('id = "gripper-01"', f'id = "{UNIT}"'))
    command = ("replay", log, "--config", config, "--id", UNIT)
    assert twin(monkeypatch, *command, "-o", "out.mcap") == 0
    (line,) = said(capsys)
    assert f"no data set of '{UNIT}' or its type 'other' in " in line
    assert "using [data] of the configuration" in line
    assert about(here / "out.mcap", "origin") == "[data] of the configuration"
    config.write_text(f'[asset]\ntype = "other"\nid = "{UNIT}"\n')
    assert twin(monkeypatch, *command) == 2
    message = capsys.readouterr().err
    assert f"no data set of '{UNIT}' or its type 'other' at that time" in message
    assert "known types: compact-ejector-35" in message


def test_a_replay_takes_what_was_known_at_a_time(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    add_unit(monkeypatch, 30.0)
    between = datetime.now(UTC).isoformat()
    add_unit(monkeypatch, 31.0)
    capsys.readouterr()
    for name, as_of in (("now", ()), ("then", ("--as-of", between))):
        assert twin(monkeypatch, "replay", log, "--id", UNIT, *as_of, "-o", f"{name}.mcap") == 0
        assert said(capsys) == []
    used = [json.loads(about(here / f"{name}.mcap", "data")) for name in ("now", "then")]
    assert [data["ejector"]["suction_capacity_sl_min"] for data in used] == [31.0, 30.0]
    assert twin(monkeypatch, "replay", log, "--id", UNIT, "--as-of", "then") == 2
    assert "not a time: 'then'" in capsys.readouterr().err


def test_a_log_with_a_data_set_of_another_shape_is_named_with_the_key(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    samples, ticks = rows(log)
    text = rigs.config("gripper").document.text
    data = rigs.config("gripper").data.model_dump(mode="json") | {"colour": "red"}
    metadata = {"data": json.dumps(data), "program": "9.8.7"}
    with Recorder(here / "new.mcap", LogHeader("t", "", "g.toml", text, metadata)) as recorder:
        recorder.write(samples[:2000], ticks[:2000])
    for command in ("replay", "diagnose"):
        assert twin(monkeypatch, command, "new.mcap") == 3
        problem, hint = said(capsys)
        assert problem == (
            "twin: new.mcap: its data set cannot be used: data.colour: unknown key:"
            " known are ambient, catalogue, effects, ejector, sensor, supply, system, terms"
        )
        assert "--config CONFIG" in hint
        assert "9.8.7" in hint
    assert twin(monkeypatch, "replay", "new.mcap", "--config", GRIPPER) == 0


def test_a_stored_data_set_of_another_shape_is_named_with_record_and_key(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = {"ejector": {"h2_mbar": "high"}}
    with open_assets(here / "assets.sqlite") as assets:  # as another version might have had it
        record = assets.add(Record("instance", UNIT, "compact-ejector-35", data))
    assert twin(monkeypatch, "replay", log, "--id", UNIT, "-o", "out.mcap") == 2
    problem, hint = said(capsys)
    assert problem == (
        f"twin: assets.sqlite: record {record.id[:8]} of instance '{UNIT}' cannot be used:"
        " data.ejector.h2_mbar: must be a number"
        " (is 'high')"
    )
    assert f"twin assets show {UNIT}" in hint
    assert [path.name for path in here.iterdir()] == ["assets.sqlite"]


NEWER = "INSERT INTO asset_schema VALUES (2, '9.8.7')"


@pytest.mark.parametrize(
    ("deed", "code", "message"),
    [
        (NEWER, 2, "an asset database of ejector-twin 9.8.7 (schema 2)"),
        ("BEGIN EXCLUSIVE", 3, "asset database: database is locked"),
    ],
)
@pytest.mark.parametrize(
    "command",
    [
        ("replay", "LOG", "--id", UNIT, "-o", "out.mcap"),
        ("import", "none.csv", "--config", "cell.toml", "-o", "out.mcap"),
        ("calibrate", "LOG", "--config", "cell.toml"),
        ("assets", "add", "unit.toml"),
    ],
    ids=lambda command: command[0],
)
def test_a_database_that_cannot_be_used_is_said_and_nothing_is_half_written(
    command: tuple[str, ...],
    deed: str,
    code: int,
    message: str,
    log: Path,
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (here / "cell.toml").write_text(GRIPPER.read_text())
    add_unit(monkeypatch, 30.0)
    monkeypatch.setattr(place, "open_assets", partial(open_assets, busy_s=0.05))
    before = sorted(here.iterdir())
    capsys.readouterr()
    with closing(sqlite3.connect(here / "assets.sqlite", isolation_level=None)) as other:
        other.execute(deed)
        content = (here / "assets.sqlite").read_bytes()
        arguments = [log if argument == "LOG" else argument for argument in command]
        assert twin(monkeypatch, *arguments) == code
    assert message in capsys.readouterr().err
    assert sorted(here.iterdir()) == before
    assert (here / "assets.sqlite").read_bytes() == content


def test_a_diagnosis_judges_by_the_data_set_of_the_log_or_the_unit_that_is_named(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Too short a log is quick to diagnose, and the report names the data set all the same."""
    add_unit(monkeypatch, 30.0)
    samples, ticks = rows(log)
    short = record(here / "short.mcap", samples[:4000], ticks[:4000])
    assert twin(monkeypatch, "replay", short, "--id", UNIT, "-o", "unit.mcap") == 0
    used = {}
    for name, chosen in (("short", ()), ("unit", ()), ("short", ("--id", UNIT))):
        report = here / f"{name}{len(chosen)}.html"
        assert twin(monkeypatch, "diagnose", f"{name}.mcap", *chosen, "--report", report) == 0
        used[report.stem] = "suction capacity 30 sl/min" in report.read_text()
    assert used == {"short0": False, "unit0": True, "short2": True}
    assert about(here / "unit.mcap", "data_set") in (here / "short2.html").read_text()


@pytest.mark.slow
def test_a_unit_that_is_calibrated_is_the_one_that_is_replayed(
    log: Path,
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = here / "cell.toml"
    config.write_text(GRIPPER.read_text())
    answer = here / "calibration.json"
    command = ("calibrate", log, "--config", config, "--id", UNIT, "--json", answer)
    named = ("--assets", "assets.sqlite")  # what is named and not there is made as well
    assert twin(monkeypatch, *command, *named) == 0
    said = capsys.readouterr()
    assert f"stored as {UNIT}" in said.out
    assert "twin: making a new asset database, assets.sqlite" in said.err
    assert json.loads(answer.read_text())

    assert twin(monkeypatch, "assets", "show", UNIT, "--config", config) == 0
    shown = capsys.readouterr().out
    assert f'name = "{UNIT}"' in shown
    assert "# log: gripper.mcap" in shown

    assert twin(monkeypatch, "replay", log, "--id", UNIT, "--fail-on-alarm", "-o", "unit.mcap") == 0
    assert about(here / "unit.mcap", "origin").startswith(f"instance-specific data of {UNIT}")
    healthy = json.loads(about(here / "unit.mcap", "healthy"))
    assert {"idle_rms", "suction_rms", "hold_rms", "blow_off_rms"} <= set(healthy["figures"])


def test_a_calibration_without_a_unit_is_exit_code_2(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config, _ = edited(here, 'id = "gripper-01"', 'id = ""', "gripper")
    assert twin(monkeypatch, "calibrate", log, "--config", config) == 2
    assert "no unit is named" in capsys.readouterr().err
    assert not (here / "assets.sqlite").exists()


# Tables.


@pytest.mark.parametrize(
    "command",
    [("import", "a.csv", "--config", GRIPPER), ("replay", "a.mcap"), ("log", "recover", "a.mcap")],
)
def test_a_new_log_is_not_named_like_a_table(
    command: tuple[str | Path, ...],
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert twin(monkeypatch, *command, "-o", "x.csv") == 2
    said = capsys.readouterr().err
    assert "x.csv: a log is an MCAP file, and its name ends in .mcap" in said
    assert "say -o x.mcap" in said
    assert not (here / "x.csv").exists()


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_log_goes_out_and_comes_back_the_same(
    suffix: str, log: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = here / f"a.{suffix}"
    assert twin(monkeypatch, "export", log, "-o", table) == 0
    assert twin(monkeypatch, "import", table, "--config", GRIPPER, "-o", "in.mcap") == 0
    assert same(log, here / "in.mcap")  # the switching signals too, which are worked out anew
    assert set(rows(log)[1]["signals"]) == {0, 1, 3}
    assert twin(monkeypatch, "replay", "in.mcap", "-o", "replayed.mcap") == 0
    assert same(log, here / "replayed.mcap")
    assert twin(monkeypatch, "export", "replayed.mcap", "-o", f"b.{suffix}") == 0
    if suffix == "csv":
        first, second = (
            [line for line in (here / name).read_text().splitlines() if not line.startswith("#")]
            for name in ("a.csv", "b.csv")
        )
        assert first == second


def damaged(text: str) -> str:
    lines = text.splitlines(keepends=True)
    return "".join([*lines[:9000], lines[9000].replace(",", ",x", 1), *lines[9001:]])


def test_a_refused_import_leaves_nothing(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "export", log, "-o", "a.csv") == 0
    (here / "a.csv").write_text(damaged((here / "a.csv").read_text()))
    assert twin(monkeypatch, "import", "a.csv", "--config", GRIPPER, "-o", "in.mcap") == 3
    assert "a.csv:9001: " in capsys.readouterr().err
    assert [path.name for path in here.iterdir()] == ["a.csv"]


@pytest.mark.parametrize(
    ("config", "output", "code"),
    [("none.toml", "in.mcap", 3), (GRIPPER, "nowhere/in.mcap", 3), (GRIPPER, "a.csv/in.mcap", 3)],
)
def test_what_cannot_be_imported_is_said_and_leaves_nothing(
    config: str | Path,
    output: str,
    code: int,
    log: Path,
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert twin(monkeypatch, "export", log, "-o", "a.csv") == 0
    assert twin(monkeypatch, "import", "a.csv", "--config", config, "-o", output) == code
    assert "Traceback" not in capsys.readouterr().err
    assert [path.name for path in here.iterdir()] == ["a.csv"]


def test_a_database_that_is_not_made_yet_hinders_no_import_and_no_run_but_a_search(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = here / "cell.toml"
    cell.write_text(f'{GRIPPER.read_text()}\n[assets]\nurl = "sqlite:///plant.sqlite"\n')
    assert twin(monkeypatch, "export", log, "-o", "a.csv") == 0
    command = ("import", "a.csv", "--config", cell, "-o", "in.mcap")
    assert twin(monkeypatch, *command) == 0
    said = capsys.readouterr().err
    assert "plant.sqlite: no such asset database yet; the shipped data sets are used" in said
    assert same(log, here / "in.mcap")
    assert twin(monkeypatch, "replay", "in.mcap", "--config", cell) == 0
    assert "no such asset database yet" in capsys.readouterr().err
    assert not (here / "plant.sqlite").exists()
    for search in (("--id", "another"), ("--assets", "plant.sqlite")):
        assert twin(monkeypatch, *command, "--force", *search) == 3
        said = capsys.readouterr().err
        assert "plant.sqlite: no such asset database" in said
        assert "twin commission or calibrate, or twin assets add or import, makes one" in said


def test_an_imported_log_takes_the_place_of_no_log_in_parts(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "export", log, "-o", "a.csv") == 0
    for part in ("in.mcap", "in.0001.mcap"):
        (here / part).write_bytes(b"mine")
    command = ("import", "a.csv", "--config", GRIPPER, "-o", "in.mcap", "--force")
    assert twin(monkeypatch, *command) == 3
    assert "a log in several parts" in capsys.readouterr().err
    assert (here / "in.mcap").read_bytes() == b"mine"


def test_an_export_replaces_a_table_if_told_to(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (("export", log), ("figures", "show", log), ("figures", "costs", log)):
        (here / "a.csv").write_bytes(b"mine")
        assert twin(monkeypatch, *command, "-o", "a.csv") == 3
        assert "a.csv: there is already a file of that name" in capsys.readouterr().err
        assert (here / "a.csv").read_bytes() == b"mine"
        assert twin(monkeypatch, *command, "-o", "a.csv", "--force") == 0
        assert (here / "a.csv").stat().st_size > 100


def test_an_import_replaces_no_log_but_what_a_killed_one_left(
    log: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ("import", "a.csv", "--config", GRIPPER, "-o", "in.mcap")
    assert twin(monkeypatch, "export", log, "-o", "a.csv") == 0
    (here / "in.mcap").write_bytes(b"mine")
    assert twin(monkeypatch, *command) == 3
    said = capsys.readouterr().err
    assert "already a file of that name" in said
    assert "replace it with --force" in said
    assert (here / "in.mcap").read_bytes() == b"mine"
    assert twin(monkeypatch, *command, "--force") == 0
    assert same(log, here / "in.mcap")
    (here / "in.mcap").write_bytes(b"mine")
    (here / "in.mcap").rename(here / "in.mcap.part")
    assert twin(monkeypatch, *command) == 0
    assert same(log, here / "in.mcap")
    assert sorted(path.name for path in here.iterdir()) == ["a.csv", "in.mcap"]
