"""The parts behind the ejector, and their sum: a line between two ends.

``[[data.system.parts]]`` lists them outwards from the ejector: tubes, T-pieces, filters, the vessel
or the cups, and the sensor at its place. The volume of a part along the line is divided between the
near and the far end in proportion to the pressure drop on either side.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from twin.model.air import CRITICAL_RATIO, VISCOSITY, R, orifice
from twin.settings import Settings
from twin.signals import MBAR, ML, SL_MIN

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]

FRICTION = 0.03  # Darcy friction factor of a smooth tube at Reynolds numbers near 10⁴ (Blasius)
TUBE_LOSS = 1.5  # velocity heads lost at inlet and outlet of a tube
SPHERE: float = (36.0 * math.pi) ** (1.0 / 3.0)  # area of a sphere is this × volume^(2/3)
BLUFF = 1.15  # area of a cylinder as long as it is wide, over that of a sphere of equal volume


class Tube(Settings):
    """A hose or pipe: its length and inner diameter give volume and flow resistance."""

    kind: Literal["tube"]  # a hose or pipe
    length_mm: Positive  # along the hose
    diameter_mm: Positive  # inside


class Tee(Settings):
    """A T-piece: the loss of its straight run, and its volume."""

    kind: Literal["tee"]  # a T-piece
    diameter_mm: Positive  # inside
    loss: NotNegative = 0.0  # velocity heads; the straight run has next to none
    volume_ml: NotNegative = 0.0  # inside


class Filter(Settings):
    """A vacuum filter, clean."""

    kind: Literal["filter"]  # a vacuum filter
    pressure_drop_mbar: NotNegative  # pressure drop at nominal suction from ambient
    volume_ml: NotNegative = 0.0  # inside


class Sensor(Settings):
    """The place of the sensor that the PLC reads, with its tube. Without one it is at the port."""

    kind: Literal["sensor"]  # the place of the sensor
    tube_length_mm: NotNegative = 0.0  # length of the tube from the line to the sensor
    tube_diameter_mm: Positive = 4.0  # inside


class Vessel(Settings):
    """A rigid vessel."""

    kind: Literal["vessel"]  # a rigid vessel
    volume_ml: Positive  # inside
    wall_area_cm2: Positive | None = None  # area of the wall, by default that of a cylinder


class Cups(Settings):
    """Suction cups of one kind."""

    kind: Literal["cups"]  # suction cups
    volume_ml: Positive  # volume of one cup with its connection
    count: int = Field(1, ge=1)  # number of cups
    wall_area_cm2: Positive | None = None  # wall area of one cup
    shrinks_ml: NotNegative = 0.0  # shrinkage of one cup at full vacuum
    lip_leak_sl_min: NotNegative = 0.0  # sonic flow of one cup's lip leak
    open: int = Field(0, ge=0)  # number of cups without a part
    free_flow_mbar: Positive = 5.0  # vacuum in one open cup that draws the whole nominal suction
    release_mbar: Positive = 20.0  # vacuum at which blow-off lets the part go

    @model_validator(mode="after")
    def _open_ones_are_there(self) -> "Cups":
        if self.open > self.count:
            raise ValueError(f"more cups are open than there are: {self.open} of {self.count}")
        return self


Part = Annotated[Tube | Tee | Filter | Sensor | Vessel | Cups, Field(discriminator="kind")]


@dataclass(frozen=True)
class Lumped:
    """Sums of a system, in SI units."""

    port_volume: float  # m³, of sensor, filter and T-piece at the port
    port_area: float  # m²
    line_volume: float  # m³, of the tubes
    line_area: float  # m²
    vessel_volume: float  # m³, at ambient pressure
    vessel_area: float  # m²
    resistance: float  # Pa²/(kg/s)²
    laminar: float  # Pa²/(kg/s)
    inertance: float  # 1/m
    place: float  # of the sensor, as a share of the drop: 0 at the port, 1 at the vessel
    shrinks: float  # m³ at full vacuum
    leak: float  # kg/s sonic
    opening: float  # kg/(s Pa) through the rims of all cups, when they stand open
    open: float  # kg/(s Pa) through those that have no part
    hole: float  # kg/s sonic, the flow of ``opening`` where rims are openings
    release: float  # Pa of vacuum; NaN where nothing is let go


def lumped(
    parts: tuple[Part, ...],
    suction: float,
    ambient: float,
    temperature: float,
    critical: float = CRITICAL_RATIO,
) -> Lumped:
    """Sum of the parts at nominal ``suction`` (kg/s), ``ambient`` (Pa) and ``temperature`` (K).

    The flow through a rim that is an opening is sonic up to the pressure ratio ``critical``.
    """
    drops = [drop(part, suction, ambient, temperature) for part in parts]
    total = sum(quadratic + linear for quadratic, linear in drops)
    volumes, areas, place, drop_before = np.zeros(3), np.zeros(3), 0.0, 0.0
    for part, (quadratic, linear) in zip(parts, drops, strict=True):
        middle = drop_before + (quadratic + linear) / 2.0
        drop_before += quadratic + linear
        if isinstance(part, Sensor):
            place = drop_before
        near = 0.0 if isinstance(part, Vessel | Cups) or total == 0.0 else 1.0 - middle / total
        where = [0.0, 1.0, 0.0] if isinstance(part, Tube) else [near, 0.0, 1.0 - near]
        volumes += np.array(where) * volume(part)
        areas += np.array(where) * area(part)
    cups = [part for part in parts if isinstance(part, Cups)]
    rim = [suction / (cup.free_flow_mbar * MBAR) for cup in cups]
    hole = [suction / _share(cup.free_flow_mbar * MBAR, ambient, critical) for cup in cups]
    return Lumped(
        port_volume=float(volumes[0]),
        port_area=float(areas[0]),
        line_volume=float(volumes[1]),
        line_area=float(areas[1]),
        vessel_volume=float(volumes[2]),
        vessel_area=float(areas[2]),
        resistance=sum(quadratic for quadratic, _ in drops) / suction**2,
        laminar=sum(linear for _, linear in drops) / suction,
        inertance=sum(inertance(part) for part in parts),
        place=place / total if total > 0.0 else 0.0,
        shrinks=sum(cup.count * cup.shrinks_ml for cup in cups) * ML,
        leak=sum(cup.count * cup.lip_leak_sl_min for cup in cups) * SL_MIN,
        opening=sum(cup.count * conductance for cup, conductance in zip(cups, rim, strict=True)),
        open=sum(cup.open * conductance for cup, conductance in zip(cups, rim, strict=True)),
        hole=sum(cup.count * conductance for cup, conductance in zip(cups, hole, strict=True)),
        release=min((cup.release_mbar * MBAR for cup in cups), default=math.nan),
    )


def _share(vacuum: float, ambient: float, critical: float) -> float:
    """Flow through an opening into a ``vacuum`` (Pa) below ``ambient``, over its sonic flow."""
    share, _ = orifice(1.0 - vacuum / ambient, critical)
    return float(share)


def drop(part: Part, suction: float, ambient: float, temperature: float) -> tuple[float, float]:
    """Difference of the squared pressures (Pa²) across a part at nominal ``suction`` (kg/s).

    It has two terms, for isothermal pipe flow: one quadratic in the flow (turbulent friction and
    losses), and one linear in it (Hagen-Poiseuille).
    """
    gas = R * temperature
    if isinstance(part, Tube):
        diameter, length = part.diameter_mm * 1e-3, part.length_mm * 1e-3
        heads = FRICTION * length / diameter + TUBE_LOSS
        slow = 256.0 * VISCOSITY * length * gas * suction / (math.pi * diameter**4)
        return heads * gas * (suction / _bore(diameter)) ** 2, slow
    if isinstance(part, Tee):
        return part.loss * gas * (suction / _bore(part.diameter_mm * 1e-3)) ** 2, 0.0
    if isinstance(part, Filter):
        return ambient**2 - (ambient - part.pressure_drop_mbar * MBAR) ** 2, 0.0
    return 0.0, 0.0


def inertance(part: Part) -> float:
    """Length over cross-section (1/m): pressure per rate of change of the flow in a part."""
    return part.length_mm * 1e-3 / _bore(part.diameter_mm * 1e-3) if isinstance(part, Tube) else 0.0


def volume(part: Part) -> float:
    """Volume of a part (m³); of a cup, at ambient pressure."""
    if isinstance(part, Tube):
        return _bore(part.diameter_mm * 1e-3) * part.length_mm * 1e-3
    if isinstance(part, Sensor):
        return _bore(part.tube_diameter_mm * 1e-3) * part.tube_length_mm * 1e-3
    if isinstance(part, Cups):
        return part.count * part.volume_ml * ML
    return part.volume_ml * ML


def area(part: Part) -> float:
    """Area of the inner wall of a part (m²)."""
    if isinstance(part, Tube):
        return math.pi * part.diameter_mm * part.length_mm * 1e-6
    if isinstance(part, Sensor):
        return math.pi * part.tube_diameter_mm * part.tube_length_mm * 1e-6
    count = part.count if isinstance(part, Cups) else 1
    given = part.wall_area_cm2 if isinstance(part, Vessel | Cups) else None
    if given is not None:
        return count * given * 1e-4
    return BLUFF * SPHERE * count * float((volume(part) / count) ** (2.0 / 3.0))


def _bore(diameter: float) -> float:
    return math.pi / 4.0 * diameter**2
