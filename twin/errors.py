"""Errors for people: what is wrong, where, and what to do about it.

The command line maps each kind to its exit code; nothing below it catches them to go on quietly.
"""

from collections.abc import Iterable
from difflib import get_close_matches

_MOST_NAMES = 20  # that a hint lists: more are not read


class TwinError(Exception):
    """Something a person can put right; ``hint`` says how."""

    exit_code = 1

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint


class ConfigError(TwinError):
    """A configuration or an argument that cannot be used as it stands."""

    exit_code = 2


class SourceError(TwinError):
    """A PLC, a log or another file that could not be read or written."""

    exit_code = 3


def in_words(error: Exception) -> str:
    """What went wrong: a TwinError says it, of others the kind belongs to it."""
    return str(error) if isinstance(error, TwinError) else f"{type(error).__name__}: {error}"


def known_names(asked: str, names: Iterable[str]) -> str:
    """A hint where nothing is called ``asked``: the name that is nearest, and those there are."""
    there = sorted(set(names))
    shown = ", ".join(there[:_MOST_NAMES]) or "none"
    more = f" and {len(there) - _MOST_NAMES} more" if len(there) > _MOST_NAMES else ""
    nearest = get_close_matches(asked, there, n=1)
    did_you_mean = f"did you mean {nearest[0]!r}? " if nearest else ""
    return f"{did_you_mean}known: {shown}{more}"
