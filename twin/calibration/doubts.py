"""Reasons to doubt that a record is of a healthy unit: every cycle of it may have a fault.

Whatever a commissioning is given counts as healthy from then on. A fault that is in all cycles of
the record shows in none of the later alarms.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from twin.calibration.fit import Fitted
from twin.calibration.parameters import FREE, Free
from twin.calibration.readings import Readings
from twin.config import HAND_WRITTEN, Config
from twin.model.dataset import DataSet
from twin.monitor.healthy import Healthy
from twin.signals import MBAR

AS_BUILT = "repair first and record again, or leave it if it is as built"
# Values of a unit that its type determines, and a leak, in words.
OF_TYPE = {
    "ejector.suction_capacity_sl_min": "suction capacity",
    "ejector.end_pressure_mbar": "end pressure",
    "ejector.response_ms": "response of the nozzle",
    "ejector.blow_off_sl_min": "blow-off flow",
    "ejector.blow_off_response_ms": "response of blow-off",
    "system.leak_sl_min": "leak",
}


@dataclass(frozen=True)
class Doubt:
    """What in a record may be a fault, and what to do."""

    text: str
    action: str


def measured_doubts(configured: DataSet, readings: Readings, healthy: Healthy) -> Iterator[Doubt]:
    """Doubts by what the record itself shows: leakage in hold, and H1 that is never reached."""
    leakage, limit = healthy.key_figures.get("leakage"), configured.ejector.permitted_leakage_mbar_s
    if leakage is not None and leakage.mean > limit:
        yield Doubt(
            f"what counts as healthy from now on leaks {leakage.mean:.0f} mbar/s in hold;"
            f" {limit:g} mbar/s is the usual limit",
            AS_BUILT,
        )
    highest = configured.ambient.pressure_mbar - readings.deepest / MBAR
    saves = configured.ejector.air_saving != "off" and not readings.saves_air
    if saves and highest < configured.ejector.h1_mbar:
        yield Doubt(
            f"what counts as healthy from now on never reaches H1, {configured.ejector.h1_mbar:g}"
            f" mbar: the vacuum is {highest:.0f} mbar at most",
            "look for leaks and a low supply, or let suction last longer, and record again",
        )


def doubts_of_fit(fitted: Fitted) -> Iterator[Doubt]:
    """A doubt if the record does not tell a leak from an ejector that sucks less."""
    if fitted.leaky is not None:
        ejector = fitted.leaky.ejector
        yield Doubt(
            "what counts as healthy from now on may leak"
            f" {fitted.leaky.system.leak_sl_min:.2g} sl/min: with an end pressure of"
            f" {ejector.end_pressure_mbar:.0f} mbar the record fits as well",
            "leave half a second with both off after suction and record again, if a leak matters",
        )


def doubts_of_type(config: Config, fitted: Fitted) -> Iterator[Doubt]:
    """Doubts by what is healthy for a known type: values surely beyond, by their 95 % interval."""
    if config.origin == HAND_WRITTEN:
        return
    names = [free.name for free in fitted.free]
    for free in FREE:
        if free.name not in OF_TYPE or not fitted.determined[names.index(free.name)]:
            continue
        low, high = healthy_range(free, config.data)
        surely_low, surely_high = fitted.interval(free.name)
        if surely_low > high or surely_high < low:
            yield Doubt(
                f"{OF_TYPE[free.name]} is {free.of(fitted.data):.3g} {free.unit}, where {low:.3g}"
                f" to {high:.3g} is healthy for its type",
                AS_BUILT,
            )


def healthy_range(free: Free, typed: DataSet) -> tuple[float, float]:
    """Least and greatest value of a healthy unit of the type ``typed``."""
    expected, sigma = free.of(typed), free.sigma(typed)
    below, above = free.healthy or (float("inf"), float("inf"))
    return max(expected - below * sigma, free.low), min(expected + above * sigma, free.high)
