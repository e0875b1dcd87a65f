"""Who is logged in, and how often one may try to be."""

import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from twin.page.users import Users

SESSION_S = 12 * 3600.0  # a shift
MOST = 1000  # sessions, and addresses that are remembered
FREE_TRIES = 5


@dataclass(frozen=True)
class Session:
    """One browser that somebody has logged in with."""

    user: str
    proof: str  # what was stored of the user then
    ends: float
    csrf: str = field(default_factory=lambda: secrets.token_urlsafe(32))


class Sessions:
    """The sessions there are, in memory: a restart ends them all. ``clock`` gives seconds."""

    def __init__(self, users: Users, clock: Callable[[], float] = time.monotonic) -> None:
        self._users, self._clock = users, clock
        self._by_token: dict[str, Session] = {}

    def begin(self, user: str) -> str:
        """Begin one; gives the token that its cookie carries."""
        self._forget()
        token = secrets.token_urlsafe(32)
        ends = self._clock() + SESSION_S
        self._by_token[token] = Session(user, self._users.proof(user), ends)
        return token

    def get(self, token: str | None) -> Session | None:
        """The session of a token; None if it has ended, or its user is gone or has changed."""
        session = self._by_token.get(token or "")
        if session is None or token is None:
            return None
        if self._clock() < session.ends and self._users.proof(session.user) == session.proof:
            return session
        self.end(token)
        return None

    def end(self, token: str | None) -> None:
        """Log out."""
        self._by_token.pop(token or "", None)

    def _forget(self) -> None:
        """Those that are over, and the oldest where there are too many."""
        now = self._clock()
        left = {token: one for token, one in self._by_token.items() if now < one.ends}
        self._by_token = dict(list(left.items())[-(MOST - 1) :])


class Tries:
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
