"""Calibrate many simulated rigs and count how often a 95 % interval holds the true value.

    python tools/calibration_coverage.py [--rigs 40] [--first 0] [--cycles 8]

Every rig has true parameters of its own, drawn by seed; the twin begins from the type's data. Rigs
alternate between the shipped configurations. Compared is what means the same in rig and model.
"""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from drivers.plc.faults import Fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from twin.calibration.fit import Fitted, fit
from twin.calibration.parameters import Space
from twin.config import Config
from twin.settings import Document
from twin.signals import MS, Samples

CONFIGS = Path(__file__).parent.parent / "configs"
SYSTEMS = ("test_rig", "gripper")
TRUE: Mapping[str, Callable[[PlcSettings], float]] = {
    "ejector.suction_capacity_sl_min": lambda plc: plc.ejector.suction_capacity_sl_min,
    "ejector.end_pressure_mbar": lambda plc: plc.ejector.end_pressure_mbar,
    "ejector.response_ms": lambda plc: plc.valves.suction_on_ms,
    "ejector.blow_off_sl_min": lambda plc: plc.ejector.blow_off_sl_min,
    "ejector.blow_off_response_ms": lambda plc: plc.valves.blow_off_on_ms,
    "system.film_coefficient": lambda plc: plc.rig.vessel_film,
    "system.leak_sl_min": lambda plc: plc.rig.seal_leak_sl_min,
}


def shipped(name: str) -> Document:
    """A shipped configuration."""
    return Document.read(CONFIGS / f"{name}.toml")


def as_type(document: Document) -> Config:
    """A configuration with the system as built, and of the ejector only its type's data."""
    return Config.of(document, calibrated=False)


def rig_of(document: Document) -> PlcSettings:
    """The simulated PLC of a configuration."""
    return document.section(PlcSettings, "plc")


def drawn(plc: PlcSettings, seed: int) -> PlcSettings:
    """Another unit on another day: true parameters drawn about those of ``plc``."""
    draw = np.random.default_rng([2026, seed]).uniform
    tables = plc.model_dump()
    tables["ejector"]["suction_capacity_sl_min"] *= draw(0.9, 1.1)
    tables["ejector"]["end_pressure_mbar"] += draw(-20.0, 20.0)
    tables["ejector"]["bulge"] *= draw(0.75, 1.25)
    tables["ejector"]["second_stage"] *= draw(0.7, 1.3)
    tables["ejector"]["blow_off_sl_min"] *= draw(0.8, 1.2)
    tables["ejector"]["build_up_ms"] = draw(4.0, 9.0)
    tables["valves"]["suction_on_ms"] = draw(8.0, 18.0)
    tables["valves"]["suction_off_ms"] = draw(6.0, 13.0)
    tables["valves"]["blow_off_on_ms"] = draw(7.0, 16.0)
    tables["valves"]["blow_off_off_ms"] = draw(6.0, 13.0)
    tables["sensor"]["lag_ms"] = draw(1.0, 2.0)
    tables["rig"]["vessel_film"] = draw(6.0, 15.0)
    tables["rig"]["seal_leak_sl_min"] = draw(0.1, 0.6)
    return PlcSettings.model_validate(tables)


def recorded(plc: PlcSettings, cycles: int, seed: int, faults: Sequence[Fault] = ()) -> Samples:
    """Samples with ``cycles`` that count: without the first one and the one cut at the end."""
    program = plc.program.model_copy(update={"start_ms": 500.0})
    cycle = program.suction_ms + program.blow_off_ms + program.idle_ms
    seconds = (program.start_ms + (cycles + 1.2) * cycle) * MS
    plc = plc.model_copy(update={"program": program})
    return np.concatenate(list(blocks(plc, seconds, faults, seed)))


def misses(fitted: Fitted, plc: PlcSettings) -> dict[str, float]:
    """Errors of comparable values, in their standard deviations."""
    by_name = {}
    for name, true in TRUE.items():
        low, high = fitted.interval(name)
        by_name[name] = ((low + high) / 2.0 - true(plc)) / ((high - low) / 2.0 / 1.96)
    return by_name


def main() -> None:
    """Calibrate and print a line for each rig, then the table for the record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rigs", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="seed of the first rig")
    parser.add_argument("--cycles", type=int, default=8)
    arguments = parser.parse_args()
    documents = {name: shipped(name) for name in SYSTEMS}
    types = {name: as_type(document).data for name, document in documents.items()}
    misses_by_system: dict[str, list[dict[str, float]]] = {name: [] for name in SYSTEMS}
    for seed in range(arguments.first, arguments.first + arguments.rigs):
        name = SYSTEMS[seed % len(SYSTEMS)]
        plc = drawn(rig_of(documents[name]), seed)
        begin = time.perf_counter()
        fitted = fit(
            recorded(plc, arguments.cycles, seed), Space.of_type(types[name]), lambda _what: None
        )
        misses_by_system[name].append(misses(fitted, plc))
        numbers = " ".join(f"{sigmas:6.2f}" for sigmas in misses_by_system[name][-1].values())
        print(f"{name:<10}{seed:>4}  {numbers}  {time.perf_counter() - begin:.0f} s", flush=True)
    _print_table(misses_by_system)


def _print_table(misses_by_system: Mapping[str, list[dict[str, float]]]) -> None:
    print(
        f"\n{'holds the truth within 95 %':<34}"
        + "".join(f"{name:>12}" for name in misses_by_system)
    )
    for name in TRUE:
        held_values = (
            np.abs([inside[name] for inside in rigs]) <= 1.96 for rigs in misses_by_system.values()
        )
        print(f"{name:<34}" + "".join(f"{inside.sum():>7}/{inside.size}" for inside in held_values))


if __name__ == "__main__":
    main()
