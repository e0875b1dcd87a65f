"""Characteristic diagrams: what the model keeps of them, and which it refuses."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.plc.rig import bulging
from twin.assets.database import open_assets
from twin.assets.diagram import Diagram
from twin.assets.record import Record
from twin.config import Config
from twin.errors import ConfigError
from twin.model.diagram import capacity, reduce
from twin.settings import Document

VACUUM = np.linspace(0.0, 850.0, 18)
SUPPLY = np.linspace(3.5, 6.0, 6)  # what makers allow
AMBIENT = 1013.0


@settings(max_examples=25, deadline=None)
@given(
    st.floats(5.0, 200.0),
    st.floats(100.0, 300.0),
    st.floats(0.0, 0.8),
    st.floats(3.8, 5.2),
    st.floats(0.3, 2.0),
    st.floats(0.0, 0.3),
)
def test_a_diagram_of_the_models_own_shape_comes_back(
    most: float, end: float, bulge: float, optimum: float, curvature: float, slope: float
) -> None:
    truth = np.array([most, end, bulge, 0.0, 0.0, 0.0, optimum, curvature, slope])
    flow = capacity(truth, VACUUM, SUPPLY, 4.5, AMBIENT)
    reduced = reduce(VACUUM, SUPPLY, flow, 4.5, AMBIENT)
    assert reduced.worst < 0.005 * most
    assert reduced.tables["ejector"]["suction_capacity_sl_min"] == pytest.approx(most, rel=0.01)
    assert reduced.tables["supply"]["optimum_bar"] == pytest.approx(optimum, abs=0.05)


def test_a_diagram_of_another_shape_is_met_within_some_percent() -> None:
    """The simulated rig's ejector: saturating curve, a capacity and reach of another form."""
    ratio = SUPPLY / 4.8
    strength = (ratio * np.exp(1.0 - ratio)) ** 2.5
    depth = 863.0 * (1.0 - np.where(ratio < 1.0, 1.3, 0.15) * (1.0 - ratio) ** 2)
    share = [[bulging(1.0 - vacuum / deep, 1.25) for vacuum in VACUUM] for deep in depth]
    reduced = reduce(VACUUM, SUPPLY, 35.0 * strength[:, None] * np.array(share), 4.8, AMBIENT)
    assert reduced.worst < 0.08 * 35.0
    assert reduced.tables["ejector"]["suction_capacity_sl_min"] == pytest.approx(35.0, rel=0.03)
    assert reduced.tables["ejector"]["end_pressure_mbar"] == pytest.approx(150.0, abs=15.0)
    assert reduced.tables["supply"]["optimum_bar"] == pytest.approx(4.8, abs=0.2)


def test_one_operating_pressure_says_nothing_of_the_others() -> None:
    truth = np.array([35.0, 150.0, 0.4, 0.0, 0.0, 0.0, 4.5, 1.0, 0.1])
    flow = capacity(truth, VACUUM, SUPPLY[3:4], 4.5, AMBIENT)
    assert set(reduce(VACUUM, SUPPLY[3:4], flow, 4.5, AMBIENT).tables) == {"ejector"}


def test_what_is_no_ejector_is_refused() -> None:
    steps = np.where(VACUUM < 400.0, 100.0, 1.0)[None, :] * np.ones((len(SUPPLY), 1))
    with pytest.raises(ConfigError, match=r"missed by up to .* sl/min"):
        reduce(VACUUM, SUPPLY, steps, 4.5, AMBIENT)


def test_a_type_with_a_diagram_gives_its_data_set(tmp_path: Path) -> None:
    truth = np.array([60.0, 200.0, 0.5, 0.0, 0.0, 0.0, 5.0, 1.2, 0.1])
    flow = capacity(truth, VACUUM, SUPPLY, 4.5, AMBIENT)
    diagram = Diagram(
        vacuum_mbar=VACUUM.tolist(),
        supply_bar=SUPPLY.tolist(),
        suction_capacity_sl_min=np.maximum(flow, 0.0).tolist(),
    )
    url = tmp_path / "assets.sqlite"
    with open_assets(url) as database:
        database.add(
            Record("type", "big", "big", {"ejector": {"h1_mbar": 700.0}}, arrays=diagram.arrays())
        )
    text = '[asset]\ntype = "big"\n[data.ambient]\ntemperature_c = 25.0\n'
    config = Config.of(Document.parse(text, "cell.toml"), str(url))
    assert config.data.ejector.suction_capacity_sl_min == pytest.approx(60.0, rel=0.01)
    assert config.data.ejector.h1_mbar == 700.0
    assert config.data.supply.optimum_bar == pytest.approx(5.0, abs=0.05)
    assert config.data.ambient.temperature_c == 25.0
    assert "big" in config.origin
