"""Instants in words: clock time and age, the same everywhere."""

import time
from collections.abc import Iterator

import pytest

from twin.instants import SECOND_NS, age, clock, dated, instant, lasting, stamp, zone

NOW = 1_790_000_000 * SECOND_NS  # 2026-09-21 14:13:20 UTC
MINUTE, HOUR, DAY = 60 * SECOND_NS, 3600 * SECOND_NS, 86_400 * SECOND_NS


@pytest.mark.parametrize(
    ("ns", "said"),
    [
        (NOW, "14:13:20, 0 s ago"),
        (NOW - 30 * SECOND_NS, "14:12:50, 30 s ago"),
        (NOW - 8 * MINUTE, "14:05:20, 8 min ago"),
        (NOW - 5 * HOUR, "09:13:20, 5 h ago"),
        (NOW - 15 * HOUR, "2026-09-20 23:13:20, 15 h ago"),
        (NOW - 40 * DAY, "2026-08-12 14:13:20, 40 days ago"),
        (NOW + 20 * MINUTE, "14:33:20, in 20 min"),
    ],
)
def test_clock_time_and_age(ns: int, said: str) -> None:
    assert instant(ns, NOW) == said
    assert said == f"{clock(ns, NOW)}, {age(ns, NOW)}"


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0.4, "0 s"),
        (119.4, "119 s"),
        (119.6, "2 min"),
        (7169.0, "119 min"),
        (7170.0, "2 h"),
        (170_000.0, "47 h"),
        (172_000.0, "2 days"),
    ],
)
def test_how_long(seconds: float, said: str) -> None:
    assert lasting(seconds) == said


def test_before_a_line_and_for_what_is_kept() -> None:
    assert stamp(NOW + 45_600_000) == "14:13:20.045"
    assert dated(NOW) == "2026-09-21 14:13:20"


@pytest.fixture
def kolkata(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "Asia/Kolkata")
        time.tzset()
        yield
    time.tzset()


@pytest.mark.usefixtures("kolkata")
def test_the_zone_is_this_computers() -> None:
    assert zone(NOW) == 19_800
    assert instant(NOW, NOW) == "19:43:20, 0 s ago"
    assert instant(NOW - 20 * HOUR, NOW).startswith("2026-09-20 23:43:20")
