"""Configurations: what is wrong in them is said with file, line and key."""

import re
import string
from pathlib import Path
from typing import Literal

import pytest
import rigs
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from twin.config import TABLES, Config
from twin.errors import ConfigError, SourceError
from twin.model import theta as theta_table
from twin.model.dataset import DataSet, coefficients
from twin.model.theta import COEFFICIENTS, MECHANISMS
from twin.settings import Document, Settings

TEXT = """\
# a comment with delay_ms = 3 in it
[driver]
host = "10.0.0.5"

[driver.tags]  # not [driver.tags.other]
[driver.tags.pressure]
delay_ms = 5.0
"unit" = "mbar"

[ driver . limits ]
low = 1
high = 2
"""


class Tag(Settings):
    delay_ms: float = Field(1.0, ge=0.0, le=100.0)
    unit: Literal["mbar", "Pa"] = "Pa"
    span: float = 1.0


class Limits(Settings):
    low: int = 0
    high: int = 1


class Driver(Settings):
    host: str
    port: int = 502
    tags: dict[str, Tag] = Field(default_factory=dict)
    limits: Limits = Limits()


def complaint(text: str, *path: str, kind: type[Settings] = Driver) -> str:
    with pytest.raises(ConfigError) as refused:
        Document.parse(text, "cell.toml").section(kind, *path)
    assert refused.value.hint
    assert refused.value.exit_code == 2
    return str(refused.value)


def test_what_stands_there_is_taken_and_the_rest_is_default() -> None:
    driver = Document.parse(TEXT, "cell.toml").section(Driver, "driver")
    assert driver == Driver(
        host="10.0.0.5",
        tags={"pressure": Tag(delay_ms=5.0, unit="mbar")},
        limits=Limits(low=1, high=2),
    )


def test_a_missing_table_is_all_defaults() -> None:
    assert Document.parse("", "cell.toml").section(Limits, "driver", "limits") == Limits()


def test_settings_are_frozen() -> None:
    with pytest.raises(ValueError, match="frozen"):
        Limits().low = 3  # type: ignore[misc]


@pytest.mark.parametrize(
    ("old", "new", "wanted"),
    [
        ("delay_ms = 5.0", "delay_ms = 500.0", "cell.toml:7: driver.tags.pressure.delay_ms: "),
        ("delay_ms = 5.0", "delai_ms = 5.0", "cell.toml:7: driver.tags.pressure.delai_ms: unknown"),
        ('"unit" = "mbar"', '"unit" = "bar"', "cell.toml:8: driver.tags.pressure.unit: "),
        ("low = 1", 'low = "one"', "cell.toml:11: driver.limits.low: "),
        ("high = 2", "hihg = 2", "cell.toml:12: driver.limits.hihg: unknown key"),
        ('host = "10.0.0.5"', "", "cell.toml:2: driver.host: is missing"),
        ('host = "10.0.0.5"', "host = 5", "cell.toml:3: driver.host: "),
        ("[ driver . limits ]", "[driver.limit]", "cell.toml:10: driver.limit: unknown key"),
        (
            "delay_ms = 5.0",
            "span = nan",
            "cell.toml:7: driver.tags.pressure.span: must be a finite number",
        ),
        (
            "delay_ms = 5.0",
            "span = -inf",
            "cell.toml:7: driver.tags.pressure.span: must be a finite number",
        ),
    ],
)
def test_what_is_wrong_is_named_with_its_line(old: str, new: str, wanted: str) -> None:
    assert complaint(TEXT.replace(old, new), "driver").startswith(wanted)


def test_the_value_that_was_given_is_shown() -> None:
    assert complaint(TEXT.replace("5.0", "-5.0"), "driver").endswith("(is -5.0)")


def test_several_faults_are_told_together() -> None:
    text = TEXT.replace("low = 1", "lwo = 1").replace("high = 2", "hihg = 2")
    assert len(complaint(text, "driver").splitlines()) == 2


def test_a_comment_is_no_key() -> None:
    text = "# delay_ms = 500\n\n[tag]\n# delay_ms = 400\ndelay_ms = 300\n"
    assert complaint(text, "tag", kind=Tag).startswith("cell.toml:5: ")


def test_a_table_that_is_a_number_is_refused() -> None:
    assert complaint("driver = 3\n", "driver").startswith("cell.toml:1: driver: ")


def test_unknown_tables_are_refused_with_their_line() -> None:
    document = Document.parse("[driver]\n\n[monitr]\nx = 1\n", "cell.toml")
    with pytest.raises(ConfigError, match=r"cell.toml:3: unknown table \[monitr\]") as refused:
        document.refuse_unknown_tables({"driver", "monitor"})
    assert refused.value.hint == "did you mean 'monitor'? known: driver, monitor"


@pytest.mark.parametrize("text", ["[driver", "a = ", "a = 1\na = 2", "a = 1 2", "\x00"])
def test_what_is_no_toml_is_said_so(text: str) -> None:
    with pytest.raises(ConfigError, match=r"cell.toml: not valid TOML: .*(line \d|end of)"):
        Document.parse(text, "cell.toml")


def test_a_file_that_is_not_there_is_a_bad_source(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"none.toml: cannot be read: .*No such file") as refused:
        Document.read(tmp_path / "none.toml")
    assert refused.value.exit_code == 3


def test_a_file_that_is_no_text_is_a_bad_source(tmp_path: Path) -> None:
    (tmp_path / "cell.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SourceError, match="not a text file"):
        Document.read(tmp_path / "cell.toml")


keys = st.text(string.ascii_lowercase + "_", min_size=1, max_size=8).filter(
    lambda key: key not in ("low", "high")
)


@given(st.integers(0, 20), st.lists(keys, min_size=1, max_size=3, unique=True), keys)
def test_the_line_is_that_of_the_key(blank: int, tables: list[str], key: str) -> None:
    """Whatever stands around it: other tables, comments, the same key elsewhere."""
    other = "".join(f"[other.{table}]\n{key} = 1 # {key} = 2\n" for table in tables)
    text = other + "\n" * blank + f"# {key} = 3\n[{'.'.join(tables)}]\nlow = 1\n{key} = 7\n" + other
    line = len(other.splitlines()) + blank + 4
    if tables[0] != "other":
        text = text[: text.rindex(other)]  # TOML allows no table twice
        message = complaint(text, *tables, kind=Limits)
        place = ".".join([*tables, key])
        assert message.startswith(f"cell.toml:{line}: {place}: unknown key: ")


@given(st.text(max_size=60))
def test_no_text_does_more_than_be_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"cell\.toml"):  # no host stands in it by chance
        Document.parse(text, "cell.toml").section(Driver, "driver")


# The twin's own tables.


@pytest.mark.parametrize("name", rigs.NAMES)
def test_the_shipped_configurations_are_taken(name: str) -> None:
    config = rigs.config(name)
    assert set(config.document.tables) <= TABLES
    assert config.asset.id
    assert config.monitor.healthy.is_known  # its unit comes with the program


@pytest.mark.parametrize("path", sorted((rigs.ROOT / "configs").iterdir()), ids=lambda it: it.name)
def test_a_shipped_configuration_is_one_page_that_a_person_writes(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    numbers = re.findall(r"(?<![\w.])-?\d[\d.]*", re.sub(r'#.*|"[^"]*"', "", text))
    fine = [number for number in numbers if len(number.strip("-0.").replace(".", "")) > 3]
    assert set(fine) <= {"1013", "1500", "4840", "5020", "5021"}  # no fitted digits


def refused(old: str, new: str) -> str:
    text = rigs.path_of("test_rig").read_text()
    assert old in text
    with pytest.raises(ConfigError) as error:
        Config.of(Document.parse(text.replace(old, new, 1), "cell.toml"))
    line = text[: text.index(old)].count("\n") + 1
    assert str(error.value).startswith(f"cell.toml:{line}: ")
    return str(error.value)


def test_an_impossible_data_set_is_refused_at_its_line() -> None:
    assert "data.supply.optimum_bar" in refused("optimum_bar = ", "optimum_bar = -")
    assert "data.sensor.noise_mbar" in refused("noise_mbar = ", "noise_mbar = -")
    message = refused("volume_ml = ", "volumen_ml = ")
    assert message.endswith(
        "data.system.parts, 5th entry, volumen_ml: unknown key: do you mean volume_ml?"
    )


def test_a_part_of_the_system_is_refused_at_its_own_line() -> None:
    message = refused("tube_length_mm = 65.0", "tube_length_mm = -65.0")
    assert "data.system.parts, 3rd entry, tube_length_mm: must be at least 0 (is -65.0)" in message
    old = 'kind = "vessel"'
    assert "data.system.parts, 5th entry: kind must be" in refused(
        old, old.replace("vessel", "bucket")
    )


VESSEL = {"kind": "vessel", "volume_ml": 750.0}
TUBE = {"kind": "tube", "length_mm": 100.0, "diameter_mm": 6.0}


@pytest.mark.parametrize(
    ("tables", "rule"),
    [
        ({"ejector": {"h1_mbar": 600.0}}, "at least h2_mbar"),
        ({"ejector": {"h1_mbar": 998.0}, "ambient": {"pressure_mbar": 900.0}}, "below ambient"),
        ({"ejector": {"end_pressure_mbar": 1013.0}}, "below ambient"),
        ({"ejector": {"bulge": -0.9, "skew": 5.0}}, "not monotonic"),
        ({"ejector": {"suction_capacity_sl_min": 0.0}}, "greater than 0"),
        ({"supply": {"pressure_bar": -0.5}}, "greater than 0"),
        ({"supply": {"pressure_bar": 1.0, "droop_bar": 1.5}}, "below ambient"),
        ({"sensor": {"lag_ms": 0.0}}, "greater than or equal to 0.5"),
        ({"system": {"parts": [TUBE, VESSEL | {"volume_ml": 0.0}]}}, "greater than 0"),
        ({"system": {"parts": [TUBE, VESSEL | {"volume_ml": float("nan")}]}}, "finite number"),
        ({"system": {"parts": [TUBE, VESSEL | {"volume_ml": float("inf")}]}}, "finite number"),
        ({"system": {"parts": [TUBE | {"diameter_mm": 1e-300}, VESSEL]}}, "too large or too small"),
        ({"system": {"parts": [TUBE | {"diameter_mm": 1e300}, VESSEL]}}, "too large or too small"),
        ({"ejector": {"suction_capacity_sl_min": 1e300}}, "too large or too small"),
        ({"system": {"parts": [TUBE]}}, "nothing to evacuate"),
        ({"system": {"parts": [VESSEL]}}, "need a tube"),
        ({"system": {"parts": [TUBE, VESSEL, *[{"kind": "sensor"}] * 2]}}, "more than one sensor"),
    ],
)
def test_what_no_ejector_can_be_is_refused(tables: dict[str, object], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        DataSet.model_validate(tables)


def test_every_coefficient_is_filled_in() -> None:
    data = rigs.config("gripper").data
    system = data.system.model_copy(update={"sensor_shift": 0.02})  # out into the hose
    theta = coefficients(data.model_copy(update={"system": system}))
    assert len(theta) == len(COEFFICIENTS)
    zero = {name for name, value in zip(COEFFICIENTS, theta, strict=True) if value == 0.0}
    effects = {
        "LAMINAR_LEAK",
        "INFLOW",
        "PORT_INFLOW",
        "BACK_FLOW",
        "SENSOR_OFFSET",
        "GAUGE",
        "SLOW_RAMP_UP",
        "EXHAUST_FOLLOWS",
        "END_MOVES",
        "MOVED",
        "FILTER_AT",
        "H1_FOLLOWS",
        "SLOW_SENSOR",
    }
    convection = {"FREE_CONVECTION", "FORCED_CONVECTION"}
    modes = {"CONTROL_SENSOR", "BLOW_OFF_MODE"}  # the first of each
    opening = {"EXHAUST", "HOLE", "CRACKING_PRESSURE", "RELIEF_PRESSURE", "KINK"}
    cups = {"COMPLIANCE", "SOFTNESS", "STIFF_UNTIL", "CREEP", "CONTACT"}
    mechanisms = set(list(COEFFICIENTS)[MECHANISMS:])
    blow_off = {"BLOW_OFF_SHAPE", "BLOW_OFF_DRAIN"}
    line = {"LINE_CRITICAL"}
    assert zero == line | blow_off | cups | opening | convection | effects | modes | mechanisms


def test_each_coefficient_has_the_number_of_its_row() -> None:
    """Of mechanisms only the first one has a name in the module."""
    names = list(COEFFICIENTS)[:MECHANISMS]
    assert [getattr(theta_table, name) for name in names] == [*range(MECHANISMS)]


def test_the_hash_tells_data_sets_apart() -> None:
    data = rigs.config("test_rig").data
    sensor = data.sensor.model_copy(update={"lag_ms": data.sensor.lag_ms + 1e-3})
    assert data.hash == rigs.config("test_rig").data.model_copy().hash
    assert data.hash != data.model_copy(update={"sensor": sensor}).hash
