"""``twin init``: whatever is answered or not known, the file that it writes is taken as it is."""

import io
import itertools
import re
import sys
from pathlib import Path

import pytest
import rigs
from command_line import twin

from drivers.sources import settings_of
from twin.cli.init import STARTERS
from twin.config import Config
from twin.settings import Document
from twin.tables.layout import BESIDE, REPORTED
from twin.tables.settings import Column, ImportSettings

MODBUS, OPC_UA = ("--address", "10.0.0.5:502"), ("--address", "opc.tcp://plc:4840")
SAID = (
    *("--id", "gripper-7", "--type", "ecm-20", "--unit", "bar", "--reference", "vacuum"),
    *("--range", "-0.05,1.013", "--hose-mm", "1500", "--diameter-mm", "4", "--end", "cups"),
    *("--volume-ml", "60", "--sensor", "end", "--released", "yes", "--supply-bar", "5.5"),
)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, with nobody at the keyboard."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    return tmp_path


def taken(path: str = "cell.toml") -> Config:
    return Config.of(Document.read(Path(path)), calibrated=False)


@pytest.mark.parametrize(
    "flags",
    [
        (*address, ring, "--end", end, "--released", released)
        for address, ring, end, released in itertools.product(
            (MODBUS, OPC_UA),
            ("--ring", "--no-ring"),
            ("cups", "vessel"),
            ("yes", "no", "unknown"),
        )
    ],
    ids=" ".join,
)
def test_what_is_written_is_taken_as_it_is(
    flags: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert twin(monkeypatch, "init", *flags) == 0
    text = Path("cell.toml").read_text()
    assert len(text.splitlines()) <= 60
    config, driver = taken(), settings_of(Document.read(Path("cell.toml")))
    assert (driver.kind == "opcua") == ("opc.tcp://plc:4840" in flags)
    assert (driver.mode == "block") == ("--ring" in flags)
    *_, last = config.data.system.parts
    is_released = "yes" in flags or ("unknown" in flags and "cups" in flags)
    assert last.kind == ("cups" if is_released else "vessel")


LAYOUTS = [(*to, ring) for to in (MODBUS, OPC_UA) for ring in ("--ring", "--no-ring")]
RARE = ("nozzle", "air_saving", "part_present", "ambient", "temperature", "pressure_2", "flow")


@pytest.mark.parametrize("flags", LAYOUTS, ids=" ".join)
@pytest.mark.parametrize("leaving", ["nozzle", "air_saving"])  # they say the same
def test_the_tags_that_few_have_stand_there_ready_to_be_taken_in(
    flags: tuple[str, ...], leaving: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert twin(monkeypatch, "init", *flags) == 0
    text = written = Path("cell.toml").read_text()
    for name in RARE:
        assert written.count(f"# {name} = ") == 1
        alone = written.replace(f"# {name} = ", f"{name} = ")
        assert getattr(settings_of(Document.parse(alone, "x")).tags, name) is not None
        if name != leaving:
            text = text.replace(f"# {name} = ", f"{name} = ")
    tags = settings_of(Document.parse(text, "x")).tags
    assert [name for name in RARE if getattr(tags, name) is None] == [leaving]
    if flags[-1] == "--no-ring" and flags[1] == MODBUS[1]:  # each at a place of its own
        places = [getattr(tags, name).address for name in RARE if name != leaving]
        places += [tags.pressure.address, tags.suction.address, tags.blow_off.address]
        assert len(set(map(str, places))) == len(places)


def test_so_do_the_columns_of_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    assert twin(monkeypatch, "init", "--address", "none") == 0
    text = Path("cell.toml").read_text()
    offered = [column for column in Column if f'# {column} = "' in text]
    beside = {*BESIDE, *REPORTED} - {Column.SUPPLY_BAR}
    assert beside < set(offered)
    for column in offered:
        text = text.replace(f"# {column} = ", f"{column} = ")
    assert set(Document.parse(text, "x").section(ImportSettings, "import").columns) == set(offered)


def test_what_is_said_is_in_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tags = ("--no-ring", "--pressure", "40101", "--pressure-type", "uint16", "--scale", "0.1")
    commands = ("--suction", "40102/3", "--blow-off", "40102/4")
    assert twin(monkeypatch, "init", *SAID, *MODBUS, *tags, *commands) == 0
    config = taken()
    assert (config.asset.type, config.asset.id) == ("ecm-20", "gripper-7")
    hose, sensor, cups = config.data.system.parts
    assert (hose.length_mm, hose.diameter_mm, cups.volume_ml) == (1500.0, 4.0, 60.0)
    assert sensor.kind == "sensor"
    assert config.data.system.volumes_within_factor == 1.25  # a fifth off
    assert config.data.supply.pressure_bar == 5.5
    driver = settings_of(config.document)
    assert (driver.host, driver.port) == ("10.0.0.5", 502)
    assert driver.tags.pressure.address.manual == "40101"
    assert (driver.tags.pressure.scale, driver.tags.pressure.range) == (0.1, (-0.05, 1.013))
    assert (driver.tags.pressure.unit, driver.tags.pressure.reference) == ("bar", "vacuum")
    assert driver.tags.suction.bit == 3
    assert "guessed" not in config.document.text
    *_, first, second = capsys.readouterr().out.splitlines()
    assert first.strip() == "twin probe cell.toml"
    assert second.strip() == "twin commission cell.toml --cycles 12"


def test_what_nobody_knows_is_guessed_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    assert twin(monkeypatch, "init", "left.toml") == 0
    config = taken("left.toml")
    assert config.asset.id == "left"
    assert config.asset.type == "type-of-left"  # not to be taken for that of another unit
    for what in ("type", "length_mm", "diameter_mm", "volume_ml", '{ kind = "sensor" }', "host"):
        lines = [line for line in config.document.text.splitlines() if what in line]
        assert any("not known" in line or "not said" in line for line in lines), what
    assert config.data.system.volumes_within_factor == 10.0  # any size on the market
    head = " ".join(config.document.text.split("[asset]")[0].replace("#", "").split())
    flags = "--id, --type, --address, --ring, --unit, --reference, --range, --end, --hose-mm, "
    assert f"Not said, so guessed: {flags}" in head


def test_volumes_beside_a_tube_that_nobody_knows_are_less_exact(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """28 ml of tube are guessed, which may be three times as much: 1.25 x 60 + 3 x 28 over 88."""
    assert twin(monkeypatch, "init", "left.toml", "--volume-ml", "60") == 0
    assert taken("left.toml").data.system.volumes_within_factor == pytest.approx(1.81, abs=0.01)


def test_a_unit_of_which_there_are_only_files_has_no_driver(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "init", "--address", "none") == 0
    assert "driver" not in taken().document.tables
    *_, first, second = capsys.readouterr().out.splitlines()
    assert first.strip() == "twin import TRACE.csv --config cell.toml -o healthy.mcap"
    assert second.strip() == "twin commission healthy.mcap --config cell.toml"


def test_on_a_terminal_it_asks_what_no_flag_says(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("--type", "ecm-20", *MODBUS, "--ring", "--unit", "mbar", "--range", "unknown")
    answers = ("press-3", "absolute", "cups", "900", "wide", "4", "unknown", "end", "yes", "")
    monkeypatch.setattr(sys, "stdin", Terminal("\n".join(answers) + "\n"))
    assert twin(monkeypatch, "init", *given) == 0
    hose, _, cups = taken().data.system.parts
    assert (taken().asset.id, hose.length_mm, hose.diameter_mm) == ("press-3", 900.0, 4.0)
    assert cups.kind == "cups"
    said = "".join(capsys.readouterr())
    assert "'wide' is no number above zero" in said  # and it is asked again
    assert "nameplate" not in said


NAMESPACE, SCALE = "Namespace of the nodes", "for a raw value of 1"
ASKED_OF_A_PLC = [
    ((*OPC_UA, "--ring"), "--namespace", NAMESPACE),
    ((*OPC_UA, "--no-ring"), "--namespace", NAMESPACE),
    ((*MODBUS, "--no-ring"), "--scale", SCALE),
    ((*MODBUS, "--ring", "--pressure-type", "int32"), "--scale", SCALE),
    ((*MODBUS, "--ring"), "", ""),
    ((*MODBUS, "--no-ring", "--pressure-type", "float32"), "", ""),
]


@pytest.mark.parametrize(("flags", "flag", "question"), ASKED_OF_A_PLC, ids=str)
def test_namespace_and_scale_are_asked_where_they_apply_and_else_told_as_guessed(
    flags: tuple[str, ...],
    flag: str,
    question: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert twin(monkeypatch, "init", *flags) == 0
    guessed = " ".join(line for line in Path("cell.toml").read_text().splitlines() if "--" in line)
    assert {name for name in ("--namespace", "--scale") if name in guessed} == {flag} - {""}
    capsys.readouterr()
    monkeypatch.setattr(sys, "stdin", Terminal("\n" * 30))
    assert twin(monkeypatch, "init", *flags, "--force") == 0
    told = "".join(capsys.readouterr())
    assert {asked for asked in (NAMESPACE, SCALE) if asked in told} == {question} - {""}


@pytest.mark.parametrize("scale", ["0", "wide"])
def test_a_scale_that_is_no_number_is_refused(scale: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert twin(monkeypatch, "init", *MODBUS, "--no-ring", "--scale", scale) == 2
    assert not Path("cell.toml").exists()


@pytest.mark.parametrize("options", [(), *(("--starter", name) for name in STARTERS)])
def test_an_editor_finds_the_schema(
    options: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "init", *options) == 0
    capsys.readouterr()
    first, second, *_ = Path("cell.toml").read_text().splitlines()
    command, file = second.partition("twin ")[2].split(" > ")
    assert first == f"#:schema ./{file}"
    assert twin(monkeypatch, *command.split()) == 0
    assert '"driver"' in capsys.readouterr().out


def test_a_file_that_is_there_is_not_overwritten(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("cell.toml").write_text("mine")
    assert twin(monkeypatch, "init") == 3
    assert "already a file" in capsys.readouterr().err
    assert Path("cell.toml").read_text() == "mine"
    assert twin(monkeypatch, "init", "--force") == 0
    assert "[asset]" in Path("cell.toml").read_text()


def test_what_is_wrong_is_said_and_nothing_is_written(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "init", *MODBUS, "--ring", "--suction", "coil:7") == 2
    assert "driver.tags.suction" in capsys.readouterr().err
    assert list(here.iterdir()) == []


# Examples.


@pytest.mark.parametrize("name", STARTERS)
def test_an_example_refers_to_pages_and_not_to_sources(name: str) -> None:
    named = re.findall(r"[\w./-]+\.(?:py|md)\b", rigs.path_of(name).read_text())
    assert "docs/configuration.md" in named
    assert [page for page in named if not page.startswith("docs/")] == []
    assert [page for page in named if not (rigs.ROOT / page).is_file()] == []


@pytest.mark.parametrize("name", STARTERS)
def test_an_example_is_written_as_it_is_shipped(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "init", "--starter", name) == 0
    lines = Path("cell.toml").read_bytes().splitlines(keepends=True)
    assert b"".join(lines[2:]) == rigs.path_of(name).read_bytes()  # below the schema
    *_, first, second = capsys.readouterr().out.splitlines()
    assert first.strip() == "twin plc cell.toml"
    assert second.strip().startswith("twin run cell.toml --log today.mcap ")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--starter", "test_rigg"), "did you mean 'test_rig'?"),
        (("--starter", "gripper", "--volume-ml", "60"), "--volume-ml does not change an example"),
    ],
)
def test_an_example_that_there_is_not_or_that_is_to_be_changed_is_refused(
    options: tuple[str, ...],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert twin(monkeypatch, "init", *options) == 2
    assert said in capsys.readouterr().err
    assert not Path("cell.toml").exists()
