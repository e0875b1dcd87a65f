"""The paper's two systems, its two equations, and its model as a data set for the twin's kernel.

The paper's model is an adiabatic vessel with a suction mass flow. The flow falls linearly from
nominal suction at ambient pressure to zero at end pressure, without delay and without leak. With
wall heat or a bulge it becomes this twin's model.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from twin.assets.shipped import shipped_records
from twin.model import kernel
from twin.model import theta as c
from twin.model.air import R
from twin.model.dataset import Ambient, DataSet, Ejector, System, coefficients
from twin.model.parts import Part, Sensor, Tube, Vessel, area, volume
from twin.signals import MBAR, ML, MS, SL_MIN, Phase

_SHIPPED = {record.name: record.data["ejector"] for record in shipped_records()}
_MEAN_OF_TEN, _MEASURED = _SHIPPED["compact-ejector-35"], _SHIPPED["paper-unit"]
INSTANCE_SL_MIN: float = _MEASURED["suction_capacity_sl_min"]
OBJECT_SL_MIN: float = _MEAN_OF_TEN["suction_capacity_sl_min"]
END_MBAR: float = _MEAN_OF_TEN["end_pressure_mbar"]  # absolute
SAFETY = 1.2  # usual factor on equation (2)
HOSE = Tube(kind="tube", length_mm=2000.0, diameter_mm=4.0)  # of the application

# Areas of inner walls, which the paper's model does not use.
TANK_CM2, TUBES_CM2 = 470.0, 31.0  # of the rig, tubes of 165 mm × 6 mm in all
CUPS_CM2, HOSE_CM2 = 200.0, area(HOSE) * 1e4

ZERO_CELSIUS = 273.15  # K
PORT_ML = 1.0
SHORT = Tube(kind="tube", length_mm=1.0, diameter_mm=20.0)  # resists with some hundredths of a mbar
AT_ONCE = 1e-9  # s

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Setup:
    """A system to be evacuated, in the field's units; pressures are absolute."""

    name: str
    volume_ml: float
    wall_cm2: float
    ambient_mbar: float
    temperature_c: float
    target_mbar: float
    measured_ms: float
    parts: tuple[Part, ...]  # of that volume and wall

    @property
    def slowest_ms(self) -> float:
        """An upper bound (ms) of the time to the target, for all curves of interest."""
        return 2.0 * equation_1(self)


@dataclass(frozen=True)
class Unit:
    """Assumptions about the ejector and the walls around the gas."""

    suction_sl_min: float = INSTANCE_SL_MIN
    film: float = 0.0  # W/(m² K)
    bulge: float = 0.0


def one_vessel(volume_ml: float, wall_cm2: float) -> tuple[Part, ...]:
    """Parts with ``volume_ml`` including the ejector's port, and almost without resistance."""
    rest = volume_ml - PORT_ML - volume(SHORT) / ML
    wall = wall_cm2 - area(SHORT) * 1e4
    return SHORT, Vessel(kind="vessel", volume_ml=rest, wall_area_cm2=wall)


def with_hose(setup: Setup, *, sensor_in_cups: bool) -> Setup:
    """The application with its hose as a line with resistance, and a place for the sensor."""
    sensor, rest = Sensor(kind="sensor"), setup.volume_ml - PORT_ML - volume(HOSE) / ML
    cups = Vessel(kind="vessel", volume_ml=rest, wall_area_cm2=CUPS_CM2)
    parts = (HOSE, sensor, cups) if sensor_in_cups else (sensor, HOSE, cups)
    return replace(setup, parts=parts)


def of_volume(setup: Setup, volume_ml: float) -> Setup:
    """The setup with another volume; its wall grows as for the same shape."""
    wall = setup.wall_cm2 * (volume_ml / setup.volume_ml) ** (2.0 / 3.0)
    parts = one_vessel(volume_ml, wall)
    return replace(setup, volume_ml=volume_ml, wall_cm2=wall, parts=parts)


RIG = Setup(
    name="rig",
    volume_ml=755.0,
    wall_cm2=TANK_CM2 + TUBES_CM2,
    ambient_mbar=993.0,
    temperature_c=25.0,
    target_mbar=393.0,
    measured_ms=1091.0,
    parts=one_vessel(755.0, TANK_CM2 + TUBES_CM2),
)
APPLICATION = Setup(
    name="application",
    volume_ml=150.0,
    wall_cm2=CUPS_CM2 + HOSE_CM2,
    ambient_mbar=1000.0,
    temperature_c=20.0,
    target_mbar=400.0,
    measured_ms=200.0,
    parts=one_vessel(150.0, CUPS_CM2 + HOSE_CM2),
)


def time_constant(setup: Setup, suction_sl_min: float = INSTANCE_SL_MIN) -> float:
    """V / S_N in ms, with S_N as volume flow at the system's ambient pressure and temperature."""
    density = setup.ambient_mbar * MBAR / (R * (setup.temperature_c + ZERO_CELSIUS))
    return setup.volume_ml * ML / (suction_sl_min * SL_MIN / density) / MS


def equation_1(setup: Setup) -> float:
    """Evacuation time (ms) by the paper's equation (1): isothermal, falling suction volume flow."""
    begin, end = setup.ambient_mbar - END_MBAR, setup.target_mbar - END_MBAR
    return time_constant(setup) * math.log(begin / end)


def equation_2(setup: Setup) -> float:
    """Evacuation time (ms) by the paper's equation (2) with its safety factor."""
    return SAFETY * time_constant(setup) * math.log(setup.ambient_mbar / setup.target_mbar)


def isothermal(setup: Setup) -> float:
    """Evacuation time (ms) of the paper's model if the gas never cooled, in closed form."""
    return equation_1(setup) * (1.0 - END_MBAR / setup.ambient_mbar)


def data_set(setup: Setup, unit: Unit) -> DataSet:
    """The paper's model of a unit on a system as this twin's data set, with walls and bulge."""
    return DataSet(
        ambient=Ambient(pressure_mbar=setup.ambient_mbar, temperature_c=setup.temperature_c),
        ejector=Ejector(
            suction_capacity_sl_min=unit.suction_sl_min,
            end_pressure_mbar=END_MBAR,
            bulge=unit.bulge,
            port_volume_ml=PORT_ML,
            ramp_down_ms=0.5,
        ),
        system=System(
            parts=setup.parts,
            film_coefficient=unit.film,
            tube_film_coefficient=unit.film,
            leak_sl_min=0.0,
        ),
    )


def pressures(setup: Setup, unit: Unit, suction_ms: int, hold_ms: int = 0) -> Floats:
    """Pressure (Pa) at each ms from 0: the nozzle on from the beginning, later off.

    The jet has full strength from the start and the sensor has no lag, since the paper's model has
    no such effects.
    """
    theta = coefficients(data_set(setup, unit))
    theta[c.SENSOR_LAG] = AT_ONCE
    state = kernel.at_rest(theta)
    state[[kernel.NOZZLE, kernel.NOZZLE_COMMAND, kernel.DRIVE, kernel.JET]] = 1.0
    rows = suction_ms + hold_ms + 1
    dt, expected = np.full(rows, MS), np.empty(rows)
    dt[0] = 0.0
    phase = np.full(rows, Phase.SUCTION, np.uint8)
    phase[suction_ms + 1 :] = Phase.HOLD
    kernel.advance(state, theta, dt, phase, np.full(rows, np.nan), expected)
    return expected


def evacuation_ms(setup: Setup, unit: Unit) -> float:
    """Time (ms) in which the twin's kernel reaches the target."""
    pressures_mbar = pressures(setup, unit, math.ceil(setup.slowest_ms)) / MBAR
    after = int(np.argmax(pressures_mbar <= setup.target_mbar))
    assert after > 0, "the target is reached long before the end"
    before = after - 1
    return before + float(
        (pressures_mbar[before] - setup.target_mbar)
        / (pressures_mbar[before] - pressures_mbar[after])
    )
