"""``import twin``: the tutorial as it stands, and the same answers as the command line."""

import json
import shlex
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import doc_examples
import numpy as np
import pytest
import rigs
from command_line import twin as command

import twin
from drivers.plc.faults import parse_fault
from tools.tutorial_data import CYCLES, write_data
from twin.assets.database import open_assets
from twin.config import Config
from twin.figures.table import FIGURES
from twin.hil import Plant
from twin.log.reader import open_log
from twin.settings import Document
from twin.signals import MBAR, Samples

SEED = 11  # what the tutorial names is hidden with this one
GRIPPER = rigs.path_of("gripper")


@dataclass(frozen=True)
class Read:
    """The tutorial, worked through."""

    folder: Path
    hidden: str
    names: dict[str, Any]  # that its examples leave
    said: str  # where it is not as it says


@pytest.fixture(scope="module")
def tutorial(tmp_path_factory: pytest.TempPathFactory) -> Read:
    folder = tmp_path_factory.mktemp("tutorial")
    hidden = write_data(folder, SEED)
    (text,) = doc_examples.blocks("tutorial.md", "toml")
    (folder / "cell.toml").write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return Read(folder, hidden, *doc_examples.run("tutorial.md"))


@pytest.fixture
def here(tutorial: Read, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tutorial.folder)
    return tutorial.folder


def fresh(code: str) -> str:
    """What a new interpreter prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout


# What it costs, and what it gives.


def test_importing_it_imports_next_to_nothing() -> None:
    heavy = "{'numpy', 'pydantic', 'numba', 'scipy', 'twin.api'}"
    assert fresh(f"import sys, twin; print(sorted({heavy} & set(sys.modules)))") == "[]\n"


def test_all_that_is_named_is_there_and_what_is_not_is_said() -> None:
    assert set(twin.__all__) <= set(dir(twin))
    for name in twin.__all__:
        assert getattr(twin, name).__doc__
    with pytest.raises(AttributeError, match="'twin' has no attribute 'opne'"):
        twin.opne  # noqa: B018  # type: ignore[attr-defined]


# The documentation.


def test_the_tutorial_says_what_happens(tutorial: Read) -> None:
    assert tutorial.said == ""


def test_the_tutorial_finds_what_was_hidden(tutorial: Read) -> None:
    hidden = parse_fault(tutorial.hidden)
    (cause,) = tutorial.names["answer"].causes
    size = cause["parameters"][hidden.parameter.name]
    assert cause["effect"] == hidden.effect
    assert size["low95"] < hidden.value < size["high95"]


def test_the_report_is_there(tutorial: Read) -> None:
    assert "<svg" in (tutorial.folder / "today.html").read_text()


def test_the_examples_of_the_reference_say_what_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(rigs.ROOT)
    assert doc_examples.run("api.md")[1] == ""


def test_the_reference_explains_every_column(tutorial: Read) -> None:
    page = (doc_examples.DOCS / "api.md").read_text()
    table = page[page.index("## Columns") : page.index("## Simulation")]
    assert [name for name in tutorial.names["rows"] if f"`{name}`" not in table] == []


# The same as the command line.


@pytest.fixture(scope="module")
def commanded(tutorial: Read) -> Path:
    """The tutorial's commands, run; JSON of the calibration as well.

    The calibration itself is not made again: what it is made of has to be the same.
    """
    calibrated, healthy = tutorial.names["calibrated"], tutorial.names["healthy"]
    configured = Config.of(Document.read(tutorial.folder / "cell.toml"), calibrated=False)
    begun = configured.with_sensor(is_gauge=True)  # the table has a vacuum

    def fitted(config: Config, blocks: Iterable[Samples], _say: object) -> object:
        assert (config.data, config.monitor, config.asset) == (
            begun.data,
            begun.monitor,
            begun.asset,
        )
        rows, own = (np.concatenate(list(one)) for one in (blocks, healthy._samples()))
        assert rows.tobytes() == own.tobytes()
        return calibrated._calibration

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tutorial.folder)
        patch.setattr("twin.calibration.calibrate.calibrate", fitted)
        lines = doc_examples.blocks("tutorial.md", "sh")[-1].splitlines()
        assert [line.split()[1] for line in lines] == ["import", "calibrate", "import", "diagnose"]
        for line in lines:
            told = ["--json", "unit.json"] if " calibrate " in line else []
            assert command(patch, *shlex.split(line)[1:], *told) == 0
    return tutorial.folder


def test_a_calibration_is_made_of_what_the_command_makes_it_of(
    tutorial: Read, commanded: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = json.loads((commanded / "unit.json").read_text())
    calibrated, given = tutorial.names["calibrated"], {}

    def fitted(config: Config, blocks: Iterable[Samples], _say: object) -> object:
        given["config"], given["rows"] = config, np.concatenate(list(blocks))
        return calibrated._calibration

    monkeypatch.setattr("twin.api.fit_unit", fitted)
    again = twin.calibrate(tutorial.names["healthy"])
    of_type = Config.of(Document.read(Path("cell.toml")), calibrated=False)
    assert given["config"] == of_type.with_sensor(is_gauge=True)  # the table has a vacuum
    assert again.values == calibrated.values == told["parameters"]
    assert again.config.data.model_dump(mode="json") == told["data"]
    assert again.config.monitor.healthy.model_dump(mode="json") == told["healthy"]
    assert told["cycles"] == CYCLES


def test_a_diagnosis_is_that_of_the_command(tutorial: Read, commanded: Path) -> None:
    told = json.loads((commanded / "today.json").read_text())
    assert tutorial.names["answer"].json | {"log": "today.mcap"} == told


@pytest.mark.usefixtures("here")
def test_rows_beside_a_table_are_those_of_its_log(tutorial: Read, commanded: Path) -> None:
    rows = tutorial.names["today"].columns()
    of_log = twin.open(commanded / "today.mcap").columns()
    assert list(rows) == list(of_log)
    for name, column in rows.items():
        assert column.dtype == of_log[name].dtype
        assert np.array_equal(column, of_log[name], equal_nan=column.dtype.kind == "f"), name


def test_key_figures_are_those_of_the_command(
    commanded: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert command(monkeypatch, "figures", "show", "today.mcap", "--json", "figures.json") == 0
    told = json.loads((here / "figures.json").read_text())["cycles"]
    cycles = twin.open(commanded / "today.mcap").cycles()
    assert cycles == [{k: v for k, v in one.items() if k != "alarms"} for one in told]
    assert {f"{name}_measured" for name in FIGURES} >= {k for k in cycles[2] if "_meas" in k}


def test_what_is_saved_is_found_again(tutorial: Read, here: Path, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'kept.sqlite'}"
    open_assets(url).close()
    healthy = twin.open("healthy.csv", "cell.toml", assets=url)
    calibrated = tutorial.names["calibrated"]
    record = type(calibrated)(calibrated.config, calibrated._calibration, healthy).save()
    found = twin.open("today.csv", "cell.toml", assets=url).config
    assert record.name == "cell-3"
    assert found.data == calibrated.config.data
    assert found.monitor.healthy == calibrated.config.monitor.healthy


# Columns.


def test_columns_are_what_was_recorded(commanded: Path) -> None:
    samples, ticks = map(np.concatenate, zip(*open_log(commanded / "today.mcap").blocks()))  # noqa: B905
    rows = twin.open(commanded / "today.mcap").columns()
    assert np.array_equal(rows["pressure_pa"], samples["pressure"].astype(float))
    assert np.array_equal(rows["suction"], (samples["commands"] & 1) == 1)
    assert np.array_equal(rows["blow_off"], (samples["commands"] & 2) == 2)
    assert np.array_equal(rows["phase"], ticks["phase"])
    assert rows["time_s"][0] == 0.0
    assert rows["time_s"][-1] == pytest.approx((len(samples) - 1) * 1e-3)
    difference = rows["pressure_pa"] - rows["expected_pa"]
    assert np.array_equal(rows["deviation_pa"], difference, equal_nan=True)


@pytest.mark.usefixtures("here")
def test_a_frame_has_the_columns(tutorial: Read) -> None:
    frame, rows = tutorial.names["frame"], tutorial.names["healthy"].columns()
    assert list(frame) == list(rows)
    for name, column in rows.items():
        assert np.array_equal(frame[name], column, equal_nan=column.dtype.kind == "f"), name


def test_without_pandas_it_says_what_to_install(
    tutorial: Read, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(twin.TwinError) as refused:
        tutorial.names["healthy"].frame()
    assert "[notebook]" in refused.value.hint


# Simulation.


def test_a_simulation_is_the_model_alone() -> None:
    samples, _ = rigs.recorded("gripper", 3.0)
    time = (samples["time_ns"] - samples["time_ns"][0]) * 1e-9
    commands = samples["commands"]
    found = twin.simulate(GRIPPER, time, commands & 1, commands & 2)
    pressure, _ = Plant(rigs.theta("gripper")).run(samples)
    assert np.array_equal(found["pressure_pa"], pressure)
    assert found["pressure_pa"][0] == pytest.approx(1013.0 * MBAR)


def test_a_simulated_effect_is_there() -> None:
    time = np.arange(0.0, 1.0, 1e-3)
    on, off = time > 0.1, np.zeros(len(time))
    shift = {"ambient_pressure": {"shift": -20.0}}
    plain, shifted = (twin.simulate(GRIPPER, time, on, off, one) for one in (None, shift))
    fell = plain["pressure_pa"][0] - shifted["pressure_pa"][0]
    assert fell == pytest.approx(20.0 * MBAR)


@pytest.mark.parametrize(
    ("time", "suction", "said"),
    [
        ([0.0, 0.001, 0.001], [0, 0, 0], "does not go forward"),
        ([0.0, np.nan, 0.002], [0, 0, 0], "does not go forward"),
        ([0.0, 0.001], [0, 0, 0], r"suction has the shape \(3,\), time_s \(2,\)"),
    ],
)
def test_columns_that_do_not_fit_are_refused(
    time: list[float], suction: list[int], said: str
) -> None:
    with pytest.raises(twin.TwinError, match=said):
        twin.simulate(GRIPPER, time, suction, np.zeros(len(time)))


# What is refused, and what is said.


def test_a_table_needs_a_configuration(tutorial: Read) -> None:
    with pytest.raises(twin.TwinError, match="does not say which ejector"):
        twin.open(tutorial.folder / "today.csv")


def test_a_log_of_another_ejector_is_refused_unless_that_is_meant(commanded: Path) -> None:
    with pytest.raises(twin.TwinError, match="is a log of compact-ejector-35 cell-3"):
        twin.open(commanded / "today.mcap", GRIPPER)
    with pytest.warns(UserWarning, match="no instance-specific data set of 'cell-3'"):
        log = twin.open(commanded / "today.mcap", GRIPPER, unit="cell-3")
    assert log.config.asset.id == "cell-3"
    with pytest.raises(twin.TwinError, match="no unit is called 'gripper-7'"):
        twin.open(commanded / "today.mcap", GRIPPER, unit="gripper-7")


def test_a_configuration_at_hand_is_taken_as_it_is(commanded: Path, tutorial: Read) -> None:
    config = tutorial.names["calibrated"].config
    assert twin.open(commanded / "today.mcap", config).config is config
    assert isinstance(config, Config)


def test_columns_that_are_not_taken_are_said(tutorial: Read, tmp_path: Path) -> None:
    head, *rows = (tutorial.folder / "today.csv").read_text().splitlines()[:20]
    path = tmp_path / "more.csv"
    path.write_text("\n".join([f"{head},torque", *(f"{row},1" for row in rows)]))
    with pytest.warns(UserWarning, match="columns not taken: torque"):
        twin.open(path, tutorial.folder / "cell.toml")


def test_without_a_unit_nothing_is_kept(tutorial: Read) -> None:
    calibrated = tutorial.names["calibrated"]
    nobody = calibrated.config.asset.model_copy(update={"id": ""})
    config = replace(calibrated.config, asset=nobody)
    nameless = type(calibrated)(config, calibrated._calibration, tutorial.names["healthy"])
    with pytest.raises(twin.TwinError, match="no unit is named"):
        nameless.save()
