"""TOML documents and checked, frozen settings; errors name the place of an unknown key.

Each part of the program declares its settings as a ``Settings`` class in the field's units, with
bounds. A ``Document`` gives each part its checked table.
"""

import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from twin.errors import ConfigError, SourceError, known_names
from twin.validation import findings, path_in_words

ALL_MISTAKES = (
    "twin config check FILE names all mistakes of a configuration at once, docs/configuration.md"
    " has all keys"
)

# Tables that people write at the top, and where they belong.
BELOW = {
    "ambient": "[data.ambient]",
    "columns": "[import.columns]",
    "ejector": "[data.ejector]",
    "email": "[notifications.email]",
    "parts": "[[data.system.parts]]",
    "people": "[[notifications.people]]",
    "rig": "[plc.rig]",
    "ring": "[driver.ring]",
    "security": "[driver.security]",
    "sensor": "[data.sensor]",
    "supply": "[data.supply]",
    "system": "[data.system]",
    "tags": "[driver.tags]",
    "trace": "[driver.trace]",
    "upload": "[outlets.upload]",
    "user": "[driver.user]",
    "valves": "[plc.valves]",
}


class Settings(BaseModel):
    """A table of the configuration: immutable, checked, finite numbers, without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class KeyedError(ValueError):
    """An error of one key that only a check of the whole table finds."""

    def __init__(self, message: str, *keys: str) -> None:
        super().__init__(message)
        self.keys = keys  # path below the table


S = TypeVar("S", bound=Settings)


@dataclass(frozen=True)
class Document:
    """A configuration as it was written: its name for messages, its text, its tables."""

    name: str
    text: str
    tables: Mapping[str, Any]

    @classmethod
    def read(cls, path: Path) -> "Document":
        """Read a TOML file; SourceError if it cannot be read, ConfigError if it is not TOML."""
        try:
            return cls.parse(path.read_text(encoding="utf-8"), str(path))
        except OSError as error:
            message = f"{path}: cannot be read: {error.strerror}"
            raise SourceError(message, "check the path") from error
        except UnicodeDecodeError as error:
            message = f"{path}: not a text file, so not TOML"
            raise SourceError(message, "twin init FILE.toml writes one") from error

    @classmethod
    def parse(cls, text: str, name: str) -> "Document":
        """Parse TOML text from elsewhere, for example from a log."""
        try:
            return cls(name, text, tomllib.loads(text))
        except (tomllib.TOMLDecodeError, RecursionError) as error:
            raise ConfigError(f"{name}: not valid TOML: {error}") from error

    def refuse_unknown_tables(self, names: set[str]) -> None:
        """ConfigError if a top-level table is none of ``names``."""
        for key in self.tables:
            if key not in names:
                hint = known_names(key, names)
                whole = BELOW.get(key, "")
                if whole.strip("[").partition(".")[0] in names:
                    hint = f"write {whole}; {hint}"
                raise ConfigError(f"{self.place(key)}: unknown table [{key}]", hint)

    def place(self, *keys: str) -> str:
        """File and line of a key or table, for messages."""
        return f"{self.name}:{self._line(keys)}"

    def section(self, kind: type[S], *path: str) -> S:
        """Check the table at ``path`` (missing means all defaults) against its settings class."""
        table: Any = self.tables
        for key in path:
            table = table.get(key, {}) if isinstance(table, Mapping) else table
        try:
            return kind.model_validate(table)
        except ValidationError as error:
            raise ConfigError(self._explain(path, kind, error), ALL_MISTAKES) from error

    def _explain(self, path: tuple[str, ...], kind: type[S], error: ValidationError) -> str:
        lines = []
        for problem, text in findings(error, kind):
            cause = problem.get("ctx", {}).get("error")
            inner_keys = cause.keys if isinstance(cause, KeyedError) else ()
            keys = self._written((*path, *problem["loc"], *inner_keys))
            line = self._line(tuple(map(str, keys)))
            lines.append(f"{self.name}:{line}: {path_in_words(keys)}: {text}")
        return "\n".join(lines)

    def _written(self, path: tuple[str | int, ...]) -> tuple[str | int, ...]:
        """Keys as written in the text: without the kind that distinguishes a list's tables."""
        keys: list[str | int] = []
        table: Any = self.tables
        for step in path:
            if isinstance(table, Mapping) and step == table.get("kind") and step not in table:
                continue
            if step == "[key]":  # Pydantic's step for an invalid key of a dictionary
                continue
            keys.append(step)
            try:
                table = table[step]
            except (KeyError, IndexError, TypeError):
                table = None
        return tuple(keys)

    def _line(self, keys: tuple[str, ...]) -> int:
        """Line of the deepest of ``keys`` that can be found; TOML parsers keep no lines."""
        table: tuple[str, ...] = ()
        seen: Counter[str] = Counter()  # how often a table of a list has begun
        items: tuple[str, ...] = ()  # the list whose inline tables have lines of their own
        best, depth = 1, 0
        for number, line in enumerate(self.text.splitlines(), 1):
            if header := re.match(r"\s*\[+\s*([^\]]+?)\s*\]", line):
                table = _path(header[1])
                if line.lstrip().startswith("[["):
                    table = (*table, str(seen[header[1]]))
                    seen[header[1]] += 1
                path = table
            elif key := re.match(r"""\s*(["'\w.-]+)\s*=\s*(\[\s*(#.*)?$)?""", line):
                path = (*table, *_path(key[1]))
                items = path if key[2] else ()
            elif items and line.lstrip().startswith("{"):
                path = (*items, str(seen[".".join(items)]))
                seen[".".join(items)] += 1
            else:
                continue
            if depth < len(path) and path == keys[: len(path)]:
                best, depth = number, len(path)
        return best


def _path(key: str) -> tuple[str, ...]:
    return tuple(part.strip(" \t\"'") for part in key.split("."))
