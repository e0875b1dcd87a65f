"""Who may act on the page: users in a file, sessions that end, guesses that take ever longer."""

import stat
from pathlib import Path

import pytest

from twin.errors import ConfigError
from twin.page import sessions as module
from twin.page import users
from twin.page.sessions import SESSION_S, Sessions
from twin.page.users import Users
from twin.throttle import FREE_TRIES, LoginThrottle

WORD = "correct horse"


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(users, "N", 2)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_user_is_known_by_the_password_alone(tmp_path: Path) -> None:
    known = Users(tmp_path / "users.toml")
    known.add("ann", WORD)
    assert known.check("ann", WORD)
    assert not known.check("ann", WORD + " ")
    assert not known.check("ann", "")
    assert not known.check("bob", WORD)
    assert not known.check("", "")
    assert not known.check("bob", "nobody's")
    assert known.names == ["ann"]


def test_the_file_is_its_owners_and_has_no_password(tmp_path: Path) -> None:
    path = tmp_path / "users.toml"
    for name in ("ann", "bob"):
        Users(path).add(name, WORD)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    text = path.read_text()
    assert WORD not in text
    ann, bob = (line.partition(" = ")[2] for line in text.splitlines()[1:])
    assert ann != bob  # each has a salt
    assert list(tmp_path.iterdir()) == [path]


def test_the_hash_is_scrypt_that_takes_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    assert 128 * users.N * users.R >= 2**25
    assert users._is(WORD, users._hashed(WORD))


def test_what_another_process_writes_holds_at_once(tmp_path: Path) -> None:
    path = tmp_path / "users.toml"
    here, there = Users(path), Users(path)
    assert here.names == []
    there.add("ann", WORD)
    assert here.check("ann", WORD)
    there.remove("ann")
    assert not here.check("ann", WORD)
    path.unlink()
    assert here.names == []


@pytest.mark.parametrize("name", ["ann", "bob"])
def test_a_name_that_is_none_takes_as_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    known, hashed = Users(tmp_path / "users.toml"), list[str]()
    known.add("ann", WORD)
    plain = users._hashed
    monkeypatch.setattr(users, "_hashed", lambda *how: (hashed.append(how[0]), plain(*how))[1])
    assert known.check(name, "wrong horse") is False
    assert hashed == ["wrong horse"]


@pytest.mark.parametrize("name", ["", "a b", "a/b", "x" * 41, 'a"', "a\n"])
def test_names_of_no_use_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="cannot be the name"):
        Users(tmp_path / "u").add(name, WORD)


def test_short_passwords_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="9 letters"):
        Users(tmp_path / "u").add("ann", "x" * 9)
    assert not (tmp_path / "u").exists()


@pytest.mark.parametrize("text", ["users = 3", "[users]\nann = 3", "nonsense", "[other]\n"])
def test_a_file_that_is_none_of_users_is_said(tmp_path: Path, text: str) -> None:
    path = tmp_path / "users.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="not a file of users"):
        _ = Users(path).names


def test_a_hash_that_is_none_is_nobodys_password(tmp_path: Path) -> None:
    path = tmp_path / "users.toml"
    path.write_text('[users]\nann = "plain"\nbob = "scrypt$2$!$!"\n')
    assert not Users(path).check("ann", "plain")
    assert not Users(path).check("bob", "!")


def test_a_session_ends_with_its_time_its_user_or_a_new_password(tmp_path: Path) -> None:
    known, clock = Users(tmp_path / "users.toml"), Clock()
    known.add("ann", WORD)
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
    known.add("ann", "another horse")
    assert sessions.get(second) is None
    third = sessions.begin("ann")
    known.remove("ann")
    assert sessions.get(third) is None


def test_sessions_and_their_tokens_differ_and_do_not_pile_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST", 3)
    known = Users(tmp_path / "users.toml")
    known.add("ann", WORD)
    sessions = Sessions(known)
    tokens = [sessions.begin("ann") for _ in range(5)]
    there = [sessions.get(one) for one in tokens]
    assert [one is None for one in there] == [True, True, False, False, False]
    assert len({one.csrf for one in there if one}) == 3
    sessions.end(tokens[-1])
    assert sessions.get(tokens[-1]) is None


def test_after_some_wrong_tries_each_takes_longer() -> None:
    clock = Clock()
    tries = LoginThrottle(60.0, clock)
    waits = []
    for _ in range(FREE_TRIES + 8):
        tries.wrong("a")
        waits.append(tries.wait_s("a"))
    assert waits == [0.0] * (FREE_TRIES - 1) + [1, 2, 4, 8, 16, 32, 60, 60, 60]
    assert tries.wait_s("b") == 0.0
    clock.now = 59.0
    assert tries.wait_s("a") == 1.0
    tries.right("a")
    assert tries.wait_s("a") == 0.0


def test_who_has_tried_is_not_remembered_without_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twin.throttle.MOST", 10)
    tries = LoginThrottle(60.0, Clock())
    for number in range(100):
        tries.wrong(str(number))
    assert len(tries._wrong) == 10
