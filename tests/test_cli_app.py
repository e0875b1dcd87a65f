"""What all commands have in common: help that says what was written, ``-h`` and ``--version``."""

import io
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import pytest
import rigs
from command_line import twin
from terminal import Program
from typer.main import get_command

from twin.cli.console import progress
from twin.cli.main import BEGIN, INSTEAD, ORDER, app
from twin.cli.run import _hinted


def _commands() -> Iterator[tuple[str, ...]]:
    yield ()
    for name, command in get_command(app).commands.items():
        yield (name,)
        yield from ((name, below) for below in getattr(command, "commands", ()))


COMMANDS = list(_commands())


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_has_short_help_and_a_version(
    command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, *command, "-h") == 0
    short = capsys.readouterr().out
    assert twin(monkeypatch, *command, "--help") == 0
    assert capsys.readouterr().out == short
    assert short.startswith(f"Usage: {' '.join(('twin', *command))} ")
    assert "..." not in short.partition("Commands:")[2]  # no sentence is cut
    assert twin(monkeypatch, *command, "--version") == 0
    assert capsys.readouterr().out.startswith(f"twin {version('ejector-twin')} ")


def test_the_help_begins_with_what_a_day_begins_with(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "-h") == 0
    commands, _, begin = capsys.readouterr().out.partition("Commands:")[2].rpartition("\n\n")
    lines = commands.splitlines()
    shown = [line.split()[0] for line in lines if line.startswith("  ") and line[2] != " "]
    assert shown == list(ORDER)
    assert begin.strip() == BEGIN


@pytest.mark.parametrize("name", INSTEAD)
def test_who_types_a_command_that_is_not_there_reads_which_is(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, name, "a.mcap") == 2
    assert f"There is: {INSTEAD[name]}" in " ".join(capsys.readouterr().err.split())
    assert name not in ORDER
    for line in INSTEAD[name].split(", "):
        _, *command = (word for word in line.split() if word.isalpha() and word.islower())
        assert tuple(command) in COMMANDS


@pytest.mark.parametrize("terminal", [True, False])
def test_hints_are_for_people_at_a_terminal_alone(
    terminal: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    told, log = list[str](), tmp_path / "today.mcap"
    with _hinted(log, told.append, hil=False) as file:
        assert file == log
        assert told == ([f"log: {log}; Ctrl-C ends the run"] if terminal else [])
    following = f"twin diagnose {log} --report {tmp_path / 'today.html'}"
    assert told[1:] == ([f"{log} is written; next: {following}"] if terminal else [])
    with _hinted(log, None, hil=False), _hinted(None, told.append, hil=True):
        pass
    assert told[2:] == (["Ctrl-C ends the run"] if terminal else [])


def test_a_simulated_plc_says_what_to_run_beside_it(tmp_path: Path) -> None:
    with Program(tmp_path, "plc", rigs.path_of("gripper"), "--port", "0") as plc:
        plc.until(r"listening on 127\.0\.0\.1:\d+")
        plc.until(r"twin: Ctrl-C ends it; beside it, in a second terminal: twin run \S+gripper")
        plc.interrupt()
        assert plc.end() == 0


def test_the_shell_completes_commands() -> None:
    asked = {"_TWIN_COMPLETE": "complete_bash", "COMP_WORDS": "twin co", "COMP_CWORD": "1"}
    program = Path(sys.executable).with_name("twin")
    done = subprocess.run(
        [program], env={**os.environ, **asked}, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["config", "commission", "compare"]


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("run", "Unit, instead of [asset] id."),
        ("run", "[hil.tags]"),
        ("import", "[import] maps columns."),
        ("serve", "that its [mqtt] names"),
        ("alarms", "as a file that [alarms] rules can name."),
    ],
)
def test_help_keeps_names_of_tables(
    command: str, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, command, "--help") == 0
    assert said in " ".join(capsys.readouterr().out.split())


def test_no_value_is_dropped_without_a_word(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    twice = ("--config", "a.toml", "--config", "b.toml")
    assert twin(monkeypatch, "alarms", "history", *twice) == 2
    assert "--config is given twice, and only one can be used" in capsys.readouterr().err


class Screen(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_counts_rows_where_the_total_is_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Screen()
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    assert len(list(progress(["x" * 1000, "y" * 500], "reading"))) == 2
    assert "reading: 1,500 rows" in screen.getvalue()
    assert "?" not in screen.getvalue().replace("\x1b[?25", "")  # which hides the cursor
