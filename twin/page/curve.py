"""The curve of an ejector for any range of time, small enough for a browser.

It consists of the unit's logs, and of live rows that are later than these.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from twin.figures.database import SIDES
from twin.page import ring
from twin.page.bins import Bins, follows_gap, json_numbers, merged, of_live
from twin.page.log_folders import remembered
from twin.page.recorded import RecordedRows
from twin.page.settings import RING

MOST_COLUMNS = 1000  # each with a lowest and a highest value
COARSEST_READ_NS = 1 << 29  # wide columns are made of bins of about half a second, which are kept
MOST_PHASES = 400  # more of them are too narrow to be seen
MOST_GAPS = 400

Interval = tuple[int, int]  # ns


@dataclass(frozen=True)
class Curve:
    """The columns of a curve, and its coverage by logs."""

    columns: Bins
    width_ns: int
    phases: list[tuple[int, int, int]] | None  # begin, end, phase; None if there are too many
    gaps: list[Interval]
    share: float  # of the logs that has been read; below 1 another request reads more
    damaged: int  # stretches of logs that cannot be read
    logged: bool  # whether there are logs at all


class Curves:
    """Makes the curves of one unit from the data that its runs have stored in ``folder``."""

    def __init__(self, folder: Path, unit: tuple[str, str]) -> None:
        self._folder = folder
        self._recorded = RecordedRows(lambda: remembered(folder), unit)

    @property
    def logged(self) -> bool:
        """Whether any run has stored the folder of its logs."""
        return bool(remembered(self._folder))

    def read(self, from_ns: int, to_ns: int, now_ns: int) -> Curve:
        """The curve of a range of time; time after ``now_ns`` is no gap."""
        width_ns = column_width(to_ns - from_ns)
        recorded = self._recorded.read(from_ns, to_ns, min(width_ns, COARSEST_READ_NS))
        bins = self._with_live(recorded.bins, from_ns, to_ns)
        columns = merged(bins, width_ns)
        return Curve(
            columns,
            width_ns,
            _phases(bins, width_ns),
            _gaps(columns, width_ns, from_ns, min(to_ns, now_ns)) if recorded.share == 1.0 else [],
            recorded.share,
            recorded.damaged,
            logged=self.logged,
        )

    def _with_live(self, bins: Bins, from_ns: int, to_ns: int) -> Bins:
        """Bins of logs with the live rows that are later."""
        live = ring.read(self._folder / RING)
        if live is None:
            return bins
        rows = of_live(live)
        logged_ns = max(int(bins["last_ns"][-1]), from_ns) if len(bins) else from_ns
        return np.concatenate(
            [bins, rows[(rows["first_ns"] > logged_ns) & (rows["first_ns"] <= to_ns)]]
        )


def column_width(span_ns: int) -> int:
    """A power of two (ns), so that neighbouring ranges and zooms have the same columns."""
    return 1 << max(0, math.ceil(math.log2(max(span_ns, 1) / MOST_COLUMNS)))


def _phases(bins: Bins, width_ns: int) -> list[tuple[int, int, int]] | None:
    """Each phase, from its first row to the first row of the next one or to a gap."""
    if not len(bins):
        return []
    is_gap = follows_gap(bins, max(width_ns, COARSEST_READ_NS // 2))
    is_other = np.diff(bins["phase"], prepend=bins["phase"][:1]) != 0
    starts = np.flatnonzero(is_other | is_gap)
    starts = np.unique(np.append(0, starts))
    if len(starts) > MOST_PHASES:
        return None
    ends = np.append(starts[1:], len(bins)) - 1
    begin_ns, last_ns = bins["first_ns"][starts], bins["last_ns"][ends]
    until_ns = np.append(np.where(is_gap[starts[1:]], last_ns[:-1], begin_ns[1:]), last_ns[-1])
    return list(
        zip(begin_ns.tolist(), until_ns.tolist(), bins["phase"][starts].tolist(), strict=True)
    )


def _gaps(columns: Bins, width_ns: int, from_ns: int, to_ns: int) -> list[Interval]:
    """Intervals without records, also at both ends; only the widest ones if there are too many."""
    after = np.flatnonzero(follows_gap(columns, width_ns))
    begins, ends = columns["last_ns"][after - 1], columns["first_ns"][after]
    gaps = list(zip(begins.tolist(), ends.tolist(), strict=True))
    first, last = (
        (columns["first_ns"][0], columns["last_ns"][-1]) if len(columns) else (to_ns, to_ns)
    )
    least = max(2 * width_ns, ring.ROW_NS * 80)
    edges = [(from_ns, int(first)), (int(last), to_ns)]
    gaps += [(begin, end) for begin, end in edges if end - begin > least]
    gaps.sort(key=lambda gap: gap[0] - gap[1])
    return sorted(gaps[:MOST_GAPS])


def document_of(curve: Curve) -> dict[str, Any]:
    """The curve for JSON: vacuum in mbar, times as Unix seconds; null where rows are missing."""
    columns = curve.columns
    after = np.flatnonzero(follows_gap(columns, curve.width_ns))
    breaks = np.zeros(len(after), columns.dtype)
    breaks["last_ns"] = columns["first_ns"][after] - 1_000_000
    for side in SIDES:
        for name in (f"{side}_low", f"{side}_high"):
            breaks[name] = np.nan
    columns = np.insert(columns, after, breaks)
    values = {
        f"{side}_{end}": json_numbers(columns[f"{side}_{end}"])
        for side in SIDES
        for end in ("low", "high")
    }
    return {
        "time": _seconds(columns["last_ns"]),
        **values,
        "phases": curve.phases
        and [[begin / 1e9, end / 1e9, phase] for begin, end, phase in curve.phases],
        "gaps": [[begin / 1e9, end / 1e9] for begin, end in curve.gaps],
        "share": round(curve.share, 3),
        "damaged": curve.damaged,
        "logged": curve.logged,
    }


def _seconds(times_ns: Any) -> list[float]:
    seconds: list[float] = (times_ns / 1e9).round(4).tolist()
    return seconds
