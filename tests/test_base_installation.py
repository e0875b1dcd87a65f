"""What the base installation can do without an extra, and what each command without one says.

Programs run here as after ``pip install`` of the wheel alone: each import of anything else fails,
in the processes that they start, too.
"""

import os
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable
from importlib.metadata import packages_distributions
from pathlib import Path

import hatchling.build
import pytest
import rigs
from packaging.utils import canonicalize_name
from plc_process import PlcProcess

from tools.audit import needs_of, reached
from twin.cli.init import STARTERS
from twin.errors import ConfigError
from twin.extras import install_hint
from twin.log.reader import open_log
from twin.log.recorder import Recorder

GRIPPER, OPC_UA = rigs.path_of("gripper"), rigs.path_of("test_rig_opcua")
ONLY = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in NOT_THERE:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
"""
Run = Callable[..., "subprocess.CompletedProcess[str]"]


def modules_of_no_base() -> set[str]:
    """Modules that are here, and are of no package that the base needs, directly or not."""
    project = tomllib.loads((rigs.ROOT / "pyproject.toml").read_text())["project"]
    packages = reached(project["dependencies"], needs_of)
    return {
        module
        for module, distributions in packages_distributions().items()
        if not packages & {canonicalize_name(name) for name in distributions}
    }


def base_in(folder: Path, root: Path) -> Run:
    """Runs the program of ``root`` in a folder, as the base installation does."""
    missing = modules_of_no_base() - {"twin", "drivers", "coverage"}
    (folder / "sitecustomize.py").write_text(f"NOT_THERE = {missing!r}\n{ONLY}")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(root)])}

    def run(*arguments: str | Path, code: str = "") -> "subprocess.CompletedProcess[str]":
        what = ["-c", code] if code else ["-m", "twin.cli", *map(str, arguments)]
        return subprocess.run(
            [sys.executable, *what],
            env=environment,
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
        )

    return run


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return base_in(tmp_path_factory.mktemp("base"), rigs.ROOT)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs what is in the wheel, away from the checkout."""
    folder, root = tmp_path_factory.mktemp("away"), tmp_path_factory.mktemp("wheel")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(rigs.ROOT)
        name = hatchling.build.build_wheel(str(root))
    with zipfile.ZipFile(root / name) as archive:
        archive.extractall(root)
    return base_in(folder, root)


def done(process: "subprocess.CompletedProcess[str]") -> str:
    """What it printed; it went well."""
    assert process.returncode == 0, process.stderr
    return process.stdout


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of healthy cycles, enough to calibrate."""
    path = tmp_path_factory.mktemp("log") / "healthy.mcap"
    samples, _ = rigs.recorded("gripper", 20.0)
    with Recorder(path, rigs.config("gripper").log_header()) as recorder:
        recorder.write(*rigs.expectation(rigs.twin("gripper"), [samples]), [])
    return path


def test_the_base_has_no_package_of_an_extra(base: Run) -> None:
    assert "No module named 'matplotlib'" in base(code="import matplotlib").stderr
    assert done(base(code="import numba, pymodbus, mcap")) == ""


@pytest.mark.slow
def test_a_first_configuration(base: Run, tmp_path: Path) -> None:
    for name, address in (("cell", "10.0.0.5:502"), ("node", "opc.tcp://plc:4840")):
        path = tmp_path / f"{name}.toml"
        done(base("init", path, "--address", address))
        assert "no mistake" in done(base("config", "check", path))
    assert "hil" in done(base("config", "schema"))


@pytest.mark.slow
def test_a_run_beside_a_plc(base: Run, plc: PlcProcess, tmp_path: Path) -> None:
    address = ("--address", f"127.0.0.1:{plc.port}")
    assert "scan" in done(base("probe", GRIPPER, *address))
    done(base("run", GRIPPER, *address, "--log", tmp_path / "a.mcap", "--duration", "2"))
    assert sum(len(rows) for rows, _ in open_log(tmp_path / "a.mcap").blocks()) > 1000


@pytest.mark.slow
@pytest.mark.parametrize("name", STARTERS)
def test_a_wheel_begins_with_an_example_away_from_a_checkout(name: str, wheel: Run) -> None:
    assert str(rigs.ROOT) not in done(wheel(code="import twin; print(twin.__file__)"))
    assert f"twin plc {name}.toml" in done(wheel("init", f"{name}.toml", "--starter", name))
    assert "no mistake" in done(wheel("config", "check", f"{name}.toml"))


@pytest.mark.slow
def test_the_first_run_of_a_wheel(wheel: Run, plc: PlcProcess) -> None:
    done(wheel("init", "rig.toml", "--starter", "gripper"))
    assert "listening" in done(wheel("plc", "rig.toml", "--port", "0", "--duration", "0.1"))
    options = ("--address", f"127.0.0.1:{plc.port}", "--duration", "1", "--log", "a.mcap")
    done(wheel("run", "rig.toml", *options))
    assert "state: complete" in done(wheel("log", "check", "a.mcap"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("log check L", "rows"),
        ("replay L", "cycle"),
        ("calibrate L --config C --id new --assets assets.sqlite", "new"),
        ("commission L --config C --id other --assets assets.sqlite --json a.json", "other"),
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
def test_the_main_way_needs_no_extra(command: str, says: str, base: Run, log: Path) -> None:
    arguments = [{"L": str(log), "C": str(GRIPPER)}.get(word, word) for word in command.split()]
    assert says in done(base(*arguments))


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extra", "command"), [(extra, hint) for extra, some in HINTS.items() for hint in some]
)
def test_without_its_extra_a_command_says_what_to_install(
    extra: str, command: str, base: Run, log: Path, tmp_path: Path
) -> None:
    paths = {"L": log, "C": GRIPPER, "U": OPC_UA}
    refused = base(*(paths.get(word, word) for word in command.split()))
    assert refused.returncode == ConfigError.exit_code, refused.stderr
    first, second = refused.stderr.splitlines()
    assert first.startswith("twin: ")
    assert f" needs the extra [{extra}]: " in first
    assert second.strip() == install_hint(extra)


def test_results_over_opcua_need_the_extra(base: Run, tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(GRIPPER.read_text() + "\n[results]\nopcua = true\n")
    assert "[results] over OPC UA needs the extra [opcua]" in base("run", path, "--once").stderr


def test_a_notebook_needs_the_extra(base: Run) -> None:
    assert "twin.open needs the extra [notebook]" in base(code="import twin; twin.open").stderr
