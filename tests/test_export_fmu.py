"""``twin export-fmu`` on the command line, and the system structures that it writes."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
import rigs
from command_line import twin
from fmpy import extract, read_model_description, simulate_fmu
from fmpy.ssp.ssd import ParameterSet, build_path, get_connections, read_ssd, read_ssv
from fmpy.validation import validate_fmu
from fmus import by_twin

from twin.config import Config
from twin.model.dataset import coefficients
from twin.settings import Document
from twin.signals import MS, Command

UNIT = '[asset]\ntype = "compact-ejector-35"\nid = "paper-unit"\n'


def exported(monkeypatch: pytest.MonkeyPatch, folder: Path, *options: str | Path) -> int:
    monkeypatch.chdir(folder)
    return twin(monkeypatch, "export-fmu", *options)


def values(parameters: ParameterSet) -> dict[str, str]:
    return {parameter.name: parameter.value for parameter in parameters.parameters}


@pytest.mark.needs("cc")
def test_a_unit_of_the_database_is_written_under_its_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exported(monkeypatch, tmp_path, "--id", "paper-unit") == 0
    said = capsys.readouterr()
    assert "paper-unit in paper_unit.fmu: FMI 3.0, instance-specific data" in said.out
    assert "compiled: binaries/" in said.err
    path = str(tmp_path / "paper_unit.fmu")
    assert validate_fmu(path) == []
    assert read_model_description(path).modelName == "paper-unit"


def test_a_configuration_says_which_and_what(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    options = ("--config", rigs.path_of("gripper"), "--fmi", "2", "--vessel", "outside")
    assert exported(monkeypatch, tmp_path, *options, "--sources-only", "-o", "a.fmu") == 0
    described = read_model_description(str(tmp_path / "a.fmu"))
    known = {variable.name: variable for variable in described.modelVariables}
    assert described.fmiVersion == "2.0"
    assert known["vessel.pressure"].causality == "input"
    assert "vessel.inflow" not in known
    assert "effect.added_volume.volume" not in known  # the vessel is somebody else's
    assert float(known["supply.pressure"].start) == 5e5
    assert (known["effect.leakage.sonic_flow"].min, known["effect.leakage.sonic_flow"].max) == (
        "0.0",
        "60.0",
    )
    with zipfile.ZipFile(tmp_path / "a.fmu") as archive:
        assert not [name for name in archive.namelist() if name.startswith("binaries")]
        page = archive.read("documentation/index.html").decode()
    assert all(f"<code>{name}</code>" in page for name in known)


def test_a_mistyped_unit_is_refused_and_its_type_is_one_that_can_be_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--config", rigs.path_of("test_rig"), "--sources-only")
    assert exported(monkeypatch, tmp_path, *options, "--id", "paper-unlt") == 2
    assert "did you mean 'paper-unit'?" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    assert exported(monkeypatch, tmp_path, *options, "--id", "compact-ejector-35") == 0
    assert "compact-ejector-35 in compact_ejector_35.fmu" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ((), "of which ejector?"),
        (("--id", "nobody"), "no type or unit is called 'nobody'"),
        (("--id", "paper-unit", "-o", "a.zip"), "does not end in .fmu or .ssp"),
        (("--id", "paper-unit", "--fmi", "1"), "Invalid value for '--fmi'"),
    ],
)
def test_a_wrong_wish_is_refused(
    options: tuple[str, ...],
    what: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert exported(monkeypatch, tmp_path, *options) == 2
    assert what in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_cannot_be_written_is_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--id", "paper-unit", "--sources-only", "-o", tmp_path / "none" / "a.fmu")
    assert exported(monkeypatch, tmp_path, *options) == 3
    assert "cannot be written" in capsys.readouterr().err


@pytest.mark.needs("cc")
def test_the_unit_lies_over_its_type_in_a_system_structure(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert exported(monkeypatch, tmp_path, "--id", "paper-unit", "-o", "a.ssp") == 0
    path = str(tmp_path / "a.ssp")
    component = read_ssd(path).system.elements[0]  # validated against the schema
    sources = [binding.source for binding in component.parameterBindings]
    assert sources == ["resources/type.ssv", "resources/unit.ssv"]  # the later one holds
    kind, unit = (values(read_ssv(path, resource=source)) for source in sources)
    extract(path, tmp_path / "all")
    fmu = str(tmp_path / "all" / component.source)
    described = read_model_description(fmu)
    own = {
        variable.name: variable
        for variable in described.modelVariables
        if variable.causality == "parameter"
    }
    assert set(kind) == set(own)
    assert 0 < len(unit) < len(kind)
    for name, value in unit.items():
        assert kind[name] != value
        assert own[name].start == value
    # Both bindings as they are said to be laid, into a tool that knows nothing of the data sets.
    commands = np.repeat(np.array([0, Command.SUCTION], np.uint8), [50, 800])
    given = [("time", float), ("command.suction", bool)]
    rows = np.zeros(len(commands), given)
    rows["time"], rows["command.suction"] = np.arange(len(commands)) * MS, commands
    for bindings, whose in ((kind, ""), ({**kind, **unit}, "paper-unit")):
        start = {k: v for k, v in bindings.items() if own[k].type != "Enumeration"}
        result = simulate_fmu(
            fmu, stop_time=rows["time"][-1], step_size=MS, output_interval=MS,
            input=rows, start_values=start, output=["sensor.pressure"],
        )  # fmt: skip
        document = Document.parse(UNIT.replace("paper-unit", whose), "")
        theta = coefficients(Config.of(document).data)
        assert np.abs(result["sensor.pressure"] - by_twin(theta, commands)).max() < 0.1


SEEN = """
[data.catalogue.NAME]
mechanism = "sensor_warming_up"
sentence = "What somebody saw"
parameters.offset = { low = -20.0, high = 20.0, found = 5.0 }
parameters.sets_in = { low = 1.0, high = 60.0, found = 10.0 }
"""


def test_effects_taken_in_are_parameters_of_unit_and_type_and_those_left_out_are_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "a.toml"
    catalogue = "".join(SEEN.replace("NAME", name) for name in ("warm", "warmer", "hot"))
    found = "[data.effects.sensor_warming_up]\noffset = 3.0\nsets_in = 20.0\n"
    config.write_text(UNIT + catalogue + found, encoding="utf-8")
    options = ("--config", config, "--sources-only", "-o", "a.ssp")
    assert exported(monkeypatch, tmp_path, *options) == 0
    assert "left out of the catalogue: hot (no more than 2 mechanisms" in capsys.readouterr().err
    path = str(tmp_path / "a.ssp")
    kind = values(read_ssv(path, resource="resources/type.ssv"))
    extract(path, tmp_path / "all")
    described = read_model_description(str(tmp_path / "all" / "resources" / "paper_unit.fmu"))
    own = {variable.name: variable for variable in described.modelVariables}
    names = {name for name in own if name.startswith(("effect.warm", "effect.hot"))}
    assert names == {f"effect.{of}.{p}" for of in ("warm", "warmer") for p in ("offset", "sets_in")}
    assert names < set(kind)
    assert (own["effect.warm.offset"].start, own["effect.warm.offset"].max) == ("3.0", "20.0")
    assert (own["effect.warmer.offset"].start, own["effect.warmer.sets_in"].start) == (
        "0.0",
        "10.0",
    )


@pytest.mark.parametrize("where", ["inside", "outside"])
def test_every_port_leads_out_of_the_system(
    where: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    config = rigs.path_of("gripper")
    options = ("--config", config, "--sources-only", "--vessel", where, "-o", "a.ssp")
    assert exported(monkeypatch, tmp_path, *options) == 0
    system = read_ssd(str(tmp_path / "a.ssp")).system
    ports = {connector.name: connector.kind for connector in system.connectors}
    led = {(build_path(start), build_path(end)) for start, end in get_connections(system)}
    for name, kind in ports.items():
        ends = (f"system.{name}", f"system.ejector.{name}")
        assert (ends if kind == "input" else ends[::-1]) in led
    assert len(led) == len(ports)
    assert {"supply.pressure", "vessel.pressure", "vessel.mass_flow"} <= set(ports)


def test_a_data_set_with_terms_says_that_they_are_left_out(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    term = '\n[[data.terms]]\nwhere = "hold"\nover = "time"\nat = [0.0]\nmbar = [3.0]\n'
    path = tmp_path / "cell.toml"
    path.write_text(rigs.path_of("gripper").read_text() + term)
    options = ("--config", path, "--sources-only", "-o", "a.fmu")
    assert exported(monkeypatch, tmp_path, *options) == 0
    assert "terms are left out" in capsys.readouterr().err
