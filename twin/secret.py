"""Passwords and tokens: how a configuration names them, and where none may be written.

A configuration is copied into every log, shown on pages and quoted in messages. So a secret is in a
file or an environment variable, and the configuration names that.
"""

import logging
import os
import re
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self
from urllib.parse import parse_qsl, urlsplit

from pydantic import model_validator

from twin.errors import ConfigError
from twin.settings import Settings

Say = Callable[[str], None]

INSTEAD = '{ file = "FILE" } or { env = "NAME" }'
# A part of a path that looks like a service's token.
_TOKEN = re.compile(r"(?=[^/]*\d)(?=[^/]*[A-Za-z])[\w-]{20,}")
_log = logging.getLogger(__name__)
_reported = set[Path]()  # files reported as readable by others: each connection reads them again


class Secret(Settings):
    """What nobody else is to know: where it stands."""

    file: Path | None = None  # a text file with it alone, from the configuration's folder
    env: str = ""  # an environment variable

    @model_validator(mode="before")
    @classmethod
    def _not_itself(cls, given: Any) -> Any:
        if isinstance(given, str):
            raise ValueError(
                f"a secret does not belong in a configuration, which is copied into logs: {INSTEAD}"
            )
        return given

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.file is None) == (not self.env):
            raise ValueError("needs one place: file or env")
        return self

    def below(self, folder: Path) -> "Secret":
        """The secret with its file in ``folder``, unless its path is absolute."""
        return self if self.file is None else Secret(file=folder / self.file)

    def read(self, key: str, folder: Path, say: Say = _log.warning) -> str:
        """The secret of ``key``, one line; ConfigError if there is none.

        A file that others may read is reported once.
        """
        if self.file is None:
            text, origin = os.environ.get(self.env, ""), f"environment variable {self.env}"
        else:
            text, origin = _read(key, folder / self.file, say), str(folder / self.file)
        text = text.strip("\r\n")  # as echo and editors leave them
        if not text:
            raise ConfigError(f"{key}: {origin} is empty or not set", "put the secret there")
        if not text.isprintable():
            raise ConfigError(
                f"{key}: {origin} has a line break, or another character that cannot be seen,"
                " in it",
                "put the secret there alone, on one line of plain text",
            )
        return text


def refuse_password(url: str, instead: str) -> None:
    """ValueError if the URL of a database contains a password; ``instead`` is the advice."""
    try:
        parts = urlsplit(url)
        password = parts.password
    except ValueError:  # no URL: its reader says so
        return
    keys = {key.lower() for key, _ in parse_qsl(parts.query, keep_blank_values=True)}
    if password is not None or keys & {"password", "sslpassword"}:
        raise ValueError(
            f"a password does not belong in a URL, which is logged and shown: {instead}"
        )


def refuse_secrets(url: str) -> None:
    """ValueError if the address of a service contains something that looks like a secret."""
    parts = urlsplit(url)
    has_token = any(_TOKEN.fullmatch(part) for part in parts.path.split("/"))
    if parts.username is not None or parts.query or parts.fragment or has_token:
        raise ValueError(
            "what looks like a secret does not belong in an address, which is copied into logs:"
            f" url = {INSTEAD} keeps all of it elsewhere; a password goes into headers"
        )


def _read(key: str, path: Path, say: Say) -> str:
    try:
        mode = path.stat().st_mode
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{key} {path}: cannot be read: {error}", "a text file with the secret alone"
        ) from error
    is_open = os.name == "posix" and mode & (stat.S_IRWXG | stat.S_IRWXO)
    if is_open and path not in _reported:
        _reported.add(path)
        say(f"{key}: others may read {path}; keep it to yourself: chmod 600 {path}")
    return text
