"""The users of the page and of the OPC UA servers: names, roles, and hashes of their passwords.

They stand in one file that only its owner can read. It is read again whenever it has changed: what
one process writes holds in the others at once.
"""

import os
import re
import stat
import tempfile
import threading
import tomllib
import unicodedata
from contextlib import suppress
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import tomli_w
from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError
from pydantic import BeforeValidator, Field, ValidationError

from twin.errors import ConfigError, SourceError, known_names
from twin.settings import Settings

FILE = "users.toml"
NAME = re.compile(r"[\w.@-]{1,40}")
SHORTEST, LONGEST = 10, 200  # letters of a password
# Argon2id, more than OWASP's least (19 MiB, 2 passes): a check takes 32 MiB and 0.07 s of a core.
HASHER = PasswordHasher(time_cost=2, memory_cost=32 * 1024, parallelism=1)


class Role(StrEnum):
    """What a user may do; each role may what those before it may."""

    LOOK = "look"  # read
    ACKNOWLEDGE = "acknowledge"  # acknowledge, comment and shelve alarms
    CONFIGURE = "configure"  # take alarms out of service, and back

    def covers(self, needed: "Role") -> bool:
        """Whether it may what ``needed`` may."""
        return list(Role).index(self) >= list(Role).index(needed)


def role_of(word: str) -> Role:
    """The role of that name; ConfigError if there is none."""
    try:
        return Role(word)
    except ValueError as error:
        raise ConfigError(f"no role is called {word!r}", known_names(word, Role)) from error


def _no_table(given: Any) -> Any:
    if not isinstance(given, str | Path):
        raise ValueError("the name of a file is needed; twin users makes it")
    return given


UsersFile = Annotated[
    Path, BeforeValidator(_no_table, json_schema_input_type=str)
]  # of a server's settings


class User(Settings):
    """One user."""

    role: Role
    hash: str  # of the password, with its salt and parameters, as Argon2 writes it


class _File(Settings):
    users: dict[str, User] = Field(default_factory=dict)


class Users:
    """The users of a file; ``hasher`` says what a new password's hash costs."""

    def __init__(self, path: Path, hasher: PasswordHasher = HASHER) -> None:
        self.path, self._hasher = path, hasher
        self._lock = threading.Lock()
        self._seen: tuple[int, int, int] | None = None  # of the file, when it was read last
        self._users: dict[str, User] = {}

    @property
    def names(self) -> list[str]:
        """Who there is; SourceError if the file cannot be read."""
        return sorted(self._read())

    def add(self, name: str, password: str, role: Role) -> None:
        """Add somebody; ConfigError for a name that is there, or a name or password of no use."""
        users, name = self._read(), normal(name)
        if not NAME.fullmatch(name):
            raise ConfigError(
                f"{name!r} cannot be the name of a user", "up to 40 letters, digits and . @ - _"
            )
        if name in users:
            raise ConfigError(f"{self.path}: {name} is there", "twin users password and role")
        self._write({**users, name: User(role=role, hash=self._hashed(password))})

    def remove(self, name: str) -> None:
        """Take somebody away; ConfigError if there is none of that name."""
        gone = self._of(name)
        self._write({other: user for other, user in self._read().items() if user is not gone})

    def set_password(self, name: str, password: str) -> None:
        """Give a new password; ConfigError for one of no use, or if there is nobody."""
        self._change(name, hash=self._hashed(password))

    def set_role(self, name: str, role: Role) -> None:
        """Give another role; ConfigError if there is nobody of that name."""
        self._change(name, role=role)

    def role(self, name: str) -> Role | None:
        """What a user may do; None where there is none."""
        user = self._read().get(normal(name))
        return user.role if user else None

    def proof(self, name: str) -> str:
        """What is stored of a user's password, other after a new one; empty where there is none."""
        user = self._read().get(normal(name))
        return user.hash if user else ""

    def check(self, name: str, password: str) -> Role | None:
        """The role of a user whose password that is; as slow for somebody whom there is not."""
        user, nobody = self._read().get(normal(name)), self._nobody
        right = self._is(password[: 4 * LONGEST], user.hash if user else nobody)
        return user.role if user and right else None

    @cached_property
    def _nobody(self) -> str:
        return self._hasher.hash("nobody's")

    def _is(self, password: str, stored: str) -> bool:
        try:
            return self._hasher.verify(stored, normal(password))
        except (VerificationError, InvalidHashError, UnicodeEncodeError):
            return False

    def _hashed(self, password: str) -> str:
        password = normal(password)
        if not SHORTEST <= len(password) <= LONGEST:
            raise ConfigError(
                f"the password has {len(password)} letters", f"take {SHORTEST} to {LONGEST}"
            )
        if not password.isprintable():
            raise ConfigError("the password has a letter that cannot be seen", "type another one")
        return self._hasher.hash(password)

    def _of(self, name: str) -> User:
        users = self._read()
        if normal(name) not in users:
            raise ConfigError(
                f"{self.path}: no user is called {name!r}", known_names(name, sorted(users))
            )
        return users[normal(name)]

    def _change(self, name: str, **changes: object) -> None:
        changed = self._of(name).model_copy(update=changes)
        self._write({**self._read(), normal(name): changed})

    # --- the file -------------------------------------------------------------------------------

    def _read(self) -> dict[str, User]:
        with self._lock:
            try:
                there = self.path.stat()
                if os.name == "posix" and there.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
                    raise ConfigError(
                        f"{self.path}: others may read or change the users",
                        f"keep it to its owner: chmod 600 {self.path}",
                    )
                seen = (there.st_mtime_ns, there.st_size, there.st_ino)
                if seen != self._seen:
                    self._users = _parsed(self.path)
                    self._seen = seen
            except FileNotFoundError:
                self._users, self._seen = {}, None
            except OSError as error:
                raise SourceError(
                    f"{self.path}: cannot be read: {error.strerror}",
                    "it belongs to whoever added its users: run as the same user of this machine",
                ) from error
            return self._users

    def _write(self, users: dict[str, User]) -> None:
        """All or nothing, readable for the owner only from the first byte on."""
        plain = {name: user.model_dump(mode="json") for name, user in users.items()}
        try:
            handle, name = tempfile.mkstemp(prefix=".users-", dir=self.path.parent)  # mode 0600
            try:
                with os.fdopen(handle, "wb") as file:
                    tomli_w.dump({"users": plain}, file)
                    file.flush()
                    os.fsync(file.fileno())
                Path(name).replace(self.path)
            except BaseException:
                with suppress(OSError):
                    Path(name).unlink()
                raise
        except OSError as error:
            raise SourceError(f"{self.path}: cannot be written: {error.strerror}") from error


def _parsed(path: Path) -> dict[str, User]:
    try:
        found = _File.model_validate(tomllib.loads(path.read_text(encoding="utf-8"))).users
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, ValidationError) as error:
        raise ConfigError(
            f"{path}: not a file of users", "take it away, and add them with twin users add NAME"
        ) from error
    return {normal(name): user for name, user in found.items()}


def normal(text: str) -> str:
    """The same text for the same letters: keyboards differ in how they compose an ü."""
    return unicodedata.normalize("NFC", text)
