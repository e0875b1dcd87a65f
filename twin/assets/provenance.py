"""Where a record is from, if it was made of a log, and since when it holds."""

import hashlib
import time
from importlib.metadata import version
from pathlib import Path


def of_log(log: Path) -> dict[str, str]:
    """The log by name and content, and the program, as ``Record.provenance`` keeps them."""
    with log.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {
        "log": log.name,
        "log_sha256": digest,
        "program": f"ejector-twin {version('ejector-twin')}",
    }


def valid_from(received_ns: int) -> int:
    """When a record holds from: since its rows were received, whatever clock stamped them."""
    return min(max(received_ns, 0), time.time_ns())
