"""Rows of a stream: the time between them, and subsampled rows for interpolation."""

import numpy as np

from twin.model.compiled import compiled
from twin.monitor.bins import Floats, Ints, drawn
from twin.quality import BREAK
from twin.signals import NS, Samples, Ticks


class TimeSteps:
    """Seconds from row to row of a stream, over its blocks; −1 at a break."""

    def __init__(self) -> None:
        self._last_ns: int | None = None

    def over(self, samples: Samples) -> Floats:
        """The steps of the next rows; the first row of the stream has 0."""
        dt = time_steps(samples, self._last_ns)
        if len(samples):
            self._last_ns = int(samples["time_ns"][-1])
        return dt


def elapsed(samples: Samples, before_ns: int | None = None) -> Floats:
    """Seconds from row to row by their times alone, breaks included; see ``time_steps``."""
    times = samples["time_ns"]
    seconds: Floats = np.diff(times, prepend=times[:1] if before_ns is None else before_ns) * NS
    return seconds


def time_steps(samples: Samples, before_ns: int | None = None) -> Floats:
    """Seconds from row to row, −1 at a break.

    ``before_ns`` is the PLC time of the row before; without one the first row has 0.
    """
    dt = np.empty(len(samples))
    if len(dt):
        _time_steps(samples, int(samples["time_ns"][0]) if before_ns is None else before_ns, dt)
    return dt


@compiled
def _time_steps(samples: Samples, before_ns: int, dt: Floats) -> None:
    for row in range(len(dt)):
        time_ns = samples[row].time_ns
        dt[row] = -1.0 if samples[row].quality & BREAK else (time_ns - before_ns) * NS
        before_ns = time_ns


def drawn_rows(samples: Samples, ticks: Ticks) -> Ints:
    """Subsampled rows for interpolation of the expected pressure, denser after each change."""
    begins = np.diff(ticks["phase"], prepend=255) != 0
    begins |= np.isfinite(ticks["level"])
    is_expected = np.isfinite(ticks["expected"])
    begins |= np.diff(is_expected, prepend=False) != 0
    return drawn(time_steps(samples), begins)
