"""Tables for the tests of import and export."""

from pathlib import Path

import numpy as np

from twin.signals import Samples
from twin.tables.reader import open_table
from twin.tables.settings import ImportSettings

AMBIENT = 101_325.0  # Pa
MARK = ImportSettings(values="mark", jumps="mark", gaps="mark")
REFUSE = ImportSettings()

SMALL = """time_ms,suction,blow_off,pressure_mbar
0,0,0,1013.25
1,1,0,1000.5
2,1,0,900.25
3,0,1,1013
"""


def written(folder: Path, text: str | bytes, name: str = "t.csv") -> Path:
    """A file with this in it."""
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def taken(path: Path, settings: ImportSettings = REFUSE) -> Samples:
    """All samples of a table."""
    return np.concatenate(list(open_table(path, settings, AMBIENT).blocks()))
