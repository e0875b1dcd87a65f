"""What components add up to: known volumes, textbook resistances, and what is refused."""

import math
import re

import numpy as np
import pytest
import rigs
from pydantic import ValidationError
from stepping import states, theta_of

from twin.model import kernel
from twin.model import theta as c
from twin.model.air import CRITICAL_RATIO, VISCOSITY, R, orifice
from twin.model.dataset import DataSet
from twin.model.parts import (
    FRICTION,
    TUBE_LOSS,
    Cups,
    Filter,
    Lumped,
    Part,
    Sensor,
    Tee,
    Tube,
    Vessel,
    drop,
    lumped,
)
from twin.signals import MBAR, ML, SL_MIN, Phase

AMBIENT, KELVIN, SUCTION = 1.013e5, 293.15, 35.0 * SL_MIN


def tube(length: float = 100.0, diameter: float = 6.0) -> Tube:
    return Tube(kind="tube", length_mm=length, diameter_mm=diameter)


def vessel(volume: float = 750.0) -> Vessel:
    return Vessel(kind="vessel", volume_ml=volume)


def sensor(**given: float) -> Sensor:
    return Sensor(kind="sensor", **given)


def cups(**given: float) -> Cups:
    return Cups.model_validate({"kind": "cups", "volume_ml": 10.0} | given)


def total(*parts: Part) -> Lumped:
    return lumped(parts, SUCTION, AMBIENT, KELVIN)


def room(of: Lumped) -> float:
    return of.port_volume + of.line_volume + of.vessel_volume


# Volumes.


def test_two_metres_of_four_millimetre_hose_hold_25_ml() -> None:
    assert total(tube(2000.0, 4.0), vessel()).line_volume == pytest.approx(25.13 * ML, rel=1e-3)


def test_the_founding_papers_test_rig_holds_755_ml() -> None:
    parts = rigs.config("test_rig").data.system.parts
    assert room(total(*parts)) == pytest.approx(755.0 * ML, rel=2e-3)


def test_the_founding_papers_gripper_holds_150_ml() -> None:
    parts = rigs.config("gripper").data.system.parts
    assert room(total(*parts)) == pytest.approx(150.0 * ML, rel=2e-3)


@pytest.mark.parametrize("name", rigs.NAMES)
def test_the_nodes_share_out_all_there_is(name: str) -> None:
    data, theta = rigs.config(name).data, rigs.theta(name)
    of = lumped(data.system.parts, theta[c.SUCTION], theta[c.AMBIENT], theta[c.TEMPERATURE])
    nodes = theta[[c.PORT_VOLUME, c.LINE_VOLUME, c.VOLUME]].sum()
    assert nodes == pytest.approx(room(of) + data.ejector.port_volume_ml * ML)


@pytest.mark.parametrize("name", rigs.NAMES)
def test_wherever_gas_is_stored_there_is_a_wall_and_each_wall_counts_once(name: str) -> None:
    data, theta = rigs.config(name).data, rigs.theta(name)
    of = lumped(data.system.parts, theta[c.SUCTION], theta[c.AMBIENT], theta[c.TEMPERATURE])
    tubes = theta[[c.PORT_HEAT, c.LINE_HEAT]] / data.system.tube_film_coefficient
    walls = np.append(tubes, theta[c.AREA])
    assert (walls > 0.0).all()
    assert theta[c.FILM] > 0.0
    assert walls.sum() == pytest.approx(of.port_area + of.line_area + of.vessel_area)


def test_a_wall_that_is_not_given_is_that_of_a_cylinder_as_long_as_wide() -> None:
    diameter = (4.0 * 750e-6 / math.pi) ** (1 / 3)
    wall = 1.5 * math.pi * diameter**2
    assert total(tube(), vessel(750.0)).vessel_area == pytest.approx(wall, rel=0.01)
    given = Vessel(kind="vessel", volume_ml=750.0, wall_area_cm2=470.0)
    assert total(tube(), given).vessel_area == pytest.approx(0.047)


# Resistance, by hand.


def test_a_tube_resists_slow_flow_as_hagen_and_poiseuille_say() -> None:
    """Δp = 128 μ l Q / (π d⁴), so Δ(p²) = 2 p̄ Δp with p̄ Q = w R T."""
    _, slow = drop(tube(2000.0, 4.0), SUCTION, AMBIENT, KELVIN)
    per_flow = 128.0 * VISCOSITY * 2.0 / (math.pi * 0.004**4)  # Pa per m³/s
    assert slow == pytest.approx(2.0 * per_flow * SUCTION * R * KELVIN)


def test_a_tube_resists_swift_flow_as_darcy_says() -> None:
    """Δp = (f l/d + ζ) ρ u²/2 with ρ u = w/A, so Δ(p²) = (f l/d + ζ) R T (w/A)²."""
    swift, _ = drop(tube(2000.0, 4.0), SUCTION, AMBIENT, KELVIN)
    bore = math.pi / 4 * 0.004**2
    heads = FRICTION * 2.0 / 0.004 + TUBE_LOSS
    density = AMBIENT / (R * KELVIN)
    loss = heads * density / 2 * (SUCTION / bore / density) ** 2  # Pa, at ambient density
    assert swift == pytest.approx(2.0 * AMBIENT * loss)


def test_tubes_in_line_add_up() -> None:
    one, two = total(tube(500.0), vessel()), total(tube(500.0), tube(500.0), vessel())
    for name in ("resistance", "laminar", "inertance", "line_volume"):
        assert getattr(two, name) == pytest.approx(2.0 * getattr(one, name))
    assert one.inertance == pytest.approx(0.5 / (math.pi / 4 * 0.006**2))


def test_a_filter_costs_its_drop_at_nominal_suction() -> None:
    clean = Filter(kind="filter", pressure_drop_mbar=30.0)
    quadratic, linear = drop(clean, SUCTION, AMBIENT, KELVIN)
    assert linear == 0.0
    assert AMBIENT - math.sqrt(AMBIENT**2 - quadratic) == pytest.approx(30 * MBAR)


def test_a_tee_loses_its_velocity_heads_and_a_straight_one_nothing() -> None:
    bent = Tee(kind="tee", diameter_mm=6.0, loss=1.5)
    assert drop(Tee(kind="tee", diameter_mm=6.0), SUCTION, AMBIENT, KELVIN) == (0.0, 0.0)
    ends, _ = drop(tube(1e-6, 6.0), SUCTION, AMBIENT, KELVIN)  # TUBE_LOSS heads and no length
    assert drop(bent, SUCTION, AMBIENT, KELVIN)[0] == pytest.approx(ends * 1.5 / TUBE_LOSS)


@pytest.mark.parametrize("part", [vessel(), cups(), sensor()])
def test_what_is_no_line_resists_nothing(part: Part) -> None:
    assert drop(part, SUCTION, AMBIENT, KELVIN) == (0.0, 0.0)


# Order and place.


def test_volume_goes_to_the_end_of_the_line_it_stands_at() -> None:
    full = Filter(kind="filter", pressure_drop_mbar=0.0, volume_ml=40.0)
    before, after = total(full, tube(), vessel()), total(tube(), full, vessel())
    assert before.port_volume == pytest.approx(40 * ML)
    assert after.port_volume == pytest.approx(0.0, abs=1e-12)
    assert after.vessel_volume == pytest.approx(790 * ML)
    half = total(tube(), full, tube(), vessel())
    assert half.port_volume == pytest.approx(20 * ML)
    assert half.vessel_volume == pytest.approx(770 * ML)


@pytest.mark.parametrize(
    ("parts", "place"),
    [
        ((tube(), vessel()), 0.0),
        ((sensor(), tube(), vessel()), 0.0),
        ((tube(50.0), sensor(), tube(50.0), vessel()), 0.5),
        ((tube(), vessel(), sensor()), 1.0),
    ],
)
def test_the_sensor_is_where_it_stands(parts: tuple[Part, ...], place: float) -> None:
    assert total(*parts).place == pytest.approx(place)


def test_a_sensors_tube_is_room_too() -> None:
    tubed = sensor(tube_length_mm=65.0, tube_diameter_mm=6.0)
    assert room(total(tubed, tube(), vessel())) - room(total(tube(), vessel())) == pytest.approx(
        math.pi / 4 * 6.0**2 * 65.0 * 1e-9
    )


# Cups.


def test_cups_count() -> None:
    four = total(tube(), cups(count=4, shrinks_ml=1.5, lip_leak_sl_min=0.2, wall_area_cm2=12.0))
    assert four.vessel_volume == pytest.approx(40 * ML)
    assert four.shrinks == pytest.approx(6 * ML)
    assert four.leak == pytest.approx(0.8 * SL_MIN)
    assert four.vessel_area == pytest.approx(48e-4)


@pytest.mark.parametrize("critical", [0.3, CRITICAL_RATIO])
def test_a_cup_that_draws_all_the_suction_has_its_free_flow_vacuum(critical: float) -> None:
    parts = tube(), cups(count=3, open=1, free_flow_mbar=8.0, release_mbar=30.0)
    of = lumped(parts, SUCTION, AMBIENT, KELVIN, critical)
    through, _ = orifice(1.0 - 8 * MBAR / AMBIENT, critical)
    assert of.open == pytest.approx(SUCTION / (8 * MBAR))
    assert of.hole * through == pytest.approx(3 * SUCTION)
    assert of.opening == pytest.approx(3 * of.open)
    assert of.release == 30 * MBAR


def test_what_has_no_cups_lets_nothing_go() -> None:
    assert math.isnan(total(tube(), vessel()).release)
    assert total(tube(), vessel()).opening == 0.0


def test_an_open_cup_stays_near_ambient() -> None:
    """All of the suction passes its rim, so its vacuum is the free-flow vacuum or little less."""
    parts = [{"kind": "tube", "length_mm": 100, "diameter_mm": 8}]
    ends = {"kind": "cups", "volume_ml": 20, "count": 2, "open": 1, "free_flow_mbar": 6.0}
    theta = theta_of(system={"parts": [*parts, ends], "leak_sl_min": 0.0})
    rows = states(theta, [(Phase.SUCTION, 600)])
    assert np.ptp(rows[-50:, kernel.VESSEL]) < 1.0
    vacuum = theta[c.AMBIENT] - rows[-1, kernel.VESSEL]
    assert 5.0 * MBAR < vacuum <= 6.0 * MBAR
    assert rows[-1, kernel.NEAR] == pytest.approx(vacuum * theta[c.LAMINAR_LEAK], rel=1e-3)


# What is refused.

TUBE = {"kind": "tube", "length_mm": 100.0, "diameter_mm": 6.0}
VESSEL = {"kind": "vessel", "volume_ml": 750.0}
CUPS = {"kind": "cups", "volume_ml": 10.0, "count": 2}


@pytest.mark.parametrize(
    ("tables", "complaint"),
    [
        ({"system": {"parts": [TUBE]}}, "parts need a vessel or cups"),
        ({"system": {"parts": [VESSEL]}}, "parts need a tube"),
        (
            {"system": {"parts": [TUBE, {"kind": "sensor"}, {"kind": "sensor"}, VESSEL]}},
            "more than one sensor",
        ),
        ({"system": {"parts": [TUBE, VESSEL | {"volume_ml": 0.0}]}}, "greater than 0"),
        ({"system": {"parts": [TUBE | {"length_mm": 0.0}, VESSEL]}}, "greater than 0"),
        ({"system": {"parts": [TUBE, {"kind": "bucket"}]}}, "bucket"),
        ({"system": {"parts": [TUBE, CUPS | {"open": 3}]}}, "more cups are open than there are"),
        ({"system": {"parts": [TUBE | {"colour": "blue"}, VESSEL]}}, "Extra inputs"),
        (
            {"ejector": {"h1_mbar": 600.0, "h1_hysteresis_mbar": 150.0, "h2_mbar": 550.0}},
            "h1_mbar must be at least h2_mbar + h1_hysteresis_mbar = 700",
        ),
        (
            {"ejector": {"h2_mbar": 10.0, "h2_hysteresis_mbar": 10.0}},
            "h2_hysteresis_mbar must be less than h2_mbar",
        ),
        ({"ejector": {"bulge": -0.9, "skew": 4.0}}, "not monotonic"),
        ({"supply": {"pressure_bar": 0.5, "droop_bar": 0.6}}, "below ambient"),
        ({"supply": {"pressure_bar": -0.1}}, "greater than 0"),
        ({"ejector": {"end_pressure_mbar": 1013.0}}, "end_pressure_mbar must be below ambient"),
        (
            {"ambient": {"pressure_mbar": 700.0}, "ejector": {"end_pressure_mbar": 100.0}},
            "h1_mbar must be below ambient",
        ),
    ],
)
def test_what_cannot_be_is_refused(tables: dict[str, object], complaint: str) -> None:
    with pytest.raises(ValidationError, match=re.escape(complaint)):
        DataSet.model_validate(tables)
