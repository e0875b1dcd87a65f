"""The model stepped by hand: over phases, row by row, from states of one's own."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from twin.model import kernel
from twin.model import theta as c
from twin.model.air import R
from twin.model.dataset import DataSet, coefficients
from twin.model.theta import Theta
from twin.signals import MS, Phase

Rows = npt.NDArray[np.float64]
Phases = Sequence[tuple[Phase, int]]  # so many rows of each
TANK = (
    {"kind": "tube", "length_mm": 100.0, "diameter_mm": 6.0},
    {"kind": "vessel", "volume_ml": 750.0},
)
HOSE = (
    {"kind": "tube", "length_mm": 2000.0, "diameter_mm": 4.0},
    {"kind": "vessel", "volume_ml": 125.0},
)
PRESSURES = [kernel.PORT, kernel.LINE, kernel.VESSEL]
MASSES = [kernel.PORT_MASS, kernel.LINE_MASS, kernel.VESSEL_MASS]


def theta_of(**tables: object) -> Theta:
    return coefficients(DataSet.model_validate(tables))


def closed(parts: Sequence[object] = TANK, **system: object) -> Theta:
    """A tight system that takes up no heat, unless ``system`` says otherwise."""
    none = {"leak_sl_min": 0.0, "film_coefficient": 0.0, "tube_film_coefficient": 0.0}
    return theta_of(system={"parts": parts} | none | system)


def phase_rows(phases: Phases) -> npt.NDArray[np.uint8]:
    return np.concatenate([np.full(rows, value, "u1") for value, rows in phases])


def advance(
    theta: Theta,
    phases: Phases,
    state: kernel.State | None = None,
    levels: dict[int, float] | None = None,
    dt: Rows | None = None,
) -> Rows:
    """Expected pressure over phases of so many rows; from rest, or synchronised by ``levels``."""
    phase = phase_rows(phases)
    level = np.full(len(phase), np.nan)
    for row, value in (levels or {}).items():
        level[row] = value
    steps = np.full(len(phase), MS) if dt is None else dt
    expected = np.empty(len(phase))
    state = kernel.at_rest(theta) if state is None else state
    kernel.advance(state, theta, steps, phase, level, expected)
    return expected


def states(theta: Theta, phases: Phases, state: kernel.State | None = None, dt: float = MS) -> Rows:
    """State after every row, in rows."""
    state = kernel.at_rest(theta) if state is None else state
    rows, step = [], np.array([dt])
    for value in phase_rows(phases):
        advance(theta, [(Phase(value), 1)], state, dt=step)
        rows.append(state.copy())
    return np.array(rows)


def standing(theta: Theta, pressure: float, warmer: float = 0.0) -> kernel.State:
    """All gas at ``pressure``, ``warmer`` than the wall by so many K; nothing commanded."""
    state = kernel.at_rest(theta)
    state[MASSES] *= pressure / theta[c.AMBIENT]
    state[kernel.VESSEL_MASS] *= volume(theta, pressure) / theta[c.VOLUME]
    state[MASSES] *= theta[c.TEMPERATURE] / (theta[c.TEMPERATURE] + warmer)
    state[[*PRESSURES, kernel.SENSOR_STAGE, kernel.SENSED]] = pressure
    state[kernel.OPEN] = 0.0
    return state


def switched_on(state: kernel.State) -> kernel.State:
    """The same with the nozzle on and its jet at full strength."""
    state[[kernel.NOZZLE, kernel.NOZZLE_COMMAND, kernel.DRIVE, kernel.JET]] = 1.0
    state[kernel.PHASE] = Phase.SUCTION
    return state


def volume(theta: Theta, pressure: npt.ArrayLike) -> Rows:
    """Volume of the vessel (m³), less what cups shrink."""
    vacuum, stiff = 1.0 - np.asarray(pressure) / theta[c.AMBIENT], theta[c.STIFF_UNTIL]
    stiff /= theta[c.AMBIENT]
    pull = vacuum * np.abs(vacuum) * (1.0 + stiff) / np.maximum(np.abs(vacuum) + stiff, 1e-12)
    shape = (1.0 + theta[c.SOFTNESS]) * pull / (1.0 + theta[c.SOFTNESS] * np.abs(pull))
    return np.asarray(theta[c.VOLUME] - theta[c.COMPLIANCE] * shape)


def temperature(theta: Theta, rows: Rows) -> Rows:
    """Gas temperature in the vessel (K)."""
    vessel = rows[..., kernel.VESSEL]
    return vessel * volume(theta, vessel) / (R * rows[..., kernel.VESSEL_MASS])


def mass(rows: Rows) -> Rows:
    """Mass of all gas (kg)."""
    return rows[..., MASSES].sum(axis=-1)


def energy(theta: Theta, rows: Rows) -> Rows:
    """Internal energy of all gas (J), volumes being rigid."""
    volumes = theta[[c.PORT_VOLUME, c.LINE_VOLUME, c.VOLUME]]
    return rows[..., PRESSURES] @ volumes / 0.4
