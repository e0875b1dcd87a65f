"""Units of both worlds with a mechanism hidden, and how each is recorded under other conditions."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from drivers.plc.settings import PlcSettings
from tools import battery_first, battery_second
from tools.battery_cases import CaseFile, Hidden
from tools.battery_first import OUTSIDE, SYSTEMS, draw_size
from tools.battery_second import CADENCES, Fault, Met, Rig, record
from tools.calibration_coverage import recorded
from twin.config import Config
from twin.model.dataset import DataSet
from twin.signals import BAR, Samples

CYCLES = 12  # of the log that is diagnosed
JUDGED = 8  # of each log that the extended model is judged on
UNITS = 2  # calibrated units of each system of the first world


@dataclass(frozen=True)
class Change:
    """How another log differs from the one that is diagnosed."""

    suction: float = 1.0  # times the duration
    supply_bar: float = 0.0  # added to the operating pressure
    volume: float = 1.0  # times the vessel's


CHANGES = {
    "same": Change(),
    "suction × 2": Change(suction=2.0),
    "suction × 0.5": Change(suction=0.5),
    "supply + 1 bar": Change(supply_bar=1.0),
    "supply − 1 bar": Change(supply_bar=-1.0),
    "volume + 30 %": Change(volume=1.3),
    "volume − 30 %": Change(volume=0.7),
}


@dataclass(frozen=True)
class Subject:
    """A unit, and what is hidden in it."""

    name: str
    config: Config
    hidden: Hidden
    samples: Samples  # of the log that is diagnosed
    record: Callable[[Change, bool], Samples]  # another log, with the hidden mechanism or without


def changed_config(config: Config, change: Change) -> Config:
    """The configuration as a person who makes this change on the rig would change it."""
    supply_bar = config.data.supply.pressure_bar + change.supply_bar
    tables = config.data.at_supply(supply_bar).model_dump()
    end = tables["system"]["parts"][-1]
    end["volume_ml"] *= change.volume
    if end["wall_area_cm2"] is not None:
        end["wall_area_cm2"] *= change.volume ** (2 / 3)
    return replace(config, data=DataSet.model_validate(tables))


# --- the first world ------------------------------------------------------------------------------


def changed_plc(plc: PlcSettings, change: Change) -> PlcSettings:
    """The rig behind the simulated PLC, changed."""
    suction_ms = change.suction * plc.program.suction_ms
    supply_bar = plc.ejector.supply_bar + change.supply_bar
    size = {
        "vessel_ml": change.volume * plc.rig.vessel_ml,
        "vessel_area_m2": change.volume ** (2 / 3) * plc.rig.vessel_area_m2,
    }
    return plc.model_copy(
        update={
            "program": plc.program.model_copy(update={"suction_ms": suction_ms}),
            "ejector": plc.ejector.model_copy(update={"supply_bar": supply_bar}),
            "rig": plc.rig.model_copy(update=size),
        }
    )


def first(seed: int) -> Subject:
    """A calibrated unit of the first world: mechanisms take turns, unit and size are drawn."""
    rng = np.random.default_rng([2026, 27, seed])
    name = SYSTEMS[int(rng.integers(len(SYSTEMS)))]
    unit = battery_first.unit(name, int(rng.integers(UNITS)))
    effect = list(OUTSIDE)[seed % len(OUTSIDE)]
    hidden = Hidden(effect, "constant", draw_size(rng, name, effect))
    fault = battery_first.fault(rng, unit.plc, hidden)
    samples = recorded(unit.plc, CYCLES - 1, int(rng.integers(1 << 30)), [fault])

    def log(change: Change, present: bool) -> Samples:
        plc, number = changed_plc(unit.plc, change), list(CHANGES.values()).index(change)
        return recorded(plc, JUDGED, 100 * seed + 2 * number + present, [fault] * present)

    return Subject(name, unit.config, hidden, samples, log)


# --- the second world -----------------------------------------------------------------------------


def changed_rig(rig: Rig, change: Change) -> Rig:
    """A rig of the second world, changed."""
    vessel = rig.vessel
    more = (change.volume - 1.0) * (vessel.rigid_volume + vessel.cup_volume)
    return replace(
        rig,
        program=replace(rig.program, suction_s=change.suction * rig.program.suction_s),
        supply=replace(rig.supply, supply_gauge=rig.supply.supply_gauge + change.supply_bar * BAR),
        vessel=replace(
            vessel,
            rigid_volume=max(vessel.rigid_volume + more, 0.1 * vessel.rigid_volume),
            vessel_surface=change.volume ** (2 / 3) * vessel.vessel_surface,
        ),
    )


def second(seed: int, file: CaseFile) -> Subject | None:
    """A commissioned rig of the second world; None if it is not commissioned.

    The commissioning is read from the file if it is there, else stored.
    """
    drawn = battery_second.drawn(seed, CADENCES)
    assert drawn is not None
    name = battery_second.NAME
    answered = file.get(name, ("commissioning", seed, 0))
    commissioning = answered or file.add(name, battery_second.commissioned(drawn))
    met = battery_second.with_unit(drawn, commissioning)
    return None if met is None else _hidden(met)


def _hidden(met: Met) -> Subject:
    assert met.unit is not None
    (hidden,) = next(
        effects for kind, _, effects in battery_second.cases(met) if kind == "unlisted"
    )
    (size_name, *_) = battery_second.faults.OUTSIDE[hidden.effect]
    fault = Fault(hidden.effect, {size_name: hidden.size})

    def log(change: Change, present: bool) -> Samples:
        number = 1 + list(CHANGES.values()).index(change)
        seed = 2_000_000 + 100 * met.seed + 2 * number + present
        rig = changed_rig(met.rig, change)
        return met.person.samples(record(rig, seed, JUDGED + 1, [fault] * present))

    samples = met.person.samples(record(met.rig, 2_000_000 + 100 * met.seed, CYCLES, [fault]))
    return Subject(met.name, met.unit, hidden, samples, log)
