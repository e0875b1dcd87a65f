"""Cases of the first world: the rigs behind the simulated PLC, about the shipped configurations.

Each case has a rig with true values about those of a shipped configuration. It is calibrated on its
own healthy record. Then effect, course and size are drawn.
"""

import math
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from drivers.plc.faults import Fault, parse_fault
from drivers.plc.settings import PlcSettings
from tools.battery_cases import Case, Hidden
from tools.calibration_coverage import SYSTEMS, as_type, drawn, recorded, rig_of, shipped
from twin.calibration.calibrate import calibrate
from twin.config import Config
from twin.diagnosis.answer import diagnose
from twin.errors import TwinError
from twin.signals import MS, Samples

NAME = "first"
CYCLES = 12
# Sizes from just isolable to gross, in the unit of the effect's parameter, drawn log-uniformly.
# The gripper's volume is a sixth of the tank's, and its wall takes up less heat.
SIZES = {
    "leakage": (0.4, 8.0),
    "porous_leakage": (0.4, 6.0),
    "check_valve_leak": (0.5, 5.0),
    "suction_loss": (3.0, 30.0),
    "end_vacuum_loss": (10.0, 60.0),
    "supply_pressure_drop": (0.25, 1.5),
    "filter_clogging": (15.0, 150.0),
    "added_volume": (15.0, 200.0),
    "cup_compliance": (10.0, 80.0),
    "heat_exchange": (14.0, 25.0),
    "response_delay": (4.0, 40.0),
    "slow_ramp_up": (8.0, 50.0),
    "threshold_drift": (5.0, 40.0),
    "weak_blow_off": (6.0, 50.0),
    "blow_off_delay": (4.0, 40.0),
    "sensor_offset": (3.0, 30.0),
    "sensor_gain": (0.8, 6.0),
    "sensor_lag": (5.0, 40.0),
    "ambient_pressure": (6.0, 40.0),
}
ON_GRIPPER = {
    "added_volume": (8.0, 60.0),
    "cup_compliance": (10.0, 50.0),
    "heat_exchange": (25.0, 50.0),
    "creeping_cup": (8.0, 40.0),
}
SIGNED = {"threshold_drift", "sensor_offset", "sensor_gain"}
NEGATIVE = {"ambient_pressure"}
UNLISTED = {  # of the live naming trial, and of the battery until 2026-11-29
    "lip_lift": (1.5, 8.0),
    "supply_swing": (0.4, 1.5),
    "condensate": (3.0, 12.0),
    "nozzle_icing": (10.0, 50.0),
    "sensor_backlash": (10.0, 50.0),
}
# All mechanisms outside the table, in the unit of the first size.
OUTSIDE = UNLISTED | {
    "creeping_cup": (15.0, 90.0),
    "sticking_valve": (15.0, 60.0),
    "blow_off_valve_leak": (1.0, 6.0),
    "filling_silencer": (30.0, 120.0),
    "second_ejector": (0.4, 1.5),
    "adsorbed_moisture": (2.0, 12.0),
    "sensor_thermal_drift": (8.0, 40.0),
}
COURSES = {"constant": 0.4, "step": 0.25, "ramp": 0.15, "intermittent": 0.2}
COUNTS = {"single": 152, "pair": 20, "healthy": 30, "unlisted": 20}


@dataclass(frozen=True)
class Unit:
    """One rig, and its calibrated configuration."""

    name: str
    plc: PlcSettings
    config: Config


@cache
def unit(name: str, seed: int) -> Unit:
    """A rig with drawn true values, calibrated on its own healthy record."""
    document = shipped(name)
    plc, config = drawn(rig_of(document), 1000 + seed), as_type(document)
    calibrated = calibrate(config, [recorded(plc, 10, 5000 + seed)], _quiet)
    monitor = config.monitor.model_copy(update={"healthy": calibrated.healthy})
    return Unit(name, plc, replace(config, data=calibrated.fitted.data, monitor=monitor))


def _quiet(_what: str) -> None:
    """Ignore progress."""


def draw_size(rng: np.random.Generator, name: str, effect: str, least: float = 0.0) -> float:
    """A drawn size of an effect on a system; ``least`` is the share of its range to start from."""
    table = {**SIZES, **OUTSIDE, **(ON_GRIPPER if name == "gripper" else {})}
    low, high = (math.log(end) for end in table[effect])
    size = math.exp(rng.uniform(low + least * (high - low), high))
    down = effect in NEGATIVE or (effect in SIGNED and rng.random() < 0.5)
    return -size if down else size


def fault(rng: np.random.Generator, plc: PlcSettings, hidden: Hidden) -> Fault:
    """The rig's fault for a hidden effect; its onset or its cycles are drawn."""
    program = plc.program
    cycle = (program.suction_ms + program.blow_off_ms + program.idle_ms) * MS
    text = f"{hidden.effect}={hidden.size:.4f}"
    if hidden.course == "step":
        text += f"@{0.5 + cycle * rng.uniform(4.0, 8.0):.2f}"
    elif hidden.course == "ramp":
        text += f"/ramp:{0.5 + CYCLES * cycle:.1f}"
    elif hidden.course == "intermittent":
        text += f"/share:{rng.uniform(0.35, 0.65):.2f}"
    return parse_fault(text)


def drawn_case(
    kind: str,
    seed: int,
    units: int,
    first_unit: int = 0,
    mechanisms: Collection[str] = tuple(OUTSIDE),
) -> tuple[Unit, list[Hidden], Samples]:
    """One of ``units`` rigs from ``first_unit`` on, the hidden effects, and the log.

    Unlisted ``mechanisms`` take turns; with ``UNLISTED`` a case is that of before 2026-11-29.
    """
    rng = np.random.default_rng([2026, seed, sorted(COUNTS).index(kind)])
    name = SYSTEMS[int(rng.integers(len(SYSTEMS)))]
    rig = unit(name, first_unit + int(rng.integers(units)))
    hidden: list[Hidden] = []
    if kind == "single":
        effect = list(SIZES)[seed % len(SIZES)]
        course = str(rng.choice(list(COURSES), p=list(COURSES.values())))
        hidden = [Hidden(effect, course, draw_size(rng, name, effect))]
    elif kind == "pair":
        effects = rng.choice(list(SIZES), 2, replace=False)
        hidden = [Hidden(str(e), "constant", draw_size(rng, name, str(e), 0.4)) for e in effects]
    elif kind == "unlisted":
        effect = list(mechanisms)[seed % len(mechanisms)]
        hidden = [Hidden(effect, "constant", draw_size(rng, name, effect))]
    faults = [fault(rng, rig.plc, entry) for entry in hidden]
    return rig, hidden, recorded(rig.plc, CYCLES - 1, int(rng.integers(1 << 30)), faults)


def answered(
    kind: str, seed: int, units: int, mechanisms: Collection[str] = tuple(OUTSIDE)
) -> Case:
    """Draw a case of a kind and diagnose it."""
    rig, hidden, samples = drawn_case(kind, seed, units, mechanisms=mechanisms)
    begin, answer, error = time.process_time(), None, ""
    try:
        answer = diagnose(rig.config, [samples], "battery", _quiet).json
    except TwinError as refusal:
        error = str(refusal)
    seconds = round(time.process_time() - begin, 2)
    return Case(kind, seed, rig.name, hidden, answer, error=error, seconds=seconds)


def keys(first: int, counts: dict[str, int]) -> Iterator[tuple[str, int]]:
    """Kind and seed of each case of a run."""
    return ((kind, seed) for kind, count in counts.items() for seed in range(first, first + count))
