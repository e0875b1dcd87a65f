"""Draw a trend as ``twin figures trend --picture`` does: three weeks in which a leak grows.

    python tools/trend_picture.py PICTURE.png

The cycles are drawn by seed, not simulated: shifts on working days, a machine that warms up, and
now and then a part that is gripped badly.
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from twin.assets.unit import Unit
from twin.figures.database import open_store
from twin.figures.key_figures import FIGURES
from twin.figures.picture import draw
from twin.figures.settings import FigureSettings, limits
from twin.figures.text import in_words, trend_of_figure
from twin.instants import DAY_NS
from twin.model.dataset import DataSet
from twin.monitor.settings import MonitorSettings

UNIT = Unit("compact-ejector-35", "gripper-01")
WORKING_DAYS = (0, 1, 2, 3, 4, 7, 8, 9, 10, 11, 14, 15, 16, 17, 18)
SHIFT = 0.6  # of a day
CYCLES = 60  # of a shift that are kept
HEALTHY, GROWTH, SCATTER = 74.0, 7.0, 8.0  # mbar/s; growth a day
WARMING_UP, BADLY_GRIPPED = 12.0, 150.0  # mbar/s


def main(picture: Path) -> None:
    """Store the cycles, judge their trend and draw it."""
    figure = FIGURES["leakage"]
    with open_store("sqlite://") as store:
        store.add(UNIT, "drawn", "trend_picture", list(cycles()))
        history = store.history(UNIT)
    known_limits = limits(FigureSettings(), DataSet(), MonitorSettings())
    trend = trend_of_figure(history, figure, known_limits)
    draw(history, figure, trend, in_words(figure, trend, int(history.host_ns[-1])), picture)


def cycles() -> Iterator[dict[str, Any]]:
    """Cycles of three weeks, up to now, with a leakage that grows."""
    rng = np.random.default_rng(1)
    begin_ns = time.time_ns() - round((WORKING_DAYS[-1] + SHIFT) * DAY_NS)
    for day in WORKING_DAYS:
        for part in np.linspace(0.0, 1.0, CYCLES):
            days = day + SHIFT * part
            leakage = HEALTHY + GROWTH * days + rng.normal(0.0, SCATTER)
            leakage += WARMING_UP * np.exp(-5.0 * part) + BADLY_GRIPPED * (rng.random() < 0.02)
            ns = begin_ns + round(days * DAY_NS)
            times = {"cycle": day * CYCLES, "begin_ns": ns, "host_ns": ns, "warnings": []}
            yield {**times, "leakage_measured": leakage, "leakage_expected": HEALTHY}


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
