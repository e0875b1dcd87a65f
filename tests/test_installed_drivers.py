"""Drivers of other packages: that of the documentation is installed and run, and bad ones."""

import os
import re
import socketserver
import subprocess
import sys
import threading
import time
import tomllib
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import hatchling.build
import jsonschema
import numpy as np
import pytest
import rigs
import tomli_w
from doc_examples import blocks

from drivers import installed
from drivers.sources import BUILT_IN, open_source, probe_source, settings_of
from twin.cli.config import json_schema, mistakes
from twin.errors import ConfigError, SourceError, TwinError
from twin.events import Kind
from twin.log.reader import open_log
from twin.quality import Quality
from twin.settings import Document
from twin.signals import MBAR, Samples

PAGE = "write-a-driver.md"
TABLE, PROJECT = blocks(PAGE, "toml")
(MODULE,) = blocks(PAGE, "python")
ROWS_AT_ONCE = 30
Run = Callable[..., "subprocess.CompletedProcess[str]"]


# --- the example --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the example is installed, as from its wheel."""
    folder = tmp_path_factory.mktemp("ejector-twin-lines")
    (folder / "pyproject.toml").write_text(PROJECT)
    (folder / "ejector_twin_lines.py").write_text(MODULE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        wheel = hatchling.build.build_wheel(str(folder))
    with zipfile.ZipFile(folder / wheel) as archive:
        archive.extractall(folder / "installed")
    return folder / "installed"


class _Sender(socketserver.BaseRequestHandler):
    """Sends the rows of a rig as lines, as fast as they are scanned."""

    def handle(self) -> None:
        samples, _ = rigs.recorded("gripper", 12.0)
        started_ns = time.time_ns()
        for rows in rigs.cut(samples, ROWS_AT_ONCE):
            passed_ns = rows["time_ns"] - samples["time_ns"][0]
            time.sleep(max(0.0, (started_ns + int(passed_ns[-1]) - time.time_ns()) * 1e-9))
            try:
                self.request.sendall(lines(rows, passed_ns + started_ns))
            except OSError:  # the twin has hung up
                return


def lines(rows: Samples, time_ns: "np.typing.NDArray[np.int64]") -> bytes:
    texts = (
        f"{row['sequence']} {ns} {float(row['pressure']) / MBAR!r} {row['commands']}\n"
        for row, ns in zip(rows, time_ns, strict=True)
    )
    return "".join(texts).encode()


@contextmanager
def line_server() -> Iterator[int]:
    """A PLC that sends lines; gives its port."""
    rigs.recorded("gripper", 12.0)  # before anybody waits for it
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), _Sender) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.server_address[1]
        finally:
            server.shutdown()
            thread.join()


def configuration(folder: Path, port: int) -> Path:
    """That of the gripper, with the table of the page."""
    tables = tomllib.loads(rigs.path_of("gripper").read_text()) | tomllib.loads(TABLE)
    tables["driver"] |= {"host": "127.0.0.1", "port": port}
    (path := folder / "cell.toml").write_text(tomli_w.dumps(tables))
    return path


def twin_with(packages: Path) -> Run:
    """Runs the command line with the packages of a folder, in a process of its own."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(packages), str(rigs.ROOT)])}

    def run(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
        command = [sys.executable, "-m", "twin.cli", *map(str, arguments)]
        return subprocess.run(
            command, cwd=packages, env=environment, capture_output=True, text=True, check=False
        )

    return run


@pytest.mark.slow
def test_the_twin_runs_on_the_driver_of_the_page(packages: Path, tmp_path: Path) -> None:
    twin, log = twin_with(packages), tmp_path / "lines.mcap"
    with line_server() as port:
        config = configuration(tmp_path, port)
        checked = twin("config", "check", config)
        assert checked.returncode == 0, checked.stdout
        probed = twin("probe", config)
        assert probed.returncode == 0, probed.stdout + probed.stderr
        assert re.fullmatch(r"ok  pressure       101\d\.\d mbar absolute\n", probed.stdout)
        done = twin("run", config, "--duration", 8, "--log", log)
    assert done.returncode == 0, done.stderr
    recorded = open_log(log)
    cycles = [event for event in recorded.events() if event.kind is Kind.CYCLE]
    assert len(cycles) >= 2
    rows = np.concatenate(list(recorded.samples))
    sent = rigs.recorded("gripper", 12.0)[0]
    sent = sent[: len(rows)] if rows["sequence"][0] == sent["sequence"][0] else sent[:0]
    for name in ("sequence", "pressure", "commands"):
        assert np.array_equal(rows[name], sent[name])
    assert not (rows["quality"] & ~np.uint8(Quality.OURS)).any()


# --- what a package can have wrong --------------------------------------------------------------


GOOD = """
import numpy as np
from drivers.driver import Driver
from drivers.probe import Line
from drivers.settings import DriverSettings
from twin.signals import SAMPLE

class Table(DriverSettings):
    host: str = ""

class Good(Driver):
    settings_class = Table
    def blocks(self, away=None, *, known=False):
        yield np.zeros(3, SAMPLE)
    def probe(self):
        return [Line("connection", f"to {self.settings.host}")]
"""
Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Installs a package with a driver: its kind, its code, its class, its name."""
    present = set(sys.modules)
    monkeypatch.syspath_prepend(tmp_path)

    def write(kind: str, code: str, name: str = "Good", package: str = "acme-drivers") -> None:
        module = f"{package.replace('-', '_')}_{kind}"
        (tmp_path / f"{module}.py").write_text(code)
        (folder := tmp_path / f"{package.replace('-', '_')}-2.1.dist-info").mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 2.1\n")
        (folder / "entry_points.txt").write_text(f"[{installed.GROUP}]\n{kind} = {module}:{name}\n")

    yield write
    for name in set(sys.modules) - present:
        if name.startswith("acme"):
            del sys.modules[name]


def table(text: str) -> Document:
    return Document.parse(f"[driver]\n{text}", "cell.toml")


def test_a_driver_of_another_package_is_opened_and_probed(install: Install) -> None:
    install("acme", GOOD)
    document = table('kind = "acme"\nhost = "there"')
    assert [len(block) for block in open_source(document)] == [3]
    assert list(probe_source(document)) == ["ok  connection     to there"]
    assert not any("driver" in mistake for mistake in mistakes(document))


def test_its_keys_are_checked_as_others_are(install: Install) -> None:
    install("acme", GOOD)
    (mistake,) = (one for one in mistakes(table('kind = "acme"\nhots = "there"')) if "hots" in one)
    assert mistake == "cell.toml:3: driver.hots: unknown key: do you mean host?"
    with pytest.raises(ConfigError, match="'acme' takes no --address"):
        settings_of(table('kind = "acme"'), "plc:1")


def test_one_that_cannot_write_says_so(install: Install) -> None:
    install("acme", GOOD)
    document = table('kind = "acme"\n[hil.tags]\n')
    assert any("of kind 'acme' only reads; leave [hil] out" in one for one in mistakes(document))


def test_an_unknown_kind_names_what_there_is(install: Install) -> None:
    install("acme", GOOD)
    with pytest.raises(ConfigError, match=r"cell.toml:2: unknown driver 'acne'") as caught:
        settings_of(table('kind = "acne"'))
    assert caught.value.hint.startswith(
        "did you mean 'acme'? known: acme, modbus, opcua; 'acme' comes with acme-drivers 2.1; "
    )


@pytest.mark.parametrize(
    ("code", "name", "message"),
    [
        ("import snap7_not_there", "Good", "imported from acme_drivers_acme:Good: ModuleNotFound"),
        ("class Good(", "Good", "SyntaxError"),
        ("raise OSError('no licence')", "Good", "OSError: no licence"),
        (GOOD, "Better", "AttributeError: .*Better"),
        ("class Good: pass", "Good", "is no class derived from drivers.driver.Driver"),
        (GOOD, "np", "is no class derived from"),
        (GOOD.replace("def probe", "def prob"), "Good", "acme_drivers_acme:Good lacks probe"),
        (GOOD.replace("= Table", "= 3"), "Good", "has no settings_class derived from"),
    ],
)
def test_one_that_cannot_be_used_says_why(
    code: str, name: str, message: str, install: Install
) -> None:
    install("acme", code, name)
    whole = rf"^cell.toml: the driver 'acme' of acme-drivers 2.1 .*{message}"
    with pytest.raises(ConfigError, match=whole) as caught:
        open_source(table('kind = "acme"'))
    assert caught.value.hint
    assert any(str(caught.value) in mistake for mistake in mistakes(table('kind = "acme"')))


INIT = "    def __init__(self, settings, pool=None):"
WRONG = "    host: str = ''\n    def"


@pytest.mark.parametrize(
    ("old", "new", "address", "message"),
    [
        ("import numpy", "import sys; sys.exit()\nimport numpy", "", "imported .*: SystemExit"),
        ("= Table\n", "= Table\n    hil_settings_class = 3\n", "", "has a hil_settings_class that"),
        ("= Table\n", f"= Table\n{INIT}\n        pass\n", "", "failed: AttributeError: .*settings"),
        ("= Table\n", f"= Table\n{INIT}\n        1 / 0\n", "", "failed: ZeroDiv.*line 14"),
        ('    host: str = ""', f"{WRONG} below(self, folder): 1 / 0", "", "failed: Zero.*line 10"),
        ('    host: str = ""', f"{WRONG} below(self, folder): pass", "", "NoneType instead of set"),
        ('    host: str = ""', f"{WRONG} at(self, host, port): {{}}['x']", "a:1", "failed: KeyErr"),
        ('[Line("connection", f"to', '[(f"to', "", "gave str instead of a line"),
        ('[Line("connection", f"to', 'exit(1); [(f"to', "", "failed: SystemExit: 1"),
    ],
)
def test_one_that_cannot_be_probed_is_named(
    old: str, new: str, address: str, message: str, install: Install
) -> None:
    assert GOOD.count(old) == 1
    install("acme", GOOD.replace(old, new))
    whole = f"the driver 'acme' of acme-drivers 2.1 .*{message}"
    with pytest.raises(TwinError, match=whole) as caught:
        list(probe_source(table('kind = "acme"'), address))
    assert caught.value.hint


def test_a_mistake_in_its_settings_is_among_those_of_the_configuration(install: Install) -> None:
    install("acme", GOOD.replace('host: str = ""', "def below(self, folder): 1 / 0"))
    assert any("failed: ZeroDiv" in mistake for mistake in mistakes(table('kind = "acme"')))


def test_two_packages_with_one_kind_are_named(install: Install) -> None:
    install("acme", GOOD)
    install("acme", GOOD, package="bolt-drivers")
    with pytest.raises(ConfigError, match=r"'acme': acme-drivers 2.1 and bolt-drivers 2.1"):
        open_source(table('kind = "acme"'))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("yield np.zeros(3, SAMPLE)", "yield [1, 2]", "gave list instead of a block"),
        ("zeros(3, SAMPLE)", "zeros(3)", "gave an array of float64 in 1 dim"),
        ("zeros(3, SAMPLE)", "zeros((3, 3), SAMPLE)", "in 2 dimensions instead of a block"),
        ("yield np", "{}['slot']; yield np", "KeyError: 'slot' .*acme.py, line 14"),
        ("yield", "return", "instead of a block"),
    ],
)
def test_one_that_fails_is_named(old: str, new: str, message: str, install: Install) -> None:
    install("acme", GOOD.replace(old, new))
    with pytest.raises(SourceError, match=f"the driver 'acme' of acme-drivers 2.1 .*{message}"):
        next(open_source(table('kind = "acme"')))


def test_one_whose_probe_fails_is_named(install: Install) -> None:
    install("acme", GOOD.replace("return [Line", "raise OSError('slot')\n        return [Line"))
    with pytest.raises(SourceError, match=r"acme-drivers 2.1 failed: OSError: slot \(.*line 16"):
        list(probe_source(table('kind = "acme"')))


HELD = """
        rows.append(self.rows(known))
        return rows[-1]
    def rows(self, known):
        try:
            yield np.zeros(3, SAMPLE)
            raise SourceError("rack 2 is off", "switch it on")
        finally:
            released.append(known)
"""


@pytest.mark.parametrize("ends_by", ["error", "close"])
def test_what_it_holds_is_released(ends_by: str, install: Install) -> None:
    code = GOOD.replace("        yield np.zeros(3, SAMPLE)\n", HELD)
    install("acme", f"from twin.errors import SourceError\nrows, released = [], []\n{code}")
    source = open_source(table('kind = "acme"'), known=True)
    next(source)
    if ends_by == "error":
        with pytest.raises(SourceError, match=r"^rack 2 is off$"):  # an error for people stays
            next(source)
    else:
        source.close()  # type: ignore[attr-defined]
    assert sys.modules["acme_drivers_acme"].released == [True]


# --- built-in ones ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", BUILT_IN)
def test_a_built_in_kind_is_never_looked_up(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A look-up takes some 50 ms of each start; and no package replaces a built-in driver."""
    monkeypatch.setattr(installed, "entry_points", pytest.fail)
    with pytest.raises(ConfigError, match="tags"):
        settings_of(table(f'kind = "{kind}"'))


def test_the_schema_takes_drivers_of_others() -> None:
    validator = jsonschema.Draft202012Validator(json_schema())
    assert validator.is_valid({"driver": {"kind": "acme", "rack": 2}})
    assert not validator.is_valid({"driver": {"kind": "modbus", "rack": 2}})
    assert not validator.is_valid({"driver": {"rack": 2}})


def test_the_schema_takes_what_drivers_of_others_write() -> None:
    validator = jsonschema.Draft202012Validator(json_schema())
    tables = tomllib.loads(rigs.path_of("gripper").read_text())
    built_in = tables["driver"]
    assert validator.is_valid({"driver": {"kind": "acme"}, "hil": {"db": 7}})
    assert not validator.is_valid({"driver": {"kind": "acme"}, "hil": 7})
    for other in ({"driver": built_in}, {"driver": built_in | {"kind": "modbus"}}, {}):
        assert validator.is_valid(other | {"hil": {"min_interval_ms": 50, "tags": {}}})
        assert not validator.is_valid(other | {"hil": {"tags": {}, "db": 7}})
