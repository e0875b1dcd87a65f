"""Errors for people: what is wrong, where, and what to do about it.

The command line maps each kind to its exit code. No code below it suppresses these errors.
"""

from collections.abc import Iterable
from difflib import get_close_matches

_MOST_NAMES = 20  # in a hint: nobody reads more


class TwinError(Exception):
    """An error that a person can correct; ``hint`` says how."""

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


def in_words(error: BaseException) -> str:
    """The text of an error; with its class, unless it is a TwinError."""
    return str(error) if isinstance(error, TwinError) else f"{type(error).__name__}: {error}"


def known_names(asked: str, names: Iterable[str]) -> str:
    """A hint for an unknown name ``asked``: the nearest name, and the known names."""
    sorted_names = sorted(set(names))
    shown = ", ".join(sorted_names[:_MOST_NAMES]) or "none"
    more = f" and {len(sorted_names) - _MOST_NAMES} more" if len(sorted_names) > _MOST_NAMES else ""
    nearest = get_close_matches(asked, sorted_names, n=1)
    did_you_mean = f"did you mean {nearest[0]!r}? " if nearest else ""
    return f"{did_you_mean}known: {shown}{more}"
