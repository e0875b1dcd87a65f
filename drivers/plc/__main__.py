"""``python -m drivers.plc CONFIG...``: the simulated PLC in a process of its own."""

import argparse
import sys
from pathlib import Path

from drivers.plc.faults import parse_fault
from drivers.plc.live import run_plc
from drivers.plc.settings import PlcSettings
from twin.errors import TwinError
from twin.settings import Document


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m drivers.plc", description=__doc__)
    parser.add_argument("configs", type=Path, nargs="+", metavar="config", help="one per ejector")
    parser.add_argument("--fault", action="append", default=[], help="leakage=1.9@10/ramp:30")
    parser.add_argument("--port", type=int, help="instead of the configured one; 0 takes any free")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--duration", type=float, help="s; without it until interrupted")
    parser.add_argument("--witness", type=Path, help="keep every scan in this file")
    return parser.parse_intermixed_args()


def main() -> int:
    """Run, and explain on stderr what is wrong; gives the exit code."""
    given = _arguments()
    try:
        settings = [Document.read(one).section(PlcSettings, "plc") for one in given.configs]
        faults = [parse_fault(text) for text in given.fault]
        on_port = [one.on_port(given.port) for one in settings]
        run_plc(on_port, faults, given.seed, given.duration, witness=given.witness)
    except TwinError as error:
        print(f"{error}\n{error.hint}", file=sys.stderr)  # noqa: T201
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
