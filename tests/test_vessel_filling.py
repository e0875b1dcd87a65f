"""A measured vessel that fills from ambient air through an orifice: pressure and gas temperature.

16.18 l, evacuated to 37 mbar, behind an orifice of 2.71 mm with a discharge coefficient of 0.84
(tests/data/README.md). One number is chosen, the film coefficient, to fit the temperatures;
the orifice's flow is that of an isentropic nozzle, and below sonic ISO 6358's ellipse.
"""

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar
from stepping import standing, states, temperature, theta_of

from twin.model import kernel
from twin.model.air import GAMMA, R
from twin.model.theta import Theta
from twin.signals import MBAR, SL_MIN, Phase

Floats = npt.NDArray[np.float64]
DATA = Path(__file__).parent / "data" / "vessel_filling"
KELVIN, AMBIENT = 295.0, 1000.0  # mbar
DIAMETER, LENGTH = 0.20, 0.515  # m, of the vessel
ROW = 0.02  # s


def sonic_flow(diameter: float, discharge: float) -> float:
    """Flow (kg/s) of an isentropic nozzle from ambient."""
    choked = (2.0 / (GAMMA + 1.0)) ** ((GAMMA + 1.0) / (2.0 * (GAMMA - 1.0)))
    bore = math.pi / 4.0 * diameter**2
    return discharge * bore * AMBIENT * MBAR * math.sqrt(GAMMA / (R * KELVIN)) * choked


def measured(name: str) -> Floats:
    return np.loadtxt(DATA / name, delimiter=",", skiprows=1).T


def filling(film_coefficient: float) -> tuple[Theta, Floats, Floats]:
    """Coefficients, time (s) and states while the vessel fills."""
    wall = math.pi * DIAMETER * (LENGTH + DIAMETER / 2.0)  # m²
    theta = theta_of(
        ambient={"pressure_mbar": AMBIENT, "temperature_c": KELVIN - 273.15},
        system={
            "parts": [
                {"kind": "tube", "length_mm": 20.0, "diameter_mm": 6.0},
                {"kind": "vessel", "volume_ml": 16180.0, "wall_area_cm2": wall * 1e4},
            ],
            "film_coefficient": film_coefficient,
            "leak_sl_min": sonic_flow(2.71e-3, 0.84) / SL_MIN,
        },
    )
    rows = states(theta, [(Phase.IDLE, 4000)], standing(theta, 37.0 * MBAR), dt=ROW)
    return theta, np.arange(1, 4001) * ROW, rows


def gas(film_coefficient: float, times: Floats) -> Floats:
    theta, t, rows = filling(film_coefficient)
    return np.interp(times, t, temperature(theta, rows))


def test_a_filled_vessel_is_predicted_with_one_film_coefficient() -> None:
    when, kelvin = measured("gas_temperature.csv")

    def off(film: float) -> float:
        return float(((gas(film, when) - kelvin) ** 2).mean())

    film = minimize_scalar(off, bounds=(2.0, 40.0), method="bounded", options={"xatol": 0.2}).x
    theta, t, rows = filling(film)
    at, bar = measured("pressure.csv")
    deviation = np.interp(at, t, rows[:, kernel.VESSEL]) / MBAR - bar * 1e3
    warmest = temperature(theta, rows).max()
    assert 4.0 < film < 25.0  # W/(m² K), as free convection has it
    assert np.sqrt((deviation**2).mean()) < 20.0  # mbar
    assert abs(warmest - kelvin.max()) < 4.0
