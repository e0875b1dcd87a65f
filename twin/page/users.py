"""Who may act on the page: names and what their passwords come to, in a file for its owner only."""

import base64
import hashlib
import hmac
import os
import re
import secrets
import tempfile
import threading
import tomllib
from contextlib import suppress
from pathlib import Path

import tomli_w
from pydantic import Field, ValidationError

from twin.errors import ConfigError, SourceError
from twin.settings import Settings

FILE = "users.toml"
NAME = re.compile(r"[\w.@-]{1,40}")
SHORTEST, LONGEST = 10, 200  # letters of a password
N, R, P = 2**15, 8, 1  # of scrypt: a tenth of a second and 32 MB for each try
MOST_MEMORY = 2 * 128 * N * R


class _File(Settings):
    """The file: a salt and a hash for each user, both in base64."""

    users: dict[str, str] = Field(default_factory=dict)


class Users:
    """The users of a file, which is read again whenever it has changed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._seen: tuple[int, int, int] | None = None  # of the file, when it was read last
        self._users: dict[str, str] = {}
        self._nobody = _hashed("nobody's")

    @property
    def names(self) -> list[str]:
        """Who there is; SourceError if the file cannot be read."""
        return sorted(self._read())

    def add(self, name: str, password: str) -> None:
        """Add somebody, or give a new password; ConfigError for a name or password of no use."""
        if not NAME.fullmatch(name):
            raise ConfigError(
                f"{name!r} cannot be the name of a user", "up to 40 letters, digits and . @ - _"
            )
        if not SHORTEST <= len(password) <= LONGEST:
            raise ConfigError(
                f"the password has {len(password)} letters", f"take {SHORTEST} to {LONGEST}"
            )
        self._write({**self._read(), name: _hashed(password)})

    def remove(self, name: str) -> None:
        """Take somebody away; ConfigError if there is none of that name."""
        users = dict(self._read())
        if name not in users:
            there = f"there are: {', '.join(sorted(users)) or 'none'}"
            raise ConfigError(f"{self._path}: no user is called {name!r}", there)
        del users[name]
        self._write(users)

    def proof(self, name: str) -> str:
        """What is stored of a user, other after a new password; empty where there is none."""
        return self._read().get(name, "")

    def check(self, name: str, password: str) -> bool:
        """Whether that is the password; as slow for somebody whom there is not."""
        stored = self.proof(name)
        right = _is(password[: LONGEST + 1], stored or self._nobody)
        return bool(stored) and right

    def _read(self) -> dict[str, str]:
        with self._lock:
            try:
                there = self._path.stat()
                seen = (there.st_mtime_ns, there.st_size, there.st_ino)
                if seen != self._seen:
                    self._users = _parsed(self._path)
                    self._seen = seen
            except FileNotFoundError:
                self._users, self._seen = {}, None
            except OSError as error:
                raise SourceError(f"{self._path}: cannot be read: {error.strerror}") from error
            return self._users

    def _write(self, users: dict[str, str]) -> None:
        """All or nothing, readable for the owner only from the first byte on."""
        try:
            handle, name = tempfile.mkstemp(prefix=".users-", dir=self._path.parent)  # mode 0600
            try:
                with os.fdopen(handle, "wb") as file:
                    tomli_w.dump({"users": users}, file)
                    file.flush()
                    os.fsync(file.fileno())
                Path(name).replace(self._path)
            except BaseException:
                with suppress(OSError):
                    Path(name).unlink()
                raise
        except OSError as error:
            raise SourceError(f"{self._path}: cannot be written: {error.strerror}") from error


def _parsed(path: Path) -> dict[str, str]:
    try:
        return _File.model_validate(tomllib.loads(path.read_text(encoding="utf-8"))).users
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, ValidationError) as error:
        raise ConfigError(
            f"{path}: not a file of users", "take it away, and add them with --add-user NAME"
        ) from error


def _hashed(password: str, salt: bytes | None = None) -> str:
    salt = salt or secrets.token_bytes(16)
    known = hashlib.scrypt(
        password.encode(), salt=salt, n=N, r=R, p=P, maxmem=MOST_MEMORY, dklen=32
    )
    return "$".join(["scrypt", str(N), *(base64.b64encode(one).decode() for one in (salt, known))])


def _is(password: str, stored: str) -> bool:
    try:
        _, _, salt, _ = stored.split("$")
        return hmac.compare_digest(stored, _hashed(password, base64.b64decode(salt)))
    except ValueError:  # not of our making: nobody's password
        return False
