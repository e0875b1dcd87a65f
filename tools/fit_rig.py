"""Calibrate the [data] tables of a configuration on healthy cycles of its own simulated rig.

    python tools/fit_rig.py configs/test_rig.toml

prints TOML: the data set of that rig and what its healthy cycles scatter, as `twin calibrate` finds
them. The shipped configurations were made with it; rerun it when the model's physics change.
"""

import sys
from dataclasses import replace
from pathlib import Path

import tomli_w
from rich.console import Console

from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from twin.calibration.calibrate import calibrate
from twin.config import Config
from twin.settings import Document

SECONDS = 130.0  # some 40 cycles: enough to know their scatter
DIGITS = 4  # significant


def main() -> None:
    """Calibrate and print."""
    document = Document.read(Path(sys.argv[1]))
    config = replace(Config.of(document), origin="its simulated rig")
    rig = document.section(PlcSettings, "plc")
    with Console(stderr=True).status("") as status:
        found = calibrate(config, blocks(rig, duration_s=SECONDS, seed=7), status.update)
    healthy = {name: one.model_dump() for name, one in found.healthy.items()}
    data = found.fitted.data.model_dump(exclude_none=True)
    print(tomli_w.dumps({"data": _rounded(data), "monitor": {"healthy": _rounded(healthy)}}))


def _rounded(value: object) -> object:
    if isinstance(value, dict):
        return {key: _rounded(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(one) for one in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


if __name__ == "__main__":
    main()
