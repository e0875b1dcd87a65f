"""Faults by name, size and course, and how they become the numbers that the plant takes.

Sizes have the units of the field; `schedule` converts them to SI. Zero is neutral everywhere.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from second_world import ejector
from second_world.constants import BAR, MBAR, ML, MS, R_AIR, SL_PER_MIN
from second_world.gas import nozzle_flow
from second_world.rig import Rig

TABLE: dict[str, dict[str, float]] = {  # effect -> parameter -> its unit in SI
    "leakage": {"sonic_flow": SL_PER_MIN},
    "porous_leakage": {"flow_at_600mbar": SL_PER_MIN},
    "check_valve_leak": {"sonic_flow": SL_PER_MIN},
    "suction_loss": {"loss": 0.01},
    "end_vacuum_loss": {"end_pressure_rise": MBAR},
    "supply_pressure_drop": {"drop": BAR},
    "filter_clogging": {"pressure_drop_at_nominal": MBAR},
    "added_volume": {"volume": ML},
    "cup_compliance": {"volume_at_full_vacuum": ML},
    "heat_exchange": {"film_coefficient": 1.0},
    "response_delay": {"delay": MS},
    "slow_ramp_up": {"time_constant": MS},
    "threshold_drift": {"h1_shift": MBAR, "h2_shift": MBAR},
    "weak_blow_off": {"loss": 0.01},
    "blow_off_delay": {"delay": MS},
    "sensor_offset": {"offset": MBAR},
    "sensor_gain": {"error": 0.01},
    "sensor_lag": {"time_constant": MS},
    "ambient_pressure": {"shift": MBAR},
}
OUTSIDE: dict[str, dict[str, float]] = {  # mechanisms that the product's table does not know
    "nozzle_icing": {"blockage": 0.01},  # ice narrows the nozzle while it runs, melts while off
    "condensate": {"blockage": 0.01},  # water gathers in the hose, blow-off clears it
    "lifting_lip": {"sonic_flow": SL_PER_MIN},  # leaks above 400 mbar vacuum
    "cup_backlash": {"volume": ML},  # moves 150 mbar later on the way back
    "supply_swing": {"amplitude": BAR},  # a compressor switches
    "creeping_cup": {"volume": ML},  # gives way over seconds
    "sticking_valve": {"delay": MS},  # a third of the suction valve's strokes
    "blow_off_valve_leak": {"sonic_flow": SL_PER_MIN},  # seat leaks compressed air all the time
    "filling_silencer": {"back_pressure": MBAR},  # builds up over a second of running
    "second_ejector": {"flow": SL_PER_MIN},  # on the same supply, in its own rhythm
    "outgassing": {"flow": SL_PER_MIN},  # adsorbed moisture, most at the start of each vacuum
    "sensor_thermal_drift": {"offset": MBAR},  # the sensor warms up over a minute
    "leaking_flap": {"sonic_flow": SL_PER_MIN},  # second stage's flap; of two stages only
    "collapsing_hose": {"area_loss": 0.01},  # narrows with vacuum
}
EVERYTHING = TABLE | OUTSIDE
INDEX = {
    (effect, name): number
    for number, (effect, name) in enumerate(
        (effect, name) for effect, names in EVERYTHING.items() for name in names
    )
}
COURSES = ("constant", "step", "ramp", "intermittent")
_RAMP_STEP_S = 0.1


@dataclass(frozen=True)
class Fault:
    """One effect, its size in the field's units, and how it runs in time.

    `ramp` grows from `onset_s` by `rate_per_hour` of the first parameter's unit up to the size.
    `intermittent` acts in the cycles named, or in a drawn `share` of them.
    """

    effect: str
    parameters: Mapping[str, float]
    course: str = "constant"
    onset_s: float = 0.0
    rate_per_hour: float = 0.0
    share: float = 0.5
    cycles: Sequence[int] | None = None

    def __post_init__(self):
        if self.effect not in EVERYTHING:
            raise ValueError(f"no effect is called {self.effect!r}: take one of {set(EVERYTHING)}")
        if unknown := set(self.parameters) - set(EVERYTHING[self.effect]):
            raise ValueError(f"{self.effect} has no parameter {unknown}")
        if self.course not in COURSES:
            raise ValueError(f"no course is called {self.course!r}: take one of {COURSES}")


@dataclass(frozen=True)
class Schedule:
    """Sizes in SI that hold from `starts_ms` on, one row each."""

    starts_ms: npt.NDArray[np.int64]
    sizes: npt.NDArray[np.float64]
    cycles: dict[str, list[int]] = field(default_factory=dict)  # of intermittent faults


def schedule(
    rig: Rig, faults: Sequence[Fault], starts_ms: Sequence[int], end_ms: int, seed: int
) -> Schedule:
    """Sizes over time. A break stands at every cycle, onset, and each 0.1 s of a ramp."""
    breaks = {0, *starts_ms}
    for fault in faults:
        onset_ms = round(fault.onset_s * 1e3)
        if fault.course in ("step", "ramp"):
            breaks.add(onset_ms)
        if fault.course == "ramp":
            breaks.update(range(onset_ms, end_ms, round(_RAMP_STEP_S * 1e3)))
    times = np.array(sorted(breaks), np.int64)
    sizes = np.zeros((len(times), len(INDEX)))
    affected = {}
    for number, fault in enumerate(faults):
        drawn = np.random.default_rng([seed, 77, number]).random(len(starts_ms)) < fault.share
        chosen = list(np.flatnonzero(drawn)) if fault.cycles is None else list(fault.cycles)
        shares = _shares(fault, times, starts_ms, [int(cycle) for cycle in chosen])
        for name, size in fault.parameters.items():
            unit = EVERYTHING[fault.effect][name]
            sizes[:, INDEX[fault.effect, name]] += size * unit * shares
        if fault.course == "intermittent":
            affected[fault.effect] = [int(cycle) for cycle in chosen]
    _to_plant(rig, sizes)
    return Schedule(times, sizes, affected)


def _shares(fault, times_ms, starts_ms, cycles):
    if fault.course == "constant":
        return np.ones(len(times_ms))
    onset_ms = round(fault.onset_s * 1e3)
    if fault.course == "step":
        return (times_ms >= onset_ms).astype(float)
    if fault.course == "ramp":
        largest = abs(next(iter(fault.parameters.values()))) or 1.0
        hours = np.maximum(times_ms - onset_ms, 0) / 3.6e6
        return np.minimum(hours * abs(fault.rate_per_hour) / largest, 1.0)
    cycle = np.searchsorted(np.asarray(starts_ms), times_ms, side="right") - 1
    return np.isin(cycle, cycles).astype(float)


def _to_plant(rig, sizes):
    """Turn sizes that mean something only on this rig into what the plant takes."""
    column = INDEX["end_vacuum_loss", "end_pressure_rise"]
    for rise in np.unique(sizes[:, column]):
        chosen = sizes[:, column] == rise
        sizes[chosen, column] = _back_pressure(rig, rise) if rise else 0.0
    density = rig.surroundings.ambient_pressure / (R_AIR * rig.surroundings.ambient_temperature)
    column = INDEX["filter_clogging", "pressure_drop_at_nominal"]
    sizes[:, column] *= density / rig.nominal_flow**2  # to Pa per kg²/(s²·kg/m³)


def _back_pressure(rig, rise):
    """Extra pressure behind the ejector that lifts its end pressure by `rise` (Pa)."""
    ambient = rig.surroundings.ambient_pressure
    target = ambient - rig.end_vacuum + rise
    low, high = 0.0, 3.0 * abs(rise)
    for _ in range(50):
        middle = 0.5 * (low + high)
        if sucked_at(rig, target, middle) > 0.0:
            low = middle
        else:
            high = middle
    return math.copysign(middle, rise)


def sucked_at(rig, p_chamber, extra):
    """Flow in kg/s that a running ejector sucks at a chamber pressure, supply not sagging.

    `extra`: Pa of back pressure. Of two stages, the second one's flap is closed or open by itself.
    """
    here, unit, supply = rig.surroundings, rig.ejector, rig.supply
    ambient, t = here.ambient_pressure, here.ambient_temperature
    pressure = ambient + supply.supply_gauge
    primary = nozzle_flow.py_func(unit.nozzle_area, pressure, p_chamber, t)
    push, ring = ejector.jet.py_func(pressure, p_chamber, t, primary, unit.velocity_coefficient)
    behind = ambient + unit.silencer * primary**2 + extra
    stage = ejector.stage.py_func

    def first(p_behind):
        return stage(
            p_chamber, t, p_behind, t, push, primary, ring, unit.first_area, unit.first_losses
        )[0]

    if unit.stages == 1:
        return first(behind)

    def second(p_second):
        kept = unit.momentum_kept * max(push + (p_chamber - p_second) * unit.first_area, 0.0)
        carried = primary + first(p_second)
        area = unit.second_area
        return stage(
            p_second, t, behind, t, kept, carried, unit.first_area, area, unit.second_losses
        )[0]

    open_flow = second(p_chamber)
    if open_flow > 0.0:
        return first(p_chamber) + open_flow
    low, high = p_chamber, behind  # flap closed: the second stage idles where it sucks nothing
    for _ in range(50):
        middle = 0.5 * (low + high)
        if second(middle) > 0.0:
            high = middle
        else:
            low = middle
    return first(low)
