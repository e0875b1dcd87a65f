"""Record a simulated fleet with a few hidden faults, and see whether the report lists them first.

    python tools/fleet_trial.py FOLDER [--units 500] [--faults 12] [--first SEED]

Every unit has a rig of its own and two logs: one when it was new, one of today; in a few of today's
a fault is hidden, with effect and size drawn by seed. Asked again it goes on where it was ended.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from drivers.plc.faults import parse_fault
from tools.battery_first import ON_GRIPPER, SIGNED, SIZES
from tools.calibration_coverage import SYSTEMS, drawn, recorded, rig_of, shipped
from twin.config import Config
from twin.live import Twin
from twin.log.header import LogHeader
from twin.log.recorder import Recorder
from twin.signals import MBAR, Samples

CYCLES = 12
LISTED, FOUND = 15, 11  # rows of the report, and how many of twelve faults must be in them
DAY_NS = 86_400 * 10**9
NEW_NS = 1_767_225_600 * 10**9  # 2026-01-01
TODAY = 120  # days later
TWIN = [sys.executable, "-c", "from twin.cli.main import main; main()"]


def hidden(units: int, faults: int, seed: int) -> Mapping[int, str]:
    """Faults by unit, drawn by seed."""
    rng = np.random.default_rng([2027, seed])
    faults_by_unit = {}
    for unit in rng.choice(units, faults, replace=False).tolist():
        effect = str(rng.choice(list(SIZES)))
        low, high = SIZES[effect]
        if _system(unit) == "gripper":
            low, high = ON_GRIPPER.get(effect, (low, high))
        size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        sign = float(rng.choice([-1.0, 1.0])) if effect in SIGNED else 1.0
        faults_by_unit[unit] = f"{effect}={sign * size:.4g}"
    return faults_by_unit


def record(unit: int, faults: Mapping[int, str], folder: Path, seed: int) -> None:
    """Record both logs of a unit with the twin of its type; existing ones are kept."""
    document = shipped(_system(unit))
    config = Config.of(document, unit=_id(unit), own=_id(unit))  # nothing is known of it yet
    plc = drawn(rig_of(document), 10_000 * (1 + seed) + unit)
    for day, fault in ((0, None), (TODAY, faults.get(unit))):
        path = folder / f"{_id(unit)}-{day:03d}.mcap"
        if path.exists():
            continue
        hides = [] if fault is None else [parse_fault(fault)]
        samples = recorded(plc, CYCLES, 1_000_000 * seed + 1_000 * unit + day, hides)
        samples["host_ns"] += NEW_NS + day * DAY_NS - samples["host_ns"][0]
        part = path.with_suffix(".part")
        part.unlink(missing_ok=True)
        write_log(part, config, samples)
        part.rename(path)


def write_log(path: Path, config: Config, samples: Samples) -> None:
    """Write a log of rows with the twin of a configuration."""
    header = LogHeader(
        config.asset.type,
        config.asset.id,
        Path(config.document.name).name,
        config.document.text,
        {"data": config.data.model_dump_json()},
        config.data.ambient.pressure_mbar * MBAR,
    )
    recorder, twin = Recorder(path, header), Twin.of(config.data)
    for rows, ticks in twin.over([samples]):
        recorder.write(rows, ticks)
    recorder.close()


def _system(unit: int) -> str:
    return SYSTEMS[unit % len(SYSTEMS)]


def _id(unit: int) -> str:
    return f"U{unit:04d}"


def main() -> None:
    """Record the fleet, make its report, and print the ranks of the faults."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--units", type=int, default=500)
    parser.add_argument("--faults", type=int, default=12)
    parser.add_argument("--first", type=int, default=0, help="seed")
    arguments = parser.parse_args()
    logs, database = arguments.folder / "logs", arguments.folder / "fleet.sqlite"
    logs.mkdir(parents=True, exist_ok=True)
    faults = hidden(arguments.units, arguments.faults, arguments.first)
    work = partial(record, faults=faults, folder=logs, seed=arguments.first)
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as workers:
        for done, _ in enumerate(workers.map(work, range(arguments.units)), 1):
            print(
                f"\r{done} of {arguments.units} units recorded", end="", file=sys.stderr, flush=True
            )
    answer, page = arguments.folder / "report.json", arguments.folder / "report.html"
    files = ["--json", str(answer), "--report", str(page)]
    command = [*TWIN, "fleet", "report", str(logs), "--assets", str(database), *files]
    subprocess.run(command, check=True)
    rank = {entry["id"]: entry["rank"] for entry in json.loads(answer.read_text())["units"]}
    for unit, fault in sorted(faults.items(), key=lambda entry: rank[_id(entry[0])]):
        print(f"{rank[_id(unit)]:>4}  {_id(unit)}  {_system(unit):<9} {fault}")
    first = sum(rank[_id(unit)] <= LISTED for unit in faults)
    print(f"{first} of {len(faults)} in the first {LISTED} rows")
    sys.exit(first < FOUND * len(faults) / 12)


if __name__ == "__main__":
    main()
