"""Rigs drawn by seed, over what the market has. Only combinations that make sense are drawn.

An ejector is drawn by what its data sheet would say (capacity, end vacuum, where the second stage
closes); `size_ejector` finds the areas and losses that its momentum balance needs for that.
"""

import math
from dataclasses import replace

import numpy as np

from second_world import rig as parts
from second_world.constants import (
    BAR,
    MBAR,
    ML,
    MS,
    R_AIR,
    SL_PER_MIN,
    ZERO_CELSIUS,
)
from second_world.ejector import jet, stage
from second_world.faults import sucked_at
from second_world.gas import nozzle_flow
from second_world.rig import Rig

KINDS = (
    "closed_tank",
    "gripper",  # hard cups, released
    "soft_cups",  # released, with hysteresis
    "held_part",  # cups on a part that stays, nothing opens
    "porous_part",
    "two_stage",
    "no_air_saving",
    "micro",  # a few ml
    "big_tank",
    "long_hose",
)
RELEASED = ("gripper", "soft_cups", "porous_part", "two_stage", "no_air_saving", "micro")
DIAMETERS = np.array([2.0, 2.5, 4.0, 5.5, 6.0, 7.5, 9.0, 12.0]) * 1e-3  # m, bores on the market
_FULL = 1.0e5  # Pa, sonic conductances are per upstream pressure
_CELL = 0.08  # m of hose in a cell, roughly


def _log(rng, low, high):
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def draw_rig(seed: int, kind: str | None = None) -> Rig:
    """Draw a rig; `kind` is one of KINDS, or drawn too."""
    if kind is not None and kind not in KINDS:
        raise ValueError(f"no kind is called {kind!r}: take one of {KINDS}")
    rng = np.random.default_rng([seed, 2])
    kind = str(rng.choice(KINDS)) if kind is None else kind
    for _ in range(2000):
        if (drawn := _attempt(rng, seed, kind)) is not None:
            return drawn
    raise RuntimeError(f"seed {seed}, {kind}: no sensible rig in 2000 attempts")


def _attempt(rng, seed, kind):
    """Draw everything once; None if it makes no sense together."""
    here = parts.Surroundings(
        ambient_pressure=float(rng.uniform(870.0, 1040.0)) * MBAR,
        ambient_temperature=ZERO_CELSIUS + float(rng.uniform(5.0, 40.0)),
        weather=float(rng.uniform(0.0, 0.4)) * MBAR,
    )
    gauge = float(rng.uniform(3.5, 7.0)) * BAR
    flow, volume = _duty(rng, kind)
    hose = _hose(rng, kind, flow, volume, here)
    if hose is None:
        return None
    two = kind == "two_stage" or (kind not in ("micro",) and rng.random() < 0.2)
    unit = size_ejector(rng, here, gauge, flow * SL_PER_MIN, 2 if two else 1)
    if unit is None:
        return None
    ejector, end = unit
    saving = _air_saving(rng, kind, end)
    depth = saving.h1 if saving.air_saving else 0.9 * end
    ambient = here.ambient_pressure
    volume_all = volume + math.pi / 4.0 * hose.line_diameter**2 * hose.line_length
    trial = _Sizing(here, ejector, _stiff_supply(gauge))
    evacuation = evacuation_time(trial, volume_all, min(depth, 0.9 * end))
    if not 0.02 <= evacuation <= 30.0:
        return None
    vessel = _vessel(rng, kind, volume, flow, here)
    fill = depth * volume_all / (R_AIR * here.ambient_temperature)
    blow_flow = fill / min(max(0.5 * evacuation, 0.03), 4.0) * float(rng.uniform(0.8, 1.6))
    supply = _supply(rng, ejector, gauge, blow_flow, here)
    head_volume = max(1.0, flow * 0.06) * ML * float(rng.uniform(0.7, 1.5))
    check = int(saving.air_saving or rng.random() < 0.6)  # no air is saved without the valve
    ejector = replace(ejector, head_volume=head_volume, has_check_valve=check)
    blow_off = _blow_off(rng, blow_flow, fill, ambient + gauge, vessel.released)
    sensor = _sensor(rng, kind, evacuation)
    program = _program(rng, kind, evacuation, fill / blow_flow, vessel)
    slow = evacuation > 3.0
    steps = 8 if slow else 10 if evacuation > 0.5 else 20
    drawn = Rig(
        kind,
        seed,
        here,
        supply,
        ejector,
        hose,
        vessel,
        blow_off,
        saving,
        sensor,
        program,
        flow * SL_PER_MIN,
        end,
        evacuation,
        steps,
    )
    return drawn if _holds(drawn, depth) else None


def _duty(rng, kind):
    """Suction capacity in sl/min and volume in m³ that belong together."""
    flow = _log(rng, 5.0, 500.0)
    if kind == "micro":
        return _log(rng, 5.0, 20.0), _log(rng, 1.0, 10.0) * ML
    if kind == "big_tank":
        return _log(rng, 60.0, 500.0), _log(rng, 5.0, 50.0) * 1e-3
    low, high = (0.25, 8.0) if kind == "closed_tank" else (0.04, 1.5)
    seconds = _log(rng, low, high)
    volume = flow / 60.0 * 1e-3 * seconds
    return flow, min(max(volume, 1.0 * ML), 50.0e-3)


def _hose(rng, kind, flow, volume, here):
    """A hose that is neither much too narrow nor much of the volume."""
    diameter = float(rng.choice(DIAMETERS))
    length = _log(rng, 2.0, 5.0) if kind == "long_hose" else _log(rng, 0.1, 3.0)
    area = math.pi / 4.0 * diameter**2
    density = here.ambient_pressure / (R_AIR * here.ambient_temperature)
    speed = flow * SL_PER_MIN / (density * area)
    drop = (0.03 * length / diameter + 3.0) * 0.5 * density * speed * speed
    small = 2.0 if kind in ("long_hose", "micro") else 0.8
    if drop > 60.0 * MBAR or speed > 80.0 or area * length > small * volume:
        return None
    if diameter > 0.003 and drop < 0.5 * MBAR and kind != "long_hose":
        return None
    wall = math.pi * diameter * length * 0.0015  # m³ of plastic, 1.5 mm thick
    return parts.Line(
        line_length=length,
        line_diameter=diameter,
        line_roughness=1.5e-6,
        line_fittings=float(rng.uniform(0.5, 3.0)),
        line_cells=int(min(max(math.ceil(length / _CELL), 4), 16)),
        line_wall_heat=wall * 1.2e6 * 1.6,  # density times heat capacity of polyurethane
        line_wall_loss=8.0 * math.pi * (diameter + 0.003) * length,
    )


def size_ejector(rng, here, gauge, flow, stages):
    """An ejector that sucks `flow` (kg/s) at ambient, and its end vacuum (Pa); or None."""
    end = float(rng.uniform(0.72, 0.90)) * here.ambient_pressure
    base = {
        "stages": stages,
        "velocity_coefficient": float(rng.uniform(0.92, 0.97)),
        "momentum_kept": float(rng.uniform(0.85, 0.95)),
        "first_area": float(rng.uniform(5.0, 9.0) if stages == 2 else rng.uniform(4.5, 9.0)),
        "second_area": 0.0,
    }
    if stages == 2:
        base["second_area"] = base["first_area"] * float(rng.uniform(2.2, 3.5))
    closes = float(rng.uniform(0.3, 0.6)) * end
    losses = _losses(base, here, gauge, end, closes)
    if losses is None:
        return None
    total = _free_flow(base, losses, here, gauge)
    nozzle = flow / total
    area = 1.0 if stages == 1 else base["second_area"] / base["first_area"]
    open_flow = flow / _FULL
    ejector = parts.Ejector(
        stages=stages,
        nozzle_area=nozzle,
        velocity_coefficient=base["velocity_coefficient"],
        first_area=base["first_area"] * nozzle,
        first_losses=losses[0],
        second_area=max(base["second_area"], area) * nozzle,
        second_losses=losses[1],
        momentum_kept=base["momentum_kept"],
        flap_conductance=open_flow * float(rng.uniform(3.0, 6.0)),
        flap_opening=float(rng.uniform(1.0, 4.0)) * MBAR,
        has_check_valve=1,
        check_conductance=open_flow * float(rng.uniform(4.0, 8.0)),
        check_opening=float(rng.uniform(3.0, 12.0)) * MBAR,
        flap_time=float(rng.uniform(0.5, 2.0)) * MS,
        silencer=float(rng.uniform(2.0, 15.0)) * MBAR / (2.5 * flow) ** 2,
        silencer_time=float(rng.uniform(3.0, 15.0)) * MS,
        second_chamber=max(0.5, flow / SL_PER_MIN * 0.03) * ML,
        first_chamber=max(0.5, flow / SL_PER_MIN * 0.03) * ML,
        head_volume=1.0 * ML,
    )
    trial = _Sizing(here, ejector, _stiff_supply(gauge))
    low, high = 0.3 * end, 0.999 * here.ambient_pressure
    for _ in range(40):  # the vacuum that it really reaches, back pressure included
        middle = 0.5 * (low + high)
        if sucked_at(trial, here.ambient_pressure - middle, 0.0) > 0.0:
            low = middle
        else:
            high = middle
    reached = low - ejector.check_opening
    if not 0.6 < reached / here.ambient_pressure < 0.92:
        return None
    return (ejector, reached) if _suits_supply(here, ejector, gauge, reached) else None


def _suits_supply(here, ejector, gauge, end):
    """Whether the nozzle is made for this supply, as data sheets advise.

    A tenth more or less supply changes the time to 60 % of the end vacuum by a third at most, and
    with a tenth more the ejector still comes to 90 % of it. Others choke themselves or stall.
    """

    def seconds(share, depth):
        trial = _Sizing(here, ejector, _stiff_supply(share * gauge))
        return evacuation_time(trial, 1.0e-3, depth * end)

    usual = seconds(1.0, 0.6)
    if not all(0.75 < seconds(share, 0.6) / usual < 1.33 for share in (0.9, 1.1)):
        return False
    return seconds(1.1, 0.9) < 1.33 * seconds(1.0, 0.9)


def evacuation_time(trial, volume, depth):
    """Time in s to a vacuum of `depth` (Pa), isothermal, without leaks."""
    here = trial.surroundings
    slices = 16
    seconds = 0.0
    for k in range(slices):
        pressure = here.ambient_pressure - (k + 0.5) / slices * depth
        flow = sucked_at(trial, pressure, 0.0)
        if flow <= 0.0:
            return math.inf
        seconds += volume * depth / slices / (R_AIR * here.ambient_temperature * flow)
    return seconds


class _Sizing:
    """What `sucked_at` needs of a rig."""

    def __init__(self, surroundings, ejector, supply):
        self.surroundings, self.ejector, self.supply = surroundings, ejector, supply


def _stiff_supply(gauge):
    """A stiff supply of this gauge pressure (Pa)."""
    return parts.Supply(gauge, *[0.0] * 12)


def _primary(base, here, gauge, p_chamber):
    pressure, t = here.ambient_pressure + gauge, here.ambient_temperature
    flow = nozzle_flow.py_func(1.0, pressure, p_chamber, t)
    return flow, *jet.py_func(pressure, p_chamber, t, flow, base["velocity_coefficient"])


def _losses(base, here, gauge, end, closes):
    """Losses of both stages, per area of nozzle, that give these vacuums; None if none would."""
    ambient, t = here.ambient_pressure, here.ambient_temperature
    p_end, p_close = ambient - end, ambient - closes

    def balance(area, drive, behind, flow):
        return drive * behind / (R_AIR * t) * (area / flow) ** 2 if drive > 0.0 else 0.0

    flow, push, ring = _primary(base, here, gauge, p_end)
    area = base["first_area"]
    if ring > 0.9 * area:
        return None
    if base["stages"] == 1:
        first = balance(area, p_end - ambient + push / area, ambient, flow)
        return (first, 1.0) if 0.5 < first < 3.0 else None
    first, second, wide = 1.0, 1.0, base["second_area"]
    for _ in range(30):
        flow, push, ring = _primary(base, here, gauge, p_close)
        more, _ = stage.py_func(p_close, t, p_close, t, push, flow, ring, area, first)
        kept = base["momentum_kept"] * push
        second = balance(wide, p_close - ambient + kept / wide, ambient, flow + max(more, 0.0))
        if second <= 0.0:
            return None
        flow, push, ring = _primary(base, here, gauge, p_end)
        idle = _idle_pressure(base, ambient, t, second, flow, push, p_end)
        fresh = balance(area, p_end - idle + push / area, idle, flow)
        first = min(max(0.5 * (first + fresh), 0.3), 5.0)
    good = 0.4 < first < 4.0 and 0.4 < second < 4.0 and abs(fresh - first) < 0.01 * first
    return (first, second) if good else None


def _idle_pressure(base, ambient, t, losses, flow, push, p_end):
    """Pressure at which the second stage sucks nothing while the first is at its end."""
    area, wide = base["first_area"], base["second_area"]
    low, high = p_end, ambient
    for _ in range(40):
        middle = 0.5 * (low + high)
        kept = base["momentum_kept"] * max(push + (p_end - middle) * area, 0.0)
        more, _ = stage.py_func(middle, t, ambient, t, kept, flow, area, wide, losses)
        if more > 0.0:
            high = middle
        else:
            low = middle
    return low


def _free_flow(base, losses, here, gauge):
    """Flow in kg/s sucked at ambient pressure, per m² of nozzle."""
    ambient, t = here.ambient_pressure, here.ambient_temperature
    flow, push, ring = _primary(base, here, gauge, ambient)
    area, wide = base["first_area"], base["second_area"]
    sucked, _ = stage.py_func(ambient, t, ambient, t, push, flow, ring, area, losses[0])
    if base["stages"] == 2:
        kept = base["momentum_kept"] * push
        more, _ = stage.py_func(ambient, t, ambient, t, kept, flow + sucked, area, wide, losses[1])
        sucked += more
    return max(sucked, 1e-9)


def _air_saving(rng, kind, end):
    saves = kind not in ("no_air_saving", "porous_part") and rng.random() < 0.8
    h1 = min(float(rng.uniform(0.72, 0.9)) * end, 800.0 * MBAR)
    return parts.AirSaving(
        air_saving=int(saves),
        h1=h1,
        hysteresis=float(rng.uniform(0.08, 0.25)) * h1,
        own_lag=float(rng.uniform(0.5, 4.0)) * MS,
        own_period_ms=int(rng.integers(1, 5)),
        own_noise=float(rng.uniform(0.1, 0.8)) * MBAR,
        own_offset=float(rng.normal(0.0, 3.0)) * MBAR,
        own_gauge=int(rng.random() < 0.5),
        min_pause=float(rng.choice([0.0, 0.0, 0.02, 0.1])),
    )


def _vessel(rng, kind, volume, flow, here):
    soft = kind == "soft_cups" or (kind in ("gripper", "held_part") and rng.random() < 0.3)
    cup = volume * float(rng.uniform(0.1, 0.45)) if soft else 0.0
    length = volume ** (1.0 / 3.0)
    surface = 6.0 * length**2
    released = kind in RELEASED
    leak = _log(rng, 0.0005, 0.012) * (1.0 if released else 0.4)
    porous = float(rng.uniform(0.03, 0.12)) if kind == "porous_part" else 0.0
    return parts.Vessel(
        rigid_volume=volume - cup,
        vessel_length=length,
        vessel_surface=surface * float(rng.uniform(1.0, 1.6)),
        vessel_wall_heat=surface * float(rng.uniform(0.001, 0.003)) * 3.0e6,
        vessel_wall_loss=8.0 * surface,
        cup_volume=cup,
        cup_softness=float(rng.uniform(60.0, 300.0)) * MBAR,
        cup_play=float(rng.uniform(5.0, 60.0)) * MBAR if soft else 0.0,
        cup_time=float(rng.uniform(5.0, 80.0)) * MS,
        released=int(released),
        lift_pressure=float(rng.uniform(1.0, 15.0)) * MBAR,
        open_conductance=float(rng.uniform(4.0, 12.0)) * flow * SL_PER_MIN / _FULL,
        contact_delay=_contact(rng),
        contact_jitter=float(rng.uniform(0.0, 3.0)) * MS,
        leak=leak * flow * SL_PER_MIN,
        leak_critical=float(rng.uniform(0.2, 0.55)),
        leak_at_vessel=int(rng.random() < 0.7),
        leak_scatter=float(rng.uniform(0.02, 0.2)),
        porous=porous * flow * SL_PER_MIN,
        relief_pressure=float(rng.uniform(200.0, 500.0)) * MBAR,
    )


def _contact(rng):
    """Most rigs touch the part before suction; some suck while they come down on it."""
    return -0.03 if rng.random() < 0.75 else float(rng.uniform(0.01, 0.12))


def _supply(rng, ejector, gauge, blow_flow, here):
    absolute = here.ambient_pressure + gauge
    primary = nozzle_flow.py_func(
        ejector.nozzle_area, absolute, here.ambient_pressure, here.ambient_temperature
    )
    demand = max(primary, 0.5 * blow_flow)
    sag = float(rng.uniform(0.02, 0.15)) * BAR  # half at the regulator, half along the hose
    return parts.Supply(
        supply_gauge=gauge,
        supply_noise=float(rng.uniform(0.002, 0.015)) * BAR,
        supply_scatter=float(rng.uniform(0.002, 0.02)) * BAR,
        supply_volume=max(10.0 * ML, demand * 0.03),
        supply_droop=0.5 * sag / demand,
        supply_resistance=0.5 * sag / demand**2,
        feed_volume=_log(rng, 0.002, 0.012) * primary * R_AIR * here.ambient_temperature / absolute,
        valve_conductance=primary / absolute * float(rng.uniform(2.5, 5.0)),
        open_dead_time=float(rng.uniform(4.0, 25.0)) * MS,
        close_dead_time=float(rng.uniform(4.0, 30.0)) * MS,
        dead_time_jitter=float(rng.uniform(0.1, 0.8)) * MS,
        opening_time=float(rng.uniform(2.0, 10.0)) * MS,
        closing_time=float(rng.uniform(2.0, 12.0)) * MS,
    )


def _blow_off(rng, flow, fill, pressure, released):
    reservoir = released and rng.random() < 0.35
    held = fill * float(rng.uniform(1.5, 3.0))  # kg that the reservoir gives while it decays
    return parts.BlowOff(
        from_reservoir=int(reservoir),
        reservoir_volume=max(held * 8.5e4 / pressure, 2.0 * ML),
        refill_conductance=flow / pressure * float(rng.uniform(0.15, 0.5)),
        blow_conductance=flow / pressure,
        blow_dead_time=float(rng.uniform(4.0, 25.0)) * MS,
        blow_close_dead_time=float(rng.uniform(4.0, 25.0)) * MS,
        blow_jitter=float(rng.uniform(0.1, 0.8)) * MS,
        blow_opening_time=float(rng.uniform(2.0, 10.0)) * MS,
        blow_closing_time=float(rng.uniform(2.0, 12.0)) * MS,
    )


def _sensor(rng, kind, evacuation):
    fast = evacuation < 0.2
    second = rng.random() < 0.3
    lag = _log(rng, 0.3, 4.0 if fast else 12.0) * MS
    return parts.Sensor(
        place=str(rng.choice(["ejector", "line", "vessel"], p=[0.65, 0.15, 0.2])),
        sensor_lag=lag,
        second_lag=0.5 * lag if second else 0.0,
        gain_error=float(rng.normal(0.0, 0.003)),
        offset=float(rng.normal(0.0, 1.5)) * MBAR,
        gauge=bool(rng.random() < 0.5),
        full_scale=float(rng.choice([1000.0, 1013.25, 1100.0, 2000.0])) * MBAR,
        step=float(rng.choice([0.0, 0.1, 0.24414, 1.0], p=[0.2, 0.35, 0.35, 0.1])) * MBAR,
        noise=_log(rng, 0.05, 1.0) * MBAR,
        hum=float(rng.uniform(0.3, 2.0)) * MBAR if rng.random() < 0.3 else 0.0,
        update_ms=int(rng.choice([1, 1, 1, 2] if fast else [1, 1, 2, 5])),
        cadence_ms=int(rng.choice([1, 1, 2] if fast else [1, 1, 2, 5, 10])),
        stamp_jitter=float(rng.uniform(0.0, 0.15)) * MS,
        missing=float(rng.uniform(0.0, 0.05)) if rng.random() < 0.3 else 0.0,
    )


def _program(rng, kind, evacuation, filling, vessel):
    hold = float(rng.uniform(0.2, 1.5)) * max(evacuation, 0.3) + 0.2
    suction = min(max(1.5 * evacuation + hold, 0.3), 60.0)
    generous = float(rng.uniform(1.3, 2.0)) + (0.5 if vessel.released else 0.0)
    return parts.Program(
        suction_s=suction,
        pause_s=float(rng.choice([0.0, 0.0, 0.05])),
        blow_off_s=min(max(generous * filling + 0.03, 0.05), 12.0),
        idle_s=float(rng.uniform(0.2, 1.0)) + 0.3 * min(evacuation, 5.0),
        variation=float(rng.uniform(0.0, 0.06)),
        lead_s=0.2,
        varied=bool(rng.random() < 0.15),
    )


def _holds(rig, depth):
    """Whether the ejector reaches what it shall against the healthy leaks."""
    ambient = rig.surroundings.ambient_pressure
    vessel = rig.vessel
    vacuum = depth + rig.ejector.check_opening + 5.0 * MBAR
    share = (ambient + ambient - vacuum) / (2.0 * ambient - 600.0 * MBAR) * vacuum / (600.0 * MBAR)
    leaks = 1.5 * vessel.leak + vessel.porous * share
    if not rig.air_saving.air_saving:
        vacuum = 0.6 * ambient
    return sucked_at(rig, ambient - vacuum, 0.0) > 1.3 * leaks
