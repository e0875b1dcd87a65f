"""The rig's constants, its state at rest, and the records of its readings, in SI units."""

import math

import numpy as np
import numpy.typing as npt

from drivers.plc.settings import PlcSettings
from twin.errors import ConfigError
from twin.signals import BAR, MBAR, ML, MS, SL_MIN

R_GAS = 287.05  # J/(kg·K)
CV = 717.6  # J/(kg·K)
VISCOSITY = 1.82e-5  # Pa·s

TRUTH = np.dtype(
    [
        ("port", "f8"),  # Pa, absolute
        ("vessel", "f8"),  # Pa, absolute
        ("temperature", "f8"),  # K, in the vessel
        ("mass", "f8"),  # kg, in all volumes
        ("energy", "f8"),  # J, in all volumes
        ("supply", "f8"),  # Pa, gauge, at the nozzle
        ("jet", "f8"),  # 0 to 1
        ("nozzle", "u1"),  # the suction valve is open
        ("part_present", "u1"),  # the compact ejector's own signal
        ("open", "u1"),  # the cup is open to ambient
    ]
)

READING = np.dtype(
    [
        ("pressure", "f8"),  # Pa, absolute
        ("supply", "f8"),  # Pa, gauge
        ("overflow", "u1"),
        ("reported", "u1"),  # 1 nozzle on, 2 air saving, 4 part present: as its control has them
        ("ambient", "f8"),  # Pa, absolute
        ("temperature", "f8"),  # K, of the surroundings
        ("vessel", "f8"),  # Pa, absolute
        ("flow", "f8"),  # kg/s, out of the line into the port
    ]
)

Record = npt.NDArray[np.void]  # one row of named numbers


def _record(values: dict[str, float]) -> Record:
    return np.array([tuple(values.values())], dtype=[(name, "f8") for name in values])


def plant(settings: PlcSettings) -> Record:
    """All constants of the rig in SI units, one row."""
    rig, ejector, valves = settings.rig, settings.ejector, settings.valves
    diameter = rig.line_diameter_mm * 1e-3
    half, bore = rig.line_length_m / 2, math.pi / 4 * diameter**2
    best = ejector.optimum_supply_bar * BAR + rig.ambient_mbar * MBAR
    return _record(
        {
            "ambient": rig.ambient_mbar * MBAR,
            "wall": rig.temperature_c + 273.15,
            "port_volume": rig.port_ml * ML,
            "line_volume": rig.line_ml * ML,
            "vessel_volume": rig.vessel_ml * ML,
            "port_heat": rig.tube_film * 4 * rig.port_ml * ML / diameter,  # a tube's wall area
            "line_heat": rig.tube_film * 4 * rig.line_ml * ML / diameter,
            "vessel_area": rig.vessel_area_m2,
            "sensor_in_line": float(rig.sensor == "line"),
            "inertance": half / bore,
            "laminar": 32 * VISCOSITY * half / (diameter**2 * bore),
            "turbulent": (0.03 * half / diameter + 0.75) / (2 * bore**2),
            "nominal_flow": ejector.suction_capacity_sl_min * SL_MIN,
            "nominal_density": rig.ambient_mbar * MBAR / (R_GAS * (rig.temperature_c + 273.15)),
            "seal_leak": rig.seal_leak_sl_min * SL_MIN,
            "opens": float(rig.opens),
            "opening": rig.opening_sl_min * SL_MIN,
            "release": rig.release_mbar * MBAR,
            "end_fraction": ejector.end_pressure_mbar / rig.ambient_mbar,
            "optimum": ejector.optimum_supply_bar * BAR,
            "bulge": ejector.bulge,
            "second_stage": ejector.second_stage,
            "second_stage_depth": ejector.second_stage_depth,
            "build_up": ejector.build_up_ms * MS / 2,  # each of two stages
            "collapse": ejector.collapse_ms * MS / 2,
            "supply": ejector.supply_bar * BAR,
            "droop": ejector.supply_droop_bar * BAR,
            "supply_lag": ejector.supply_lag_ms * MS,
            "blow_off": ejector.blow_off_sl_min * SL_MIN / best,
            "relief": ejector.blow_off_sl_min * SL_MIN / (ejector.relief_mbar * MBAR),
            "suction_on": valves.suction_on_ms * MS,
            "suction_off": valves.suction_off_ms * MS,
            "blow_off_on": valves.blow_off_on_ms * MS,
            "blow_off_off": valves.blow_off_off_ms * MS,
            "blow_off_opening": valves.blow_off_opening_ms * MS,
            "valve_scatter": settings.scatter.valve_ms * MS,
            "sensor_lag": settings.sensor.lag_ms * MS,
            "sensor_noise": settings.sensor.noise_mbar * MBAR,
            "sensor_step": settings.sensor.step_mbar,  # mbar: readings are exact in the field unit
            "full_scale": settings.sensor.full_scale_mbar * MBAR,
            "supply_noise": settings.sensor.supply_noise_mbar * MBAR,
            "air_saving": float(settings.control.air_saving),
            "h1": settings.control.h1_mbar * MBAR,
            "on_again": (settings.control.h1_mbar - settings.control.h1_hysteresis_mbar) * MBAR,
            "h2": settings.control.h2_mbar * MBAR,
            "h2_back": (settings.control.h2_mbar - settings.control.h2_hysteresis_mbar) * MBAR,
            "own_noise": settings.control.noise_mbar * MBAR,
        }
    )


def refuse_stiff(p: Record, step: float) -> None:
    """ConfigError if the rig is too fast for explicit steps of ``step`` seconds."""
    c2 = 1.4 * R_GAS * float(p["wall"][0])  # m²/s², speed of sound squared
    narrow = min(float(p["port_volume"][0]), float(p["line_volume"][0]))
    opening = float(p["opens"][0] * p["opening"][0] / p["ambient"][0]) * 46  # slope near ambient
    rates = {
        "port_ml": float(p["relief"][0] * c2 / p["port_volume"][0]),
        "line_length_m": math.sqrt(2 * c2 / float(p["inertance"][0]) / narrow),
        "opening_sl_min": opening * c2 / float(p["vessel_volume"][0]),
    }
    for key, rate in rates.items():
        if rate * step > 1.5:
            raise ConfigError(
                f"[plc.rig] {key}: this rig is too quick to be simulated",
                "larger volumes, a longer or narrower line, or smaller openings",
            )


def at_rest(p: Record, ambient: float) -> Record:
    """State of a rig in equilibrium with ``ambient`` (Pa), one row."""
    wall = float(p["wall"][0])
    state = {"scan": 0.0}
    for chamber in ("port", "line", "vessel"):
        volume = float(p[f"{chamber}_volume"][0])
        state[f"{chamber}_mass"] = ambient * volume / (R_GAS * wall)
        state[f"{chamber}_energy"] = ambient * volume * CV / R_GAS
        state[f"{chamber}_pressure"] = ambient
    state |= {"vessel_volume": float(p["vessel_volume"][0]), "added_volume": 0.0}
    state |= {"shrunk": 0.0, "crept": 0.0, "filled": 0.0, "moisture": 1.0}
    state |= {"near_flow": 0.0, "far_flow": 0.0}  # port to line, line to vessel
    state |= {"supply": float(p["supply"][0]), "jet": 0.0, "jet_drive": 0.0, "ice": 0.0}
    state |= {"suction_wanted": 0.0, "suction_due": 0.0, "suction_open": 0.0}
    state |= {"blow_off_wanted": 0.0, "blow_off_due": 0.0, "blow_off_open": 0.0, "blow_off": 0.0}
    state |= {"saving": 0.0, "part_present": 0.0, "own": ambient}
    state |= {"open_wanted": float(p["opens"][0]), "open": float(p["opens"][0]), "suctioned": 0.0}
    state |= dict.fromkeys(("sensor_first", "sensor_second", "sensor_lagged", "sensed"), ambient)
    return _record(state)
