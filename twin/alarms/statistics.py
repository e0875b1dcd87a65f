"""How many alarms people get, after EEMUA 191 and ISA-18.2: rate, floods, standing, chattering.

The figures are those of one operator, so they are of all ejectors that one person looks after.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from twin.alarms.board import SUPPRESSION, Episode
from twin.instants import SECOND_NS, instant
from twin.language import tr

DAY_NS = 86_400 * SECOND_NS
# Limits as ISA-18.2 (2016) recommends them, which EEMUA 191 (edition 3) has alike.
WINDOW_NS = 600 * SECOND_NS  # the ten minutes that rates are given for
MANAGEABLE = 2.0  # alarms in ten minutes on the average: the most that a person can manage
FLOOD = 10  # more alarms in ten minutes are a flood
STANDING_NS = DAY_NS  # active for longer: it stands, and nobody looks at it any more
CHATTERING, CHATTER_NS = 3, 60 * SECOND_NS  # so many times within a minute
MOST = 10  # of the most frequent

Known = tuple[str, str]  # ejector and alarm
Named = tuple[str, Episode]  # an episode with the name of its ejector


@dataclass(frozen=True)
class Statistics:
    """The figures of some time; an ``average`` and ``peak`` are alarms in ten minutes."""

    days: float
    count: int
    average: float
    peak: int
    flood_share: float  # of the stretches of ten minutes
    standing: Sequence[tuple[Known, int]]  # with when it was raised (ns), the oldest first
    chattering: Sequence[tuple[Known, int]]  # with the most times within a minute
    top: Sequence[tuple[Known, int]]  # with how often it was raised


def statistics(episodes: Sequence[Named], since_ns: int, now_ns: int) -> Statistics:
    """The figures from ``since_ns`` to ``now_ns``; episodes from before count where they stand yet.

    What was suppressed by design was announced to nobody, and is left out.
    """
    told = [one for one in episodes if one[1].acknowledged_by != SUPPRESSION]
    raised = [one for one in told if since_ns <= one[1].raised_ns <= now_ns]
    times = np.sort(np.array([one.raised_ns for _, one in raised], dtype=np.int64))
    span = now_ns - since_ns
    by_alarm: dict[Known, list[int]] = {}
    for name, episode in raised:
        by_alarm.setdefault((name, episode.alarm), []).append(episode.raised_ns)
    often = {known: _most_within(np.sort(at), CHATTER_NS) for known, at in by_alarm.items()}
    return Statistics(
        days=span / DAY_NS,
        count=len(raised),
        average=len(raised) * WINDOW_NS / span,
        peak=_most_within(times, WINDOW_NS),
        flood_share=_flood_share(times, since_ns, now_ns),
        standing=sorted(_standing(told, now_ns), key=lambda one: one[1]),
        chattering=_by_number({known: n for known, n in often.items() if n >= CHATTERING}),
        top=_by_number({known: len(at) for known, at in by_alarm.items()})[:MOST],
    )


def _most_within(times: npt.NDArray[np.int64], span_ns: int) -> int:
    """The most of some times (ascending, ns) that lie within a span."""
    if not len(times):
        return 0
    ends = np.searchsorted(times, times + span_ns, side="left")
    return int((ends - np.arange(len(times))).max())


def _flood_share(times: npt.NDArray[np.int64], since_ns: int, now_ns: int) -> float:
    windows = max(1, -(-(now_ns - since_ns) // WINDOW_NS))
    counts = Counter(((times - since_ns) // WINDOW_NS).tolist())
    return sum(count > FLOOD for count in counts.values()) / windows


def _standing(told: Sequence[Named], now_ns: int) -> Iterator[tuple[Known, int]]:
    for name, episode in told:
        if episode.cleared_ns is None and now_ns - episode.raised_ns > STANDING_NS:
            yield (name, episode.alarm), episode.raised_ns


def _by_number(counts: dict[Known, int]) -> list[tuple[Known, int]]:
    return sorted(counts.items(), key=lambda one: (-one[1], one[0]))


def in_words(
    found: Statistics, title: Callable[[Known], str], now_ns: int
) -> list[tuple[str, str]]:
    """What each figure is, and its value with what is good; ``title`` names an alarm."""
    average = tr(
        "{average} in 10 min ({count} in {days} days); up to {limit} can be managed",
        average=f"{found.average:.2g}",
        count=found.count,
        days=f"{found.days:.3g}",
        limit=f"{MANAGEABLE:g}",
    )
    peak = tr("{peak} in 10 min; more than {limit} are a flood", peak=found.peak, limit=FLOOD)
    flood = tr("{share} % of the time; below 1 % is good", share=f"{100 * found.flood_share:.2g}")
    lists = (
        (
            tr("standing for over 24 h"),
            [f"{title(one)} ({instant(at, now_ns)})" for one, at in found.standing],
        ),
        (
            tr("chattering: 3 times in a minute"),
            [f"{title(one)} ({count})" for one, count in found.chattering],
        ),
        (
            tr("most frequent"),
            [f"{title(one)} ({100 * count / found.count:.0f} %)" for one, count in found.top],
        ),
    )
    figures = [(tr("alarm rate"), average), (tr("highest rate"), peak), (tr("in a flood"), flood)]
    return [*figures, *((what, "; ".join(said) or tr("none")) for what, said in lists)]


def plain(found: Statistics) -> dict[str, Any]:
    """The same as JSON has it."""

    def each(listed: Sequence[tuple[Known, int]], what: str) -> list[dict[str, Any]]:
        return [{"unit": unit, "alarm": alarm, what: value} for (unit, alarm), value in listed]

    return {
        "days": found.days,
        "alarms": found.count,
        "per_10_min": found.average,
        "most_in_10_min": found.peak,
        "flood_pct": 100.0 * found.flood_share,
        "standing": each(found.standing, "raised_ns"),
        "chattering": each(found.chattering, "in_a_minute"),
        "most_frequent": each(found.top, "times"),
    }
