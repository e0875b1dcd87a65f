"""Provenance of a record that was made from a log, its verdict, and its valid time."""

import hashlib
import math
import time
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from twin.signals import Phase

VERDICT, WEAK = "verdict", "weak"  # of a commissioning, in ``Record.provenance``


def of_log(log: Path) -> dict[str, str]:
    """The log's name and hash, and the program, for ``Record.provenance``."""
    with log.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {
        "log": log.name,
        "log_sha256": digest,
        "program": f"ejector-twin {version('ejector-twin')}",
    }


def of_verdict(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The verdict of a commissioning, which a record made from this one has as well."""
    return {key: provenance[key] for key in (VERDICT, WEAK) if key in provenance}


def weak_phases(stored: object) -> dict[str, float]:
    """Phases that a twin follows less well than its record allowed, with times the floor.

    What is stored may come from anybody: what is no phase or no finite number is left out.
    """
    entries = stored.items() if isinstance(stored, Mapping) else ()
    names = {phase.name.lower() for phase in Phase}
    return {
        phase: float(times)
        for phase, times in entries
        if phase in names and isinstance(times, int | float) and math.isfinite(times)
    }


def valid_from(received_ns: int) -> int:
    """The valid time of a record: when its rows were received, but between 1970 and now."""
    return min(max(received_ns, 0), time.time_ns())
