"""Where the data set of a unit comes from: type, [data] and unit in layers, and who is to blame."""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rigs

from twin.assets.database import Assets, open_assets
from twin.assets.record import Record
from twin.config import Config
from twin.errors import ConfigError, SourceError
from twin.log.header import LogHeader
from twin.model.dataset import DataSet
from twin.model.diagram import capacity
from twin.monitor.healthy import Healthy
from twin.settings import Document

TYPE, UNIT = "deep", "unit-1"
OF_TYPE = {
    "ejector": {"suction_capacity_sl_min": 60.0, "end_pressure_mbar": 100.0, "h1_mbar": 800.0},
    "supply": {"droop_bar": 0.3},
}
CELL = f"""\
[asset]
type = "{TYPE}"
id = "{UNIT}"

[data.ejector]
h1_mbar = 760.0
h2_mbar = 560.0

[[data.system.parts]]
kind = "tube"
length_mm = 900.0
diameter_mm = 4.0

[[data.system.parts]]
kind = "vessel"
volume_ml = 90.0

[monitor]
clear_cycles = 5
"""
HEALTHY = {"figures": {"hold_rms": {"mean": 2.0, "sigma": 0.5}}}


@pytest.fixture
def url(tmp_path: Path) -> str:
    return str(tmp_path / "assets.sqlite")


@pytest.fixture
def database(url: str) -> Iterator[Assets]:
    with open_assets(url) as assets:
        assets.add(Record("type", TYPE, TYPE, OF_TYPE))
        yield assets


def taken(url: str, text: str = CELL, unit: str = "", **options: Any) -> Config:
    return Config.of(Document.parse(text, "cell.toml"), url, unit, **options)


def add(database: Assets, data: Mapping[str, Any], **more: Any) -> Record:
    return database.add(Record("instance", UNIT, TYPE, data, **more))


def whole(url: str, **ejector: float) -> dict[str, Any]:
    """All tables of the unit, as a calibration gives them."""
    data = taken(url, calibrated=False).data
    changed = data.ejector.model_copy(update=ejector)
    return data.model_copy(update={"ejector": changed}).model_dump(mode="json")


# --- layers -------------------------------------------------------------------------------------


def test_the_configuration_lies_over_its_type(database: Assets, url: str) -> None:
    config = taken(url)
    assert config.data.ejector.suction_capacity_sl_min == 60.0  # the type's
    assert config.data.supply.droop_bar == 0.3
    assert config.data.ejector.h1_mbar == 760.0  # said by both
    assert [part.kind for part in config.data.system.parts] == ["tube", "vessel"]
    assert config.data.ejector.ramp_up_ms == DataSet().ejector.ramp_up_ms  # said by nobody
    record = database.get(TYPE).record
    assert config.origin == f"object-specific data of {TYPE}, record {record.id[:8]}"


def test_a_calibrated_unit_holds_over_everything(database: Assets, url: str) -> None:
    own = whole(url, suction_capacity_sl_min=58.0, h1_mbar=770.0)
    record = add(database, own, healthy=HEALTHY)
    config = taken(url)
    assert config.data == DataSet.model_validate(own)
    assert config.origin == f"instance-specific data of {UNIT}, record {record.id[:8]}"
    assert config.instead == ""


def test_what_a_unit_leaves_out_is_taken_from_below(database: Assets, url: str) -> None:
    add(database, {"ejector": {"suction_capacity_sl_min": 58.0}})
    config = taken(url)
    ejector = config.data.ejector
    assert ejector.suction_capacity_sl_min == 58.0  # its own
    assert (ejector.h1_mbar, ejector.h2_mbar) == (760.0, 560.0)  # [data]
    assert ejector.end_pressure_mbar == 100.0  # the type's
    assert config.data.supply.droop_bar == 0.3
    assert config.data.system == taken(url, calibrated=False).data.system
    kind = database.get(TYPE).record
    assert config.origin.startswith(f"instance-specific data of {UNIT}, record ")
    assert config.origin.endswith(f", over object-specific data of {TYPE}, record {kind.id[:8]}")


def test_the_papers_unit_evacuates_both_shipped_systems(tmp_path: Path) -> None:
    """It says nothing of what hangs on it, as the paper uses it on two systems."""
    for name in rigs.NAMES:
        document = Document.read(rigs.path_of(name))
        document = replace(document, name=str(tmp_path / "cell.toml"))
        config = Config.of(document, unit="paper-unit")
        assert config.data.ejector.suction_capacity_sl_min == 35.0
        assert config.data.system.parts == rigs.config(name).data.system.parts
        assert "paper-unit" in config.origin


def test_a_unit_may_have_a_diagram_of_its_own(database: Assets, url: str) -> None:
    vacuum, supply = np.linspace(0.0, 850.0, 12), np.array([3.5, 4.2, 5.0])
    truth = np.array([50.0, 120.0, 0.3, 0.0, 0.0, 0.0, 4.6, 1.0, 0.1])
    flow = capacity(truth, vacuum, supply, 4.2, 1013.0)  # at the nozzle: 4.5 - 0.3 bar
    arrays = {
        "diagram_vacuum_mbar": vacuum,
        "diagram_supply_bar": supply,
        "diagram_flow_sl_min": np.maximum(flow, 0.0),
    }
    add(database, {"ejector": {"bulge": 0.1}}, arrays=arrays)
    config = taken(url)
    assert config.data.ejector.suction_capacity_sl_min == pytest.approx(50.0, rel=0.01)
    assert config.data.supply.optimum_bar == pytest.approx(4.6, abs=0.05)
    assert config.data.ejector.bulge == 0.1  # said outright
    assert config.data.supply.droop_bar == 0.3  # the type's


def test_not_calibrated_is_the_unit_as_its_type_has_it(database: Assets, url: str) -> None:
    before = taken(url)
    add(database, {"ejector": {"suction_capacity_sl_min": 58.0}}, healthy=HEALTHY)
    assert taken(url, calibrated=False).data == before.data
    assert taken(url, calibrated=False).monitor == before.monitor
    assert taken(url).data != before.data


def test_the_healthy_scatter_is_the_units_if_it_has_one(database: Assets, url: str) -> None:
    assert taken(url).monitor.healthy == Healthy()
    add(database, {})
    assert taken(url).monitor.healthy == Healthy()
    add(database, {}, healthy=HEALTHY)
    assert taken(url).monitor.healthy == Healthy.model_validate(HEALTHY)
    assert taken(url).monitor.clear_cycles == 5  # the configuration's


def test_what_a_calibration_found_is_no_configuration(database: Assets, url: str) -> None:
    found = "\n[monitor.healthy.figures]\nhold_rms = { mean = 1.0, sigma = 0.1 }\n"
    with pytest.raises(ConfigError, match=r"cell\.toml: \[monitor\.healthy\]: ") as caught:
        taken(url, CELL + found)
    assert "twin calibrate" in caught.value.hint
    header = LogHeader(TYPE, UNIT, "cell.toml", CELL + found, {"data": whole_json()})
    old = Config.of_recorded(header, "day.mcap", unit=UNIT, assets=url)
    assert old.monitor.healthy == Healthy()  # a log of that time may be replayed


def test_a_unit_moved_to_another_system_is_refused(database: Assets, url: str) -> None:
    add(database, whole(url))
    moved = CELL.replace("length_mm = 900.0", "length_mm = 1900.0")
    with pytest.raises(ConfigError, match=f"{UNIT} was calibrated on another system") as caught:
        taken(url, moved)
    assert str(caught.value).startswith("cell.toml: ")
    assert "calibrate it again" in caught.value.hint
    assert taken(url, moved, calibrated=False).data.system.parts[0].length_mm == 1900.0
    silent = CELL[: CELL.index("[[data.system")]  # a configuration that leaves it to the record
    assert taken(url, silent).data.system.parts == taken(url).data.system.parts


def test_as_of_takes_what_was_known_then(database: Assets, url: str) -> None:
    first = add(database, {"ejector": {"suction_capacity_sl_min": 58.0}})
    second = add(database, {"ejector": {"suction_capacity_sl_min": 57.0}})

    def capacity_at(as_of_ns: int | None) -> float:
        return taken(url, as_of_ns=as_of_ns).data.ejector.suction_capacity_sl_min

    assert capacity_at(None) == 57.0
    assert capacity_at(second.recorded_ns) == 57.0
    assert capacity_at(second.recorded_ns - 1) == 58.0
    assert capacity_at(first.recorded_ns - 1) == 60.0  # the type's
    assert taken(url, as_of_ns=1).origin == "[data] of the configuration"


# --- who is known -------------------------------------------------------------------------------


def test_a_unit_that_is_not_known_is_its_type_and_that_is_said(database: Assets, url: str) -> None:
    config = taken(url, CELL.replace(f'id = "{UNIT}"', 'id = "unit-2"'))
    assert config.asset.id == "unit-2"
    assert config.data == taken(url, calibrated=False).data
    assert config.instead == (
        f"no instance-specific data set of 'unit-2' in {url}; using the type's '{TYPE}'"
    )
    assert taken(url, CELL.replace(f'id = "{UNIT}"', "")).instead == ""
    assert taken(url, unit="unit-2", calibrated=False).instead == ""


def test_a_unit_that_is_named_in_place_of_another_must_be_known(database: Assets, url: str) -> None:
    with pytest.raises(ConfigError, match="no unit is called 'unit-3'"):
        taken(url, unit="unit-3")
    assert taken(url, unit="unit-3", own="unit-3").asset.id == "unit-3"  # a log of it
    assert taken(url, unit="unit-3", calibrated=False).asset.id == "unit-3"  # to be calibrated


def test_a_type_that_nobody_knows_is_what_the_configuration_says(
    database: Assets, url: str
) -> None:
    config = taken(url, CELL.replace(TYPE, "other"))
    assert config.origin == "[data] of the configuration"
    assert config.data.ejector.end_pressure_mbar == DataSet().ejector.end_pressure_mbar
    assert f"no data set of '{UNIT}' or its type 'other' in {url}; using [data]" in config.instead


def test_a_type_that_nobody_knows_is_refused_where_nothing_is_said(
    database: Assets, url: str
) -> None:
    with pytest.raises(ConfigError, match="no data set of 'u' or its type 'other'") as caught:
        taken(url, '[asset]\ntype = "other"\nid = "u"\n')
    assert f"compact-ejector-35, {TYPE}" in caught.value.hint


@pytest.mark.parametrize(
    ("asset", "unit"), [(f'id = "{UNIT}"', ""), ("", UNIT), (f'id = "{UNIT}"\ntype = ""', "")]
)
def test_an_id_without_a_type_is_refused(database: Assets, url: str, asset: str, unit: str) -> None:
    text = f"[asset]\n{asset}\n[data.supply]\npressure_bar = 5.0\n"
    with pytest.raises(ConfigError, match=rf"cell\.toml: asset '{UNIT}' has no type") as caught:
        taken(url, text, unit)
    assert 'type = "..." under [asset]' in caught.value.hint


def test_a_unit_of_another_type_is_refused(database: Assets, url: str) -> None:
    add(database, {})
    with pytest.raises(ConfigError, match=f"is of type '{TYPE}' in the database, not 'compact-"):
        taken(url, CELL.replace(TYPE, "compact-ejector-35"))


# --- who is to blame ----------------------------------------------------------------------------

UNFIT = [
    ({"ejector": {"colour": "red"}}, "data.ejector.colour: unknown key"),
    ({"colours": {}}, "data.colours: unknown key"),
    (
        {"supply": {"pressure_bar": "high"}},
        "data.supply.pressure_bar: must be a number (is 'hi",
    ),
    ({"supply": 5}, "data.supply: must be a table (is 5)"),
    ({"supply": {"pressure_bar": -1.0}}, "data.supply.pressure_bar: must be greater than 0"),
    ({"ejector": {"h2_mbar": 700.0}}, "data.ejector: h1_mbar must be at least"),
    ({"system": {"parts": [{"kind": "vessel"}]}}, "1st entry, volume_ml: is missing"),
    ({"system": {"parts": [{"volume_ml": 3.0}]}}, "data.system.parts, 1st entry: needs a kind"),
]


@pytest.mark.parametrize(("data", "problem"), UNFIT)
def test_a_record_of_another_shape_is_named_with_its_key(
    database: Assets, url: str, data: dict[str, Any], problem: str
) -> None:
    for kind, name in (("instance", UNIT), ("type", TYPE)):  # the type last: it is below the unit
        record = database.add(Record(kind, name, TYPE, data))
        with pytest.raises(ConfigError) as caught:
            taken(url)
        where = f"{url}: record {record.id[:8]} of {kind} {name!r} cannot be used: "
        assert str(caught.value).startswith(where)
        assert problem in str(caught.value)
        assert f"twin assets show {name}" in caught.value.hint


@pytest.mark.parametrize(
    ("healthy", "problem"),
    [
        (
            {"figures": {"hold_rms": {"mean": 1.0}}},
            "healthy.figures.hold_rms.sigma: is missing",
        ),
        (
            {"figures": {"hold_rms": {"mean": 1.0, "sigma": 0.0}}},
            "healthy.figures.hold_rms.sigma: must be",
        ),
        (
            {"figures": {"hold_rms": 1.0}},
            "healthy.figures.hold_rms: must be a table",
        ),
    ],
)
def test_a_healthy_scatter_of_another_shape_is_named_with_its_key(
    database: Assets, url: str, healthy: dict[str, Any], problem: str
) -> None:
    record = add(database, {}, healthy=healthy)
    with pytest.raises(ConfigError, match=f"record {record.id[:8]} of instance") as caught:
        taken(url)
    assert problem in str(caught.value)
    stored = {"data": whole_json(), "healthy": json.dumps(healthy)}
    with pytest.raises(SourceError) as unfit:
        Config.of_log(Document.parse(CELL, "cell.toml"), stored, "day.mcap")
    assert problem in str(unfit.value)


def test_a_fault_of_the_configuration_is_its_own(database: Assets, url: str) -> None:
    """Though type and unit are at hand, file and line are those of the configuration."""
    add(database, whole(url))
    for old, new, line, problem in (
        ("h2_mbar = 560.0", "h3_mbar = 560.0", 7, "data.ejector.h3_mbar: unknown key"),
        ("volume_ml = 90.0", "volume_ml = 0.0", 16, "volume_ml: must be greater than 0"),
        ("h2_mbar = 560.0", "h2_mbar = 700.0", 5, "data.ejector: h1_mbar must be"),
    ):
        with pytest.raises(ConfigError) as caught:
            taken(url, CELL.replace(old, new))
        assert str(caught.value).startswith(f"cell.toml:{line}: ")
        assert problem in str(caught.value)
    with pytest.raises(ConfigError, match=r"cell\.toml:.*data: must be a table"):
        taken(url, f'data = 5\n[asset]\ntype = "{TYPE}"\n')


# --- the data set of a log ----------------------------------------------------------------------


def whole_json(**changes: Any) -> str:
    return json.dumps(DataSet().model_dump(mode="json") | changes)


def of_log(**metadata: str) -> Config:
    return Config.of_log(Document.parse(CELL, "cell.toml"), metadata, "day.mcap")


def test_a_log_gives_its_data_set_back_without_a_database() -> None:
    config = of_log(data=whole_json(), origin="elsewhere", healthy=json.dumps(HEALTHY))
    assert config.data == DataSet()
    assert config.origin == "elsewhere"
    assert config.monitor.healthy.figures["hold_rms"].sigma == 0.5
    assert (config.asset.id, config.instead) == (UNIT, "")


@pytest.mark.parametrize(("data", "problem"), UNFIT)
def test_a_logs_data_set_of_another_shape_is_named_with_its_key(
    data: dict[str, Any], problem: str
) -> None:
    with pytest.raises(SourceError) as caught:
        of_log(data=json.dumps(data), program="9.8.7")
    assert str(caught.value).startswith("day.mcap: its data set cannot be used: ")
    assert problem in str(caught.value)
    assert "--config" in caught.value.hint
    assert "9.8.7" in caught.value.hint


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{", "line 1 column 2"),
        ('{"a":' * 100_000, "recursion"),
        (whole_json(supply={"pressure_bar": math.inf}), "pressure_bar: must be a finite"),
        ("5", "data: must be a table"),
        (
            "{}",
            "data.ambient, data.supply, data.ejector, data.sensor, data.system, data.effects,"
            " data.terms: missing",
        ),
        (
            whole_json(
                sensor={
                    key: value
                    for key, value in DataSet().sensor.model_dump(mode="json").items()
                    if key != "lag_ms"
                }
            ),
            "data.sensor.lag_ms: missing",
        ),
        (
            whole_json(
                system=DataSet().system.model_dump(mode="json")
                | {
                    "parts": [
                        {"kind": "tube", "length_mm": 1.0, "diameter_mm": 1.0},
                        {"kind": "vessel", "volume_ml": 1.0},
                    ]
                }
            ),
            "data.system.parts.1.wall_area_cm2: missing",
        ),
    ],
)
def test_nothing_is_made_up_that_a_log_does_not_say(text: str, problem: str) -> None:
    """A default is what this program takes, not what was there when the log was recorded."""
    with pytest.raises(SourceError) as caught:
        of_log(data=text)
    assert problem in str(caught.value)
    assert "of unknown version" in caught.value.hint


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[asset\n", "cell.toml: not valid TOML: "),
        (CELL + "[colours]\n", "cell.toml:20: unknown table [colours]"),
        (CELL.replace("clear_", "clean_"), "cell.toml:19: monitor.clean_cycles: unknown key"),
        (CELL.replace("id =", "ib ="), "cell.toml:3: asset.ib: unknown key"),
    ],
)
def test_a_logs_configuration_of_another_shape_is_said_to_stand_in_it(
    text: str, problem: str
) -> None:
    """No file of that name need be there: what is wrong is the log, or too old a program."""
    metadata = {"data": whole_json(), "program": "9.8.7"}
    header = LogHeader(TYPE, UNIT, "cell.toml", text, metadata)
    with pytest.raises(SourceError) as caught:
        Config.of_recorded(header, "day.mcap")
    assert str(caught.value).startswith("day.mcap: the configuration in it cannot be used: ")
    assert problem in str(caught.value)
    assert "--config" in caught.value.hint
    assert "9.8.7" in caught.value.hint
    other = Document.parse(CELL.replace(TYPE, "other"), "cell.toml")
    assert Config.of_recorded(header, "day.mcap", other).asset.type == "other"
