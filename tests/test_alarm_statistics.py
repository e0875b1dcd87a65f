"""Statistics of alarms: rates, floods, what stands, chatters, and comes most often."""

import pytest

from twin.alarms.board import SUPPRESSION, Episode
from twin.alarms.statistics import WINDOW_NS, Named, in_words, plain, statistics
from twin.instants import DAY_NS

S = 1_000_000_000
BEGIN = 1_790_000_000 * S
END = BEGIN + 10 * DAY_NS


def raised(name: str, alarm: str, *seconds: float, lasting: float | None = 1.0) -> list[Named]:
    begun = [BEGIN + round(second * S) for second in seconds]
    over = [None if lasting is None else begin_ns + round(lasting * S) for begin_ns in begun]
    return [
        (name, Episode(alarm, at, end, raised_as=alarm))
        for at, end in zip(begun, over, strict=True)
    ]


def test_rates_are_of_all_ejectors_together() -> None:
    spread = raised("a", "x", *(3600.0 * hour for hour in range(120)))
    burst = raised("b", "y", *(100.0 + 50.0 * n for n in range(12)))
    found = statistics([*spread, *burst], BEGIN, END)
    assert (found.count, found.days) == (132, 10.0)
    assert found.average == pytest.approx(132 / 1440)
    assert found.peak == 12  # in any ten minutes
    assert found.flood_share == pytest.approx(1 / 1440)  # eleven and the one at 0 s, by the clock
    assert found.top == [(("a", "x"), 120), (("b", "y"), 12)]


def test_three_times_in_a_minute_is_chattering_and_two_are_not() -> None:
    chatters = raised("a", "x", 0.0, 20.0, 59.0, 4000.0)
    slow = raised("a", "y", 0.0, 30.0, 61.0)
    found = statistics([*chatters, *slow], BEGIN, END)
    assert found.chattering == [(("a", "x"), 3)]


def test_what_is_active_for_over_a_day_stands_also_from_before() -> None:
    before = raised("b", "old", -5.0 * 86_400.0, lasting=None)
    long, short = (raised("a", "x", 86_400.0 * day, lasting=None) for day in (2.0, 9.5))
    over = raised("a", "over", 0.0, lasting=5.0 * 86_400.0)
    found = statistics([*short, *long, *before, *over], BEGIN, END)
    assert [known for known, _ in found.standing] == [("b", "old"), ("a", "x")]
    assert found.count == 3  # the one from before was raised before


def test_what_nobody_was_told_of_counts_for_nothing() -> None:
    ((name, one),) = raised("a", "x", 5.0)
    quiet = Episode("x", one.raised_ns, one.cleared_ns, one.cleared_ns, SUPPRESSION)
    assert statistics([(name, quiet)], BEGIN, END).count == 0


def test_only_the_ten_most_frequent_are_named() -> None:
    many = [
        episode
        for n in range(12)
        for episode in raised("a", f"x{n:02}", *range(0, 600 * (n + 1), 600))
    ]
    top = statistics(many, BEGIN, END).top
    assert [alarm for (_, alarm), _ in top] == [f"x{n:02}" for n in range(11, 1, -1)]


def test_a_flood_is_more_than_ten() -> None:
    ten = raised("a", "x", *range(10))
    assert statistics(ten, BEGIN, BEGIN + WINDOW_NS).flood_share == 0.0
    eleven = [*ten, *raised("a", "x", 11.0)]
    assert statistics(eleven, BEGIN, BEGIN + WINDOW_NS).flood_share == 1.0


def test_words_and_json_have_all_of_it() -> None:
    empty = dict(in_words(statistics([], BEGIN, END), " ".join, END))
    assert empty["alarm rate"] == "0 in 10 min (0 in 10 days); up to 2 can be managed"
    assert empty["most frequent"] == empty["standing for over 24 h"] == "none"
    found = statistics(
        [*raised("a", "x", 0.0, 20.0, 30.0), *raised("a", "y", 50.0, lasting=None)], BEGIN, END
    )
    said = dict(in_words(found, ": ".join, END))
    assert said["most frequent"] == "a: x (75 %); a: y (25 %)"
    assert said["chattering: 3 times in a minute"] == "a: x (3)"
    assert said["standing for over 24 h"].startswith("a: y (")
    json = plain(found)
    assert json["most_frequent"][0] == {"unit": "a", "alarm": "x", "times": 3}
    assert json["chattering"] == [{"unit": "a", "alarm": "x", "in_a_minute": 3}]
    assert (json["alarms"], json["most_in_10_min"], json["flood_pct"]) == (4, 4, 0.0)
