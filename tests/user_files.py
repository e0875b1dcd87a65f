"""Files of users whose passwords are quickly checked, and a clock for who has to wait."""

from functools import partial
from pathlib import Path

import pytest
from argon2 import PasswordHasher

from twin import login
from twin.audit import Audit
from twin.login import Authenticator
from twin.throttle import LoginThrottle
from twin.users import Role, Users

CHEAP = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)


def quick_users(path: Path, *added: tuple[str, str, Role]) -> Users:
    """The users of a file, with some added: name, password and role."""
    users = Users(path, CHEAP)
    for name, password, role in added:
        users.add(name, password, role)
    return users


def authenticator_of(users: Users) -> Authenticator:
    """As the page has it; an audit trail that cannot be written fails the test."""
    return Authenticator(users, Audit(users.path.parent, "page", pytest.fail))


class Clock:
    """Says what it is set to (s)."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def throttled_by(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock of all throttles that are made from now on."""
    clock = Clock()
    monkeypatch.setattr(login, "LoginThrottle", partial(LoginThrottle, clock=clock))
    return clock
