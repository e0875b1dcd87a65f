"""``twin config``: all mistakes at once, in words; and a schema that editors can use."""

import json
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import rigs
from command_line import twin
from pydantic import BaseModel

from twin.cli.config import json_schema, mistakes, sections
from twin.keys import ANY, comments_of, defaults_of, tables_below
from twin.settings import BELOW, Document
from twin.validation import alike, models_at, ordinal, path_in_words

BAD = """\
[asset]
bacth = "7"

[data.ejector]
suction_capacity_sl_min = -3

[[data.system.parts]]
kind = "tube"
length_mm = 100
diamter_mm = 6

[driver]
host = 5
intervall_ms = 30

[driver.tags]
presure = { address = "30002", type = "float32", unit = "mbar", reference = "absolute" }
suction = { address = "coil:99999999" }

[import.columns]
presure_mbar = "Druck"

[monitor]
false_alarm_days = "six"
isolate = "perhaps"

[mqqt]
host = "broker"
"""
SAID = (
    "2: asset.bacth: unknown key: do you mean batch?",
    "5: data.ejector.suction_capacity_sl_min: must be greater than 0 (is -3)",
    "10: data.system.parts, 1st entry, diamter_mm: unknown key: do you mean diameter_mm?",
    '13: driver.host: must be text, in quotation marks: "..." (is 5)',
    "14: driver.intervall_ms: unknown key: do you mean interval_ms?",
    "17: driver.tags.presure: unknown key: do you mean pressure?",
    '18: driver.tags.suction.address: "coil:99999999" is no address',
    "21: import.columns.presure_mbar: there is no key presure_mbar: do you mean pressure_mbar?",
    "24: monitor.false_alarm_days: must be a number (is 'six')",
    "25: monitor.isolate: must be true or false (is 'perhaps')",
    "27: unknown table [mqqt]; did you mean 'mqtt'?",
)


def test_all_mistakes_are_told_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(BAD)
    assert twin(monkeypatch, "config", "check", path) == 2
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert len(lines) == len(SAID)
    for line, said in zip(lines, SAID, strict=True):
        assert line.startswith(f"{path}:{said}")
    assert err == f"twin: {path}: {len(SAID)} mistakes\n"


@pytest.mark.parametrize("path", sorted((rigs.ROOT / "configs").iterdir()), ids=lambda it: it.name)
def test_a_shipped_configuration_has_none(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "config", "check", path) == 0
    assert "no mistake in [asset]" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            '[mqtt]\nport = 1\n[data.supply]\npressure_bar = 5\n[asset]\nid = "x"',
            "has no host",
        ),
        ('[asset]\ntype = "nobody-knows"', "nobody-knows"),
        ('[driver]\nkind = "profinet"', "unknown driver 'profinet'; known: modbus, opcua"),
        ("[monitor.healthy]\nx = 1\n[data.supply]\npressure_bar = 5", "remove the table"),
        ('[alarms]\nrules = "none.toml"\n[data.supply]\npressure_bar = 5', "none.toml: cannot be"),
        ('[assets]\nurl = "oracle://x"\n[data.supply]\npressure_bar = 5', "oracle"),
        ("[data.ejector]\nh1_mbar = 500", "h1_mbar must be at least"),
    ],
)
def test_what_only_several_keys_show_is_told_too(text: str, said: str) -> None:
    found = mistakes(Document.parse(text, "cell.toml"))
    assert any(said in line for line in found), found


def test_a_persons_hours_and_zone_are_told_with_the_rest() -> None:
    text = """[notifications.email]
host = "mail"
port = "x"
[[notifications.people]]
name = "Ann"
address = "ann@plant.example"
hours = "06:00-25:00"
time_zone = "Europe/Atlantis"
steep = 1
[asset]
type = "compact-ejector-35"
"""
    found = mistakes(Document.parse(text, "cell.toml"))
    assert [line.partition(": ")[0] for line in found] == [
        f"cell.toml:{number}" for number in (3, 7, 8, 9)
    ]
    assert "people, 1st entry, hours: must be two times of the day" in found[1]


def test_a_driver_that_is_none_is_told_with_its_line() -> None:
    found = mistakes(Document.parse('[driver]\nhost = "plc"\nkind = "modbsu"\n', "cell.toml"))
    assert found[-1].startswith("cell.toml:3: unknown driver 'modbsu'; did you mean 'modbus'?")


@pytest.mark.parametrize(
    ("text", "table"),
    [
        ('[email]\nhost = "mail"', "[notifications.email]"),
        ('[[people]]\nname = "Ann"', "[[notifications.people]]"),
        ('[columns]\ntime = "Zeit"', "[import.columns]"),
    ],
)
def test_a_table_that_belongs_below_another_is_told_its_place(text: str, table: str) -> None:
    (found,) = mistakes(Document.parse(text, "cell.toml"))
    assert found.startswith("cell.toml:1: unknown table [")
    assert f"]; write {table}; known: " in found


def test_a_place_that_is_told_exists() -> None:
    tables = {
        ".".join((section, *path)).removesuffix("[]")
        for section, kinds in sections().items()
        for kind in kinds.values()
        for path, _ in tables_below(kind)
    }
    assert {table.strip("[]") for table in BELOW.values()} <= {
        path.removesuffix(f".{ANY}") for path in tables
    }


def test_what_follows_from_a_mistake_is_not_told() -> None:
    text = """[data.supply]
pressure_bar = "high"
[[data.system.parts]]
kind = "tube"
lenght_mm = 3
"""
    found = mistakes(Document.parse(text, "cell.toml"))
    assert [line.partition(": ")[2] for line in found] == [
        "data.supply.pressure_bar: must be a number (is 'high')",
        "data.system.parts, 1st entry, diameter_mm: is missing, and has no default",
        "data.system.parts, 1st entry, lenght_mm: unknown key: do you mean length_mm?",
    ]


# --- words --------------------------------------------------------------------------------------


def test_paths_and_questions_in_words() -> None:
    assert path_in_words(("data", "system", "parts", 1, "volume_ml")) == (
        "data.system.parts, 2nd entry, volume_ml"
    )
    assert path_in_words(("alarm", 0)) == "alarm, 1st entry"
    assert [ordinal(n) for n in (1, 2, 3, 4, 11, 12, 21)] == (
        ["1st", "2nd", "3rd", "4th", "11th", "12th", "21st"]
    )
    assert alike("presure", ["pressure", "suction"]) == "do you mean pressure?"
    assert alike("x", ["pressure", "suction"]) == "known are pressure, suction"


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("presure", "there is no key presure: do you mean pressure?"),
        ("Druck", "there is no key Druck: known are ambient_mbar, blow_off, "),
    ],
)
def test_a_key_that_there_is_not_is_called_so(key: str, said: str) -> None:
    text = f'[asset]\ntype = "compact-ejector-35"\n[import.columns]\n{key} = "p"'
    (found,) = mistakes(Document.parse(text, "cell.toml"))
    assert found.startswith(f"cell.toml:4: import.columns.{key}: {said}")
    assert "(is " not in found


def test_kinds_of_tables_are_found_at_their_places() -> None:
    data = sections()["data"][""]
    names = {model.__name__ for model in models_at(data, ("system", "parts", 3))}
    assert names == {"Tube", "Tee", "Filter", "Sensor", "Vessel", "Cups"}
    columns = sections()["import"][""]
    assert [model.__name__ for model in models_at(columns, ("columns", "x"))] == ["ColumnSource"]


def test_comments_beside_and_above_a_key_are_read() -> None:
    supply = {one.__name__: one for _, one in tables_below(sections()["data"][""])}["Supply"]
    comments = comments_of(supply)
    assert comments["pressure_bar"] == "gauge pressure at the regulator"
    assert comments["optimum_bar"].startswith("Gauge pressure of the greatest suction")
    tag = sections()["driver"]["modbus"].model_fields["tags"].annotation
    pressure = next(models_at(tag, ("pressure",)))
    assert comments_of(pressure)["scale"] == "factor on the raw number"  # of a class above its own
    assert defaults_of(pressure)["scale"] == 1.0


# --- the schema ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def validator() -> jsonschema.Draft202012Validator:
    schema = json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(json.loads(json.dumps(schema)))


@pytest.mark.parametrize("path", sorted((rigs.ROOT / "configs").iterdir()), ids=lambda it: it.name)
def test_the_schema_takes_what_the_program_takes(
    path: Path, validator: jsonschema.Draft202012Validator
) -> None:
    validator.validate(tomllib.loads(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize(
    "text",
    [
        "[asset]\nbacth = 1",
        "[mqqt]\nhost = 1",
        "[data.ejector]\nh1_mbar = -1",
        '[import]\nvalues = "keep"',
        '[import.columns]\npresure = "p"',
        '[[data.system.parts]]\nkind = "bucket"',
        "[monitor.healthy]\n",
    ],
)
def test_the_schema_refuses_what_the_program_refuses(
    text: str, validator: jsonschema.Draft202012Validator
) -> None:
    assert list(validator.iter_errors(tomllib.loads(text)))


@pytest.mark.parametrize(
    "text",
    [
        '[import.columns]\npressure = "p"\nvacuum = { name = "v", unit = "kPa" }',
        '[driver.ring]\nheader = "40101"\n[driver]\nhost = "a"\n[driver.tags.pressure]\n'
        'address = "30002"\ntype = "float32"\nunit = "hPa"\nreference = "absolute"',
        '[results]\nopcua = true\nusers = "users.toml"',
    ],
)
def test_the_schema_knows_texts_that_become_something_else(
    text: str, validator: jsonschema.Draft202012Validator
) -> None:
    validator.validate(tomllib.loads(text))


def test_the_schema_says_what_a_key_is_and_its_default() -> None:
    definitions = json_schema()["$defs"]
    ring: dict[str, Any] = definitions["Ring"]["properties"]
    assert ring["records"] == {
        "type": "string",
        "description": "first register of the ring",
        "default": "holding:1000",
    }
    assert definitions["ImportSettings"]["properties"]["period_ms"]["description"]


def test_a_schema_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "config", "schema") == 0
    assert json.loads(capsys.readouterr().out) == json_schema()


def test_every_kind_of_table_can_be_read_for_its_comments() -> None:
    kinds: set[type[BaseModel]] = {
        one for by in sections().values() for kind in by.values() for _, one in tables_below(kind)
    }
    assert len(kinds) > 60
    assert all(set(comments_of(kind)) == set(kind.model_fields) for kind in kinds)
