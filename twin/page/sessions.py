"""The sessions of logged-in users."""

import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from twin.users import Users

SESSION_S = 12 * 3600.0  # a shift
MOST = 1000  # sessions


@dataclass(frozen=True)
class Session:
    """One browser with a logged-in user."""

    user: str
    proof: str  # the user's stored password hash at the login
    ends: float
    csrf: str = field(default_factory=lambda: secrets.token_urlsafe(32))


class Sessions:
    """All sessions, in memory: a restart ends them. ``clock`` returns seconds."""

    def __init__(self, users: Users, clock: Callable[[], float] = time.monotonic) -> None:
        self._users, self._clock = users, clock
        self._by_token: dict[str, Session] = {}

    def begin(self, user: str) -> str:
        """Begin a session; returns the token for its cookie."""
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
        """End the session of a token."""
        self._by_token.pop(token or "", None)

    def _forget(self) -> None:
        """Delete ended sessions, and the oldest if there are too many."""
        now = self._clock()
        active = {token: session for token, session in self._by_token.items() if now < session.ends}
        self._by_token = dict(list(active.items())[-(MOST - 1) :])
