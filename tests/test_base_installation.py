"""What the base installation can do without an extra, and what each command without one says.

Programs run here as after ``pip install`` of the wheel alone: each import of anything else fails,
in the processes that they start, too.
"""

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import NamedTuple

import hatchling.build
import numpy as np
import pytest
import rigs
from packaging.utils import canonicalize_name
from plc_process import PlcProcess
from test_started_at_once import PATIENCE_S, S, expected_again, logged, missing, told

from tools.audit import needs_of, reached
from twin.cli.compiling import COMPILING
from twin.cli.init import STARTERS
from twin.errors import ConfigError, SourceError
from twin.events import Kind
from twin.extras import install_hint
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.signals import Samples

GRIPPER, OPC_UA = rigs.path_of("gripper"), rigs.path_of("test_rig_opcua")
ONLY = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in NOT_THERE:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
"""
FIRST_ROW_S = 15.0  # from the start of the process, with nothing compiled


def modules_of_no_base() -> set[str]:
    """Modules that are here, and are of no package that the base needs, directly or not."""
    project = tomllib.loads((rigs.ROOT / "pyproject.toml").read_text())["project"]
    packages = reached(project["dependencies"], needs_of)
    return {
        module
        for module, distributions in packages_distributions().items()
        if not packages & {canonicalize_name(name) for name in distributions}
    }


@dataclass(frozen=True)
class Base:
    """Runs the program of ``root`` in a folder, as the base installation does."""

    folder: Path
    root: Path

    def __post_init__(self) -> None:
        missing = modules_of_no_base() - {"twin", "drivers", "coverage"}
        (self.folder / "sitecustomize.py").write_text(f"NOT_THERE = {missing!r}\n{ONLY}")

    def __call__(
        self, *arguments: str | Path, code: str = ""
    ) -> "subprocess.CompletedProcess[str]":
        """Run a command, or some code, to its end."""
        with self.started(*arguments, code=code) as process:
            out, said = process.communicate()
        return subprocess.CompletedProcess(process.args, process.returncode, out, said)

    @contextmanager
    def started(self, *arguments: str | Path, code: str = "") -> Iterator["subprocess.Popen[str]"]:
        """Start it; it is killed at the end if it still runs."""
        what = ["-c", code] if code else ["-m", "twin.cli", *map(str, arguments)]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join([str(self.folder), str(self.root)])
        }
        pipe = subprocess.PIPE
        with subprocess.Popen(
            [sys.executable, *what],
            env=environment,
            cwd=self.folder,
            stdout=pipe,
            stderr=pipe,
            text=True,
        ) as process:
            try:
                yield process
            finally:
                process.kill()


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Base:
    return Base(tmp_path_factory.mktemp("base"), rigs.ROOT)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Base:
    """Runs what is in the wheel, away from the checkout."""
    folder, root = tmp_path_factory.mktemp("away"), tmp_path_factory.mktemp("wheel")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(rigs.ROOT)
        name = hatchling.build.build_wheel(str(root))
    with zipfile.ZipFile(root / name) as archive:
        archive.extractall(root)
    return Base(folder, root)


def done(process: "subprocess.CompletedProcess[str]") -> str:
    """What it printed; it went well."""
    assert process.returncode == 0, process.stderr
    return process.stdout


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of healthy cycles, enough to calibrate."""
    path = tmp_path_factory.mktemp("log") / "healthy.mcap"
    return write_log(path, rigs.recorded("gripper", 20.0)[0])


@pytest.fixture(scope="module")
def coarse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with fewer rows, which a commissioning fits sooner."""
    samples = rigs.recorded("gripper", 16.0)[0][::4].copy()
    samples["sequence"], samples["pressure_2"] = np.arange(len(samples)), 0.0
    return write_log(tmp_path_factory.mktemp("coarse") / "coarse.mcap", samples)


def write_log(path: Path, samples: Samples) -> Path:
    with Recorder(path, rigs.config("gripper").log_header()) as recorder:
        recorder.write(*rigs.expectation(rigs.twin("gripper"), [samples]), [])
    return path


def test_the_base_has_no_package_of_an_extra(base: Base) -> None:
    assert "No module named 'matplotlib'" in base(code="import matplotlib").stderr
    assert done(base(code="import numba, pymodbus, mcap")) == ""


@pytest.mark.slow
def test_a_first_configuration(base: Base, tmp_path: Path) -> None:
    for name, address in (("cell", "10.0.0.5:502"), ("node", "opc.tcp://plc:4840")):
        path = tmp_path / f"{name}.toml"
        done(base("init", path, "--address", address))
        assert "no mistake" in done(base("config", "check", path))
    assert "hil" in done(base("config", "schema"))


@pytest.mark.slow
def test_a_run_beside_a_plc(base: Base, plc: PlcProcess, tmp_path: Path) -> None:
    address = ("--address", f"127.0.0.1:{plc.port}")
    assert "scan" in done(base("probe", GRIPPER, *address))
    done(base("run", GRIPPER, *address, "--log", tmp_path / "a.mcap", "--duration", "2"))
    assert sum(len(rows) for rows, _ in open_log(tmp_path / "a.mcap").blocks()) > 1000


@pytest.mark.slow
@pytest.mark.parametrize("name", STARTERS)
@pytest.mark.needs("uplot")
def test_a_wheel_begins_with_an_example_away_from_a_checkout(name: str, wheel: Base) -> None:
    assert str(rigs.ROOT) not in done(wheel(code="import twin; print(twin.__file__)"))
    assert f"twin plc {name}.toml" in done(wheel("init", f"{name}.toml", "--starter", name))
    assert "no mistake" in done(wheel("config", "check", f"{name}.toml"))


def until_live(log: Path) -> None:
    """Wait until what waited has been worked off, and rows are logged as they come."""
    until_received(log, 1)
    until_received(log, time.time_ns())


def until_received(log: Path, since_ns: int) -> None:
    """Wait for a row that was received at that time or later."""
    deadline = time.monotonic() + PATIENCE_S
    while last_received_ns(log) < since_ns:
        assert time.monotonic() < deadline, "nothing is logged"
        time.sleep(0.2)


def last_received_ns(log: Path) -> int:
    """When the last row was received; 0 without any."""
    try:
        return max((int(rows["host_ns"][-1]) for rows, _ in open_log(log).blocks()), default=0)
    except SourceError:  # not yet there, or its head not yet written
        return 0


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.needs("uplot")
def test_on_a_new_machine_the_first_row_of_a_wheel_is_there_at_once(
    wheel: Base, plc: PlcProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All that came while the model was compiled is logged with it."""
    log = wheel.folder / "a.mcap"
    done(wheel("init", "rig.toml", "--starter", "gripper"))
    with monkeypatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(wheel.folder / "cache"))
        assert "listening" in done(wheel("plc", "rig.toml", "--port", "0", "--duration", "0.1"))
        address = ("--address", f"127.0.0.1:{plc.port}")
        begun_ns = time.time_ns()
        with wheel.started("run", "rig.toml", *address, "--log", log) as process:
            until_live(log)
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert said == f"twin: {COMPILING}\n"
    samples, ticks = logged(log)
    assert samples["host_ns"][0] - begun_ns < FIRST_ROW_S * S
    assert missing(samples) == 0
    assert Kind.NO_MODEL not in told(log)
    assert ticks.tobytes() == expected_again(log, monkeypatch)
    assert "state: complete" in done(wheel("log", "check", log))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("log check L", "rows"),
        ("replay L", "cycle"),
        ("calibrate L --config C --id new --assets assets.sqlite", "new"),
        ("commission R --config C --id other --assets assets.sqlite --json a.json", "other"),
        ("diagnose L --json b.json", ""),
        ("figures show L", "evacuation"),
        ("figures costs L", ""),
        ("compare L L", ""),
        ("export-fmu --config C -o a.fmu", ""),
        ("assets list", "rig-01"),
        ("assets export -o b.json", ""),
        ("alarms rules", ""),
        ("users list --users users.toml", ""),
        ("effects", "leakage"),
        ("plc C --port 0 --duration 0.1", "listening"),
        ("--version", "twin"),
    ],
)
def test_the_main_way_needs_no_extra(
    command: str, says: str, base: Base, log: Path, coarse: Path
) -> None:
    paths = {"L": log, "R": coarse, "C": GRIPPER}
    assert says in done(base(*(paths.get(word, word) for word in command.split())))


HINTS = {
    "tables": (
        "import rows.csv --config C -o new.mcap",
        "export L -o new.csv",
        "export L -o new.parquet",
        "figures show L -o new.xlsx",
        "figures export -o new.csv",
        "alarms export -o new.xlsx",
    ),
    "reports": (
        "diagnose L --report new.html",
        "diagnose L -o new.html",
        "diagnose L --report /dev/null",
        "commission L --config C --report new.html",
        "compare L L --picture new.svg",
        "figures trend --picture new.png",
        "paper -o new.svg",
    ),
    "view": ("run C --view", "run C --rrd new.rrd", "replay L --view", "compare L L -o new.rrd"),
    "serve": ("serve --config C", "diagnose L --language de"),
    "opcua": (
        "run U --once",
        "probe U",
        "commission U --cycles 5 --id new",
        "plc U --port 0 --duration 0.1",
        "cert pki",
    ),
    "postgres": ("assets list --assets postgresql://plant/twin",),
    "fleet": ("fleet report", "fleet replay L", "fleet replay L --engine dask --scheduler tcp://h:1"),
    "aas": ("assets export --aasx new.aasx", "assets import new.aasx"),
}  # fmt: skip


# Runs each command of a list as the program does, in a copy of a process that has done no more than
# to import it. Prints a line for each: exit code, complaint, and modules as the copy begins.
EACH = """
import io, json, os, sys, traceback
from contextlib import redirect_stderr, redirect_stdout
from twin.cli.main import main

for arguments in COMMANDS:
    if os.fork():
        os.wait()
        continue
    begun_with = len(sys.modules)
    sys.argv, said, code = ["twin", *arguments], io.StringIO(), 0
    with redirect_stderr(said), redirect_stdout(io.StringIO()):
        try:
            main()
        except SystemExit as end:
            code = end.code
        except Exception:
            code = 1
            traceback.print_exc()
    print(json.dumps([code, said.getvalue(), begun_with]))
    break
"""


class Refusal(NamedTuple):
    """The end of a command that lacks an extra."""

    code: int
    said: str
    begun_with: int  # number of modules that are there before it begins


@pytest.fixture(scope="module")
def refused(base: Base, log: Path) -> dict[str, Refusal]:
    """How each command of ``HINTS`` ends, none of which finds what another one imports."""
    paths = {"L": str(log), "C": str(GRIPPER), "U": str(OPC_UA)}
    hints = [hint for some in HINTS.values() for hint in some]
    commands = [[paths.get(word, word) for word in hint.split()] for hint in hints]
    lines = done(base(code=f"COMMANDS = {commands!r}\n{EACH}")).splitlines()
    return {hint: Refusal(*json.loads(line)) for hint, line in zip(hints, lines, strict=True)}


@pytest.mark.slow
def test_each_command_without_its_extra_begins_anew(refused: dict[str, Refusal]) -> None:
    assert len({end.begun_with for end in refused.values()}) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extra", "command"), [(extra, hint) for extra, some in HINTS.items() for hint in some]
)
def test_without_its_extra_a_command_says_what_to_install(
    extra: str, command: str, refused: dict[str, Refusal]
) -> None:
    code, said, _ = refused[command]
    assert code == ConfigError.exit_code, said
    assert said.count("\n") == 2, said
    first, second = said.splitlines()
    assert first.startswith("twin: ")
    assert f" needs the extra [{extra}]: " in first
    assert second.strip() == install_hint(extra)


def test_results_over_opcua_need_the_extra(base: Base, tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(GRIPPER.read_text() + "\n[results]\nopcua = true\n")
    assert "[results] over OPC UA needs the extra [opcua]" in base("run", path, "--once").stderr


def test_a_notebook_needs_the_extra(base: Base) -> None:
    assert "twin.open needs the extra [notebook]" in base(code="import twin; twin.open").stderr
