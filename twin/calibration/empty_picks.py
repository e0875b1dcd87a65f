"""Suctions of a record in which cups met no part: they are of no twin, and are left out.

An open cup draws a little vacuum only. Such a cycle differs from the others by most of the vacuum,
so a few of them would hide all that a fit leaves, and later all that a fault changes.
"""

import numpy as np

from twin.calibration.readings import Stretch, stretches
from twin.model.dataset import DataSet
from twin.model.parts import Cups
from twin.monitor.cycles import OPEN_CUPS, now_and_then
from twin.quality import UNUSABLE
from twin.signals import Command, Samples

FEWEST = 3  # suctions, to know what is usual


def without_empty_picks(data: DataSet, samples: Samples) -> tuple[Samples, int]:
    """``samples`` without cycles in which no part was met now and then, and how many these were.

    Before and after such a cycle the cups are open, so the rows after it follow on those before.
    """
    suctions = [
        stretch for stretch in stretches(samples["commands"]) if stretch.command == Command.SUCTION
    ]
    if not any(isinstance(part, Cups) for part in data.system.parts) or len(suctions) < FEWEST:
        return samples, 0
    empty = now_and_then(_empty(samples, suctions), len(suctions))
    if not empty:
        return samples, 0
    ends = [*(suction.first for suction in suctions[1:]), len(samples)]
    joined = samples.copy()
    kept = np.ones(len(samples), np.bool_)
    for number in empty:
        first, end = suctions[number].first, ends[number]
        kept[first:end] = False
        for clock in ("time_ns", "sequence") if end < len(samples) else ():
            joined[clock][end:] -= samples[clock][end] - samples[clock][first]
    return joined[kept], len(empty)


def _empty(samples: Samples, suctions: list[Stretch]) -> list[int]:
    """Numbers of the suctions that stay far above the pressure of others after the same time."""
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(samples["pressure"])
    pressure = np.where(usable, samples["pressure"].astype(np.float64), np.inf)
    ambient = float(np.median([pressure[suction.first] for suction in suctions]))
    rows = np.array([suction.last - suction.first for suction in suctions])
    usual_rows = int(np.median(rows))
    lowest = [np.minimum.accumulate(pressure[suction.first : suction.last]) for suction in suctions]

    def is_empty(number: int) -> bool:
        last = min(int(rows[number]), usual_rows) - 1
        others = [curve[last] for curve in lowest if len(curve) > last]
        return bool(ambient - lowest[number][-1] < OPEN_CUPS * (ambient - np.median(others)))

    return [number for number in range(len(suctions)) if is_empty(number)]
