"""Write the trace exports for the tutorial: one of a healthy unit, one with something wrong in it.

    python tools/tutorial_data.py [FOLDER] [--seed SEED] [--fault FAULT]

Unit, effect, size and onset are drawn by seed. What was hidden is said only with --tell. With
--fault the unit is the shipped one, and only its export with that fault is written.
"""

import argparse
from pathlib import Path

import numpy as np

from drivers.plc.faults import parse_fault
from tools.calibration_coverage import drawn, recorded, rig_of, shipped
from twin.signals import BAR, MBAR, NS, Command, Samples

CELL = Path(__file__).parents[1] / "configs" / "test_rig.toml"
CYCLES = 8
AMBIENT = 1013.0  # mbar, as in configs/test_rig.toml
# Clear sizes of what may be hidden, in the unit of the effect's parameter.
SIZES = {
    "leakage": (1.5, 4.0),
    "filter_clogging": (60.0, 150.0),
    "added_volume": (80.0, 200.0),
    "weak_blow_off": (20.0, 50.0),
    "response_delay": (15.0, 40.0),
}


def write_data(folder: Path, seed: int) -> str:
    """Write ``healthy.csv`` and ``today.csv``; gives the cause hidden in the second."""
    rng = np.random.default_rng(seed)
    plc = drawn(rig_of(shipped("test_rig")), seed)
    effect = str(rng.choice(list(SIZES)))
    hidden = f"{effect}={rng.uniform(*SIZES[effect]):.3g}@{rng.uniform(9.0, 15.0):.1f}"
    write_csv(folder / "healthy.csv", recorded(plc, CYCLES, 2 * seed))
    write_csv(folder / "today.csv", recorded(plc, CYCLES, 2 * seed + 1, [parse_fault(hidden)]))
    return hidden


def write_cell(folder: Path, unit: str, cycles: int, seed: int = 11, fault: str = "") -> None:
    """Write the ``cell.toml`` of a unit, its ``healthy.csv`` and, with ``fault``, ``today.csv``."""
    folder.mkdir(exist_ok=True)
    text = CELL.read_text(encoding="utf-8").replace('"rig-01"', f'"{unit}"')
    (folder / "cell.toml").write_text(text, encoding="utf-8")
    plc = drawn(rig_of(shipped("test_rig")), seed)
    write_csv(folder / "healthy.csv", recorded(plc, cycles, 2 * seed))
    if fault:
        faulty = recorded(plc, cycles, 2 * seed + 1, [parse_fault(fault)])
        write_csv(folder / "today.csv", faulty)


def write_csv(path: Path, samples: Samples) -> None:
    """Write samples as a PLC tool exports a trace."""
    since = (samples["time_ns"] - samples["time_ns"][0]) * NS
    columns = {
        "time_s": (since, "%.3f"),
        "suction": ((samples["commands"] & Command.SUCTION) != 0, "%d"),
        "blow_off": ((samples["commands"] & Command.BLOW_OFF) != 0, "%d"),
        "vacuum_mbar": (AMBIENT - samples["pressure"].astype(float) / MBAR, "%.2f"),
        "supply_bar": (samples["supply"].astype(float) / BAR, "%.3f"),
    }
    table = np.column_stack([column for column, _ in columns.values()])
    formats = [form for _, form in columns.values()]
    np.savetxt(path, table, formats, ",", header=",".join(columns), comments="")


def main() -> None:
    """Write the files and print their paths."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path())
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--tell", action="store_true", help="say what is hidden")
    parser.add_argument("--fault", help="a fault of the shipped unit, such as leakage=2")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    if arguments.fault:
        faults = [parse_fault(arguments.fault)]
        plc = rig_of(shipped("test_rig"))
        write_csv(arguments.folder / "today.csv", recorded(plc, CYCLES, arguments.seed, faults))
        print(f"today.csv is in {arguments.folder.resolve()}")
        return
    hidden = write_data(arguments.folder, arguments.seed)
    print(f"healthy.csv and today.csv are in {arguments.folder.resolve()}")
    if arguments.tell:
        print(hidden)


if __name__ == "__main__":
    main()
