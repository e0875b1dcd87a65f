"""How often one may try a password."""

import time
from collections.abc import Callable
from dataclasses import dataclass

MOST = 1000  # who are remembered
FREE_TRIES = 5


@dataclass
class _Wrong:
    """The wrong passwords of somebody."""

    count: int = 0
    then: float = 0.0  # when the next one may be
    is_told: bool = False  # that it was tried before that


class LoginThrottle:
    """Slows down who guesses: after some wrong ones each takes twice as long as the one before."""

    def __init__(self, longest_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._longest_s, self._clock = longest_s, clock
        self._wrong: dict[str, _Wrong] = {}

    def wait_s(self, who: str) -> float:
        """How long somebody has to wait until he may try."""
        return max(0.0, self._wrong.get(who, _Wrong()).then - self._clock())

    def is_news(self, who: str) -> bool:
        """Whether somebody has to wait and has not asked for it since the last wrong one."""
        if self.wait_s(who) <= 0.0 or self._wrong[who].is_told:
            return False
        self._wrong[who].is_told = True
        return True

    def wrong(self, who: str) -> None:
        """He was wrong."""
        count = self._wrong.pop(who, _Wrong()).count + 1
        pause = min(2.0 ** min(count - FREE_TRIES, 20), self._longest_s)
        then = self._clock() + (pause if count >= FREE_TRIES else 0.0)
        self._wrong[who] = _Wrong(count, then)
        if len(self._wrong) > MOST:
            del self._wrong[next(iter(self._wrong))]

    def right(self, who: str) -> None:
        """He was right: nothing is held against him."""
        self._wrong.pop(who, None)
