"""Check from the curves how pressure and commands are connected, before any fit."""

from collections.abc import Iterator
from itertools import pairwise
from typing import NoReturn

import numpy as np

from twin.calibration.readings import Floats, Readings, stretches
from twin.errors import ConfigError
from twin.quality import UNUSABLE
from twin.signals import MBAR, Command, Samples

NEVER_OPENED = 0.2  # of ambient pressure: a record below it was never at ambient
TWICE = 1.5  # of ambient pressure: an idle above it counts ambient pressure twice
# Of ambient pressure. A wrong reference counts it twice or not at all: an idle three times as high,
# or a vacuum so far below zero, has another unit.
TOO_HIGH, TOO_DEEP = 3.0, -1.1
BELOW_NOTHING = -20.0 * MBAR  # Pa, absolute: lower than a slightly wrong ambient explains
# A pressure that holds and then rises is not a leak: a leak, choked all the way, makes a tenth of
# its rise within an eighth of the time that nine tenths take.
HELD = 0.25
RISEN = 0.5  # of the vacuum: a smaller rise is no blow-off
ANOTHER_UNIT = 6.0  # times the vacuum of the cycles before: mbar to kPa is 10, bar to psi is 14.5
EACH = 2  # cycles at least in each of two units
TAG = "[driver.tags.pressure], or of the column"


def refuse_miswired(samples: Samples, readings: Readings, ambient: float) -> None:
    """ConfigError if the curves show another wiring; ``ambient`` (Pa) as configured."""
    _refuse_two_units(samples)
    if readings.idle > TOO_HIGH * ambient or readings.deepest < TOO_DEEP * ambient:
        raise ConfigError(
            f"the pressure goes from {readings.deepest / MBAR:.0f} to {readings.highest / MBAR:.0f}"
            f" mbar absolute, and ambient pressure is {ambient / MBAR:.0f}: no vacuum does so",
            f"check the unit of {TAG}: is it read in bar, psi or kPa, and measured in mbar?",
        )
    if readings.rises_in_suction:
        _refuse_rising(readings, ambient)
    if readings.deepest < BELOW_NOTHING:
        raise ConfigError(
            f"the pressure falls to {readings.deepest / MBAR:.0f} mbar absolute, and none is below"
            " zero: it is gauge pressure, taken for absolute",
            f'set reference = "gauge" of {TAG}',
        )
    if readings.highest < NEVER_OPENED * ambient:
        raise ConfigError(
            f"the pressure is never above {readings.highest / MBAR:.0f} mbar absolute: too little,"
            f" as ambient pressure is {ambient / MBAR:.0f}",
            f"check the unit of {TAG}: is it in kPa or psi?",
        )
    if readings.idle > TWICE * ambient:
        raise ConfigError(
            f"the pressure idles at {readings.idle / MBAR:.0f} mbar absolute, and ambient pressure"
            f" is {ambient / MBAR:.0f}: it is absolute pressure, taken for gauge",
            f'set reference = "absolute" of {TAG}',
        )
    if not readings.deepest < readings.highest - readings.least_vacuum:
        raise ConfigError(
            f"the pressure moves by {(readings.highest - readings.deepest) / MBAR:.1f} mbar only"
            " in the whole record: no vacuum is made",
            f"check the unit and the range of {TAG}",
        )
    if not readings.tells_blow_off:
        _refuse_missing_blow_off(samples)


def _refuse_two_units(samples: Samples) -> None:
    """ConfigError if the unit of measurement changes within the record: all cycles from one on."""
    moves = np.array(_movements(samples))
    for first in range(EACH, len(moves) - EACH + 1):
        before, after = moves[:first], moves[first:]
        larger = max(before.min() / after.max(), after.min() / before.max())
        if larger > ANOTHER_UNIT:
            middle = [f"{np.median(part) / MBAR:.3g}" for part in (before, after)]
            raise ConfigError(
                f"the pressure moves by {middle[0]} mbar in each cycle, and by {middle[1]} mbar"
                f" from cycle {first + 1} on: its unit of measurement changes within the record",
                f"give both parts the same unit, or use one part alone; check {TAG}",
            )


def _movements(samples: Samples) -> list[float]:
    """Highest less lowest pressure (Pa) from each suction to the next; at least 1 Pa."""
    pressure = samples["pressure"].astype(np.float64)
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(pressure)
    begins = [
        stretch.first
        for stretch in stretches(samples["commands"])
        if stretch.command == Command.SUCTION
    ]
    cycles = [
        pressure[first:last][usable[first:last]]
        for first, last in pairwise([*begins, len(pressure)])
    ]
    return [max(float(np.ptp(cycle)), 1.0) for cycle in cycles if len(cycle)]


def _refuse_rising(readings: Readings, ambient: float) -> NoReturn:
    """ConfigError with the reason for a rise in suction: reference, sign or commands."""
    highest = f"{readings.highest / MBAR:.0f}"
    if readings.deepest < NEVER_OPENED * ambient and readings.highest < ambient:
        raise ConfigError(
            f"the pressure rises from about zero to {highest} mbar under suction: it is vacuum,"
            " taken for absolute pressure",
            f'set reference = "vacuum" of {TAG}',
        )
    if readings.highest - ambient > ambient - readings.deepest:
        raise ConfigError(
            f"the pressure rises to {highest} mbar absolute while suction is commanded: its sign is"
            " wrong",
            f'set reference = "gauge" (falls in suction) or "vacuum" (rises) of {TAG}',
        )
    raise ConfigError(
        "the pressure rises while suction is commanded and falls while blow-off is: the two"
        " commands are swapped",
        "swap [driver.tags.suction] and [driver.tags.blow_off], or the two columns",
    )


def _refuse_missing_blow_off(samples: Samples) -> None:
    """ConfigError if the pressure rises as only blow-off makes it rise."""
    idles = list(_idles(samples))
    rises = [idle[-1] - idle[0] for idle in idles]
    if idles and np.median([_delay_ratio(idle) for idle in idles]) > HELD:
        raise ConfigError(
            f"after suction the pressure holds, then rises by {np.median(rises) / MBAR:.0f} mbar at"
            " once, and no row has blow-off commanded: something lets air in that the record does"
            " not have",
            "connect [driver.tags.blow_off], or the column blow_off, and record again",
        )


def _idles(samples: Samples) -> Iterator[Floats]:
    """Pressures (Pa) of each idle that loses most of the vacuum."""
    pressure = samples["pressure"].astype(np.float64)
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(pressure)
    ambient = float(np.quantile(pressure[usable], 0.99)) if usable.any() else 0.0
    for stretch in list(stretches(samples["commands"]))[1:]:
        if stretch.command == 0:
            rows = np.flatnonzero(usable[stretch.first : stretch.last]) + stretch.first
            idle = pressure[rows]
            if len(idle) > 1 and idle.max() - idle[0] > RISEN * (ambient - idle[0]):
                yield idle


def _delay_ratio(idle: Floats) -> float:
    """Time of a tenth of the rise over the time of nine tenths."""
    risen = (idle - idle[0]) / (idle.max() - idle[0])
    tenth, nine_tenths = (int(np.argmax(risen > share)) for share in (0.1, 0.9))
    return tenth / max(nine_tenths, 1)
