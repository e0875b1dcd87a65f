"""Cases of the second world: rigs that share no equation with the model, commissioned first.

Each rig is known only as a person knows it. A healthy record is read as by `twin import`. The
configuration is that of `twin init` from values read off, a fifth off or unknown. The code of
`twin commission` commissions the rig. Only then are effects hidden in further records.
"""

import math
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tools.battery_cases import STORED, Case, Hidden
from twin.calibration.commission import Commissioned, commission
from twin.calibration.report import commissioned_as_json, headline
from twin.cli.init import Answer, End, Place, Reference, Sensor, System, Unit, configuration
from twin.config import Config
from twin.diagnosis.answer import diagnose
from twin.errors import TwinError
from twin.model.dataset import DataSet
from twin.model.parts import volume
from twin.monitor.healthy import Healthy
from twin.settings import Document
from twin.signals import MBAR, ML, MS, SL_MIN, Samples
from twin.tables.reader import open_table
from twin.tables.settings import Bad, ImportSettings

sys.path.append(str(Path(__file__).parent.parent / "tests"))  # where the second world is

from second_world import Fault, draw_rig, faults, record
from second_world.gas import nozzle_flow, orifice
from second_world.plant import CRITICAL_VALVE
from second_world.records import Record, plan_cycles
from second_world.rig import Rig

NAME = "second"
RIGS = 60
CYCLES = 12
CADENCES = (1, 2, 5, 10)  # ms
SINGLES, PAIRS, UNLISTED = 3, 1, 1  # records of each rig, in addition to a second healthy one
RECORDS = 1 + SINGLES + PAIRS + UNLISTED
LONG_WAY = 0.4  # share of an effect's range from which on sizes of pairs are drawn
COURSES = {"constant": 0.4, "step": 0.25, "ramp": 0.15, "intermittent": 0.2}
CRASHED = "crashed: "


class Range(NamedTuple):
    """Sizes of an effect, from just isolable to gross, in units of a quantity of the rig."""

    low: float
    high: float
    of: Callable[[Rig], float] = lambda _: 1.0
    signed: int = 1  # -1: only downwards; 0: both ways


def _flow(rig: Rig) -> float:
    """Suction capacity, sl/min."""
    return rig.nominal_flow / SL_MIN


def _vessel(rig: Rig) -> float:
    """Evacuated volume, ml."""
    return (rig.vessel.rigid_volume + rig.vessel.cup_volume) / ML


def _slow(rig: Rig) -> float:
    """Evacuation time over 0.8 s, from 1 to 10: on slow rigs only longer delays show."""
    return min(max(rig.evacuation_s / 0.8, 1.0), 10.0)


SIZES = {
    "leakage": Range(0.01, 0.1, _flow),
    "porous_leakage": Range(0.01, 0.1, _flow),
    "check_valve_leak": Range(0.01, 0.1, _flow),
    "suction_loss": Range(5.0, 35.0),
    "end_vacuum_loss": Range(15.0, 70.0),
    "supply_pressure_drop": Range(0.3, 1.2),
    "filter_clogging": Range(20.0, 150.0),
    "added_volume": Range(0.04, 0.3, _vessel),
    "cup_compliance": Range(0.04, 0.3, _vessel),
    "heat_exchange": Range(15.0, 60.0),
    "response_delay": Range(4.0, 40.0, _slow),
    "slow_ramp_up": Range(8.0, 40.0, _slow),
    "threshold_drift": Range(8.0, 40.0, signed=0),
    "weak_blow_off": Range(8.0, 50.0),
    "blow_off_delay": Range(4.0, 40.0, _slow),
    "sensor_offset": Range(4.0, 30.0, signed=0),
    "sensor_gain": Range(1.0, 6.0, signed=0),
    "sensor_lag": Range(5.0, 40.0, _slow),
    "ambient_pressure": Range(8.0, 40.0, signed=-1),
}
OUTSIDE = {
    "nozzle_icing": Range(12.0, 40.0),
    "condensate": Range(50.0, 85.0),
    "lifting_lip": Range(0.02, 0.1, _flow),
    "cup_backlash": Range(0.08, 0.3, _vessel),
    "supply_swing": Range(0.4, 1.0),
    "creeping_cup": Range(0.1, 0.4, _vessel),
    "sticking_valve": Range(20.0, 60.0, _slow),
    "blow_off_valve_leak": Range(0.02, 0.1, _flow),
    "filling_silencer": Range(40.0, 120.0),
    "second_ejector": Range(1.0, 3.0, _flow),
    "outgassing": Range(0.02, 0.1, _flow),
    "sensor_thermal_drift": Range(10.0, 40.0),
    "leaking_flap": Range(0.1, 0.4, _flow),
    "collapsing_hose": Range(50.0, 85.0),
}
OF_AIR_SAVING = {"threshold_drift", "check_valve_leak"}
OF_CUPS = {"cup_compliance", "creeping_cup", "cup_backlash", "lifting_lip"}
MOST = {"cup_compliance": 90.0, "added_volume": 4000.0}  # ml, bounds of the effects
# Effects whose sizes mean the same in both worlds. Sizes of flows and volumes scale with the
# configured volume of the vessel, which is up to a fifth off.
COMPARABLE = {
    "suction_loss",
    "end_vacuum_loss",
    "supply_pressure_drop",
    "response_delay",
    "threshold_drift",
    "weak_blow_off",
    "blow_off_delay",
    "sensor_offset",
    "sensor_gain",
    "sensor_lag",
    "ambient_pressure",
}
OF_VOLUME = {"leakage", "porous_leakage", "check_valve_leak", "added_volume"}


@dataclass(frozen=True)
class Person:
    """What a person reads off a rig: its configuration, and how its records are imported."""

    config: Config

    @classmethod
    def at(cls, readable: Mapping[str, Any], name: str) -> "Person":
        """The answers to ``twin init``; ``readable`` has values as read off, or "unknown"."""

        def known(key: str, factor: float = 1.0) -> float | None:
            return None if readable[key] == "unknown" else round(float(readable[key]) * factor, 4)

        released = readable["part_released"]
        system = System(
            known("hose_length_m", 1e3),
            known("hose_diameter_mm"),
            End.CUPS if released else End.VESSEL,
            known("vessel_ml"),
            Place.EJECTOR if readable["sensor_place"] == "ejector" else Place.END,
            Answer.YES if released else Answer.NO,
            known("supply_bar"),
        )
        gauge = readable["sensor_reference"] == "gauge"
        kind = Reference.VACUUM if gauge else Reference.ABSOLUTE
        sensor = Sensor(Unit.MBAR, kind, None)
        text = configuration(Path(f"{name}.toml"), (name, ""), None, sensor, system, ())
        if (ambient := known("ambient_mbar")) is not None:  # there is a barometer
            text += f"\n[data.ambient]\npressure_mbar = {ambient}\n"
        config = Config.of(Document.parse(text, name), calibrated=False)
        return cls(config.with_sensor(is_gauge=gauge))

    def samples(self, logged: Record) -> Samples:
        """A record as ``twin import`` reads it, gaps marked."""
        columns = logged.columns()
        if not self.config.is_gauge:
            columns["pressure_mbar"] = logged.pressure_pa / MBAR
            del columns["vacuum_mbar"]
        ambient = self.config.data.ambient.pressure_mbar * MBAR
        settings = ImportSettings(gaps=Bad.MARK, jumps=Bad.MARK)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "trace.parquet"
            pq.write_table(pa.table(columns), path)
            return np.concatenate(list(open_table(path, settings, ambient).blocks()))


@dataclass(frozen=True)
class Met:
    """A drawn rig with what a person reads off it; ``unit`` is None before commissioning."""

    seed: int
    rig: Rig
    person: Person
    unit: Config | None = None

    @property
    def name(self) -> str:
        """Name of the rig: its kind and seed."""
        return f"{self.rig.kind}-{self.seed}"


def drawn(seed: int, cadences: Sequence[int]) -> Met | None:
    """The rig of a seed; None if its cadence (ms) is not among ``cadences``."""
    rig = draw_rig(seed)
    if rig.sensor.cadence_ms not in cadences:
        return None
    readable = record(rig, seed, 1).truth.readable
    return Met(seed, rig, Person.at(readable, f"{rig.kind}-{seed}"))


# --- commissioning --------------------------------------------------------------------------------


def commissioned(met: Met) -> Case:
    """Commission a rig on its healthy record."""
    samples = met.person.samples(record(met.rig, met.seed, CYCLES))

    def answer() -> dict[str, Any]:
        return _as_answer(met, commission(met.person.config, [samples], _quiet))

    case = _answered("commissioning", met, 0, (), answer, {"cadence_ms": met.rig.sensor.cadence_ms})
    if not case.error:
        return case
    return replace(case, more=case.more | {"true": is_true(case.error, met.rig)})


def is_true(error: str, rig: Rig) -> bool:
    """Whether a refusal gives a reason that is true of the rig's healthy record."""
    return "gaps" in error and rig.sensor.missing > 0.0


def _answered(
    kind: str,
    met: Met,
    number: int,
    hidden: Sequence[Hidden],
    answer: Callable[[], Mapping[str, Any]],
    more: Mapping[str, Any],
) -> Case:
    """A case with its answer or its error, and the processor time spent (s)."""
    begin, result, error = time.process_time(), None, ""
    try:
        result = answer()
    except TwinError as refusal:
        error = str(refusal)
        if refusal.__cause__ is not None:
            more = {**more, "cause": str(refusal.__cause__)}
    except Exception:  # a crash is a finding of its own
        error = CRASHED + traceback.format_exc()
    seconds = round(time.process_time() - begin, 2)
    return Case(kind, met.seed, met.rig.kind, hidden, result, number, error, seconds, more)


def _as_answer(met: Met, outcome: Commissioned) -> dict[str, Any]:
    as_json = commissioned_as_json(outcome, met.person.config.asset, None)
    answer = {
        key: as_json[key] for key in ("verdict", "residual", "contradicts", "assumed", "data")
    }
    answer["healthy"] = outcome.calibration.healthy.model_dump(mode="json")
    answer["reason"] = headline(outcome.verdict)
    answer["scale"] = scale = _told_volume(outcome.calibration.fitted.data) / _true_volume(met.rig)
    answer["covered"] = {}
    for name, true in truths(met, scale).items():
        low, high = outcome.calibration.fitted.interval(name)
        value = 0.5 * (low + high)
        answer["covered"][name] = {
            "true": true,
            "value": value,
            "low95": low,
            "high95": high,
            "determined": name not in outcome.assumed,
            "holds": bool(low <= true <= high),
        }
    return answer


def _told_volume(data: DataSet) -> float:
    """Volume (m³) that the fitted twin evacuates."""
    return sum(volume(part) for part in data.system.parts) + data.ejector.port_volume_ml * ML


def _true_volume(rig: Rig) -> float:
    hose = math.pi / 4.0 * rig.line.line_diameter**2 * rig.line.line_length
    return _vessel(rig) * ML + hose + rig.ejector.head_volume


def truths(met: Met, scale: float) -> dict[str, float]:
    """True values of parameters that rig and model share, in the model's units.

    Pressures are as the sensor reads them. Flows scale with the configured volume, which is a rough
    value, so they are multiplied by ``scale``: configured over true volume.
    """
    rig = met.rig
    fed = _as_fed(rig)
    opening = rig.ejector.check_opening if rig.ejector.has_check_valve else 0.0
    end = _end_pressure(fed) + opening
    parameters = {
        "ejector.suction_capacity_sl_min": scale * _capacity(fed) / SL_MIN,
        "ejector.end_pressure_mbar": _as_read(met, end) / MBAR,
    }
    if not rig.vessel.porous:
        parameters["system.leak_sl_min"] = scale * rig.vessel.leak / SL_MIN
    return parameters


def _as_fed(rig: Rig) -> Rig:
    """The rig with the supply pressure at its nozzle, behind regulator and suction valve."""
    surroundings, supply = rig.surroundings, rig.supply
    ambient, t = surroundings.ambient_pressure, surroundings.ambient_temperature
    low, high = 0.0, supply.supply_gauge
    for _ in range(40):
        middle = 0.5 * (low + high)
        fed = replace(rig, supply=replace(supply, supply_gauge=middle))
        flow = _primary(fed)
        sag = supply.supply_droop * flow + supply.supply_resistance * flow**2
        before = ambient + supply.supply_gauge - sag
        valve_flow = orifice.py_func(
            supply.valve_conductance, CRITICAL_VALVE, before, ambient + middle, t
        )
        low, high = (middle, high) if valve_flow > flow else (low, middle)
    return fed


def _capacity(rig: Rig) -> float:
    """Flow (kg/s) into the port at ambient pressure, through the check valve if there is one."""
    ambient, t = rig.surroundings.ambient_pressure, rig.surroundings.ambient_temperature
    if not rig.ejector.has_check_valve:
        return _sucked(rig, ambient)
    low, high = 0.7 * ambient, ambient
    for _ in range(30):
        middle = 0.5 * (low + high)
        valve_flow = orifice.py_func(
            rig.ejector.check_conductance, CRITICAL_VALVE, ambient, middle, t
        )
        low, high = (middle, high) if valve_flow > _sucked(rig, middle) else (low, middle)
    return _sucked(rig, low)


def _sucked(rig: Rig, pressure: float) -> float:
    """Suction flow (kg/s) at a chamber pressure (Pa), with the back pressure that it causes."""
    flow, extra = 0.0, 0.0
    for _ in range(10):
        flow = faults.sucked_at(rig, pressure, extra)
        extra = rig.ejector.silencer * ((_primary(rig) + flow) ** 2 - _primary(rig) ** 2)
    return flow


def _primary(rig: Rig) -> float:
    """Flow (kg/s) through the nozzle."""
    surroundings = rig.surroundings
    pressure = surroundings.ambient_pressure + rig.supply.supply_gauge
    flow = nozzle_flow.py_func(
        rig.ejector.nozzle_area,
        pressure,
        surroundings.ambient_pressure,
        surroundings.ambient_temperature,
    )
    return float(flow)


def _end_pressure(rig: Rig) -> float:
    """Chamber pressure (Pa) at which the suction flow ends."""
    low, high = 0.0, rig.surroundings.ambient_pressure
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if faults.sucked_at(rig, middle, 0.0) > 0.0 else (middle, high)
    return low


def _as_read(met: Met, pressure: float) -> float:
    """The twin's reading of a pressure (Pa), with sensor errors and the configured ambient."""
    sensor, true = met.rig.sensor, met.rig.surroundings.ambient_pressure
    zero = met.person.config.data.ambient.pressure_mbar * MBAR if sensor.gauge else true
    return zero - ((true - pressure) * (1.0 + sensor.gain_error) - sensor.offset)


def with_unit(met: Met, case: Case) -> Met | None:
    """The rig with the unit that its commissioning stored; None if it stored nothing."""
    if case.answer is None or case.verdict not in STORED:
        return None
    config = met.person.config
    monitor = config.monitor.model_copy(update={"healthy": Healthy(**case.answer["healthy"])})
    data = DataSet.model_validate(case.answer["data"])
    return replace(met, unit=replace(config, data=data, monitor=monitor))


# --- what is hidden -------------------------------------------------------------------------------


def cases(met: Met) -> Iterator[tuple[str, int, list[Hidden]]]:
    """Kind, number and hidden effects of each record of a rig after its commissioning."""
    seed, rig = met.seed, met.rig
    yield "healthy", 0, []
    listed = [effect for effect in SIZES if applies(rig, effect)]
    outside = [effect for effect in OUTSIDE if applies(rig, effect)]
    for number in range(SINGLES):
        rng = np.random.default_rng([seed, 11, number])
        effect = listed[(seed * SINGLES + number) % len(listed)]
        course = str(rng.choice(list(COURSES), p=list(COURSES.values())))
        yield "single", number, [Hidden(effect, course, draw_size(rng, rig, effect))]
    for number in range(PAIRS):
        rng = np.random.default_rng([seed, 12, number])
        effects = [str(effect) for effect in rng.choice(listed, 2, replace=False)]
        yield (
            "pair",
            number,
            [
                Hidden(effect, "constant", draw_size(rng, rig, effect, LONG_WAY))
                for effect in effects
            ],
        )
    for number in range(UNLISTED):
        rng = np.random.default_rng([seed, 13, number])
        effect = outside[(seed * UNLISTED + number) % len(outside)]
        yield "unlisted", number, [Hidden(effect, "constant", draw_size(rng, rig, effect))]


def applies(rig: Rig, effect: str) -> bool:
    """Whether a rig has what an effect acts on."""
    if effect in OF_AIR_SAVING:
        return bool(rig.air_saving.air_saving)
    if effect == "leaking_flap":
        return rig.ejector.stages == 2
    return effect not in OF_CUPS or bool(rig.vessel.released or rig.vessel.cup_volume)


def draw_size(rng: np.random.Generator, rig: Rig, effect: str, least: float = 0.0) -> float:
    """A drawn size of an effect on a rig; ``least`` is the share of its range to start from."""
    sizes = (SIZES | OUTSIDE)[effect]
    low, high = math.log(sizes.low), math.log(sizes.high)
    size = math.exp(rng.uniform(low + least * (high - low), high)) * sizes.of(rig)
    size = min(size, MOST.get(effect, size))
    down = sizes.signed < 0 or (sizes.signed == 0 and rng.random() < 0.5)
    return -size if down else size


def fault(hidden: Hidden, rng: np.random.Generator, seconds: float) -> Fault:
    """The second world's fault for an effect hidden in a record of this many seconds."""
    name = next(iter(faults.EVERYTHING[hidden.effect]))
    sizes = {name: hidden.size}
    if hidden.course == "step":
        return Fault(hidden.effect, sizes, "step", seconds * rng.uniform(0.35, 0.65))
    if hidden.course == "ramp":
        rate = abs(hidden.size) * 3600.0 / seconds
        return Fault(hidden.effect, sizes, "ramp", 0.0, rate)
    if hidden.course == "intermittent":
        return Fault(hidden.effect, sizes, "intermittent", share=rng.uniform(0.35, 0.65))
    return Fault(hidden.effect, sizes)


def stepped(
    met: Met, hidden: Hidden, seed: int, cycles: tuple[int, int], rng: np.random.Generator
) -> Record:
    """A record of healthy cycles, then cycles with a fault that begins anywhere within a cycle.

    ``cycles`` counts both.
    """
    before, after = cycles
    plan = plan_cycles(met.rig, seed, before + after)
    onset_ms = rng.uniform(plan[before].suction_on, plan[before].end)
    name = next(iter(faults.EVERYTHING[hidden.effect]))
    begun = Fault(hidden.effect, {name: hidden.size}, "step", onset_ms * MS)
    return record(met.rig, seed, before + after, [begun])


def diagnosed(met: Met, kind: str, number: int, hidden: Sequence[Hidden]) -> Case:
    """Diagnose one further record of a commissioned rig."""
    assert met.unit is not None
    unit, order = met.unit, ("healthy", "single", "pair", "unlisted").index(kind)
    seed = 1_000_000 + 1000 * met.seed + 10 * order + number
    clean = record(met.rig, seed, CYCLES)
    rng = np.random.default_rng([seed, 14])
    seconds = float(clean.time_ns[-1]) * 1e-9
    logged = record(met.rig, seed, CYCLES, [fault(effect, rng, seconds) for effect in hidden])
    samples = met.person.samples(logged)
    moved = float(np.sqrt(np.mean((logged.pressure_pa - clean.pressure_pa) ** 2))) / MBAR

    def answer() -> Mapping[str, Any]:
        return diagnose(unit, [samples], "battery", _quiet).json

    noise = unit.data.sensor.noise_mbar
    more: dict[str, Any] = {"moved_mbar": round(moved, 3), "noise_mbar": round(noise, 3)}
    if kind == "single":
        effect = hidden[0].effect
        more["of_volume"] = effect in OF_VOLUME
        more["comparable"] = effect in COMPARABLE | OF_VOLUME
    return _answered(kind, met, number, hidden, answer, more)


def _quiet(_what: str) -> None:
    """Ignore progress."""
