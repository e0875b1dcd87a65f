"""Diagnose the same logs on one Dask worker and on two: how much faster, and whether alike.

    python tools/fleet_speed.py [--logs 40] [--first SEED]

Half of the logs of 12 cycles hide a fault. Each worker is warmed up with two logs of its own.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tools.dask_cluster import cluster
from tools.fleet_trial import TODAY, TWIN, hidden, record

ASKED = 1.8
COMMISSIONED = "commissioned.sqlite"  # the data sets of all units


def answers(logs: Sequence[Path], scheduler: str, folder: Path, name: str) -> tuple[Any, float]:
    """Answers of all logs, and the seconds that they took."""
    report = folder / f"{name}.json"
    answered = shutil.copy(folder / COMMISSIONED, folder / f"{name}.sqlite")
    database = ["--assets", str(answered), "--json", str(report)]
    on = ["--engine", "dask", "--scheduler", scheduler]
    begun = time.perf_counter()
    subprocess.run([*TWIN, "fleet", "diagnose", *map(str, logs), *database, *on], check=True)
    seconds = time.perf_counter() - begun
    return [log["answer"] for log in json.loads(report.read_text())["logs"]], seconds


def main() -> None:
    """Record, commission, diagnose on one and on two, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="seed")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        folder = Path(directory)
        units = arguments.logs + 4  # the last four warm up
        faults = hidden(units, units // 2, arguments.first)
        for unit in range(units):
            record(unit, faults, folder, arguments.first)
        healthy = sorted(folder.glob("*-000.mcap"))
        into = ["--assets", str(folder / COMMISSIONED)]
        subprocess.run([*TWIN, "fleet", "calibrate", *map(str, healthy), *into], check=True)
        every = sorted(folder.glob(f"*-{TODAY:03d}.mcap"))
        answers_by_workers, took = [], []
        for workers in (1, 2):
            with cluster(workers) as started:
                answers(every[-4:], started.address, folder, f"warm{workers}")
                result, seconds = answers(every[:-4], started.address, folder, f"on{workers}")
            answers_by_workers.append(result)
            took.append(seconds)
            print(f"{workers} of one thread: {seconds:.1f} s for {len(result)} logs", flush=True)
    are_equal, ratio = answers_by_workers[0] == answers_by_workers[1], took[0] / took[1]
    print(f"{ratio:.2f} times as fast, answers {'the same' if are_equal else 'NOT the same'}")
    sys.exit(not are_equal or ratio < ASKED)


if __name__ == "__main__":
    main()
