"""Uncertainty of the model on another day than that of the calibration.

The model follows ambient pressure and temperature; real ejectors scatter about its prediction.
Their end pressure follows ambient in proportion, as in the model, or one to one if the jet makes a
vacuum of its own. Flows are proportional to density, sonic flows to the root of temperature, or to
neither. So the uncertainty grows with the distance from the day of the calibration. Temperature is
uncertain as well if nobody measures it.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

from twin.model import theta as c
from twin.model.effects import apply, standing_for
from twin.model.theta import Theta
from twin.signals import MBAR

HOUR_NS, HOUR_S = 3_600_000_000_000, 3600.0
# K, one sigma of the temperature between two cycles without a thermometer: halls warm up by some
# kelvins in a morning. Chosen; over a year see HALL_K.
KELVINS_AN_HOUR, MOST_KELVINS = 1.0, 5.0


class Day(NamedTuple):
    """When something was, and the surroundings as far as they are known."""

    hour: float  # of receipt
    ambient: float  # Pa
    temperature: float  # K, that of the data set if nobody measures it

    @classmethod
    def of(cls, theta: Theta, host_ns: int) -> "Day":
        """The time of a row, and the surroundings in coefficients."""
        return cls(int(host_ns) / HOUR_NS, float(theta[c.AMBIENT]), float(theta[c.TEMPERATURE]))

    @property
    def seconds(self) -> float:
        """The time in seconds."""
        return self.hour * HOUR_S

    def until(self, other: "Day", *, temperature_is_measured: bool) -> tuple[float, float]:
        """Change of ambient pressure (Pa), and relative change of densities in flows.

        Sonic flows are proportional to the root of temperature.
        """
        higher = other.ambient - self.ambient
        warmer = other.temperature - self.temperature
        if not temperature_is_measured:
            warmer = min(KELVINS_AN_HOUR * abs(other.hour - self.hour), MOST_KELVINS)
        return higher, math.hypot(higher / self.ambient, warmer / self.temperature / 2.0)


Way = tuple[Theta, Theta]  # coefficients one sigma to either side

BAROMETER = 2.0 * MBAR  # Pa, one sigma; cheap ones are within 3 or 4 mbar
# Pa, one sigma of the pressure sensor's zero: without a barometer, the calibration of an opened
# system has taken the sensor's reading for ambient.
ZERO = 2.0 * MBAR
# K, one sigma of the difference between two days without a thermometer. The sigma of each is 10 K:
# 15 °C and 35 °C are both within a year's two sigmas.
HALL_K = 10.0 * math.sqrt(2.0)
SMALLEST = 1e-4  # least relative change that counts
# Coefficients that vary together: suction, blow-off, its outlets, leaks, and friction in the line.
# Blow-off comes from the supply and does not vary with its outlets.
ALIKE = (
    (c.SUCTION,),
    (c.BLOW_OFF,),
    (c.RELIEF, c.EXHAUST),
    (c.LEAK, c.LAMINAR_LEAK, c.OPENING, c.HOLE, c.BACK_FLOW),
    (c.RESISTANCE, c.NEAR_RESISTANCE, c.LAMINAR, c.NEAR_LAMINAR, c.PLACE),
)


def unsure(
    calibrated: Theta, present: Theta, ambient: float, measured: frozenset[str]
) -> Iterator[Way]:
    """Coefficients one sigma to either side, for each way in which a healthy rig may differ.

    ``present`` are the coefficients of the day, ``ambient`` (Pa) is that of a hypothesis.
    ``measured`` are measured surroundings, ``ambient`` or ``temperature``.
    """
    if "ambient" in measured:
        yield _in_air_of(present, BAROMETER), _in_air_of(present, -BAROMETER)
        yield _changed(present, c.SENSOR_OFFSET, ZERO), _changed(present, c.SENSOR_OFFSET, -ZERO)
    if "temperature" not in measured:
        yield _changed(present, c.TEMPERATURE, HALL_K), _changed(present, c.TEMPERATURE, -HALL_K)
    yield from of_the_day(calibrated, present, ambient)


def _in_air_of(theta: Theta, shift: float) -> Theta:
    """``theta`` with ambient pressure ``shift`` (Pa) above the measured or assumed one."""
    weather, parameter = standing_for(c.AMBIENT)
    return apply(theta, weather.name, {parameter.name: shift / MBAR})


def of_the_day(calibrated: Theta, present: Theta, ambient: float) -> Iterator[Way]:
    """Ways that grow in proportion to the day's difference from that of the calibration.

    ``ambient`` (Pa) is that of the day. The air saving switches at a vacuum, as in the model, or at
    an absolute pressure: then its thresholds move with the weather.
    """
    higher = ambient - float(calibrated[c.AMBIENT])
    denser = math.log(ambient / calibrated[c.AMBIENT])
    warmer = math.log(present[c.TEMPERATURE] / calibrated[c.TEMPERATURE])
    follows = (1.0 - float(present[c.END_RATIO])) * higher / ambient
    if abs(follows) > SMALLEST:
        yield _changed(present, c.END_RATIO, follows), _changed(present, c.END_RATIO, -follows)
        yield _switched(present, higher), _switched(present, -higher)
    size = math.hypot(denser, warmer / 2.0)
    if size > SMALLEST:
        for group in ALIKE:
            yield _scaled(present, group, size), _scaled(present, group, -size)


def _switched(theta: Theta, shift: float) -> Theta:
    return _changed(_changed(theta, c.H1, shift), c.H1_LOW, shift)


def _changed(theta: Theta, coefficient: int, change: float) -> Theta:
    theta = theta.copy()
    theta[coefficient] += change
    return theta


def _scaled(theta: Theta, coefficients: tuple[int, ...], size: float) -> Theta:
    theta = theta.copy()
    theta[list(coefficients)] *= math.exp(size)
    return theta
