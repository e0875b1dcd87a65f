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
    """Run; explain errors on stderr; return the exit code."""
    arguments = _arguments()
    try:
        settings = [Document.read(path).section(PlcSettings, "plc") for path in arguments.configs]
        faults = [parse_fault(text) for text in arguments.fault]
        on_port = [plc.on_port(arguments.port) for plc in settings]
        run_plc(on_port, faults, arguments.seed, arguments.duration, witness=arguments.witness)
    except TwinError as error:
        print(f"{error}\n{error.hint}", file=sys.stderr)  # noqa: T201
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
