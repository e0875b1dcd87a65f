"""``import twin``: the tutorial as it stands, and the same answers as the command line."""

import base64
import json
import re
import shlex
import subprocess
import sys
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass, replace
from html import unescape
from html.parser import HTMLParser
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
from twin.calibration.commission import Commissioned as Commissioning
from twin.calibration.readings import read
from twin.calibration.record_checks import Remark
from twin.calibration.verdict import Residual, Verdict
from twin.config import Config
from twin.diagnosis.curves import outline
from twin.errors import ConfigError
from twin.extras import install_hint
from twin.figures.key_figures import FIGURES
from twin.hil import Plant
from twin.log.reader import open_log
from twin.settings import Document
from twin.signals import MBAR, Phase, Samples

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


@pytest.mark.slow
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


def test_the_report_is_german_if_asked_for_and_its_pictures_too(
    tutorial: Read, tmp_path: Path
) -> None:
    tutorial.names["answer"].report(tmp_path / "heute.html", language="de")
    page = (tmp_path / "heute.html").read_text()
    assert '<html lang="de">' in page
    assert "gemessen" in page
    assert re.search(r">\d+,\d<", page)  # a tick of an axis
    assert not re.search(r">\d+\.\d<", page)
    assert tutorial.names["answer"].plot().axes[0].get_legend_handles_labels()[1][0] == "measured"


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
        rows, own = (np.concatenate(list(stream)) for stream in (blocks, healthy._samples()))
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


@pytest.mark.slow
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
    assert cycles == [{k: v for k, v in answer.items() if k != "alarms"} for answer in told]
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
    assert list(frame) == [*rows, *rows.FIELD]
    for name, column in rows.items():
        assert np.array_equal(frame[name], column, equal_nan=column.dtype.kind == "f"), name
    assert np.array_equal(frame["vacuum_mbar"], rows.vacuum_mbar)
    deviation = frame["expected_vacuum_mbar"] - frame["vacuum_mbar"]
    assert np.allclose(frame["deviation_mbar"], deviation, atol=1e-9, equal_nan=True)
    assert "vacuum_mbar" in simulated(tutorial.names["healthy"].config).frame()


def test_without_pandas_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ConfigError, match=r"^twin\.open needs the extra") as refused:
        _ = twin.open
    assert refused.value.hint == install_hint("notebook")


# What a notebook shows.

EVIL = '<script>alert("x")</script> Größe $1$ & Söhne'  # of an asset, as a stranger's log has it


class Shown(HTMLParser):
    """Tags, attributes and texts of a summary."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags, self.values, self.text = list[str](), list[str](), ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.values += [value or "" for _, value in attrs]

    def handle_data(self, data: str) -> None:
        self.text += data


def renamed(config: Config) -> Config:
    asset = config.asset.model_copy(update={"id": EVIL})
    return replace(config, asset=asset)


def evil_objects(tutorial: Read) -> dict[str, Any]:
    """Everything a notebook shows, of an asset whose name is hostile."""
    names = tutorial.names
    log = replace(names["healthy"], config=renamed(names["healthy"].config))
    today = replace(names["today"], config=renamed(names["today"].config), path=Path(EVIL))
    diagnosis = names["answer"]._diagnosis
    cause = diagnosis.json["causes"][0] | {"not_separable_from": ["porous_leakage"]}
    evil = diagnosis.json | {"log": EVIL, "asset": {"type": EVIL, "id": EVIL}, "causes": [cause]}
    calibrated = names["calibrated"]
    return {
        "log": log,
        "columns": log.columns(1.0, 5.0),
        "simulation": simulated(renamed(names["healthy"].config)),
        "calibration": replace(calibrated, config=renamed(calibrated.config)),
        "comparison": log.compare(today),
        "answer": twin.Answer(replace(diagnosis, json=evil)),
    }


def simulated(config: Any, **options: Any) -> twin.Columns:
    time = np.arange(0.0, 1.0, 1e-3)
    return twin.simulate(config, time, time > 0.1, np.zeros(len(time)), **options)


@pytest.fixture(scope="module")
def evil(tutorial: Read) -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tutorial.folder)
        return evil_objects(tutorial)


NAMED = ["log", "columns", "simulation", "calibration", "comparison"]  # with the asset's name
KINDS = [*NAMED, "answer"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_summary_is_small_alone_and_harmless(kind: str, evil: dict[str, Any], here: Path) -> None:
    html = evil[kind]._repr_html_()
    shown = Shown(html)
    assert len(html) < 400_000
    assert "script" not in shown.tags
    assert shown.tags.count("img") == 1
    links = [value for value in shown.values if ":" in value and "data:image/png" not in value]
    assert [value for value in links if "http" in value or "javascript" in value] == []
    if kind in NAMED:
        assert EVIL in shown.text  # also its umlauts, as they are
    picture = base64.b64decode(html.partition("base64,")[2].partition('"')[0])
    assert picture.startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_plot_is_a_figure_that_shows_itself(
    kind: str, evil: dict[str, Any], here: Path, tmp_path: Path
) -> None:
    picture = evil[kind].plot()
    root = ET.fromstring(picture._repr_svg_())
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert [tag for tag in root.iter() if tag.tag.endswith("script")] == []
    if kind in ("log", "columns", "simulation"):
        assert "Größe $1$ & Söhne" in str(root.get("aria-label"))
    shown = Shown(picture._repr_html_())
    assert shown.tags == ["img"]
    assert picture.alt in shown.values
    picture.savefig(tmp_path / "a.png")
    assert "mbar" in "".join(root.itertext())


def test_a_summary_says_what_matters(tutorial: Read, here: Path) -> None:
    names = tutorial.names
    healthy = Shown(names["healthy"]._repr_html_()).text
    assert "compact-ejector-35 cell-3" in healthy
    assert "mbar rms" in healthy
    calibrated = Shown(names["calibrated"]._repr_html_()).text
    assert "8 healthy cycles" in calibrated
    assert "Good: the twin follows this record" in calibrated
    assert "times the floor" in calibrated
    answer = Shown(names["answer"]._repr_html_()).text
    for text in ("Cause found: Air leaks in", "hoses, fittings and cups", "less rms deviation"):
        assert text in answer


def test_a_result_is_named_in_a_line(tutorial: Read, evil: dict[str, Any], here: Path) -> None:
    names = tutorial.names
    assert repr(names["answer"]) == "<Answer explained: leakage>"
    assert repr(names["calibrated"]) == "<Calibrated compact-ejector-35 cell-3: good>"
    assert repr(commissioned(tutorial)) == "<Commissioned compact-ejector-35 cell-3: good>"
    conclusion = evil["comparison"].conclusion
    assert repr(evil["comparison"]) == f"<Compared: {conclusion}>"


def test_a_log_without_rows_has_a_summary(tutorial: Read, monkeypatch: pytest.MonkeyPatch) -> None:
    log = tutorial.names["healthy"]
    monkeypatch.setattr(type(log), "_rows", lambda _: iter(()))
    assert "no rows" in log._repr_html_()
    with pytest.raises(twin.TwinError, match="no row lies between"):
        log.plot()


def test_a_summary_reads_the_beginning_of_a_log_alone(
    tutorial: Read, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.api.SHOWN_S", 2.0)
    assert "0 to 2 s" in Shown(tutorial.names["healthy"]._repr_html_()).text


def test_an_answer_has_the_pictures_of_its_report(tutorial: Read) -> None:
    answer = tutorial.names["answer"]
    alts = [answer.plot(name).alt for name in ("cycle", "log", "phases", "ranking")]
    page = unescape((tutorial.folder / "today.html").read_text())
    assert [alt for alt in alts if alt not in page] == []
    with pytest.raises(twin.TwinError, match="no picture is called 'cylce'") as refused:
        answer.plot("cylce")
    assert "did you mean 'cycle'?" in refused.value.hint
    with pytest.raises(twin.TwinError, match="whose verdict is explained has no picture 'left'"):
        answer.plot("left")
    insufficient = answer._diagnosis.json | {"verdict": "insufficient", "next_experiment": "record"}
    silent = twin.Answer(replace(answer._diagnosis, json=insufficient))
    with pytest.raises(twin.TwinError, match="insufficient has no picture 'cycle'"):
        silent.plot()
    assert "The log cannot answer: record." in Shown(silent._repr_html_()).text


# Field units.


def test_columns_are_in_mbar_and_ms_as_well(tutorial: Read, here: Path) -> None:
    rows = tutorial.names["today"].columns()
    ambient = tutorial.names["today"].config.data.ambient.pressure_mbar
    for name, si, factor in (
        ("time_ms", "time_s", 1e3),
        ("pressure_mbar", "pressure_pa", 1e-2),
        ("deviation_mbar", "deviation_pa", 1e-2),
        ("supply_bar", "supply_pa", 1e-5),
    ):
        np.testing.assert_allclose(getattr(rows, name), rows[si] * factor)
    np.testing.assert_allclose(rows.vacuum_mbar, ambient - rows.pressure_mbar, atol=1e-6)
    off = rows.expected_vacuum_mbar - rows.vacuum_mbar
    np.testing.assert_allclose(off, rows.deviation_mbar, atol=1e-3)
    assert rows.suctions == 10
    run = simulated(GRIPPER, effects={"ambient_pressure": {"shift": -20.0}})
    assert run.vacuum_mbar[0] == pytest.approx(0.0, abs=0.01)  # counts from the ambient pressure


def test_a_range_of_time_is_that_of_the_whole(tutorial: Read, here: Path) -> None:
    log = tutorial.names["today"]
    rows, some = log.columns(), log.columns(2.0, 4.5)
    inside = (rows["time_s"] >= 2.0) & (rows["time_s"] <= 4.5)
    for name, column in some.items():
        assert np.array_equal(column, rows[name][inside], equal_nan=column.dtype.kind == "f"), name
    assert "time (ms)" in log.plot(2.0, 4.5)._repr_svg_()
    assert "time (s)" in log.plot()._repr_svg_()


def test_a_calibration_has_its_values_in_the_fields_units(tutorial: Read) -> None:
    calibrated = tutorial.names["calibrated"]
    for name in ("ejector.suction_capacity_sl_min", "system.leak_sl_min"):
        value = getattr(calibrated, name.partition(".")[2])
        assert value == pytest.approx(calibrated.values[name]["value"])
    assert f"{calibrated.rms_mbar:.2f} mbar rms off" in str(calibrated)
    assert calibrated.verdict == "good"


def test_a_curve_keeps_its_peaks_however_long_it_is() -> None:
    curve = np.zeros(1_000_000)
    curve[123_457], curve[765_432], curve[500_000:500_100] = 5.0, -7.0, np.nan
    rows = outline([curve])
    assert len(rows) < 2000
    assert {0, 123_457, 765_432, 999_999} <= set(rows.tolist())
    assert len(outline([curve[:300], curve[:300]])) == 300


# Commissioning.


def verdict(times: float) -> Verdict:
    return Verdict({phase: Residual(times * 100.0, 100.0) for phase in Phase})


def commissioned(tutorial: Read, times: float = 1.0) -> twin.Commissioned:
    """A commissioning of the healthy day; the fit itself is the calibration's."""
    healthy = tutorial.names["healthy"]
    samples = np.concatenate(list(healthy._samples()))
    calibration, remark = tutorial.names["calibrated"]._calibration, Remark(EVIL, "volume_ml = 750")
    calibration = replace(calibration, verdict=verdict(times))
    found = Commissioning(calibration, read(samples), (remark,), (), samples)
    given = dict[str, Any]()

    def fit(config: Config, blocks: Iterable[Samples], _say: object) -> Commissioning:
        given["config"], given["rows"] = config, np.concatenate(list(blocks))
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tutorial.folder)
        patch.setattr("twin.api.fit_unknown", fit)
        result = twin.commission(healthy)
        of_type = Config.of(Document.read(Path("cell.toml")), calibrated=False)
    assert given["config"] == of_type.with_sensor(is_gauge=True)  # as the command has it
    assert given["rows"].tobytes() == samples.tobytes()
    return result


def test_a_commissioning_is_shown_and_kept(tutorial: Read, here: Path, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'kept.sqlite'}"
    unit = commissioned(tutorial)
    unit = replace(unit, _log=replace(unit._log, assets=url))
    assert unit.verdict == "good"
    assert unit.remarks == [f"{EVIL}: volume_ml = 750"]
    assert unit.values == tutorial.names["calibrated"].values
    assert str(unit).startswith("good: the twin follows this record")
    assert unit.config.data == tutorial.names["calibrated"].config.data
    open_assets(url).close()
    assert unit.save().name == "cell-3"
    assert twin.open("today.csv", "cell.toml", assets=url).config.data == unit.config.data
    assert "deviation" in unit.plot().alt


def test_a_commissioning_of_a_hostile_name_is_harmless(
    tutorial: Read, here: Path, tmp_path: Path
) -> None:
    unit = commissioned(tutorial)
    unit = replace(unit, config=renamed(unit.config))
    unit.report(tmp_path / "unit.html")
    for html in (unit._repr_html_(), (tmp_path / "unit.html").read_text(encoding="utf-8")):
        shown = Shown(html)
        assert "script" not in shown.tags
        assert EVIL in shown.text


def test_a_refused_commissioning_is_not_kept(tutorial: Read, here: Path) -> None:
    unit = commissioned(tutorial, times=100.0)
    assert unit.verdict == "refused"
    with pytest.raises(twin.TwinError, match="Nothing is stored"):
        unit.save()


# Comparison.


def test_a_comparison_is_that_of_the_command(
    commanded: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert command(monkeypatch, "compare", "healthy.mcap", "today.mcap", "-o", "c.json") == 0
        told = json.loads((commanded / "c.json").read_text())
        compared = twin.open("healthy.mcap").compare(twin.open("today.mcap"))
    assert compared.json == told
    assert compared.conclusion == told["conclusion"]
    assert compared.conclusion in str(compared)


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
    plain, shifted = (twin.simulate(GRIPPER, time, on, off, effects) for effects in (None, shift))
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
