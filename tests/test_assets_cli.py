"""``twin assets``, the files it takes, and which database it chooses."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from twin.assets.database import open_assets
from twin.assets.database_url import open_chosen
from twin.assets.record import Record
from twin.cli.assets import assets_app
from twin.errors import ConfigError, SourceError, TwinError
from twin.settings import Document

TYPE, PAPER_UNIT = "compact-ejector-35", "paper-unit"  # shipped
SHIPPED = [["type", TYPE], *(["instance", unit] for unit in ("gripper-01", PAPER_UNIT, "rig-01"))]

UNIT = """\
kind = "instance"
name = "unit-1"
type = "compact-ejector-35"
valid_from = 2026-05-01T12:00:00Z
note = "measured on the bench"

[data.ejector]
suction_capacity_sl_min = 35.0

[healthy.figures]
hold_rms = { mean = 2.0, sigma = 0.5 }

[diagram]
vacuum_mbar = [0, 400, 850]
supply_bar = [3.0, 4.5]
suction_capacity_sl_min = [
    [30.0, 16.0, 0.0],
    [35.0, 20.0, 1.0],
]
"""

Run = Callable[..., str]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run ``twin assets`` in an empty folder; gives what it prints to stdout."""
    monkeypatch.chdir(tmp_path)

    def assets(*arguments: str | Path) -> str:
        capsys.readouterr()
        assets_app(list(map(str, arguments)), standalone_mode=False)
        return capsys.readouterr().out

    return assets


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    path = tmp_path / "unit.toml"
    path.write_text(UNIT)
    return path


def rows(table: str) -> list[list[str]]:
    return [line.split() for line in table.splitlines()[1:]]


# --- the commands -------------------------------------------------------------------------------


def test_reading_makes_no_file(run: Run, tmp_path: Path) -> None:
    assert [row[:2] for row in rows(run("list"))] == SHIPPED
    assert "suction_capacity_sl_min = 35.0" in run("show", PAPER_UNIT)
    shown = run("show", TYPE)
    assert "suction_capacity_sl_min = 33.4" in shown
    assert "valid_from" not in shown  # always; an edited copy holds from when it is added
    assert json.loads(run("export"))["format"] == "ejector-twin-assets/1"
    assert list(tmp_path.iterdir()) == []


def test_what_is_in_no_database_was_not_recorded(run: Run) -> None:
    """Without a database there are the shipped data sets; they were not recorded just now."""
    assert [row[4:6] for row in rows(run("list"))] == [["no,", "shipped"]] * len(SHIPPED)
    assert "recorded no, shipped, id " in run("show", TYPE)
    assert run("show", TYPE, "--history").startswith("recorded no, shipped  valid from always")


def test_what_is_added_is_listed_and_shown(run: Run, unit: Path) -> None:
    assert "unit-1: added " in run("add", unit)
    table = rows(run("list"))
    added = next(row for row in table if row[1] == "unit-1")
    assert [row[:4] for row in table] == [
        *([*shipped, TYPE, "always"] for shipped in SHIPPED),
        ["instance", "unit-1", TYPE, "2026-05-01T12:00:00Z"],
    ]
    shown = run("show", "unit-1")
    assert f"# hash {added[-1]}, recorded " in shown
    assert "# note: measured on the bench" in shown
    assert "# file: unit.toml" in shown
    assert "# code: ejector-twin " in shown


def test_what_is_shown_can_be_added_again(run: Run, unit: Path, tmp_path: Path) -> None:
    run("add", unit)
    for name in ("unit-1", TYPE):
        again = tmp_path / "again.toml"
        again.write_text(run("show", name))
        assert f"{name}: unchanged" in run("add", again)
        run("add", again, "--assets", "other.sqlite")
    with open_assets(tmp_path / "assets.sqlite") as ours, open_assets("other.sqlite") as theirs:
        left, right = (assets.get(TYPE, "unit-1").record for assets in (ours, theirs))
    assert left.hash == right.hash
    assert left.valid_from_ns == right.valid_from_ns == 1_777_636_800 * 10**9
    assert left.arrays["diagram_flow_sl_min"].tolist() == [[30.0, 16.0, 0.0], [35.0, 20.0, 1.0]]


def test_what_toml_has_no_word_for_is_left_out_or_said(run: Run, tmp_path: Path) -> None:
    parts = [{"kind": "tank", "volume_ml": 755.0, "release_mbar": None}, {"kind": "tee"}]
    data = {"system": {"parts": parts, "cup": None}}
    covariance = {"covariance": np.eye(2)}
    provenance = {"log": "day.mcap", "note": "two\nlines"}
    with open_assets(tmp_path / "assets.sqlite") as assets:
        assets.add(Record("instance", "u", TYPE, data, {}, covariance, provenance))
    shown = run("show", "u")
    assert "# array covariance: shape (2, 2)" in shown
    assert "# note: two\n# lines\n" in shown
    assert Document.parse(shown, "shown").tables["data"] == {
        "system": {"parts": [{"kind": "tank", "volume_ml": 755.0}, {"kind": "tee"}]}
    }


def test_a_first_data_set_always_holds_and_a_later_one_from_now_on(
    run: Run, unit: Path, tmp_path: Path
) -> None:
    undated = UNIT.replace("valid_from = 2026-05-01T12:00:00Z\n", "")
    unit.write_text(undated)
    assert "valid from: always" in run("add", unit)
    assert "unchanged" in run("add", unit)
    unit.write_text(undated.replace("35.0", "34.0"))
    assert "valid from: 2" in run("add", unit)
    with open_assets(tmp_path / "assets.sqlite") as assets:
        first, second = assets.records(name="unit-1")
        assert abs(second.valid_from_ns - second.recorded_ns) < 60 * 10**9
        assert assets.get(TYPE, "unit-1", at_ns=0).record.id == first.id
        assert assets.get(TYPE, "unit-1").record.id == second.id


def test_show_looks_back_in_both_times(run: Run, tmp_path: Path) -> None:
    day = 86_400 * 10**9
    clock = iter(
        [*[day] * len(SHIPPED), 10 * day, 20 * day]
    )  # recorded: what is shipped, then two data sets
    with open_assets(tmp_path / "assets.sqlite", clock=lambda: next(clock)) as assets:
        assets.add(Record("instance", "u", TYPE, {"a": 1}, valid_from_ns=5 * day))
        assets.add(Record("instance", "u", TYPE, {"a": 2}, valid_from_ns=5 * day))
    assert "a = 2" in run("show", "u")
    assert "a = 2" in run("show", "u", "--at", "1970-01-06")
    assert "a = 1" in run("show", "u", "--as-of", "1970-01-20T23:59:59Z")
    assert "a = 2" in run("show", "u", "--as-of", "1970-01-21T01:00+01:00")
    with pytest.raises(ConfigError, match="no data set of 'u' holds at that time"):
        run("show", "u", "--at", "1970-01-05T23:59")
    with pytest.raises(ConfigError, match="nothing was known of 'u' at that time"):
        run("show", "u", "--as-of", "1970-01-02")
    lines = run("show", "u", "--history").splitlines()
    assert [line.split()[1] for line in lines] == ["1970-01-11T00:00:00Z", "1970-01-21T00:00:00Z"]
    with pytest.raises(ConfigError, match="not a time: 'yesterday'"):
        run("show", "u", "--at", "yesterday")


def test_a_name_that_is_not_there_lists_those_that_are(run: Run) -> None:
    with pytest.raises(ConfigError, match="'nobody'") as caught:
        run("show", "nobody")
    assert TYPE in caught.value.hint


def test_export_and_import_carry_everything_over(run: Run, unit: Path, tmp_path: Path) -> None:
    run("add", unit)
    assert run("export", "-o", "all.json") == "5 records in all.json\n"
    assert run("import", "all.json", "--assets", "sqlite:///new.sqlite").startswith("5 new of 5 ")
    assert run("import", "all.json", "--assets", "sqlite:///new.sqlite").startswith("0 new of 5 ")
    assert run("export", "--assets", "new.sqlite") == (tmp_path / "all.json").read_text()


def test_an_export_is_written_whole_or_not_at_all(run: Run, tmp_path: Path) -> None:
    (tmp_path / "all.json").mkdir()
    with pytest.raises(SourceError, match=r"all\.json: cannot be written"):
        run("export", "-o", "all.json")
    assert [path.name for path in tmp_path.iterdir()] == ["all.json"]


@pytest.mark.parametrize(
    ("content", "kind", "message"),
    [
        (None, SourceError, "cannot be read"),
        (b"\xff", SourceError, "not a text file"),
        (b"{", ConfigError, r"not valid JSON: .*line 1 column 2"),
        (b"[" * 100_000, ConfigError, "not valid JSON"),
        (b"[]", ConfigError, "not an export"),
        (b"{}", ConfigError, "not an export"),
    ],
)
def test_what_is_no_export_is_refused(
    run: Run, tmp_path: Path, content: bytes | None, kind: type[TwinError], message: str
) -> None:
    if content is not None:
        (tmp_path / "all.json").write_bytes(content)
    with pytest.raises(kind, match=message):
        run("import", "all.json")


# --- the file of an asset -----------------------------------------------------------------------

VACUUM, ROWS = "vacuum_mbar = [0, 400, 850]", "[30.0, 16.0, 0.0]"
CAPACITY = "suction_capacity_sl_min = 35.0"
SYSTEM = """[[data.system.parts]]
kind = "tube"
length_mm = 100.0
diameter_mm = 6.0
[[data.system.parts]]
kind = "vessel\""""


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ('kind = "instance"', 'kind = "group"', 1, "kind: must be type or instance"),
        ('type = "compact-ejector-35"\n', "", 1, "instance 'unit-1' has no type"),
        ("2026-05-01T12:00:00Z", "2026", 4, "valid_from"),
        ("2026-05-01T12:00:00Z", "0", 4, "valid_from"),
        ("note =", "colour =", 5, "colour: unknown key"),
        (VACUUM, "vacuum_mbar = [0, 850, 400]", 14, "rise strictly, but value 3 is 400.0 after"),
        (VACUUM, "vacuum_mbar = [0, 400, 400]", 14, "rise strictly"),
        (VACUUM, "vacuum_mbar = [10, 400, 850]", 14, "must start at 0"),
        (VACUUM, "vacuum_mbar = [0, 400, 5000]", 14, "less than 1100"),
        (VACUUM, "vacuum_mbar = [0, 400]", 16, "3 values for 2 vacuums"),
        ("supply_bar = [3.0, 4.5]", "supply_bar = [4.5, 3.0]", 15, "rise strictly"),
        ("supply_bar = [3.0, 4.5]", "supply_bar = [0.0, 4.5]", 15, "greater than 0"),
        ("supply_bar = [3.0, 4.5]", "supply_bar = [4.5]", 16, "2 rows for 1 supply pressures"),
        (ROWS, "[30.0, 31.0, 0.0]", 16, "row for 3 bar must not rise, but does at 400 mbar"),
        (ROWS, "[0.0, 0.0, 0.0]", 16, "row for 3 bar must be positive at vacuum 0"),
        (ROWS, "[30.0, 16.0, -1.0]", 16, "at least 0"),
        (ROWS, "[inf, 16.0, 0.0]", 16, "finite"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_with_its_line(
    run: Run, unit: Path, old: str, new: str, line: int, message: str
) -> None:
    assert old in UNIT
    unit.write_text(UNIT.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        run("add", unit)
    assert str(caught.value).startswith(f"{unit}:{line}: ")
    assert message in str(caught.value)
    assert not Path("assets.sqlite").exists()


def test_what_json_cannot_keep_is_refused(run: Run, unit: Path) -> None:
    unit.write_text(UNIT.replace("35.0", "nan", 1))
    with pytest.raises(ConfigError, match="its data cannot be kept"):
        run("add", unit)
    assert not Path("assets.sqlite").exists()


def test_a_characteristic_may_be_flat_where_nothing_is_left(run: Run, unit: Path) -> None:
    flat = UNIT.replace(VACUUM, "vacuum_mbar = [0, 400, 850, 900]")
    unit.write_text(flat.replace("0.0],", "0.0, 0.0],").replace("1.0],", "1.0, 0.0],"))
    assert "added" in run("add", unit)


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        (CAPACITY, "suction_capacity_sl_min = 0.0", 8, "data.ejector.suction_capacity_sl_min: "),
        (CAPACITY, "suction = 35.0", 8, "data.ejector.suction: unknown key"),
        (CAPACITY, "h2_mbar = 700.0", 7, "data.ejector: h1_mbar must be at least"),
        (CAPACITY, "end_pressure_mbar = 1013.0", 1, "end_pressure_mbar must be below ambient"),
        (CAPACITY, "bulge = -0.9\nskew = 5.0", 7, "a characteristic that is not monotonic"),
        ("[data.ejector]", "[data.supply]\npressure_bar = -1.0\n[data.ejector]", 8, "than 0"),
        ("[data.ejector]", f"{SYSTEM}\nvolume_ml = 0\n[data.ejector]", 13, "volume_ml: must be"),
        (
            "sigma = 0.5",
            "sigma = 0.0",
            11,
            "healthy.figures.hold_rms.sigma: must be greater",
        ),
    ],
)
def test_a_data_set_that_cannot_be_is_refused_with_its_line(
    run: Run, unit: Path, old: str, new: str, line: int, message: str
) -> None:
    run("add", unit)
    before = run("export")
    assert old in UNIT
    unit.write_text(UNIT.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        run("add", unit)
    assert str(caught.value).startswith(f"{unit}:{line}: ")
    assert message in str(caught.value)
    assert run("export") == before


def test_a_unit_is_judged_over_what_is_known_of_its_type(run: Run, tmp_path: Path) -> None:
    """H2 alone is right or wrong by the H1 of the type."""
    kind, unit = tmp_path / "kind.toml", tmp_path / "unit.toml"
    kind.write_text('kind = "type"\nname = "deep"\n[data.ejector]\nh1_mbar = 850.0\n')
    run("add", kind)
    text = 'kind = "instance"\nname = "u"\ntype = "TYPE"\n[data.ejector]\nh2_mbar = 650.0\n'
    unit.write_text(text.replace("TYPE", TYPE))
    with pytest.raises(ConfigError, match=r"unit\.toml:4: data\.ejector: .*h1_mbar must be"):
        run("add", unit)
    unit.write_text(text.replace("TYPE", "deep"))
    assert "u: added" in run("add", unit)
    unit.write_text(text.replace("TYPE", "shallow"))
    with pytest.raises(ConfigError, match="no data set of type 'shallow'") as caught:
        run("add", unit)
    assert f"{TYPE}, deep" in caught.value.hint


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (UNIT.replace(ROWS, "[30.0, 30.0, 30.0]"), "missed by up to 26"),
        (
            UNIT.replace(ROWS, "[30.0, 30.0, 0.0]").replace("20.0, 1.0]", "35.0, 1.0]"),
            "ejector: .* not monotonic",
        ),
    ],
)
def test_a_diagram_that_no_ejector_has_is_refused(
    run: Run, unit: Path, text: str, why: str
) -> None:
    unit.write_text(text)
    with pytest.raises(ConfigError, match=f"instance 'unit-1': the model cannot .*{why}"):
        run("add", unit)
    assert "unit-1" not in run("list")


@pytest.mark.parametrize(
    ("written", "ns"),
    [
        ("2026-05-01", 1_777_593_600 * 10**9),
        ("2026-05-01T12:00:00", 1_777_636_800 * 10**9),
        ("2026-05-01T12:00:00+02:00", 1_777_629_600 * 10**9),
        ("2026-05-01T12:00:00.000001Z", 1_777_636_800 * 10**9 + 1000),
    ],
)
def test_valid_from_takes_days_and_times(
    run: Run, unit: Path, tmp_path: Path, written: str, ns: int
) -> None:
    unit.write_text(UNIT.replace("2026-05-01T12:00:00Z", written))
    run("add", unit)
    with open_assets(tmp_path / "assets.sqlite") as assets:
        assert assets.get(TYPE, "unit-1", at_ns=2**62).record.valid_from_ns == ns


# --- which database -----------------------------------------------------------------------------


def config(folder: Path, text: str) -> Path:
    folder.mkdir()
    path = folder / "cell.toml"
    path.write_text(text)
    return path


def test_the_default_is_beside_the_configuration(run: Run, unit: Path, tmp_path: Path) -> None:
    run("add", unit, "--config", config(tmp_path / "cell", ""))
    assert (tmp_path / "cell" / "assets.sqlite").exists()
    assert not (tmp_path / "assets.sqlite").exists()


@pytest.mark.parametrize("url", ["fleet.sqlite", "sqlite:///fleet.sqlite"])
def test_the_configuration_names_a_file_from_its_own_folder(
    run: Run, unit: Path, tmp_path: Path, url: str
) -> None:
    path = config(tmp_path / "cell", f'[assets]\nurl = "{url}"\n')
    run("add", unit, "--config", path)
    assert (tmp_path / "cell" / "fleet.sqlite").exists()
    run("add", unit, "--config", path, "--assets", url)  # the command line's is where we are
    assert (tmp_path / "fleet.sqlite").exists()


def test_a_named_database_that_is_not_there_is_not_passed_over(run: Run, tmp_path: Path) -> None:
    path = config(tmp_path / "cell", '[assets]\nurl = "fleet.sqlite"\n')
    for arguments in (("--config", path), ("--assets", "fleet.sqlite")):
        with pytest.raises(SourceError, match=r"fleet\.sqlite: no such asset database"):
            run("list", *arguments)
    assert not list(tmp_path.rglob("*.sqlite"))


def test_what_is_refused_makes_no_database(run: Run, unit: Path, tmp_path: Path) -> None:
    before = sorted(tmp_path.iterdir())
    document = json.loads(run("export"))
    document["records"] = [record for record in document["records"] if record["kind"] == "instance"]
    bad = {
        "damaged.json": '{"format": "ejector-twin-assets/1"}',
        "no_type.json": json.dumps(document),
        "wrong.toml": UNIT.replace("35.0\n\n[healthy", "-35.0\n\n[healthy"),
        "other.toml": UNIT.replace(TYPE, "nobody-knows"),
    }
    for name, text in bad.items():
        (tmp_path / name).write_text(text)
        for database in ((), ("--assets", "new.sqlite")):
            with pytest.raises(ConfigError):
                run("add" if name.endswith(".toml") else "import", name, *database)
        (tmp_path / name).unlink()
    assert sorted(tmp_path.iterdir()) == before


def test_that_a_database_is_made_is_said_once(
    run: Run, unit: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for said in (1, 0):
        assets_app(["add", str(unit), "--assets", "n.sqlite"], standalone_mode=False)
        assert capsys.readouterr().err.count("making a new asset database, n.sqlite") == said


def test_an_unknown_key_of_the_configuration_is_refused(tmp_path: Path) -> None:
    document = Document.parse('[assets]\nurls = "x"\n', "cell.toml")
    with pytest.raises(ConfigError, match=r"cell\.toml:2: assets\.urls: unknown key"):
        open_chosen("", document, write=False)
