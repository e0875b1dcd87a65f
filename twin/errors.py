"""Errors for people: what is wrong, where, and what to do about it.

The command line maps each kind to its exit code; nothing below it catches them to go on quietly.
"""


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
