"""Users in a file: names, roles and hashes, and the commands that change them."""

import io
import stat
import sys
import unicodedata
from pathlib import Path

import pytest
from argon2 import PasswordHasher, extract_parameters
from command_line import twin
from user_files import CHEAP, quick_users

from twin.errors import ConfigError, SourceError
from twin.users import HASHER, Role, Users

WORD = "correct horse"
ANN = ("ann", WORD, Role.ACKNOWLEDGE)


def test_a_user_is_known_by_the_password_alone(tmp_path: Path) -> None:
    known = quick_users(tmp_path / "users.toml", ANN)
    assert known.check("ann", WORD) is Role.ACKNOWLEDGE
    for name, password in (
        *(("ann", WORD + " "), ("ann", ""), ("ann", "\ud800"), ("bob", WORD)),
        *(("", ""), ("bob", "nobody's"), ("ann", WORD + "x" * 10_000)),
    ):
        assert known.check(name, password) is None
    assert known.names == ["ann"]


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_letters_may_be_any_however_a_keyboard_composes_them(tmp_path: Path, form: str) -> None:
    known = quick_users(tmp_path / "users.toml", ("Schlüssel", "Grüße aus Ölde", Role.LOOK))
    name = unicodedata.normalize(form, "Schlüssel")
    for password in ("Grüße aus Ölde", "ü" * 200):
        known.set_password(name, password)
        assert known.check(name, unicodedata.normalize(form, password)) is Role.LOOK
        assert known.role(name) is Role.LOOK
    assert known.check("Schlussel", "ü" * 200) is None
    assert Users(tmp_path / "users.toml").names == ["Schlüssel"]


def test_the_file_is_its_owners_and_has_no_password(tmp_path: Path) -> None:
    path = tmp_path / "users.toml"
    users = quick_users(path, ANN, ("bob", WORD, Role.LOOK))
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert WORD not in path.read_text(encoding="utf-8")
    assert users.proof("ann") != users.proof("bob")  # each has a salt
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620])
def test_a_file_that_others_may_read_or_change_is_refused(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "users.toml"
    users = quick_users(path, ANN)
    path.chmod(mode)
    with pytest.raises(ConfigError, match="others may read or change") as refused:
        users.check("ann", WORD)
    assert f"chmod 600 {path}" in refused.value.hint


def test_a_hash_is_argon2id_that_takes_memory_and_time() -> None:
    how = extract_parameters(HASHER.hash(WORD))
    assert how.type.name == "ID"
    assert how.memory_cost * how.time_cost >= 19 * 1024 * 2  # KiB and passes: OWASP's least


def test_what_another_process_writes_holds_at_once(tmp_path: Path) -> None:
    path = tmp_path / "users.toml"
    here, there = quick_users(path), quick_users(path)
    assert here.names == []
    there.add(*ANN)
    assert here.check("ann", WORD) is Role.ACKNOWLEDGE
    there.set_role("ann", Role.LOOK)
    assert here.check("ann", WORD) is Role.LOOK
    there.set_password("ann", "another horse")
    assert here.check("ann", WORD) is None
    there.remove("ann")
    assert here.check("ann", "another horse") is here.role("ann") is None
    path.unlink()
    assert here.names == []


@pytest.mark.parametrize("name", ["ann", "bob"])
def test_a_name_that_is_none_takes_as_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    known, compared = quick_users(tmp_path / "users.toml", ANN), list[str]()
    plain = PasswordHasher.verify

    def verify(hasher: PasswordHasher, stored: str, password: str) -> bool:
        assert extract_parameters(stored) == extract_parameters(CHEAP.hash(""))
        compared.append(password)
        return plain(hasher, stored, password)

    monkeypatch.setattr(PasswordHasher, "verify", verify)
    assert known.check(name, "wrong horse") is None
    assert compared == ["wrong horse"]


def test_a_role_may_what_those_before_it_may() -> None:
    look, acknowledge, configure = Role
    assert [acknowledge.covers(role) for role in Role] == [True, True, False]
    assert [configure.covers(role) for role in Role] == [True, True, True]
    assert [look.covers(role) for role in Role] == [True, False, False]


@pytest.mark.parametrize("name", ["", "a b", "a/b", "x" * 41, 'a"', "a\n"])
def test_names_of_no_use_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="cannot be the name"):
        quick_users(tmp_path / "u", (name, WORD, Role.LOOK))


@pytest.mark.parametrize(
    ("password", "why"),
    [("x" * 9, "9 letters"), ("x" * 201, "201 letters"), ("correct\thorse", "cannot be seen")],
)
def test_passwords_of_no_use_are_refused(tmp_path: Path, password: str, why: str) -> None:
    users = quick_users(tmp_path / "u", ANN)
    with pytest.raises(ConfigError, match=why):
        users.add("bob", password, Role.LOOK)
    with pytest.raises(ConfigError, match=why):
        users.set_password("ann", password)
    assert users.names == ["ann"]
    assert users.check("ann", WORD)


def test_a_user_who_is_there_is_not_added_again(tmp_path: Path) -> None:
    users = quick_users(tmp_path / "u", ANN)
    with pytest.raises(ConfigError, match="ann is there"):
        users.add("ann", "another horse", Role.CONFIGURE)
    assert users.check("ann", WORD) is Role.ACKNOWLEDGE


NOT_USERS = (
    *("users = 3", "[users]\nann = 3", "nonsense", "[other]\n"),
    *('[users.ann]\nrole = "boss"\nhash = ""', '[users.ann]\nrole = "look"'),
)


@pytest.mark.parametrize("text", NOT_USERS)
def test_a_file_that_is_none_of_users_is_said(tmp_path: Path, text: str) -> None:
    path = tmp_path / "users.toml"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match="not a file of users"):
        _ = Users(path).names


def test_a_file_that_cannot_be_read_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SourceError, match="cannot be read"):
        _ = Users(tmp_path / "file" / "users.toml").names


def test_a_hash_that_is_none_is_nobodys_password(tmp_path: Path) -> None:
    path = tmp_path / "users.toml"
    path.write_text('[users.ann]\nrole = "look"\nhash = "plain"\n')
    path.chmod(0o600)
    assert quick_users(path).check("ann", "plain") is None


# --- the commands ---------------------------------------------------------------------------------


def test_users_are_managed_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config, kept = tmp_path / "cell.toml", tmp_path / "users.toml"
    config.write_text("[asset]\n")

    def users(*words: str, typed: str = "") -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
        code = twin(monkeypatch, "users", *words, "--config", config)
        return code, *capsys.readouterr()

    typed = f"{WORD}\n"
    assert users("list") == (0, "", f"{kept}: no users\n")
    assert users("add", "ann", typed=typed) == (0, "ann has the role look\n", "")
    assert users("add", "Jörg", "--role", "configure", typed=typed)[0] == 0
    assert users("role", "ann", "acknowledge")[:2] == (0, "ann has the role acknowledge\n")
    assert users("list") == (0, "configure    Jörg\nacknowledge  ann\n", "")
    assert users("password", "ann", typed="another horse\n")[0] == 0
    assert Users(kept).check("ann", "another horse") is Role.ACKNOWLEDGE
    assert users("remove", "Jörg")[0] == 0
    assert Users(kept).names == ["ann"]
    for words, why in (
        (("remove", "an"), "did you mean 'ann'"),
        (("role", "bob", "look"), "no user is called 'bob'"),
        (("role", "ann", "boss"), "no role is called 'boss'"),
        (("add", "bob", "--role", "boss"), "known: acknowledge, configure, look"),
    ):
        code, _, said = users(*words, typed=typed)
        assert code == 2
        assert why in said
    assert Users(kept).names == ["ann"]


def test_a_password_is_asked_for_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    typed = iter(["correct horse", "correct house"])
    monkeypatch.setattr("getpass.getpass", lambda _prompt: next(typed))
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    assert twin(monkeypatch, "users", "add", "ann", "--users", tmp_path / "u") == 2
    assert "differ" in capsys.readouterr().err
    assert not (tmp_path / "u").exists()
