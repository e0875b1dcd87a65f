"""To log in: the role of a user, the wait of who guesses, and what the trail says of both."""

import unicodedata
from collections.abc import Callable
from pathlib import Path

import pytest
from user_files import CHEAP, Clock, authenticator_of, quick_users, throttled_by

from twin.audit import records
from twin.errors import ConfigError
from twin.login import ADDRESS_S, NAME_S, Authenticator, Login
from twin.throttle import FREE_TRIES
from twin.users import Role, Users

WORD = "correct horse"
HERE, THERE = "192.0.2.7", "2001:db8::1"


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return throttled_by(monkeypatch)


@pytest.fixture
def door(tmp_path: Path, clock: Clock) -> Authenticator:
    known = ("ann", WORD, Role.ACKNOWLEDGE), ("Jörg", WORD, Role.LOOK)
    return authenticator_of(quick_users(tmp_path / "users.toml", *known))


def acts(folder: Path) -> list[tuple[str, str, str]]:
    return [(entry["what"], entry["who"], entry["from"]) for entry in records(folder)[0]]


def _wrong(door: Authenticator, count: int, name: str, address: str) -> None:
    for _ in range(count):
        assert door.log_in(name, "wrong horse", address).role is None


def test_who_is_let_in_and_who_is_not(door: Authenticator, tmp_path: Path) -> None:
    assert door.log_in(" ann ", WORD, HERE) == Login("ann", Role.ACKNOWLEDGE)
    assert door.log_in("ann", "wrong horse", HERE) == Login("ann", None)
    assert door.log_in("bob", WORD, THERE) == Login("bob", None)
    assert acts(tmp_path) == [
        ("logged_in", "ann", HERE),
        ("wrong_password", "ann", HERE),
        ("wrong_password", "bob", THERE),
    ]


def test_a_name_has_to_wait_wherever_it_is_tried(door: Authenticator, clock: Clock) -> None:
    for number in range(FREE_TRIES):
        _wrong(door, 1, "ann", f"192.0.2.{number}")
    assert door.log_in("ann", WORD, THERE) == Login("ann", None, 1.0)
    assert door.log_in("Jörg", WORD, THERE).role is Role.LOOK
    clock.now += 1.0
    assert door.log_in("ann", WORD, THERE).role is Role.ACKNOWLEDGE


def test_an_address_has_to_wait_whatever_name_it_tries(door: Authenticator) -> None:
    for number in range(FREE_TRIES):
        _wrong(door, 1, f"guess{number}", HERE)
    assert door.log_in("ann", WORD, HERE) == Login("ann", None, 1.0)
    assert door.log_in("ann", WORD, THERE).role is Role.ACKNOWLEDGE


def test_what_was_wrong_on_one_way_in_counts_on_the_other(door: Authenticator) -> None:
    """As the page and each results server have the same users."""
    other = authenticator_of(Users(door.users.path, CHEAP))
    for number, way in enumerate([door, other] * 3):
        if number < FREE_TRIES:
            _wrong(way, 1, "ann", f"192.0.2.{number}")
    assert door.log_in("ann", WORD, THERE).wait_s == 1.0
    assert other.log_in("ann", WORD, THERE).wait_s == 1.0


@pytest.mark.parametrize(
    ("longest_s", "place"), [(NAME_S, str), (ADDRESS_S, lambda _: HERE)], ids=["name", "address"]
)
def test_a_wait_grows_to_its_longest(
    door: Authenticator, clock: Clock, longest_s: float, place: Callable[[int], str]
) -> None:
    waits = []
    for number in range(FREE_TRIES + 8):
        _wrong(door, 1, "ann", place(number))
        wait_s = 0.0
        if number >= FREE_TRIES - 1:
            wait_s = door.log_in("ann", WORD, place(number)).wait_s
        waits.append(wait_s)
        clock.now += wait_s
    assert waits == sorted(waits)
    assert waits[-1] == longest_s


def test_a_name_is_one_however_a_keyboard_composes_it(door: Authenticator) -> None:
    for form in ("NFC", "NFD", "NFC", "NFD", "NFD"):
        _wrong(door, 1, unicodedata.normalize(form, "Jörg"), form)
    assert door.log_in("Jörg", WORD, HERE).wait_s == 1.0


def test_the_trail_tells_of_each_wait_once(
    door: Authenticator, clock: Clock, tmp_path: Path
) -> None:
    _wrong(door, FREE_TRIES, "ann", HERE)
    for _ in range(100):
        door.log_in("ann", WORD, HERE)
        door.log_in("bob", WORD, HERE)
    assert [what for what, *_ in acts(tmp_path)] == ["wrong_password"] * 5 + ["throttled"]
    clock.now += 1.0
    _wrong(door, 1, "ann", HERE)
    door.log_in("ann", WORD, HERE)
    assert [what for what, *_ in acts(tmp_path)[6:]] == ["wrong_password", "throttled"]


def test_users_that_cannot_be_read_let_nobody_in(door: Authenticator, tmp_path: Path) -> None:
    (tmp_path / "users.toml").write_text("nonsense")
    with pytest.raises(ConfigError):
        door.log_in("ann", WORD, HERE)
