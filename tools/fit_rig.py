"""Calibrate the [data] tables of a configuration on healthy cycles of its own simulated rig.

    python tools/fit_rig.py configs/test_rig.toml

prints TOML: the data set of that rig and what its healthy cycles scatter, as `twin calibrate` finds
them. The shipped configurations were made with it; rerun it when the model's physics change. It
begins from the type's data: from what it found the last time it would drift a little further each
time along whatever the log does not determine.
"""

import sys
from dataclasses import replace
from pathlib import Path

import tomli_w
from calibration_coverage import as_type, rig_of
from rich.console import Console

from drivers.plc.simulate import blocks
from twin.calibration.calibrate import calibrate
from twin.settings import Document

SECONDS = 130.0  # some 40 cycles: enough to know their scatter
DIGITS = 4  # significant


def main() -> None:
    """Calibrate and print."""
    document = Document.read(Path(sys.argv[1]))
    config = replace(as_type(document), origin="its simulated rig")
    with Console(stderr=True).status("") as status:
        found = calibrate(
            config, blocks(rig_of(document), duration_s=SECONDS, seed=7), status.update
        )
    healthy = found.healthy.model_dump()
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
