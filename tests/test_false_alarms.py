"""The rate of false alarms is judged against the one that is set, too many and too few."""

import pytest

from tools.false_alarms import Rate, is_as_set, table


def rates(times: float) -> list[Rate]:
    """Three paths with as many times the wanted number in all."""
    shares = {"sums over cycles": 0.9, "single cycles": 0.05, "limits of key figures": 0.05}
    return [Rate(what, share, times, times, times, "") for what, share in shares.items()]


@pytest.mark.parametrize(
    ("times", "kept"), [(0.0, False), (0.52, False), (0.68, True), (1.49, True), (1.6, False)]
)
def test_too_few_false_alarms_are_not_the_rate_that_is_set(times: float, kept: bool) -> None:
    assert is_as_set(rates(times)) is kept
    assert (": kept." in table(rates(times), 1000)) is kept
