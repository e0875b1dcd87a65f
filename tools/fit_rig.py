"""Calibrate the unit of a shipped configuration on healthy cycles of its own simulated rig.

    python tools/fit_rig.py configs/test_rig.toml

writes its file in `twin/assets/units`: its data set and what its healthy cycles scatter, as
`twin calibrate` finds them. Rerun it when the model's physics change. It begins from the type's
data: from what it found the last time it would drift a little further each time along whatever
the log does not determine.
"""

import re
import sys
from pathlib import Path
from typing import Any

import tomli_w
from calibration_coverage import as_type, rig_of
from rich.console import Console

from drivers.plc.simulate import blocks
from twin.calibration.calibrate import calibrate
from twin.settings import Document

SECONDS = 130.0  # some 40 cycles: enough to know their scatter
DIGITS = 4  # significant
UNITS = Path(__file__).parent.parent / "twin" / "assets" / "units"
HEAD = """\
# A simulated unit, for trials, tests and the demo: instance-specific data.
# Made by: python tools/fit_rig.py {path}
"""


def main() -> None:
    """Calibrate and write."""
    path = Path(sys.argv[1])
    document = Document.read(path)
    config = as_type(document)
    with Console(stderr=True).status("") as status:
        calibration = calibrate(
            config, blocks(rig_of(document), duration_s=SECONDS, seed=7), status.update
        )
    unit = document.tables["asset"]
    tables = {
        "kind": "instance",
        "name": unit["id"],
        "type": unit["type"],
        "note": f"as the simulated PLC of configs/{path.name} has it",
        "data": _rounded(calibration.fitted.data.model_dump(exclude_none=True)),
        "healthy": _rounded(calibration.healthy.model_dump()),
    }
    file = UNITS / f"{unit['id']}.toml"
    text = HEAD.format(path=f"configs/{path.name}") + _rows_in_lines(tomli_w.dumps(tables))
    file.write_text(text, encoding="utf-8")
    print(f"written: {file}")


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(item) for item in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def _rows_in_lines(text: str) -> str:
    """Put the numbers of a list on one line, so that a matrix has a line for each row."""
    return re.sub(
        r"= \[\n([-\d.,\se]+)\]", lambda row: f"= [{' '.join(row[1].split()).rstrip(',')}]", text
    )


if __name__ == "__main__":
    main()
