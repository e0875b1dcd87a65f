"""A rig: everything that belongs to one machine, in SI units. Nothing here changes with time."""

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class Surroundings:
    """Air around the rig."""

    ambient_pressure: float  # Pa
    ambient_temperature: float  # K
    weather: float  # Pa, how far the air pressure wanders (standard deviation)


@dataclass(frozen=True)
class Supply:
    """Compressed air: regulator, hose, and the valve with what lies between it and the nozzle."""

    supply_gauge: float  # Pa above ambient at the regulator, without flow
    supply_noise: float  # Pa, standard deviation of its wandering
    supply_scatter: float  # Pa, standard deviation from cycle to cycle
    supply_volume: float  # m³ of hose
    supply_droop: float  # Pa·s/kg, the regulator's sagging with flow
    supply_resistance: float  # Pa·s²/kg², the hose
    feed_volume: float  # m³ between valve and nozzle
    valve_conductance: float  # kg/(s·Pa)
    open_dead_time: float  # s
    close_dead_time: float  # s
    dead_time_jitter: float  # s, standard deviation per stroke
    opening_time: float  # s
    closing_time: float  # s


@dataclass(frozen=True)
class Ejector:
    """Nozzle, one or two mixing tubes, flap, non-return valve, silencer."""

    stages: int
    nozzle_area: float  # m², effective
    velocity_coefficient: float
    first_area: float  # m², mixing tube
    first_losses: float
    second_area: float  # m²
    second_losses: float
    momentum_kept: float  # share of the first stage's momentum that reaches the second
    flap_conductance: float  # kg/(s·Pa)
    flap_opening: float  # Pa
    has_check_valve: int
    check_conductance: float  # kg/(s·Pa)
    check_opening: float  # Pa
    flap_time: float  # s, inertia of flap and check valve
    silencer: float  # Pa·s²/kg², back pressure per flow squared
    silencer_time: float  # s
    second_chamber: float  # m³
    first_chamber: float  # m³
    head_volume: float  # m³ behind the check valve


@dataclass(frozen=True)
class Line:
    """Hose between ejector and vessel."""

    line_length: float  # m
    line_diameter: float  # m
    line_roughness: float  # m
    line_fittings: float  # loss coefficient of elbows and couplings
    line_cells: int
    line_wall_heat: float  # J/K
    line_wall_loss: float  # W/K to ambient


@dataclass(frozen=True)
class Vessel:
    """Tank, or cups on a part."""

    rigid_volume: float  # m³
    vessel_length: float  # m, characteristic
    vessel_surface: float  # m²
    vessel_wall_heat: float  # J/K
    vessel_wall_loss: float  # W/K
    cup_volume: float  # m³ that the cups give up when pressed flat
    cup_softness: float  # Pa at which half of it is gone
    cup_play: float  # Pa, half the width of the hysteresis
    cup_time: float  # s, viscoelastic
    released: int  # the part is let go after blow-off
    lift_pressure: float  # Pa above ambient that lifts the seal
    open_conductance: float  # kg/(s·Pa) of the free cups
    contact_delay: float  # s, suction on until the cups touch
    contact_jitter: float  # s
    leak: float  # kg/s at sonic flow from 100 kPa
    leak_critical: float  # critical pressure ratio of leaks
    leak_at_vessel: int  # else at the middle of the line
    leak_scatter: float  # relative, from cycle to cycle
    porous: float  # kg/s at 600 mbar vacuum, Darcy's law for a gas
    relief_pressure: float  # Pa above ambient


@dataclass(frozen=True)
class BlowOff:
    """Valve that lets compressed air into the head."""

    from_reservoir: int
    reservoir_volume: float  # m³
    refill_conductance: float  # kg/(s·Pa)
    blow_conductance: float  # kg/(s·Pa)
    blow_dead_time: float  # s
    blow_close_dead_time: float  # s
    blow_jitter: float  # s
    blow_opening_time: float  # s
    blow_closing_time: float  # s


@dataclass(frozen=True)
class AirSaving:
    """Two-point control in the ejector, with its own sensor."""

    air_saving: int
    h1: float  # Pa below ambient
    hysteresis: float  # Pa
    own_lag: float  # s
    own_period_ms: int
    own_noise: float  # Pa
    own_offset: float  # Pa
    own_gauge: int
    min_pause: float  # s, nozzle off at least


@dataclass(frozen=True)
class Sensor:
    """What the PLC reads."""

    place: str  # "ejector", "line" or "vessel"
    sensor_lag: float  # s
    second_lag: float  # s, 0 for a sensor of first order
    gain_error: float  # relative
    offset: float  # Pa
    gauge: bool
    full_scale: float  # Pa
    step: float  # Pa, 0 for none
    noise: float  # Pa
    hum: float  # Pa, amplitude at 50 Hz
    update_ms: int
    cadence_ms: int
    stamp_jitter: float  # s
    missing: float  # share of rows


@dataclass(frozen=True)
class Program:
    """What the PLC does, again and again."""

    suction_s: float
    pause_s: float  # between suction off and blow-off on
    blow_off_s: float
    idle_s: float
    variation: float  # relative, from cycle to cycle
    lead_s: float  # before the first cycle
    varied: bool  # every third cycle is half as long or half as long again


@dataclass(frozen=True)
class Rig:
    """One machine."""

    kind: str
    seed: int
    surroundings: Surroundings
    supply: Supply
    ejector: Ejector
    line: Line
    vessel: Vessel
    blow_off: BlowOff
    air_saving: AirSaving
    sensor: Sensor
    program: Program
    nominal_flow: float  # kg/s sucked at ambient pressure
    end_vacuum: float  # Pa below ambient
    evacuation_s: float  # estimate to nine tenths of the end vacuum, or to H1
    steps_per_ms: int


_PARTS = (Surroundings, Supply, Ejector, Line, Vessel, BlowOff, AirSaving)
PLANT = np.dtype([(field.name, "f8") for part in _PARTS for field in fields(part)])


def plant_record(rig: Rig) -> np.void:
    """All numbers of the plant as one record for compiled code."""
    record = np.zeros(1, PLANT)
    for part in (
        rig.surroundings,
        rig.supply,
        rig.ejector,
        rig.line,
        rig.vessel,
        rig.blow_off,
        rig.air_saving,
    ):
        for field in fields(part):
            record[field.name] = getattr(part, field.name)
    return record[0]
