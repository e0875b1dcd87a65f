"""The data set of an ejector and what hangs on it, in the field's units, and its SI form.

An object-specific data set describes a type, an instance-specific one a single unit; both have this
shape. ``coefficients`` turns it into the vector the compiled kernel works on: the one place where
the model's units are converted.
"""

import hashlib
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from twin.settings import Settings
from twin.signals import BAR, MBAR, ML, MS, SL_MIN

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]

# The coefficients by name; the kernel and the effects index the vector with these numbers.
COEFFICIENTS = (
    "AMBIENT",  # Pa
    "AMBIENT_NOMINAL",  # Pa, at which suction capacity was measured
    "TEMPERATURE",  # K, of ambient, wall and supply air
    "SUPPLY",  # Pa gauge at the nozzle
    "SUPPLY_NOMINAL",  # Pa gauge, at which suction capacity and end pressure hold
    "SUPPLY_OPTIMUM",  # Pa gauge, where suction capacity peaks
    "SUPPLY_CURVATURE",  # -, how sharply it peaks
    "END_SLOPE",  # 1/Pa, relative rise of end pressure per drop of supply
    "SUCTION",  # kg/s at ambient pressure in the port
    "END_RATIO",  # -, end pressure over ambient
    "BULGE",  # -, how far the characteristic bulges above a straight line
    "SKEW",  # -, and towards which end
    "RESPONSE",  # s, from the command to the valve's action
    "RAMP_UP",  # s, time constant of the jet
    "RAMP_DOWN",  # s, of its collapse
    "RESISTANCE",  # Pa²/(kg/s)², between port with sensor and vessel
    "BLOW_OFF",  # kg/s at nominal supply
    "BLOW_OFF_RESPONSE",  # s
    "BLOW_OFF_RAMP",  # s, time constant of the blow-off valve
    "RELIEF",  # kg/(s Pa), out through the exhaust while the port is above ambient
    "VOLUME",  # m³
    "COMPLIANCE",  # m³ less at full vacuum
    "FILM",  # W/(m² K)
    "AREA",  # m²
    "LEAK",  # kg/s sonic, opening to ambient
    "LAMINAR_LEAK",  # kg/(s Pa)
    "BACK_FLOW",  # kg/s sonic, through the ejector while its nozzle is off
    "SENSOR_LAG",  # s
    "SENSOR_OFFSET",  # Pa added to the absolute reading
    "SENSOR_GAIN",  # -, reads this many times the vacuum
    "H1",  # Pa below ambient, nozzle off
    "H1_LOW",  # Pa below ambient, nozzle on again
    "RELEASE",  # Pa below ambient, where blow-off lets the part go and the cup stands open; or NaN
)
(
    AMBIENT,
    AMBIENT_NOMINAL,
    TEMPERATURE,
    SUPPLY,
    SUPPLY_NOMINAL,
    SUPPLY_OPTIMUM,
    SUPPLY_CURVATURE,
    END_SLOPE,
    SUCTION,
    END_RATIO,
    BULGE,
    SKEW,
    RESPONSE,
    RAMP_UP,
    RAMP_DOWN,
    RESISTANCE,
    BLOW_OFF,
    BLOW_OFF_RESPONSE,
    BLOW_OFF_RAMP,
    RELIEF,
    VOLUME,
    COMPLIANCE,
    FILM,
    AREA,
    LEAK,
    LAMINAR_LEAK,
    BACK_FLOW,
    SENSOR_LAG,
    SENSOR_OFFSET,
    SENSOR_GAIN,
    H1,
    H1_LOW,
    RELEASE,
) = range(len(COEFFICIENTS))

Theta = npt.NDArray[np.float64]  # one value per coefficient


class Ambient(Settings):
    """The air around."""

    pressure_mbar: float = Field(1013.0, ge=500.0, le=1100.0)
    temperature_c: float = Field(20.0, ge=-20.0, le=60.0)


class Supply(Settings):
    """Operating pressure, and how suction and end pressure follow it."""

    pressure_bar: float = Field(4.5, gt=0.0, le=10.0)
    optimum_bar: float = Field(4.5, gt=0.0, le=10.0)
    curvature: NotNegative = 1.0
    end_pressure_slope: NotNegative = 0.2  # relative rise of end pressure per bar missing


class Ejector(Settings):
    """Characteristic, timing and blow-off of the ejector."""

    suction_capacity_sl_min: Positive = 35.0
    end_pressure_mbar: Positive = 150.0
    bulge: float = Field(0.0, ge=-0.5, le=2.0)
    skew: float = Field(0.0, ge=-2.0, le=2.0)
    response_ms: float = Field(15.0, ge=0.0, le=500.0)
    ramp_up_ms: float = Field(8.0, ge=1.0, le=500.0)
    ramp_down_ms: float = Field(4.0, ge=1.0, le=500.0)
    blow_off_sl_min: NotNegative = 100.0
    blow_off_response_ms: float = Field(15.0, ge=0.0, le=500.0)
    blow_off_ramp_ms: float = Field(5.0, ge=1.0, le=500.0)
    relief_sl_min: NotNegative = 200.0  # out through the exhaust at 100 mbar above ambient
    h1_mbar: float = Field(750.0, gt=0.0, le=998.0)
    h1_hysteresis_mbar: float = Field(150.0, gt=0.0)

    @model_validator(mode="after")
    def _hysteresis_fits(self) -> "Ejector":
        if self.h1_hysteresis_mbar >= self.h1_mbar:
            raise ValueError("h1_hysteresis_mbar must be less than h1_mbar")
        return self


class Vessel(Settings):
    """Where the vacuum is stored, with the line to it."""

    volume_ml: Positive = 755.0
    wall_area_cm2: NotNegative = 500.0
    film_coefficient: NotNegative = 10.0  # W/(m² K)
    line_drop_mbar: NotNegative = 5.0  # at nominal suction
    leak_sl_min: NotNegative = 0.3
    release_mbar: float | None = None  # vacuum at which blow-off lets the part go; a tank has none


class Sensor(Settings):
    """The pressure sensor the PLC reads."""

    lag_ms: float = Field(3.0, ge=1.0, le=500.0)
    noise_mbar: float = Field(0.4, gt=0.0, le=50.0)  # one standard deviation, steps included


class DataSet(Settings):
    """Everything the model knows of one type or one unit."""

    ambient: Ambient = Ambient()
    supply: Supply = Supply()
    ejector: Ejector = Ejector()
    vessel: Vessel = Vessel()
    sensor: Sensor = Sensor()

    @model_validator(mode="after")
    def _end_pressure_below_ambient(self) -> "DataSet":
        if self.ejector.end_pressure_mbar >= self.ambient.pressure_mbar:
            raise ValueError("ejector.end_pressure_mbar must be below ambient.pressure_mbar")
        return self

    @property
    def hash(self) -> str:
        """Content hash: two data sets with the same hash expect the same pressures."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]


def resistance(theta: Theta, drop: float) -> float:
    """Resistance that takes ``drop`` Pa at nominal suction from ambient (isothermal pipe flow)."""
    ambient = theta[AMBIENT_NOMINAL]
    return float((ambient**2 - (ambient - drop) ** 2) / theta[SUCTION] ** 2)


def coefficients(data: DataSet) -> Theta:
    """Turn a data set into the kernel's vector, in SI units."""
    ambient, supply, ejector, vessel = data.ambient, data.supply, data.ejector, data.vessel
    theta = np.zeros(len(COEFFICIENTS))
    theta[AMBIENT] = theta[AMBIENT_NOMINAL] = ambient.pressure_mbar * MBAR
    theta[TEMPERATURE] = ambient.temperature_c + 273.15
    theta[SUPPLY] = theta[SUPPLY_NOMINAL] = supply.pressure_bar * BAR
    theta[SUPPLY_OPTIMUM] = supply.optimum_bar * BAR
    theta[SUPPLY_CURVATURE] = supply.curvature
    theta[END_SLOPE] = supply.end_pressure_slope / BAR
    theta[SUCTION] = ejector.suction_capacity_sl_min * SL_MIN
    theta[END_RATIO] = ejector.end_pressure_mbar / ambient.pressure_mbar
    theta[BULGE] = ejector.bulge
    theta[SKEW] = ejector.skew
    theta[RESPONSE] = ejector.response_ms * MS
    theta[RAMP_UP] = ejector.ramp_up_ms * MS
    theta[RAMP_DOWN] = ejector.ramp_down_ms * MS
    theta[BLOW_OFF] = ejector.blow_off_sl_min * SL_MIN
    theta[BLOW_OFF_RESPONSE] = ejector.blow_off_response_ms * MS
    theta[BLOW_OFF_RAMP] = ejector.blow_off_ramp_ms * MS
    theta[RELIEF] = ejector.relief_sl_min * SL_MIN / (100.0 * MBAR)
    theta[H1] = ejector.h1_mbar * MBAR
    theta[H1_LOW] = (ejector.h1_mbar - ejector.h1_hysteresis_mbar) * MBAR
    theta[VOLUME] = vessel.volume_ml * ML
    theta[FILM] = vessel.film_coefficient
    theta[AREA] = vessel.wall_area_cm2 * 1e-4
    theta[LEAK] = vessel.leak_sl_min * SL_MIN
    theta[SENSOR_LAG] = data.sensor.lag_ms * MS
    theta[SENSOR_GAIN] = 1.0
    theta[RELEASE] = np.nan if vessel.release_mbar is None else vessel.release_mbar * MBAR
    theta[RESISTANCE] = resistance(theta, vessel.line_drop_mbar * MBAR)
    return theta
