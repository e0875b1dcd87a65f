"""Rows of a log as bins of time, each with its lowest and highest values, so that no peak is lost.

Times are those of the run's clock, in ns, as alarms have them; pressures are vacuum in mbar.
"""

import math
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from twin.figures.database import SIDES
from twin.page.ring import Live
from twin.quality import BREAK, NEW_TIME, UNUSABLE
from twin.signals import MBAR, MOST_BRIDGED, Samples, Ticks

BIN = np.dtype(
    [
        ("first_ns", "<i8"),  # time of its first row
        ("last_ns", "<i8"),
        ("measured_low", "<f4"),  # NaN without a usable value
        ("measured_high", "<f4"),
        ("expected_low", "<f4"),
        ("expected_high", "<f4"),
        ("phase", "u1"),  # of its last row
        ("broken", "?"),  # rows are missing before its first row
    ]
)
MOST_LATE_NS = 1_000_000_000  # by which a row may have been received after it was measured
LONGEST_PAUSE_NS = 2_000_000_000  # between rows; a driver yields a block every half a second
_ENDS = {"low": np.fmin, "high": np.fmax}

Bins: TypeAlias = npt.NDArray[np.void]  # of BIN
_Times: TypeAlias = npt.NDArray[np.int64]


def no_bins() -> Bins:
    """An empty array of bins."""
    return np.empty(0, BIN)


def of_rows(samples: Samples, ticks: Ticks, ambient: float) -> Bins:
    """A bin for each of n > 0 rows of a log; ``ambient`` in Pa."""
    usable = (samples["quality"] & UNUSABLE) == 0
    bins = np.zeros(len(samples), BIN)
    measured = np.where(usable, samples["pressure"], np.float32(np.nan))
    for side, pressure in zip(SIDES, (measured, ticks["expected"]), strict=True):
        for end in _ENDS:
            bins[f"{side}_{end}"] = (ambient - pressure) / MBAR
    bins = _timed(bins, samples, ticks["phase"])
    bins["broken"][1:] |= np.diff(samples["sequence"]) > MOST_BRIDGED + 1  # also in damaged files
    return bins


def of_live(live: Live) -> Bins:
    """A bin for each live row."""
    bins = np.zeros(len(live.rows), BIN)
    for side in SIDES:
        for end, opposite in (("low", "high"), ("high", "low")):  # of vacuum, of pressure
            bins[f"{side}_{end}"] = (live.ambient - live.rows[f"{side}_{opposite}"]) / MBAR
    return _timed(bins, live.rows, live.rows["phase"]) if len(bins) else bins


def _timed(bins: Bins, rows: npt.NDArray[np.void], phase: npt.NDArray[np.uint8]) -> Bins:
    bins["first_ns"] = bins["last_ns"] = wall_time(rows)
    bins["phase"], bins["broken"] = phase, (rows["quality"] & BREAK) != 0
    return bins


def wall_time(rows: npt.NDArray[np.void]) -> _Times:
    """Time of measurement (ns, the run's clock) of each of n > 0 rows.

    Rows arrive in blocks, so their times of receipt have steps. PLC time has none; it is moved by
    the shortest delay that was seen since PLC time began anew.
    """
    delay = rows["host_ns"] - rows["time_ns"]
    begins = (rows["quality"] & NEW_TIME) != 0
    begins[0] = True
    starts = np.flatnonzero(begins)
    shortest = np.minimum.reduceat(delay, starts)[np.cumsum(begins) - 1]
    times: _Times = np.clip(
        rows["time_ns"] + shortest, rows["host_ns"] - MOST_LATE_NS, rows["host_ns"]
    )
    return times


def merged(bins: Bins, width_ns: int) -> Bins:
    """One bin for each period of ``width_ns`` with rows, in order of time."""
    if not len(bins):
        return bins
    if (np.diff(bins["first_ns"]) < 0).any():
        bins = bins[np.argsort(bins["first_ns"], kind="stable")]
    starts = np.flatnonzero(np.diff(bins["first_ns"] // width_ns, prepend=-1))
    result = bins[starts]
    result["last_ns"] = np.maximum.reduceat(bins["last_ns"], starts)
    for side in SIDES:
        for end, extreme in _ENDS.items():
            name = f"{side}_{end}"
            result[name] = extreme.reduceat(bins[name], starts)
    result["phase"] = bins["phase"][np.append(starts[1:], len(bins)) - 1]
    return result


def follows_gap(bins: Bins, width_ns: int) -> npt.NDArray[np.bool_]:
    """True for each bin, but the first one, before which there is a gap wider than ``width_ns``."""
    pause = bins["first_ns"][1:] - bins["last_ns"][:-1]
    missing = bins["broken"][1:] | (pause > LONGEST_PAUSE_NS)
    is_gap: npt.NDArray[np.bool_] = np.append(False, missing & (pause > width_ns))
    return is_gap[: len(bins)]


def json_numbers(values: Any) -> list[float | None]:
    """Numbers for JSON, to five digits; null if not finite."""
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in values.tolist()]
