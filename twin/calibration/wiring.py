"""What the curves say about how pressure and commands are connected, before anything is fitted."""

from collections.abc import Iterator
from typing import NoReturn

import numpy as np

from twin.calibration.readings import Floats, Readings, stretches
from twin.errors import ConfigError
from twin.signals import MBAR, UNUSABLE, Samples

NEVER_OPENED = 0.2  # of ambient pressure: what never comes above it was never at ambient
TWICE = 1.5  # of ambient pressure: what idles above it counts ambient pressure twice
BELOW_NOTHING = -20.0 * MBAR  # Pa, absolute: less than an ambient pressure a little wrong explains
# What holds and then rises is not a leak: one is a tenth of the way up after at most an eighth of
# the time that nine tenths take, where it is choked all the way.
HELD = 0.25
RISEN = 0.5  # of the vacuum: less is no blow-off
TAG = "[driver.tags.pressure], or of the column"


def refuse_miswired(samples: Samples, readings: Readings, ambient: float) -> None:
    """ConfigError where the curves show another wiring; ``ambient`` (Pa) as configured."""
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
        _refuse_untold_blow_off(samples)


def _refuse_rising(readings: Readings, ambient: float) -> NoReturn:
    """Say why the pressure rises in suction: another reference, its sign, or the commands."""
    highest = f"{readings.highest / MBAR:.0f} mbar absolute"
    if readings.deepest < NEVER_OPENED * ambient and readings.highest < ambient:
        raise ConfigError(
            f"the pressure rises to {highest} while suction is commanded, from about zero: it is"
            " vacuum, taken for absolute pressure",
            f'set reference = "vacuum" of {TAG}',
        )
    if readings.highest - ambient > ambient - readings.deepest:
        raise ConfigError(
            f"the pressure rises to {highest} while suction is commanded: its sign is wrong",
            f'set reference = "gauge" (falls in suction) or "vacuum" (rises) of {TAG}',
        )
    raise ConfigError(
        "the pressure rises while suction is commanded and falls while blow-off is: the two"
        " commands are swapped",
        "swap [driver.tags.suction] and [driver.tags.blow_off], or the two columns",
    )


def _refuse_untold_blow_off(samples: Samples) -> None:
    """ConfigError where the pressure rises as only blow-off makes it rise."""
    idles = list(_idles(samples))
    rises = [one[-1] - one[0] for one in idles]
    if idles and np.median([_held(one) for one in idles]) > HELD:
        raise ConfigError(
            f"after suction the pressure holds, then rises by {np.median(rises) / MBAR:.0f} mbar at"
            " once, and no row has blow-off commanded: something lets air in that is not told",
            "connect [driver.tags.blow_off], or the column blow_off, and record again",
        )


def _idles(samples: Samples) -> Iterator[Floats]:
    """Pressures (Pa) of each idle in which most of the vacuum goes."""
    pressure = samples["pressure"].astype(np.float64)
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(pressure)
    ambient = float(np.quantile(pressure[usable], 0.99)) if usable.any() else 0.0
    for one in list(stretches(samples["commands"]))[1:]:
        if one.command == 0:
            rows = np.flatnonzero(usable[one.first : one.last]) + one.first
            idle = pressure[rows]
            if len(idle) > 1 and idle.max() - idle[0] > RISEN * (ambient - idle[0]):
                yield idle


def _held(idle: Floats) -> float:
    """How long a tenth of the rise takes, over how long nine tenths take."""
    way = (idle - idle[0]) / (idle.max() - idle[0])
    tenth, most = (int(np.argmax(way > share)) for share in (0.1, 0.9))
    return tenth / max(most, 1)
