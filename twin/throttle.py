"""How often one may try a password."""

import time
from collections.abc import Callable

MOST = 1000  # who are remembered
FREE_TRIES = 5


class LoginThrottle:
    """Slows down who guesses: after some wrong ones each takes twice as long as the one before."""

    def __init__(self, longest_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._longest_s, self._clock = longest_s, clock
        self._wrong: dict[str, tuple[int, float]] = {}  # how many, and when the next one may be

    def wait_s(self, who: str) -> float:
        """How long somebody has to wait until he may try."""
        _, then = self._wrong.get(who, (0, 0.0))
        return max(0.0, then - self._clock())

    def wrong(self, who: str) -> None:
        """He was wrong."""
        count = self._wrong.pop(who, (0, 0.0))[0] + 1
        pause = min(2.0 ** min(count - FREE_TRIES, 20), self._longest_s)
        then = self._clock() + (pause if count >= FREE_TRIES else 0.0)
        self._wrong[who] = (count, then)
        if len(self._wrong) > MOST:
            del self._wrong[next(iter(self._wrong))]

    def right(self, who: str) -> None:
        """He was right: nothing is held against him."""
        self._wrong.pop(who, None)
