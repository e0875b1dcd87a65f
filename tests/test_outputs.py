"""Files of answers: ``-o`` takes one, its ending decides the format; long steps show progress."""

import io
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import rigs
from command_line import twin
from test_catalogue import LIP, proposal
from typer.main import get_command

from twin.assets import provenance
from twin.cli.main import app
from twin.cli.options import ALL_ENDINGS, chosen, written_as
from twin.errors import ConfigError
from twin.files import require_ending
from twin.live import run as run_loop
from twin.log.recorder import Recorder


class Terminal(io.StringIO):
    """A stream that says that a person looks at it."""

    def isatty(self) -> bool:
        return True


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some cycles of a healthy gripper."""
    path = tmp_path_factory.mktemp("log") / "good.mcap"
    samples, _ = rigs.recorded("gripper", 12.0)
    sinks = [Recorder(path, rigs.config("gripper").log_header())]
    run_loop(rigs.cut(samples, 1000), rigs.twin("gripper"), rigs.monitor("gripper"), sinks)
    return path


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Run a command on a terminal; gives what it showed on stderr."""

    def run(*arguments: str | Path) -> str:
        terminal = Terminal()
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setattr("sys.stderr", terminal)
        assert twin(monkeypatch, *arguments) == 0
        return terminal.getvalue()

    return run


def options() -> Iterator[tuple[str, str]]:
    """Each command that has ``-o``, with the help text of it."""

    def below(command: object, name: str) -> Iterator[tuple[str, str]]:
        for option in command.params:  # type: ignore[attr-defined]
            if "-o" in option.opts:
                yield name, option.help
        for child, subcommand in getattr(command, "commands", {}).items():
            yield from below(subcommand, f"{name} {child}".strip())

    yield from below(get_command(app), "")


# The ending decides.


def test_an_ending_is_that_of_a_format() -> None:
    assert require_ending(Path("a.b.CSV"), ".csv", ".parquet") == ".csv"


@pytest.mark.parametrize("name", ["a.pdf", "a", "", "a.csv.gz", "folder/"])
def test_another_ending_is_refused_with_an_example(name: str) -> None:
    with pytest.raises(ConfigError, match=r"does not end in \.csv, \.parquet or \.xlsx") as refused:
        require_ending(Path(name), ".csv", ".parquet", ".xlsx")
    example = refused.value.hint.rpartition(" ")[2]
    assert example.endswith(".csv")
    assert Path(example).parent == Path(name).parent


def test_what_names_a_format_takes_any_name_but_that_of_another_format() -> None:
    check = written_as(".json")
    for name in ("a.json", "a.JSON", "answer", "/tmp/tmp.Xw93kd", "/dev/stdout"):
        assert check(Path(name)) == Path(name)
    assert check(None) is None
    for ending in set(ALL_ENDINGS) - {".json"}:
        with pytest.raises(ConfigError, match=r"does not end in \.json"):
            check(Path(f"answer{ending}"))


def test_a_format_is_written_once() -> None:
    page, other = Path("a.HTML"), Path("b.html")
    assert chosen(page, "--report", None, ".html") == page
    assert chosen(None, "--report", other, ".html") == other
    assert chosen(Path("a.json"), "--report", other, ".html") == other
    with pytest.raises(ConfigError, match=r"-o a\.HTML and --report b\.html"):
        chosen(page, "--report", other, ".html")


@pytest.mark.parametrize(("command", "text"), list(options()), ids=lambda value: value[:20])
def test_every_command_says_which_endings_it_takes(command: str, text: str) -> None:
    logs = {"import", "replay", "log recover"}
    assert re.search(r"log|\*\.\w+|JSON", text), command
    assert (command in logs) is ("log" in text)


def test_one_option_serves_each_format(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outputs = [tmp_path / f"f{ending}" for ending in (".json", ".csv", ".xlsx")]
    for path in outputs:
        assert twin(monkeypatch, "figures", "show", log, "-o", path) == 0
    document, table, sheet = outputs
    assert json.loads(document.read_text())["cycles"]
    assert table.read_text().startswith('"asset_type"') or "asset_type" in table.read_text()
    assert sheet.read_bytes().startswith(b"PK")


def test_assets_go_out_as_the_ending_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("basyx")
    monkeypatch.chdir(tmp_path)
    assert twin(monkeypatch, "assets", "export", "-o", "all.aasx", "--id", "paper-unit") == 0
    assert Path("all.aasx").read_bytes().startswith(b"PK")
    assert twin(monkeypatch, "assets", "export", "-o", "all.json") == 0
    assert json.loads(Path("all.json").read_text())["records"]


# Progress.


LONG = {
    "export LOG -o rows.csv": "exporting: 0 rows",
    "compare LOG LOG": "reading good.mcap: 0 rows",
    "log check LOG": "checking: 0 rows",
    "log recover LOG -o whole.mcap": "recovering: 0 rows",
    "figures show LOG": "reading off the curve: 0 rows",
    "figures costs LOG": "key figures of good.mcap",
    "figures savings LOG": "predicting other settings",
    "export-fmu --config CONFIG --sources-only": "translating the model to C",
    "effects add LIP --assets DATABASE": "searching for a lip",
}


@pytest.fixture
def long_command(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], list[str]]:
    """Fill in the files of a command; the diagnosis of ``effects add`` is a stand-in."""

    def diagnose(*given: Any) -> SimpleNamespace:
        progress = given[-1]
        progress("searching for a lip")
        return SimpleNamespace(json={"verdict": "unlisted", "causes": [{"effect": "lifting_lip"}]})

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("twin.diagnosis.propose.diagnose", diagnose)
    test = {"log": str(log), "log_sha256": provenance.of_log(log)["log_sha256"]}
    found_in = {"data_set": rigs.config("gripper").data.hash}
    files = {
        "LOG": log,
        "CONFIG": rigs.path_of("gripper"),
        "LIP": proposal(tmp_path, test=test, effect=LIP | {"found_in": found_in}),
        "DATABASE": f"sqlite:///{tmp_path / 'assets.sqlite'}",
    }
    return lambda command: [str(files.get(word, word)) for word in command.split()]


@pytest.mark.parametrize(("command", "shown"), LONG.items(), ids=LONG)
def test_a_long_command_shows_progress_on_a_terminal_alone(
    command: str,
    shown: str,
    long_command: Callable[[str], list[str]],
    seen: Callable[..., str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert shown in seen(*long_command(command))
    capsys.readouterr()


@pytest.mark.parametrize(("command", "shown"), LONG.items(), ids=LONG)
def test_a_long_command_shows_no_progress_in_a_pipe(
    command: str,
    shown: str,
    long_command: Callable[[str], list[str]],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert twin(monkeypatch, *long_command(command)) == 0
    out, err = capfd.readouterr()
    assert shown not in out + err
    assert "\x1b" not in out + err


@pytest.mark.parametrize("environment", [{}, {"NO_COLOR": "1"}], ids=str)
def test_progress_is_coloured_unless_no_color_says_otherwise(
    environment: dict[str, str],
    log: Path,
    tmp_path: Path,
    seen: Callable[..., str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    shown = seen("export", log, "-o", tmp_path / "rows.csv")
    assert "exporting: 0 rows" in shown
    assert bool(re.search(r"\x1b\[(\d+;)*3\d", shown)) == (not environment)  # a colour (SGR)


def test_the_paper_shows_its_steps(
    seen: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from twin.paper import separation, tables, text

    monkeypatch.setattr(tables, "recomputed", list)
    monkeypatch.setattr(tables, "late_by", lambda _: 0.0)
    monkeypatch.setattr(separation, "separate", lambda _: None)
    monkeypatch.setattr(text, "in_words", lambda *_: "")
    shown = seen("paper")
    assert "separating wall heat" in shown
