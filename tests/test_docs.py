"""The page on data sets names every key there is, and no other."""

import re
from pathlib import Path

import pytest
from pydantic import BaseModel

from twin.model.dataset import Ambient, Ejector, Supply, System, Wiring
from twin.model.parts import Cups, Filter, Sensor, Tee, Tube, Vessel

PAGE = (Path(__file__).parents[1] / "docs" / "data-set.md").read_text(encoding="utf-8")
PARTS = (Tube, Tee, Filter, Sensor, Vessel, Cups)
TABLES = (Ambient, Ejector, Supply, System, Wiring, *PARTS)


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.__name__)
def test_every_key_is_explained(table: type[BaseModel]) -> None:
    explained = set(re.findall(r"`(\w+)`", PAGE)) | set(
        re.findall(r"`\[\[data\.system\.(\w+)", PAGE)
    )
    assert set(table.model_fields) - explained == set()


def test_no_key_is_explained_that_is_not_there() -> None:
    known = {key for table in TABLES for key in table.model_fields}
    known |= {"vacuum_mbar", "supply_bar", "suction_capacity_sl_min"}  # of a diagram
    keys = {key for key in re.findall(r"`(\w+)`", PAGE) if "_" in key}
    assert keys - known == {"leak_monitoring", "without_continuous"}
