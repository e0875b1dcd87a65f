"""What changes with time: gas in cells, and everything else in one record."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from second_world.constants import CV, R_AIR
from second_world.rig import Rig

SECOND, FIRST, HEAD, CELLS = (
    0,
    1,
    2,
    3,
)  # cells: stage 2, stage 1, head, hose from here, vessel last
FLAP, CHECK, HOSE = 0, 1, 2  # faces: face i lies between the cells i and i + 1
QUEUE = 16  # strokes of a valve that may be under way at once

REST = np.dtype(
    [
        (name, "f8")
        for name in [
            "p_supply",
            "p_feed",
            "p_reservoir",
            "p_exhaust",
            "primary",
            "flap",
            "check",
            "valve",
            "valve_lagged",
            "blow_valve",
            "volume",
            "added",
            "cup_held",
            "cup_shut",
            "backlash_held",
            "backlash_shut",
            "yielded",
            "creep",
            "line_wall",
            "vessel_wall",
            "sealed",
            "ice",
            "water",
            "filled",
            "moisture",
            "warmth",
            "own_reading",
            "lag_1",
            "lag_2",
            "lag_3",
            "saving",
            "saving_since",
            "ambient",
            "leak_scale",
            "mass_in",
            "energy_in",
        ]
    ]
)


class Gas(NamedTuple):
    """Cells (mass, energy and so on) and faces (flow, friction), with room to solve in."""

    mass: npt.NDArray[np.float64]  # kg
    energy: npt.NDArray[np.float64]  # J, internal
    pressure: npt.NDArray[np.float64]  # Pa
    temperature: npt.NDArray[np.float64]  # K
    volume: npt.NDArray[np.float64]  # m³
    film: npt.NDArray[np.float64]  # W/K to the wall
    to_ambient: npt.NDArray[np.float64]  # kg/(s·Pa)
    source: npt.NDArray[np.float64]  # kg/s at ambient temperature
    sucked: npt.NDArray[np.float64]  # kg/s taken by the ejector
    slope: npt.NDArray[np.float64]  # kg/(s·Pa) of `sucked` with pressure
    flow: npt.NDArray[np.float64]  # kg/s at faces, towards the vessel
    fixed: npt.NDArray[np.float64]  # kg/s at faces, part that the new pressures do not change
    conductance: npt.NDArray[np.float64]  # kg/(s·Pa) at faces
    friction: npt.NDArray[np.float64]  # turbulent factor at faces
    upper: npt.NDArray[np.float64]
    right: npt.NDArray[np.float64]


class Strokes(NamedTuple):
    """Two valves, suction and blow-off: strokes that wait for their dead time, and the last one."""

    time: npt.NDArray[np.float64]  # valve x QUEUE, s
    target: npt.NDArray[np.float64]  # valve x QUEUE
    ends: npt.NDArray[np.int64]  # valve x (first, behind the last, strokes so far)
    begun: npt.NDArray[np.float64]  # valve, s
    start: npt.NDArray[np.float64]  # valve, opening at the begin of the stroke
    goal: npt.NDArray[np.float64]  # valve


def still_air(rig: Rig) -> Gas:
    """Everything at ambient pressure and temperature."""
    cells = rig.line.line_cells
    area = np.pi / 4 * rig.line.line_diameter**2
    hose = np.full(cells, area * rig.line.line_length / cells)
    unit = rig.ejector
    vessel = rig.vessel.rigid_volume + rig.vessel.cup_volume
    volume = np.concatenate(
        [[unit.second_chamber, unit.first_chamber, unit.head_volume], hose, [vessel]]
    )
    count = len(volume)
    pressure = np.full(count, rig.surroundings.ambient_pressure)
    temperature = np.full(count, rig.surroundings.ambient_temperature)
    mass = pressure * volume / (R_AIR * temperature)
    nodes = [np.zeros(count) for _ in range(5)]
    faces = [np.zeros(count - 1) for _ in range(4)]
    return Gas(
        mass,
        mass * CV * temperature,
        pressure,
        temperature,
        volume,
        *nodes,
        *faces,
        np.zeros(count),
        np.zeros(count),
    )


def at_rest(rig: Rig) -> np.void:
    """Valves shut, supply under pressure, walls at ambient temperature."""
    rest = np.zeros(1, REST)
    ambient = rig.surroundings.ambient_pressure
    rest["p_supply"] = rest["p_reservoir"] = ambient + rig.supply.supply_gauge
    rest["p_feed"] = rest["p_exhaust"] = rest["ambient"] = ambient
    rest["line_wall"] = rest["vessel_wall"] = rig.surroundings.ambient_temperature
    rest["volume"] = rig.vessel.rigid_volume + rig.vessel.cup_volume
    rest["sealed"] = 0.0 if rig.vessel.released else 1.0
    for name in ("own_reading", "lag_1", "lag_2", "lag_3"):
        rest[name] = ambient
    rest["moisture"] = rest["leak_scale"] = 1.0
    return rest[0]


def valves() -> Strokes:
    """Both shut, nothing under way."""
    return Strokes(
        np.zeros((2, QUEUE)),
        np.zeros((2, QUEUE)),
        np.zeros((2, 3), np.int64),
        np.zeros(2),
        np.zeros(2),
        np.zeros(2),
    )
