"""The asset database as Asset Administration Shells: nothing is lost, others understand it."""

import json
import sys
import time
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aas_test_engines.file import check_aasx_file
from basyx.aas import model
from basyx.aas.adapter.aasx import AASXReader, AASXWriter, DictSupplementaryFileContainer
from basyx.aas.examples.data import example_aas
from basyx.aas.util.traversal import walk_submodel
from command_line import twin
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.assets.database import Assets, open_assets
from twin.assets.diagram import FLOW, SUPPLY, VACUUM
from twin.assets.exchange import to_export
from twin.assets.record import Record, checked
from twin.errors import ConfigError, SourceError, TwinError
from twin.exchange.aas import read_package, write_package
from twin.exchange.elements import Element, meaning
from twin.exchange.fmu_file import read_fmu
from twin.exchange.submodels import place_of
from twin.extras import install_hint

HOUR = 3600 * 10**9
LOG = {"log": "healthy day.mcap", "log_sha256": "00ff" * 16, "note": "after the repair"}
DIAGRAM = {
    VACUUM: np.array([0.0, 300.0, 600.0, 850.0]),
    SUPPLY: np.array([4.0, 5.0]),
    FLOW: np.array([[30.0, 20.0, 10.0, 0.1], [35.0, 24.0, 12.0, 0.3]]),
}


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Assets]:
    """A type with a diagram, and a unit of it with a history."""
    with open_assets(tmp_path / "assets.sqlite") as assets:
        assets.add(Record("type", "vs-40", "vs-40", {"ejector": {"bulge": 0.1}}, arrays=DIAGRAM))
        system = {"parts": [{"kind": "tube", "length_mm": 50.0}, {"kind": "vessel"}]}
        covariance = {"covariance": np.array([[1e-300, -0.0], [-0.0, 0.1 + 0.2]])}
        first = Record(
            "instance", "cell-3", "vs-40", {"ejector": {"h1_mbar": 750}}, valid_from_ns=5
        )
        assets.add(first)
        assets.add(
            replace(
                first,
                data={"ejector": {"h1_mbar": 740.5, "air_saving": "on"}, "system": system},
                healthy={"uncertain": {"ejector.h1_mbar": [0.25]}},
                arrays=covariance,
                provenance=LOG,
                valid_from_ns=HOUR,
            )
        )
        yield assets


@pytest.fixture
def fmu(tmp_path: Path) -> Path:
    path = tmp_path / "cell 3.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        head = '<fmiModelDescription fmiVersion="3.0" version="7">'
        text = f"{head}<CoSimulation/></fmiModelDescription>"
        archive.writestr("modelDescription.xml", text)
        archive.writestr("binaries/x86_64-linux/cell.so", bytes(range(256)))
    return path


def written(path: Path, records: list[Record], fmus: Any = None, logs: str = "") -> Path:
    path.write_bytes(write_package(records, time.time_ns(), fmus or {}, logs))
    return path


Shells = dict[str, model.AssetAdministrationShell]


def read(path: Path) -> tuple[Any, Shells, DictSupplementaryFileContainer]:
    """As any other program reads it: what is in it, and its shells by name."""
    store: Any = model.DictIdentifiableStore()
    files = DictSupplementaryFileContainer()
    with AASXReader(path, failsafe=False) as reader:
        reader.read_into(store, files)
    shells = {
        shell.id_short: shell
        for shell in store
        if isinstance(shell, model.AssetAdministrationShell)
    }
    return store, shells, files


def submodel(store: Any, shell: model.AssetAdministrationShell, semantic: str) -> Any:
    """The submodel of a shell that means this."""
    (found,) = (
        submodel
        for submodel in (reference.resolve(store) for reference in shell.submodel)
        if submodel.semantic_id == meaning(semantic)
    )
    return found


def element(inside: Any, *path: str) -> Any:
    for name in path:
        inside = inside.get_referable(name)
    return inside


def conforming(path: Path) -> None:
    """Another party's checker has nothing to say."""
    with path.open("rb") as file:
        result = check_aasx_file(file)
    said = [line for line in result.to_lines() if "\033[92m" not in line]  # all but what is fine
    assert result.ok(), "\n".join(said)
    assert said == []


# Nothing is lost.

KEYS = st.text(min_size=1, max_size=6)
NUMBERS = st.floats(-1e308, 1e308)  # the checker refuses the very largest, which is one, too
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | NUMBERS | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=12,
)
TABLES = st.dictionaries(KEYS, VALUES, max_size=4)
NAMES = st.just("a b/c.d") | st.text(
    st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=12
)
TIMES = st.integers(-(2**63), 2**63 - 1)
ARRAYS = st.dictionaries(
    NAMES,
    st.lists(NUMBERS, max_size=6).map(np.array),
    max_size=2,
)


@st.composite
def histories(draw: st.DrawFn) -> list[Record]:
    """A type, sometimes with a diagram, and units of it, as the database would have them."""
    kind, units = draw(NAMES), draw(st.lists(NAMES, max_size=3))
    whose = [("type", kind), *(("instance", unit) for unit in units)]
    records = []
    for number, (what, name) in enumerate(whose):
        arrays = {**draw(ARRAYS), **(DIAGRAM if what == "type" and draw(st.booleans()) else {})}
        tables = (draw(TABLES) for _ in range(3))
        data, healthy, provenance = tables
        record = Record(
            what,  # type: ignore[arg-type]
            name,
            kind,
            data,
            healthy,
            arrays,
            provenance,
            valid_from_ns=draw(TIMES),
            recorded_ns=1000 + number,
            id=f"{draw(st.integers(0, 2**100)):030x}{number:02x}",
        )
        records.append(checked(record))
    return records


@pytest.mark.slow
@settings(max_examples=40)
@given(records=histories())
def test_whatever_the_database_holds_comes_back_and_the_shells_conform(
    records: list[Record], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = written(tmp_path_factory.mktemp("aas") / "a.aasx", records)
    document = read_package(path).document
    assert document == to_export(records)
    assert json.dumps(document) == json.dumps(to_export(records))  # −0.0 and 1 for 1.0 as well
    conforming(path)


def test_a_database_is_the_same_after_export_and_import(
    database: Assets, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert twin(monkeypatch, "assets", "export", "--aasx", "a.aasx") == 0
    assert twin(monkeypatch, "assets", "export", "-o", "one.json") == 0
    there = "sqlite:///there.sqlite"
    assert twin(monkeypatch, "assets", "import", "a.aasx", "--assets", there) == 0
    assert twin(monkeypatch, "assets", "export", "-o", "two.json", "--assets", there) == 0
    assert Path("one.json").read_bytes() == Path("two.json").read_bytes()
    with open_assets("there.sqlite") as copied:
        for one, other in zip(database.records(), copied.records(), strict=True):
            assert (one.id, one.hash) == (other.id, other.hash)
            assert {name: of.tobytes() for name, of in one.arrays.items()} == {
                name: of.tobytes() for name, of in other.arrays.items()
            }


def test_a_second_import_brings_nothing(
    database: Assets,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "a.aasx", database.records())
    assert twin(monkeypatch, "assets", "import", "a.aasx") == 0
    assert "0 new of 7 records" in capsys.readouterr().out


# What others see.


def test_a_unit_is_derived_from_its_type(database: Assets, tmp_path: Path) -> None:
    store, shells, _ = read(written(tmp_path / "a.aasx", database.records()))
    unit, kind = shells["cell_3"], shells["vs_40"]
    assert unit.derived_from is not None
    assert unit.derived_from.resolve(store) is kind
    assert kind.derived_from is None
    assert kind.asset_information.asset_kind is model.AssetKind.TYPE
    assert unit.asset_information.asset_kind is model.AssetKind.INSTANCE
    assert unit.asset_information.asset_type == kind.asset_information.global_asset_id
    assert [asset_id.value for asset_id in unit.asset_information.specific_asset_id] == ["cell-3"]


def test_ids_are_the_same_in_every_export(database: Assets, tmp_path: Path) -> None:
    first = {record.id for record in read(written(tmp_path / "a.aasx", database.records()))[0]}
    database.add(Record("instance", "cell-3", "vs-40", {"ejector": {"h1_mbar": 700}}))
    second = {record.id for record in read(written(tmp_path / "b.aasx", database.records()))[0]}
    assert first == second


def test_the_nameplate_says_what_is_known_and_makes_nothing_up(
    database: Assets, tmp_path: Path
) -> None:
    store, shells, _ = read(written(tmp_path / "a.aasx", database.records()))
    plate = submodel(store, shells["cell_3"], "https://admin-shell.io/idta/nameplate/3/0/Nameplate")
    assert element(plate, "SerialNumber").value == "cell-3"
    assert element(plate, "ManufacturerProductType").value == "vs-40"
    assert element(plate, "ManufacturerName").value is None
    assert (
        element(plate, "URIOfTheProduct").value
        == shells["cell_3"].asset_information.global_asset_id
    )


def test_technical_data_are_those_that_hold(database: Assets, tmp_path: Path) -> None:
    records = database.records()
    store, shells, _ = read(written(tmp_path / "a.aasx", records))
    technical = submodel(store, shells["cell_3"], "0173-1#01-AHX837#002")
    (area,) = element(technical, "TechnicalPropertyAreas").value
    assert element(area, "data", "ejector", "h1_mbar").value == 740.5
    assert element(area, "data", "ejector", "air_saving").value == "on"
    assert element(area, "data", "system", "parts", "parts_0", "length_mm").value == 50.0
    said = element(technical, "FurtherInformation", "TextStatement").value["en"]
    assert records[-1].hash in said
    assert "after the repair" in said


def test_the_characteristic_diagram_can_be_read(database: Assets, tmp_path: Path) -> None:
    store, shells, _ = read(written(tmp_path / "a.aasx", database.records()))
    technical = submodel(store, shells["vs_40"], "0173-1#01-AHX837#002")
    (area,) = element(technical, "TechnicalPropertyAreas").value
    diagram = element(area, "characteristic_diagram")
    assert numbers(element(diagram, "vacuum_mbar")) == DIAGRAM[VACUUM].tolist()
    for number, supply in enumerate(DIAGRAM[SUPPLY]):
        curve = element(diagram, f"curve_{number}")
        assert element(curve, "supply_bar").value == supply
        row = DIAGRAM[FLOW][number]
        assert numbers(element(curve, "suction_capacity_sl_min")) == row.tolist()


def numbers(listed: Any) -> list[float]:
    return [element.value for element in listed.value]


@pytest.mark.parametrize(
    ("logs", "where"),
    [
        ("https://logs.plant/mcap/", "https://logs.plant/mcap/healthy%20day.mcap"),
        ("", place_of("", LOG["log_sha256"], "")),
    ],
)
def test_logs_are_external_segments(
    logs: str, where: str, database: Assets, tmp_path: Path
) -> None:
    path = written(tmp_path / "a.aasx", database.records(), logs=logs)
    store, shells, files = read(path)
    series = submodel(store, shells["cell_3"], "https://admin-shell.io/idta/TimeSeries/1/1")
    (segment,) = element(series, "Segments").value
    assert segment.semantic_id == meaning(
        "https://admin-shell.io/idta/TimeSeries/Segments/ExternalSegment/1/1"
    )
    assert element(segment, "File").value == where
    assert element(segment, "Name").value["en"] == "healthy day.mcap"
    assert not any("mcap" in name for name in files)
    assert not [
        reference
        for reference in shells["vs_40"].submodel
        if "TimeSeries" in str(reference.resolve(store))
    ]
    conforming(path)


def test_a_log_is_named_by_its_content() -> None:
    # The example of RFC 6920, 8.1: "Hello World!".
    digest = "7f83b1657ff1fc53b92dc18148a1d65dfc2d4b1fa3d677284addd200126d9069"
    assert place_of("a", digest, "") == "ni:///sha-256;f4OxZX_x_FO5LcGBSKHWXfwtSx-j1ncoSt3SABJtkGk"


def test_a_simulation_model_goes_along_and_comes_back(
    database: Assets,
    fmu: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    options = ("--aasx", "a.aasx", "--id", "cell-3", "--fmu", fmu)
    assert twin(monkeypatch, "assets", "export", *options) == 0
    conforming(tmp_path / "a.aasx")
    store, shells, files = read(tmp_path / "a.aasx")
    semantic = "https://admin-shell.io/idta/SimulationModels/SimulationModels/1/0"
    models = submodel(store, shells["cell_3"], semantic)
    file = element(models, "SimulationModel", "ModelFile")
    assert element(file, "ModelFileType").value == "FMI 3.0, Co-Simulation"
    assert element(file, "ModelFileVersion", "ModelVersionId").value == "7"
    content = BytesIO()
    files.write_file(element(file, "ModelFileVersion", "DigitalFile").value, content)
    assert content.getvalue() == fmu.read_bytes()
    assert twin(monkeypatch, "assets", "import", "a.aasx", "--assets", "b.sqlite") == 0
    assert "cell_3.fmu; --fmu FILE writes it" in capsys.readouterr().err
    back = ("a.aasx", "--assets", "c.sqlite", "--fmu", "back.fmu")
    assert twin(monkeypatch, "assets", "import", *back) == 0
    assert Path("back.fmu").read_bytes() == fmu.read_bytes()


def test_only_a_unit_and_its_type_go_into_a_package_of_it(
    database: Assets, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert twin(monkeypatch, "assets", "export", "--aasx", "a.aasx", "--id", "cell-3") == 0
    assert set(read(tmp_path / "a.aasx")[1]) == {"cell_3", "vs_40"}
    assert len(read_package(tmp_path / "a.aasx").document["records"]) == 3


# What is refused.


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--fmu", "x.fmu"), "are for shells"),
        (("--logs", "https://x"), "are for shells"),
        (("--aasx", "a.zip"), "not a package of shells"),
        (("--aasx", "a.aasx", "-o", "b.json"), "exclude each other"),
        (("--aasx", "a.aasx", "--fmu", "x.fmu"), "is of one unit"),
        (("--aasx", "a.aasx", "--id", "nobody"), "no type or unit is called 'nobody'"),
        (("--aasx", "a.aasx", "--id", "cell-3", "--fmu", "text.txt"), "text.txt: not an FMU"),
    ],
)
@pytest.mark.usefixtures("database")
def test_options_that_mean_nothing_are_refused(
    options: tuple[str, ...],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("text.txt").write_text("no FMU")
    assert twin(monkeypatch, "assets", "export", *options) == 2
    assert said in capsys.readouterr().err
    assert not Path("a.aasx").exists()


def test_without_the_library_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "basyx.aas", None)
    assert twin(monkeypatch, "assets", "export", "--aasx", "a.aasx") == 2
    assert install_hint("aas") in capsys.readouterr().err


def test_an_fmu_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="cannot be read: No such file"):
        read_fmu(tmp_path / "nowhere.fmu")
    path = tmp_path / "a.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", "<fmiModelDescription/>")
    with pytest.raises(ConfigError, match="not an FMU: 'fmiVersion'"):
        read_fmu(path)


def test_a_package_without_an_fmu_gives_none(
    database: Assets,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "a.aasx", database.records())
    assert twin(monkeypatch, "assets", "import", "a.aasx", "--fmu", "b.fmu") == 2
    assert "--fmu writes one FMU, and in it are: none" in capsys.readouterr().err


def test_a_file_that_is_no_package_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"nowhere\.aasx: cannot be read: No such file"):
        read_package(tmp_path / "nowhere.aasx")
    path = tmp_path / "a.aasx"
    path.write_text("no ZIP")
    with pytest.raises(ConfigError, match=r"a\.aasx: not a whole AASX package"):
        read_package(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", "a ZIP")
    with pytest.raises(ConfigError, match=r"a\.aasx: not a whole AASX package"):
        read_package(path)


def test_another_programs_package_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.aasx"
    store: Any = example_aas.create_full_example()
    files = DictSupplementaryFileContainer()
    files.add_file("/TestFile.pdf", BytesIO(b"%PDF"), "application/pdf")
    with AASXWriter(path) as writer:
        writer.write_all_aas_objects("/aasx/data.xml", store, files)
    with pytest.raises(ConfigError, match="no shell in it has data sets of this program"):
        read_package(path)


def changed(path: Path, part: str, old: str, new: str) -> Path:
    """The package with a passage changed in the parts of a name."""
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    assert any(old.encode() in of for name, of in parts.items() if part in name)
    with zipfile.ZipFile(path, "w") as archive:
        for name, of in parts.items():
            archive.writestr(name, of.replace(old.encode(), new.encode()) if part in name else of)
    return path


@pytest.mark.parametrize(
    ("part", "old", "new", "said"),
    [
        ("records.json", "740.5", "741.5", "its hash differs"),
        ("records.json", '"kind"', '"kin"', "not an export of an asset database"),
        ("records.json", "{", "", "not valid JSON"),
        ("data.json", "740.5", "741.5", "technical data of 'cell-3' were changed"),
        ("data.json", "records.json", "nothing.json", "not a whole AASX package"),
        ("data.json", '"idShort"', '"idshort"', "not a whole AASX package"),
    ],
)
def test_a_package_that_was_changed_is_refused(
    part: str, old: str, new: str, said: str, database: Assets, tmp_path: Path
) -> None:
    path = written(tmp_path / "a.aasx", database.records())
    with pytest.raises(ConfigError, match=said):
        read_package(changed(path, part, old, new))


@pytest.mark.slow
def test_a_damaged_package_is_refused_or_whole(database: Assets, tmp_path: Path) -> None:
    whole = write_package(database.records(), time.time_ns(), {}, "")
    path, rng = tmp_path / "a.aasx", np.random.default_rng(5)
    refused = 0
    for _ in range(60):
        content = bytearray(whole)
        content[rng.integers(len(content))] ^= 1 << rng.integers(8)
        path.write_bytes(content[: rng.integers(len(content) // 2, 2 * len(content))])
        try:
            assert read_package(path).document == database.export()
        except TwinError:
            refused += 1
    assert refused > 30


def test_every_file_that_a_shell_names_is_there(
    database: Assets, fmu: Path, tmp_path: Path
) -> None:
    models = {"cell-3": read_fmu(fmu)}
    store, _, files = read(written(tmp_path / "a.aasx", database.records(), models))
    named = {
        element.value
        for inside in store
        if isinstance(inside, model.Submodel)
        for element in elements(inside)
        if isinstance(element, model.File) and str(element.value).startswith("/")
    }
    assert named == set(files)


def elements(inside: model.Submodel) -> Iterator[Element]:
    yield from walk_submodel(inside)
