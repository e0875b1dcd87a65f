"""What another day does to a rig, as far as the model does not know.

The model takes over ambient pressure and temperature, and real ejectors scatter about what it then
expects. Their end pressure follows ambient in proportion, as the model's does, or in full, where
the jet makes a vacuum of its own. Flows go with density, sonic ones with the root of temperature,
or with neither. So the farther a day is from the calibration's, the less sure is what to expect of
a healthy rig. Where nobody measures temperature, it is unknown besides.
"""

import math
from collections.abc import Iterator

from twin.model import theta as c
from twin.model.theta import Theta
from twin.signals import MBAR

Way = tuple[Theta, Theta]  # coefficients one sigma to either side

BAROMETER = 2.0 * MBAR  # Pa, one sigma; cheap ones are within 3 or 4 mbar
# Pa, one sigma, of the pressure sensor's zero beside it: where no barometer was there, an opened
# system's calibration has taken it for ambient.
ZERO = 2.0 * MBAR
HALL_K = 10.0  # one sigma, where nobody measures it: 15 °C and 35 °C are both within a year's two
SMALLEST = 1e-4  # relative change that is worth a way of its own
# What flows alike: the ejector's own, through valves, through leaks; and friction in the line.
ALIKE = (
    (c.SUCTION,),
    (c.BLOW_OFF, c.RELIEF, c.EXHAUST),
    (c.LEAK, c.LAMINAR_LEAK, c.OPENING, c.HOLE, c.BACK_FLOW),
    (c.RESISTANCE, c.NEAR_RESISTANCE, c.LAMINAR, c.NEAR_LAMINAR, c.PLACE),
)


def unsure(
    calibrated: Theta, here: Theta, ambient: float, told: frozenset[str], gauge: bool
) -> Iterator[Way]:
    """Ways in which a healthy rig may differ ``here`` (coefficients of the day) from the model.

    ``ambient`` is the pressure (Pa) that a hypothesis has there; ``told`` are the surroundings that
    somebody measures, ``ambient`` or ``temperature``; ``gauge`` says that the pressure sensor
    counts from ambient.
    """
    if "ambient" in told:
        yield in_air_of(here, BAROMETER, gauge), in_air_of(here, -BAROMETER, gauge)
        yield _changed(here, c.SENSOR_OFFSET, ZERO), _changed(here, c.SENSOR_OFFSET, -ZERO)
    if "temperature" not in told:
        yield _changed(here, c.TEMPERATURE, HALL_K), _changed(here, c.TEMPERATURE, -HALL_K)
    yield from _of_the_day(calibrated, here, ambient)


def in_air_of(theta: Theta, shift: float, gauge: bool) -> Theta:
    """The same in ambient pressure that differs by ``shift`` (Pa) from what is told or assumed.

    A ``gauge`` sensor's readings have been counted from that: they are off by as much.
    """
    theta = _changed(theta, c.AMBIENT, shift)
    return _changed(theta, c.SENSOR_OFFSET, -shift) if gauge else theta


def _of_the_day(calibrated: Theta, here: Theta, ambient: float) -> Iterator[Way]:
    """What the day's difference from that of the calibration leaves open, in proportion to it."""
    higher = ambient - float(calibrated[c.AMBIENT])
    denser = math.log(ambient / calibrated[c.AMBIENT])
    warmer = math.log(here[c.TEMPERATURE] / calibrated[c.TEMPERATURE])
    follows = (1.0 - float(here[c.END_RATIO])) * higher / ambient
    if abs(follows) > SMALLEST:
        yield _changed(here, c.END_RATIO, follows), _changed(here, c.END_RATIO, -follows)
    size = math.hypot(denser, warmer / 2.0)
    if size > SMALLEST:
        for some in ALIKE:
            yield _scaled(here, some, size), _scaled(here, some, -size)


def _changed(theta: Theta, place: int, change: float) -> Theta:
    theta = theta.copy()
    theta[place] += change
    return theta


def _scaled(theta: Theta, places: tuple[int, ...], size: float) -> Theta:
    theta = theta.copy()
    theta[list(places)] *= math.exp(size)
    return theta
