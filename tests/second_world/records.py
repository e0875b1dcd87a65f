"""A record: what a PLC would have logged, and the truth behind it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.signal import lfilter

from second_world import faults, kernel, state
from second_world.constants import BAR, MBAR, ML, SL_PER_MIN
from second_world.faults import Fault, Schedule
from second_world.kernel import BLOW_OFF, CONTACT, STRIP, SUCTION
from second_world.rig import Rig, plant_record

_STROKES = 512  # drawn per valve, then used again
_NOISE_TIME_MS = 40.0  # the supply wanders over this time
_WEATHER_TIME_MS = 60_000.0


@dataclass(frozen=True)
class Cycle:
    """Times in ms at which the PLC commands, and what happens at the seal."""

    suction_on: int
    suction_off: int
    blow_on: int
    blow_off: int
    end: int
    contact: int | None
    strip: int | None


@dataclass(frozen=True)
class Truth:
    """Everything that is hidden from the reader of a record."""

    rig: Rig
    faults: tuple[Fault, ...]
    affected_cycles: dict[str, list[int]]  # of intermittent faults
    cycles: tuple[Cycle, ...]
    nozzle_s: npt.NDArray[np.float64]  # when the nozzle's valve begins to move
    nozzle_on: npt.NDArray[np.bool_]
    supply_gauge: npt.NDArray[np.float64]  # Pa, set point of each cycle
    leak_scale: npt.NDArray[np.float64]  # of each cycle
    ambient_pressure: npt.NDArray[np.float64]  # Pa, at the start of each cycle
    noted_ambient: float  # Pa, what the PLC takes for ambient pressure
    head_pressure: npt.NDArray[np.float64]  # Pa, each ms
    vessel_pressure: npt.NDArray[np.float64]  # Pa, each ms
    supply_pressure: npt.NDArray[np.float64]  # Pa absolute, each ms
    flow: npt.NDArray[np.float64]  # kg/s, out of the hose into the ejector, each ms
    readable: dict[str, Any]


@dataclass(frozen=True)
class Record:
    """Rows that a PLC logged."""

    time_ns: npt.NDArray[np.int64]
    suction: npt.NDArray[np.bool_]
    blow_off: npt.NDArray[np.bool_]
    pressure_pa: npt.NDArray[np.float64]
    truth: Truth

    def vacuum_mbar(self) -> npt.NDArray[np.float64]:
        """Vacuum below the ambient pressure that the PLC assumes, mbar."""
        return (self.truth.noted_ambient - self.pressure_pa) / MBAR

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """Columns of a trace export."""
        return {
            "time_s": self.time_ns * 1e-9,
            "suction": self.suction.astype(np.int64),
            "blow_off": self.blow_off.astype(np.int64),
            "vacuum_mbar": self.vacuum_mbar(),
        }


def record(
    rig: Rig,
    seed: int,
    cycles: int = 12,
    faults: Sequence[Fault] = (),
    steps_per_ms: int | None = None,
) -> Record:
    """Run a rig's program for some cycles and log it. The same arguments give the same record."""
    plan = plan_cycles(rig, seed, cycles)
    rows = plan[-1].end
    course, hidden = _course(rig, seed, plan, rows)
    sizes = _schedule(rig, faults, plan, rows, seed)
    steps = rig.steps_per_ms if steps_per_ms is None else steps_per_ms
    traces, _, _ = run_course(rig, course, _chance(seed), sizes, steps)
    count = int(traces.switches[0])
    truth = Truth(
        rig,
        tuple(faults),
        sizes.cycles,
        plan,
        traces.switch_time[:count].copy(),
        traces.switch_on[:count] > 0.5,
        hidden["supply"],
        hidden["leak"],
        course.ambient[[cycle.suction_on for cycle in plan]],
        hidden["noted"],
        traces.head,
        traces.vessel,
        traces.supply,
        traces.flow,
        readable(rig, seed, hidden["noted"]),
    )
    return _read(rig, seed, course, traces, sizes, truth)


def run_course(rig, course, chance, sizes, steps, gas=None):
    """Compiled run of a given course; returns traces, gas and the rest of the state.

    `gas`: what the cells hold at the start, changed in place; still air if None.
    """
    rows = len(course.commands)
    gas = state.still_air(rig) if gas is None else gas
    rest, strokes = state.at_rest(rig), state.valves()
    switches = (np.zeros(kernel.SWITCHES), np.zeros(kernel.SWITCHES), np.zeros(1, np.int64))
    traces = kernel.Traces(*(np.zeros(rows) for _ in range(6)), *switches)
    kernel.simulate(
        plant_record(rig),
        rest,
        gas,
        strokes,
        course,
        chance,
        sizes.starts_ms,
        sizes.sizes,
        _lags(rig, len(gas.mass)),
        steps,
        traces,
    )
    return traces, gas, rest


def _lags(rig, cells):
    places = {
        "ejector": state.HEAD,
        "line": kernel.middle_of_hose(rig.line.line_cells),
        "vessel": cells - 1,
    }
    return kernel.Lags(places[rig.sensor.place], rig.sensor.sensor_lag, rig.sensor.second_lag)


def _rng(seed, name):
    """A stream of its own for everything that is drawn: no fault shifts another one's numbers."""
    return np.random.default_rng([seed, *name.encode()])


def plan_cycles(rig: Rig, seed: int, count: int) -> tuple[Cycle, ...]:
    """The PLC's program, on the PLC's own clock; the part comes and goes on its own."""
    rng = _rng(seed, "program")
    program, vessel, grid = rig.program, rig.vessel, rig.sensor.cadence_ms
    at = program.lead_s * 1e3
    plan = []
    for number in range(count):
        stretch = np.exp(rng.normal(0.0, program.variation, 4))
        if program.varied and number % 3 == 2:
            stretch[0] *= 0.6 if rng.random() < 0.5 else 1.5
        spans = [program.suction_s, program.pause_s, program.blow_off_s, program.idle_s]
        edges = np.round(np.cumsum([at, *(1e3 * stretch * spans)]) / grid).astype(int) * grid
        on, off, blow_on, blow_off, end = (int(edge) for edge in edges)
        touch = strip = None
        if vessel.released:
            jitter = rng.normal(0.0, vessel.contact_jitter)
            touch = max(on + round(1e3 * (vessel.contact_delay + jitter)), 1)
            strip = blow_off + (end - blow_off) // 3
        plan.append(Cycle(on, off, blow_on, blow_off, end, touch, strip))
        at = end
    return tuple(plan)


def _course(rig, seed, plan, rows):
    """Everything that is given for each millisecond, and what was drawn per cycle."""
    here, supply = rig.surroundings, rig.supply
    starts = np.array([cycle.suction_on for cycle in plan])
    cycle = np.maximum(np.searchsorted(starts, np.arange(rows), side="right") - 1, 0)
    rng = _rng(seed, "scatter")
    gauge = supply.supply_gauge + rng.normal(0.0, supply.supply_scatter, len(plan))
    leak = np.exp(rng.normal(0.0, rig.vessel.leak_scatter, len(plan)))
    wander = _wander(_rng(seed, "supply"), rows, _NOISE_TIME_MS) * supply.supply_noise
    weather = _wander(_rng(seed, "weather"), rows, _WEATHER_TIME_MS) * here.weather
    period = float(_rng(seed, "swing").uniform(2.3, 5.9))
    clock = np.arange(rows) * 1e-3
    rhythm = _rng(seed, "neighbour")
    beat, share = rhythm.uniform(1.1, 3.7), rhythm.uniform(0.3, 0.6)
    course = kernel.Course(
        commands(plan, rows),
        _seal_events(plan, rows),
        gauge[cycle] + wander,
        here.ambient_pressure + weather,
        leak[cycle],
        ((clock / beat) % 1.0 < share).astype(float),
        np.sin(2.0 * np.pi * clock / period),
        _rng(seed, "own").normal(0.0, rig.air_saving.own_noise, rows),
    )
    noted = here.ambient_pressure + _rng(seed, "barometer").normal(0.0, 1.5 * MBAR)
    return course, {"supply": gauge, "leak": leak, "noted": float(noted)}


def _wander(rng, rows, time_ms):
    """An Ornstein-Uhlenbeck course of standard deviation 1, one value per ms."""
    keep = np.exp(-1.0 / time_ms)
    kicks = rng.normal(0.0, np.sqrt(1.0 - keep * keep), rows)
    return lfilter([1.0], [1.0, -keep], kicks)


def commands(plan: Sequence[Cycle], rows: int) -> npt.NDArray[np.uint8]:
    """Commands of the PLC for every millisecond."""
    bits = np.zeros(rows, np.uint8)
    for cycle in plan:
        bits[cycle.suction_on : cycle.suction_off] |= SUCTION
        bits[cycle.blow_on : cycle.blow_off] |= BLOW_OFF
    return bits


def _seal_events(plan, rows):
    events = np.zeros(rows, np.uint8)
    for cycle in plan:
        if cycle.contact is not None:
            events[cycle.contact] = CONTACT
            events[cycle.strip] = STRIP
    return events


def _chance(seed):
    jitter = _rng(seed, "jitter").normal(0.0, 1.0, (2, _STROKES))
    sticking = (_rng(seed, "sticking").random(_STROKES) < 1.0 / 3.0).astype(float)
    return kernel.Chance(np.clip(jitter, -3.0, 3.0), sticking)


def _schedule(rig, chosen, plan, rows, seed) -> Schedule:
    starts = [cycle.suction_on for cycle in plan]
    return faults.schedule(rig, chosen, starts, rows, seed)


def _read(rig, seed, course, traces, sizes, truth):
    """What the PLC logs of the sensor: errors, noise, steps, its own clock, missing rows."""
    sensor, rng = rig.sensor, _rng(seed, "sensor")
    rows = len(course.commands)
    active = np.searchsorted(sizes.starts_ms, np.arange(rows), side="right") - 1

    def size(effect, name):
        return sizes.sizes[active, faults.INDEX[effect, name]]

    ambient = course.ambient + size("ambient_pressure", "shift")
    reference = ambient if sensor.gauge else np.full(rows, truth.noted_ambient)
    vacuum = (reference - traces.seen) * (1.0 + sensor.gain_error)
    vacuum = vacuum * (1.0 + size("sensor_gain", "error")) - sensor.offset
    vacuum = vacuum - size("sensor_offset", "offset")
    vacuum = vacuum - size("sensor_thermal_drift", "offset") * traces.warmth
    hum = sensor.hum * np.sin(2.0 * np.pi * 50.0 * np.arange(rows) * 1e-3 + rng.uniform(0.0, 6.28))
    vacuum = vacuum + hum + rng.normal(0.0, sensor.noise, rows)
    if sensor.step > 0.0:
        vacuum = np.round(vacuum / sensor.step) * sensor.step
    vacuum = np.clip(vacuum, -sensor.full_scale, sensor.full_scale + 100.0 * MBAR)
    logged = np.arange(0, rows, sensor.cadence_ms)
    held = logged - logged % sensor.update_ms
    kept = rng.random(len(logged)) >= sensor.missing
    jitter = np.clip(rng.normal(0.0, sensor.stamp_jitter, len(logged)), -4e-4, 4e-4)
    stamps = np.round((logged * 1e-3 + jitter + 1e-3) * 1e9).astype(np.int64)
    bits = course.commands[logged]
    return Record(
        stamps[kept],
        ((bits & SUCTION) != 0)[kept],
        ((bits & BLOW_OFF) != 0)[kept],
        (truth.noted_ambient - vacuum[held])[kept],
        truth,
    )


def readable(rig: Rig, seed: int, noted_ambient: float) -> dict[str, Any]:
    """What a person at the rig could read off, within 20 %, or "unknown"."""
    rng = _rng(seed, "person")

    def rough(value):
        return float(value * rng.uniform(0.8, 1.2)) if rng.random() > 0.15 else "unknown"

    display = rig.air_saving.air_saving and rng.random() < 0.6
    return {
        "ambient_mbar": noted_ambient / MBAR if rng.random() < 0.7 else "unknown",
        "vessel_ml": rough((rig.vessel.rigid_volume + rig.vessel.cup_volume) / ML),
        "hose_length_m": rough(rig.line.line_length),
        "hose_diameter_mm": rough(rig.line.line_diameter * 1e3),
        "sensor_place": rig.sensor.place,
        "sensor_range_mbar": rig.sensor.full_scale / MBAR,
        "sensor_reference": "gauge" if rig.sensor.gauge else "absolute",
        "part_released": bool(rig.vessel.released),
        "supply_bar": rough(rig.supply.supply_gauge / BAR),
        "suction_capacity_sl_min": rough(rig.nominal_flow / SL_PER_MIN),
        "end_vacuum_mbar": rough(rig.end_vacuum / MBAR),
        "stages": rig.ejector.stages if rng.random() < 0.7 else "unknown",
        "air_saving": bool(rig.air_saving.air_saving),
        "h1_mbar": rig.air_saving.h1 / MBAR if display else "unknown",
        "hysteresis_mbar": rig.air_saving.hysteresis / MBAR if display else "unknown",
    }


def write_csv(record: Record, path: Path) -> None:
    """Write a trace export with `time_s,suction,blow_off,vacuum_mbar`."""
    columns = record.columns()
    table = np.column_stack(list(columns.values()))
    np.savetxt(
        path,
        table,
        delimiter=",",
        header=",".join(columns),
        comments="",
        fmt=["%.9f", "%d", "%d", "%.4f"],
    )


def write_parquet(record: Record, path: Path) -> None:
    """The same columns as Parquet."""
    pq.write_table(pa.table(record.columns()), path)
