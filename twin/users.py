"""The users of the page and of the OPC UA servers: names, roles, and hashes of their passwords.

They are in one file that only its owner can read. It is read again whenever it has changed, so a
change by one process applies in the others at once.
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
# Argon2id above OWASP's minimum (19 MiB, 2 passes): a check takes 32 MiB and 0.07 s of a core.
HASHER = PasswordHasher(time_cost=2, memory_cost=32 * 1024, parallelism=1)


class Role(StrEnum):
    """The rights of a user; each role includes those before it."""

    LOOK = "look"  # read
    ACKNOWLEDGE = "acknowledge"  # acknowledge, comment and shelve alarms
    CONFIGURE = "configure"  # take alarms out of service, and back; change limits

    def covers(self, needed: "Role") -> bool:
        """Whether it includes the rights of ``needed``."""
        return list(Role).index(self) >= list(Role).index(needed)


def role_of(word: str) -> Role:
    """The role with a name; ConfigError if there is none."""
    try:
        return Role(word)
    except ValueError as error:
        raise ConfigError(f"no role is called {word!r}", known_names(word, Role)) from error


def _require_path(given: Any) -> Any:
    if not isinstance(given, str | Path):
        raise ValueError("the name of a file is needed; twin users makes it")
    return given


UsersFile = Annotated[
    Path, BeforeValidator(_require_path, json_schema_input_type=str)
]  # of a server's settings


class User(Settings):
    """One user."""

    role: Role
    hash: str  # of the password, with its salt and parameters, as Argon2 writes it


class _File(Settings):
    users: dict[str, User] = Field(default_factory=dict)


class Users:
    """The users of a file; ``hasher`` sets the cost of a new password's hash."""

    def __init__(self, path: Path, hasher: PasswordHasher = HASHER) -> None:
        self.path, self._hasher = path, hasher
        self._lock = threading.Lock()
        self._version: tuple[int, int, int] | None = None  # of the file at the last reading
        self._users: dict[str, User] = {}

    @property
    def names(self) -> list[str]:
        """The names of all users; SourceError if the file cannot be read."""
        return sorted(self._read())

    def add(self, name: str, password: str, role: Role) -> None:
        """Add a user; ConfigError for an existing name, or an invalid name or password."""
        users, name = self._read(), normal(name)
        if not NAME.fullmatch(name):
            raise ConfigError(
                f"{name!r} cannot be the name of a user", "up to 40 letters, digits and . @ - _"
            )
        if name in users:
            raise ConfigError(f"{self.path}: {name} is there", "twin users password and role")
        self._write({**users, name: User(role=role, hash=self._hashed(password))})

    def remove(self, name: str) -> None:
        """Remove a user; ConfigError if there is none of that name."""
        removed = self._user(name)
        self._write(
            {user_name: user for user_name, user in self._read().items() if user is not removed}
        )

    def set_password(self, name: str, password: str) -> None:
        """Set a new password; ConfigError for an invalid password or an unknown name."""
        self._change(name, hash=self._hashed(password))

    def set_role(self, name: str, role: Role) -> None:
        """Set another role; ConfigError for an unknown name."""
        self._change(name, role=role)

    def role(self, name: str) -> Role | None:
        """The role of a user; None for an unknown name."""
        user = self._read().get(normal(name))
        return user.role if user else None

    def proof(self, name: str) -> str:
        """The stored hash of a user's password, which changes with it; empty if unknown."""
        user = self._read().get(normal(name))
        return user.hash if user else ""

    def check(self, name: str, password: str) -> Role | None:
        """The role of a user if the password is right; as slow for unknown names."""
        user, dummy_hash = self._read().get(normal(name)), self._dummy_hash
        is_right = self._verifies(password[: 4 * LONGEST], user.hash if user else dummy_hash)
        return user.role if user and is_right else None

    @cached_property
    def _dummy_hash(self) -> str:
        return self._hasher.hash("nobody's")

    def _verifies(self, password: str, stored: str) -> bool:
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

    def _user(self, name: str) -> User:
        users = self._read()
        if normal(name) not in users:
            raise ConfigError(
                f"{self.path}: no user is called {name!r}", known_names(name, sorted(users))
            )
        return users[normal(name)]

    def _change(self, name: str, **changes: object) -> None:
        changed = self._user(name).model_copy(update=changes)
        self._write({**self._read(), normal(name): changed})

    # --- the file -------------------------------------------------------------------------------

    def _read(self) -> dict[str, User]:
        with self._lock:
            try:
                status = self.path.stat()
                if os.name == "posix" and status.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
                    raise ConfigError(
                        f"{self.path}: others may read or change the users",
                        f"keep it to its owner: chmod 600 {self.path}",
                    )
                version = (status.st_mtime_ns, status.st_size, status.st_ino)
                if version != self._version:
                    self._users = _parsed(self.path)
                    self._version = version
            except FileNotFoundError:
                self._users, self._version = {}, None
            except OSError as error:
                raise SourceError(
                    f"{self.path}: cannot be read: {error.strerror}",
                    "it belongs to whoever added its users: run as the same user of this machine",
                ) from error
            return self._users

    def _write(self, users: dict[str, User]) -> None:
        """Write the file atomically, readable for the owner only from the first byte on."""
        documents = {name: user.model_dump(mode="json") for name, user in users.items()}
        try:
            handle, name = tempfile.mkstemp(prefix=".users-", dir=self.path.parent)  # mode 0600
            try:
                with os.fdopen(handle, "wb") as file:
                    tomli_w.dump({"users": documents}, file)
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
        users = _File.model_validate(tomllib.loads(path.read_text(encoding="utf-8"))).users
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, ValidationError) as error:
        raise ConfigError(
            f"{path}: not a file of users", "take it away, and add them with twin users add NAME"
        ) from error
    return {normal(name): user for name, user in users.items()}


def normal(text: str) -> str:
    """The text in one normal form: keyboards differ in how they compose an ü."""
    return unicodedata.normalize("NFC", text)
