"""Write a record and its truth: python -m second_world.export --seed 7 --kind gripper -o FOLDER.

Run it from tests/. It writes SEED-KIND.csv or .parquet, and SEED-KIND.json: the rig (SI units),
the faults, the cycles, the nozzle's strokes, and what a person at the rig could read off.
"""

import argparse
import dataclasses
import json
from pathlib import Path

from second_world.draw import KINDS, draw_rig
from second_world.faults import EVERYTHING, Fault
from second_world.records import Record, record, write_csv, write_parquet

WRITERS = {"csv": write_csv, "parquet": write_parquet}


def truth_of(rec: Record) -> dict[str, object]:
    """What is hidden from the reader of a record, without the traces of each ms."""
    truth = rec.truth
    return {
        "rig": dataclasses.asdict(truth.rig),
        "faults": [dataclasses.asdict(fault) for fault in truth.faults],
        "affected_cycles": truth.affected_cycles,
        "cycles_ms": [dataclasses.asdict(cycle) for cycle in truth.cycles],
        "nozzle_s": truth.nozzle_s.tolist(),
        "nozzle_on": truth.nozzle_on.tolist(),
        "supply_gauge_pa": truth.supply_gauge.tolist(),
        "leak_scale": truth.leak_scale.tolist(),
        "ambient_pressure_pa": truth.ambient_pressure.tolist(),
        "readable": truth.readable,
    }


def _fault(text: str) -> Fault:
    """Read EFFECT=SIZE or EFFECT=SIZE@ONSET; the size is that of the effect's first parameter."""
    effect, _, size = text.partition("=")
    size, _, onset = size.partition("@")
    if effect not in EVERYTHING:
        raise argparse.ArgumentTypeError(f"no effect is called {effect!r}")
    name = next(iter(EVERYTHING[effect]))
    if not onset:
        return Fault(effect, {name: float(size)})
    return Fault(effect, {name: float(size)}, "step", float(onset))


def main(arguments: list[str] | None = None) -> None:
    """Write one record."""
    parser = argparse.ArgumentParser(prog="second_world.export", description=__doc__)
    parser.add_argument("--seed", type=int, required=True, help="of the rig and of its record")
    parser.add_argument("--kind", choices=KINDS, help="drawn too if it is not given")
    parser.add_argument("--cycles", type=int, default=12)
    parser.add_argument(
        "--fault", type=_fault, action="append", default=[], metavar="NAME=SIZE[@S]"
    )
    parser.add_argument("--format", choices=WRITERS, default="csv")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    options = parser.parse_args(arguments)
    rec = record(draw_rig(options.seed, options.kind), options.seed, options.cycles, options.fault)
    options.output.mkdir(parents=True, exist_ok=True)
    stem = options.output / f"{options.seed}-{rec.truth.rig.kind}"
    WRITERS[options.format](rec, stem.with_suffix(f".{options.format}"))
    stem.with_suffix(".json").write_text(json.dumps(truth_of(rec), indent=1) + "\n")


if __name__ == "__main__":
    main()
