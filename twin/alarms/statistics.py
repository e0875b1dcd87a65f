"""Alarm load after EEMUA 191 and ISA-18.2: rate, floods, standing and chattering alarms.

The figures are for one operator, so they cover all ejectors that one person looks after.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from twin.alarms.board import SUPPRESSION, Episode
from twin.instants import DAY_NS, SECOND_NS, instant, lasting
from twin.languages.texts import numeral, tr

# Limits that ISA-18.2 (2016) recommends; those of EEMUA 191 (edition 3) are the same.
WINDOW_NS = 600 * SECOND_NS  # rates are per ten minutes
MANAGEABLE = 2.0  # average alarms in ten minutes that a person can manage at most
FLOOD = 10  # more alarms in ten minutes are a flood
STANDING_NS = DAY_NS  # an alarm active for longer counts as standing
CHATTERING, CHATTER_NS = 3, 60 * SECOND_NS  # raised so often within a minute
MOST = 10  # most frequent alarms to list

Known = tuple[str, str]  # ejector and alarm
Named = tuple[str, Episode]  # an episode with the name of its ejector


@dataclass(frozen=True)
class Statistics:
    """The figures of a period; ``average`` and ``peak`` are alarms in ten minutes."""

    days: float
    count: int
    average: float
    peak: int
    flood_share: float  # of the stretches of ten minutes
    standing: Sequence[tuple[Known, int]]  # with when it was raised (ns), the oldest first
    chattering: Sequence[tuple[Known, int]]  # with the most times within a minute
    top: Sequence[tuple[Known, int]]  # with how often it was raised


def statistics(episodes: Sequence[Named], since_ns: int, now_ns: int) -> Statistics:
    """The figures from ``since_ns`` to ``now_ns``; earlier episodes count if they still stand.

    Alarms suppressed by design are left out, since nobody was notified.
    """
    announced = [entry for entry in episodes if entry[1].acknowledged_by != SUPPRESSION]
    raised = [entry for entry in announced if since_ns <= entry[1].raised_ns <= now_ns]
    times = np.sort(np.array([entry.raised_ns for _, entry in raised], dtype=np.int64))
    span = now_ns - since_ns
    by_alarm: dict[Known, list[int]] = {}
    for name, episode in raised:
        by_alarm.setdefault((name, episode.alarm), []).append(episode.raised_ns)
    most_in_a_minute = {
        alarm: _most_within(np.sort(times_ns), CHATTER_NS) for alarm, times_ns in by_alarm.items()
    }
    return Statistics(
        days=span / DAY_NS,
        count=len(raised),
        average=len(raised) * WINDOW_NS / span,
        peak=_most_within(times, WINDOW_NS),
        flood_share=_flood_share(times, since_ns, now_ns),
        standing=sorted(_standing(announced, now_ns), key=lambda entry: entry[1]),
        chattering=_by_number(
            {alarm: count for alarm, count in most_in_a_minute.items() if count >= CHATTERING}
        ),
        top=_by_number({alarm: len(times_ns) for alarm, times_ns in by_alarm.items()})[:MOST],
    )


def _most_within(times: npt.NDArray[np.int64], span_ns: int) -> int:
    """The largest number of ``times`` (ascending, ns) within any span of ``span_ns``."""
    if not len(times):
        return 0
    ends = np.searchsorted(times, times + span_ns, side="left")
    return int((ends - np.arange(len(times))).max())


def _flood_share(times: npt.NDArray[np.int64], since_ns: int, now_ns: int) -> float:
    windows = max(1, -(-(now_ns - since_ns) // WINDOW_NS))
    counts = Counter(((times - since_ns) // WINDOW_NS).tolist())
    return sum(count > FLOOD for count in counts.values()) / windows


def _standing(announced: Sequence[Named], now_ns: int) -> Iterator[tuple[Known, int]]:
    for name, episode in announced:
        if episode.cleared_ns is None and now_ns - episode.raised_ns > STANDING_NS:
            yield (name, episode.alarm), episode.raised_ns


def _by_number(counts: dict[Known, int]) -> list[tuple[Known, int]]:
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))


def in_words(
    figures: Statistics, title: Callable[[Known], str], now_ns: int
) -> list[tuple[str, str]]:
    """Label and text of each figure, with what is good; ``title`` names an alarm."""
    average = tr(
        "{average} in 10 min ({count} in {time}); up to {limit} can be managed",
        average=numeral(figures.average, ".2g"),
        count=figures.count,
        time=lasting(86_400.0 * figures.days),
        limit=numeral(MANAGEABLE, "g"),
    )
    peak = tr("{peak} in 10 min; more than {limit} are a flood", peak=figures.peak, limit=FLOOD)
    flood = tr(
        "{share} % of the time; below 1 % is good", share=numeral(100 * figures.flood_share, ".2g")
    )
    lists = (
        (
            tr("standing for over 24 h"),
            [
                f"{title(alarm)} ({instant(raised_ns, now_ns)})"
                for alarm, raised_ns in figures.standing
            ],
        ),
        (
            tr("chattering: 3 times in a minute"),
            [f"{title(alarm)} ({count})" for alarm, count in figures.chattering],
        ),
        (
            tr("most frequent"),
            [
                f"{title(alarm)} ({100 * count / figures.count:.0f} %)"
                for alarm, count in figures.top
            ],
        ),
    )
    rates = [(tr("alarm rate"), average), (tr("highest rate"), peak), (tr("in a flood"), flood)]
    return [*rates, *((label, "; ".join(entries) or tr("none")) for label, entries in lists)]


def plain(figures: Statistics) -> dict[str, Any]:
    """The figures as a JSON document."""

    def as_rows(alarms: Sequence[tuple[Known, int]], key: str) -> list[dict[str, Any]]:
        return [{"unit": unit, "alarm": alarm, key: value} for (unit, alarm), value in alarms]

    return {
        "days": figures.days,
        "alarms": figures.count,
        "per_10_min": figures.average,
        "most_in_10_min": figures.peak,
        "flood_pct": 100.0 * figures.flood_share,
        "standing": as_rows(figures.standing, "raised_ns"),
        "chattering": as_rows(figures.chattering, "in_a_minute"),
        "most_frequent": as_rows(figures.top, "times"),
    }
