"""Autoset: permitted values taught by the last good cycles, as compact ejectors do it."""

from dataclasses import dataclass

import numpy as np

from twin.errors import ConfigError
from twin.figures.database import History
from twin.figures.settings import LEAST, permitted

GOOD_CYCLES = 5  # the last ones; earlier ones say nothing of today


@dataclass(frozen=True)
class Autoset:
    """Permitted values from now on, and the number of cycles behind them."""

    permitted_t1_ms: float
    permitted_leakage_mbar_s: float
    cycles: int

    def toml(self) -> str:
        """The values as text for a configuration."""
        return (
            f"[figures]\npermitted_t1_ms = {self.permitted_t1_ms:.0f}\n"
            f"permitted_leakage_mbar_s = {self.permitted_leakage_mbar_s:.0f}\n"
        )


def autoset(history: History, tolerance: float) -> Autoset:
    """Permit the worst of the last good cycles, plus ``tolerance`` (a share of it).

    A good cycle has no warning or alarm, and has t1 and leakage. ConfigError if there is none.
    """
    t1, leakage = history.values["t1_measured"], history.values["leakage_measured"]
    calm = np.array([not warned for warned in history.warnings], bool) & (history.alarms == 0)
    good = np.flatnonzero(calm & np.isfinite(t1) & np.isfinite(leakage))[-GOOD_CYCLES:]
    if not len(good):
        raise ConfigError(
            "no good cycle is stored: one that reaches H1, without warning or alarm",
            "let it run on good parts first (twin run with [figures] keep = true), or add a log of"
            " good cycles: twin figures show LOG --keep",
        )
    worst_t1, worst_leakage = float(t1[good].max()), max(float(leakage[good].max()), 0.0)
    return Autoset(
        permitted_t1_ms=permitted(worst_t1, tolerance, LEAST["t1"]),
        permitted_leakage_mbar_s=permitted(worst_leakage, tolerance, LEAST["leakage"]),
        cycles=len(good),
    )
