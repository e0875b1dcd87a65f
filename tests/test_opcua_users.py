"""Who may come in over OPC UA: any letters, and not as often as one likes."""

import pytest

from drivers import opcua_security as module
from drivers.opcua_security import Users
from twin.throttle import FREE_TRIES, LoginThrottle


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(module, "LoginThrottle", lambda longest: LoginThrottle(longest, clock))
    return clock


def test_a_password_may_have_any_letter(clock: Clock) -> None:
    users = Users(None, {"änn": "Grüße", "bob": "plain"})
    for name, password in (("änn", "Grüße"), ("bob", "plain")):
        assert users.get_user(None, name, password) is not None
    for name, password in (("änn", "Grusse"), ("änn", "Grüsse"), ("bob", "pläin"), ("bob", None)):
        assert users.get_user(None, name, password) is None


def test_who_guesses_has_to_wait(clock: Clock) -> None:
    users = Users(None, {"ann": "right", "bob": "right"})
    for _ in range(FREE_TRIES):
        assert users.get_user(None, "ann", "wrong") is None
    assert users.get_user(None, "ann", "right") is None
    assert users.get_user(None, "bob", "right") is not None
    clock.now += module.LONGEST_S + 1.0
    assert users.get_user(None, "ann", "right") is not None
    assert users.get_user(None, "ann", "right") is not None  # nothing is held against her
