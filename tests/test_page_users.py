"""Who is logged in on the page: sessions that end, guesses that take ever longer."""

from pathlib import Path

import pytest
from user_files import quick_users

from twin.page import sessions as module
from twin.page.sessions import SESSION_S, Sessions
from twin.users import Role

ANN = ("ann", "correct horse", Role.LOOK)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_session_ends_with_its_time_its_user_or_a_new_password(tmp_path: Path) -> None:
    known, clock = quick_users(tmp_path / "users.toml", ANN), Clock()
    sessions = Sessions(known, clock)
    first = sessions.begin("ann")
    session = sessions.get(first)
    assert session is not None
    assert (session.user, sessions.get("other"), sessions.get(None)) == ("ann", None, None)
    clock.now = SESSION_S - 1
    assert sessions.get(first) is session
    clock.now = SESSION_S
    assert sessions.get(first) is None
    second = sessions.begin("ann")
    known.set_password("ann", "another horse")
    assert sessions.get(second) is None
    third = sessions.begin("ann")
    known.remove("ann")
    assert sessions.get(third) is None


def test_sessions_and_their_tokens_differ_and_do_not_pile_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST", 3)
    known = quick_users(tmp_path / "users.toml", ANN)
    sessions = Sessions(known)
    tokens = [sessions.begin("ann") for _ in range(5)]
    there = [sessions.get(token) for token in tokens]
    assert [session is None for session in there] == [True, True, False, False, False]
    assert len({session.csrf for session in there if session}) == 3
    sessions.end(tokens[-1])
    assert sessions.get(tokens[-1]) is None
