"""Provenance of a record that was made from a log, and its valid time."""

import hashlib
import time
from importlib.metadata import version
from pathlib import Path


def of_log(log: Path) -> dict[str, str]:
    """The log's name and hash, and the program, for ``Record.provenance``."""
    with log.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {
        "log": log.name,
        "log_sha256": digest,
        "program": f"ejector-twin {version('ejector-twin')}",
    }


def valid_from(received_ns: int) -> int:
    """The valid time of a record: when its rows were received, but between 1970 and now."""
    return min(max(received_ns, 0), time.time_ns())
