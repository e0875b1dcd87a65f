"""What every command says to a mistake: a message and an exit code, and never a traceback."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import rigs
from command_line import twin
from typer.main import get_command

from twin.cli.main import app
from twin.log.recorder import Recorder

CONFIG = str(rigs.path_of("test_rig"))
USAGE, SOURCE = 2, 3

# What each command needs to get as far as the mistake. A file of each kind lies in the folder.
NEEDED = {
    "run": ("C", "--once"),
    "replay": ("L",),
    "plc": ("C", "--duration", "0.01", "--port", "0"),
    "probe": ("C",),
    "diagnose": ("L",),
    "calibrate": ("L", "--config", "C"),
    "commission": ("L", "--config", "C"),
    "import": ("rows.csv", "--config", "C", "-o", "new.mcap"),
    "export": ("L", "-o", "new.csv"),
    "paper": (),
    "compare": ("L", "L"),
    "export-fmu": ("--config", "C"),
    "serve": ("--config", "C"),
    "cert": ("pki",),
    "init": (),
    "assets list": (),
    "assets show": ("paper-unit",),
    "assets add": ("unit.toml",),
    "assets import": ("here.json",),
    "assets export": (),
    "figures show": ("L",),
    "figures costs": ("L",),
    "figures savings": ("L",),
    "figures trend": (),
    "figures counters": (),
    "figures autoset": (),
    "figures forget": ("--older-than", "30"),
    "figures export": ("-o", "new.csv"),
    "alarms list": (),
    "alarms history": (),
    "alarms statistics": (),
    "alarms comment": ("plc_stale", "seen"),
    "alarms export": ("-o", "new.csv"),
    "alarms acknowledge": ("plc_stale",),
    "alarms shelve": ("plc_stale",),
    "alarms unshelve": ("plc_stale",),
    "alarms out-of-service": ("plc_stale",),
    "alarms in-service": ("plc_stale",),
    "alarms outbox": (),
    "alarms rules": (),
    "fleet calibrate": ("L",),
    "fleet diagnose": ("L",),
    "fleet replay": ("L",),
    "fleet report": ("L",),
    "users list": (),
    "users add": ("ann",),
    "users role": ("ann", "look"),
    "users password": ("ann",),
    "users remove": ("ann",),
    "users audit": (),
    "config check": ("C",),
    "config schema": (),
    "effects add": ("effect.toml", "--untested"),
    "log check": ("L",),
    "log recover": ("L", "-o", "new.mcap"),
}
# Commands that do something useful without an argument.
ALONE = {
    "paper",
    "init",
    "config schema",
    "assets list",
    "assets export",
    "alarms rules",
    "users list",
    "users audit",
}
FILES = ("text.txt", "bytes.bin", "empty", "folder")  # of no command's kind


def _options(command: str) -> set[str]:
    here = get_command(app)
    for name in command.split():
        here = here.commands[name]  # type: ignore[attr-defined]
    return {option for parameter in here.params for option in parameter.opts}


def _commands() -> Iterator[str]:
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        below = getattr(command, "commands", None)
        yield from (f"{name} {command}" for command in below) if below else (name,)


EITHER = {USAGE, SOURCE}
DATABASES = ("text.txt", "foo://bar", "folder"), EITHER
NUMBERS = ("-1", "nan", "x"), {USAGE}
OUTPUTS = ("nofolder/new",), {SOURCE}
# Values of each option that no command can take, and the exit codes that they may end with.
WRONG = {
    "--config": (("nofile", "text.txt", "bytes.bin", "folder", "other.toml"), EITHER),
    "--assets": DATABASES,
    "--figures": DATABASES,
    "--alarms": DATABASES,
    "--id": (("nobody",), EITHER),
    "--days": NUMBERS,
    "--hours": NUMBERS,
    "--duration": ((*NUMBERS[0], "0"), {USAGE}),
    "--tolerance": NUMBERS,
    "--seed": (("-1", "x"), {USAGE}),
    "--as-of": (("yesterday",), {USAGE}),
    "--json": OUTPUTS,
    "--report": OUTPUTS,
    "--html": OUTPUTS,
    "-o": (("new.pdf",), {USAGE}),
    "--address": (("nowhere", "127.0.0.1:0", "127.0.0.1:99999"), {USAGE}),
    "--port": (("70000", "-1", "x"), {USAGE}),
}
RIGHT = {
    "calibrate": "--id",
    "commission": "--id",
    "init": "--id",
    "figures show": "--figures",
}  # of these: a new unit; see below
INIT = {  # values that say nothing of a machine
    "--range": ("1500,0", "0", "nan,1", "a,b"),
    "--hose-mm": ("0", "-1", "nan", "long"),
    "--volume-ml": ("0", "inf"),
    "--unit": ("bars",),
    "--reference": ("sealevel",),
    "--end": ("nothing",),
    "--pressure": ("somewhere",),
    "--suction": ("30005/77",),
}
READ = ("C", "L", "rows.csv", "unit.toml", "here.json", "effect.toml")  # arguments that are files


def _mistakes(command: str, needed: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], set[int]]]:
    """Arguments and the exit codes that they may end with."""
    yield (*needed, "--nosuch"), {USAGE}
    if command not in ALONE:
        yield (), EITHER
    if needed and needed[0] in READ:
        yield ("nofile", *needed[1:]), {SOURCE}
        yield from (((file, *needed[1:]), EITHER) for file in FILES)
    for option in _options(command) & set(WRONG) - {RIGHT.get(command)}:
        values, codes = WRONG[option]
        yield from (((*_without(needed, option), option, value), codes) for value in values)


def _cases() -> Iterator[tuple[str, tuple[str, ...], set[int]]]:
    for command, needed in NEEDED.items():
        cases = sorted(_mistakes(command, needed), key=lambda case: case[0])
        yield from ((command, *case) for case in cases)
    for command in ("run", "probe"):
        for address in ("127.0.0.1:1", "no.such.host.invalid:502"):
            yield command, (*NEEDED[command], "--address", address), {SOURCE}
    yield "cert", ("text.txt",), {SOURCE}
    yield "init", ("text.txt",), {SOURCE}
    yield "init", ("nofolder/cell.toml",), {SOURCE}
    for option, wrong in INIT.items():
        yield from (("init", (option, value), {USAGE}) for value in wrong)
    yield "figures show", ("L", "--figures", "f.sqlite"), {USAGE}
    yield "assets show", ("paper-unit", "--as-of", "1999-01-01"), {USAGE}
    yield "fleet report", (), {SOURCE}
    yield "fleet replay", ("L", "--engine", "dask"), {USAGE}
    yield "run", ("C", "--log", "nofolder/new.mcap"), {SOURCE}
    yield "plc", ("no_rig.toml", "--duration", "1"), {USAGE}


def _without(needed: tuple[str, ...], option: str) -> tuple[str, ...]:
    if option not in needed:
        return needed
    at = needed.index(option)
    return needed[:at] + needed[at + 2 :]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "good.mcap"
    recorder = Recorder(path, rigs.config("test_rig").log_header())
    samples, _ = rigs.recorded("test_rig", 0.5)
    recorder.write(*rigs.expectation(rigs.twin("test_rig"), [samples]), [])
    recorder.close()
    return path


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, with a file of each wrong kind."""
    monkeypatch.chdir(tmp_path)
    Path("text.txt").write_text("no file of ours\n" * 40)
    Path("bytes.bin").write_bytes(bytes(range(256)) * 8)
    Path("empty").touch()
    Path("folder").mkdir()
    Path("other.toml").write_text('[project]\nname = "other"\n')
    Path("no_rig.toml").write_text('[asset]\ntype = "compact-ejector-35"\n')
    Path("rows.csv").write_text("time_s,suction,blow_off,vacuum_mbar\n0.001,0,0,0\n0.002,0,0,0\n")
    return tmp_path


def test_every_command_is_tried() -> None:
    assert sorted(_commands()) == sorted(NEEDED)


@pytest.mark.parametrize(("command", "arguments", "codes"), list(_cases()), ids=str)
def test_a_mistake_is_said_and_ends_as_the_contract_has_it(
    command: str,
    arguments: tuple[str, ...],
    codes: set[int],
    here: Path,
    log: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    there = {path.name for path in here.iterdir()}
    given = [{"C": CONFIG, "L": str(log)}.get(argument, argument) for argument in arguments]
    assert twin(monkeypatch, *command.split(), *given) in codes
    heard = capsys.readouterr()
    assert "Traceback" not in heard.err
    assert re.search(r"^(twin: |Error: |Usage: )\S", heard.err, re.MULTILINE)
    assert not re.search(
        r"Errno|codec|0x[0-9a-f]{6}|Exception", heard.err
    )  # of the program's inside
    assert {path.name for path in here.iterdir()} - there <= {"assets.sqlite"}  # fleet's answers


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("run", "empty"), "neither [asset] type nor [data]"),
        (("run", "bytes.bin"), "not a text file"),
        (("alarms", "rules", "--config", "other.toml"), "unknown table [project]"),
        (("assets", "list", "--config", "other.toml"), "unknown table [project]"),
        (("plc", "no_rig.toml", "--duration", "1"), "there is no [plc] table"),
        (("assets", "show", "paper-unit", "--as-of", "1999-01-01"), "at that time"),
        (("plc", CONFIG, "--duration", "0"), "0 is not a finite number above 0"),
        (("run", CONFIG, "--duration", "0"), "0 is not a finite number above 0"),
        (("run", CONFIG, "--once", "--id", "rig-0l"), "did you mean 'rig-01'?"),
        (("diagnos", "log.mcap"), "Did you mean diagnose?"),
        (("alarms", "aknowledge", "plc_stale"), "Did you mean acknowledge?"),
        (("serve", CONFIG), f"Say: --config {CONFIG}"),
        (("alarms", "list", "cell.toml"), "Say: --config cell.toml"),
    ],
)
def test_what_is_said_is_so(
    arguments: tuple[str, ...],
    said: str,
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert twin(monkeypatch, *arguments) == USAGE or said == "not a text file"
    assert said in capsys.readouterr().err
