"""Wall heat and a bulging characteristic: what evacuation times can tell about them.

Both are fitted to the rig's measured time: for each film coefficient a bulge meets it. What such
pairs predict for other experiments shows which of these would separate them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from twin.paper.evacuation import (
    APPLICATION,
    INSTANCE_SL_MIN,
    OBJECT_SL_MIN,
    RIG,
    Setup,
    Unit,
    evacuation_ms,
    of_volume,
    pressures,
    with_hose,
)
from twin.signals import MBAR

FILMS = (0.0, 2.0, 5.0, 10.0, 20.0, 40.0)  # W/(m² K); still gas at a wall has 5 to 20
FILM = 10.0  # of the pair that is examined in detail
BIG = of_volume(RIG, 5000.0)
AT_EJECTOR = with_hose(APPLICATION, sensor_in_cups=False)
IN_CUPS = with_hose(APPLICATION, sensor_in_cups=True)
HOLDS_MS = (1000, 4000)
MOST_BULGE = 1.0  # beyond it suction falls towards ambient
MOST_SUCTION = 60.0  # sl/min


@dataclass(frozen=True)
class Pair:
    """A film coefficient with its bulge, and what they predict."""

    unit: Unit
    rig_ms: float
    application_ms: float  # as one vessel
    at_ejector_ms: float  # with its hose as a line, pressure read at the ejector
    in_cups_ms: float  # and read in the cups
    big_ms: float  # a tank of 5 l
    lost_mbar: tuple[float, ...]  # vacuum lost in the hold after ``HOLDS_MS``, without any leak
    needed_sl_min: float  # suction capacity with which the application meets its measured time


@dataclass(frozen=True)
class Alone:
    """The evacuation times of rig and application after one change."""

    what: str
    rig_ms: float
    application_ms: float


@dataclass(frozen=True)
class Separation:
    """All results on what can be separated."""

    alone: Sequence[Alone]
    pairs: Sequence[Pair]
    film: float  # W/(m² K), of the pair that is examined in detail
    delay_ms: float  # by which the printed rig is later than the recomputed one
    delayed_ms: float  # application, if the ejector responds that much later
    object_ms: float  # application, if its ejector is a mean one of the type


def separate(delay_ms: float) -> Separation:
    """Compute everything; ``delay_ms`` is a possible response delay."""
    reference = fitted(FILM)
    delayed = fitted(FILM, delay_ms)
    mean = Unit(OBJECT_SL_MIN, reference.film, reference.bulge)
    return Separation(
        alone=_single_changes(reference),
        pairs=[_pair(fitted(film)) for film in FILMS],
        film=FILM,
        delay_ms=delay_ms,
        delayed_ms=evacuation_ms(APPLICATION, delayed) + delay_ms,
        object_ms=evacuation_ms(APPLICATION, mean),
    )


def fitted(film: float, delay_ms: float = 0.0) -> Unit:
    """The unit whose bulge meets the rig's measured time at a ``film`` coefficient."""

    def excess_ms(bulge: float) -> float:
        unit = Unit(INSTANCE_SL_MIN, film, bulge)
        return evacuation_ms(RIG, unit) + delay_ms - RIG.measured_ms

    return Unit(INSTANCE_SL_MIN, film, float(brentq(excess_ms, 0.0, MOST_BULGE, xtol=1e-5)))


def lost_in_hold(setup: Setup, unit: Unit) -> tuple[float, ...]:
    """Vacuum (mbar) lost at ``HOLDS_MS`` after the nozzle went off at the target."""
    switch_off_ms = round(evacuation_ms(setup, unit))
    pressures_pa = pressures(setup, unit, switch_off_ms, HOLDS_MS[-1] + 100)
    lowest = int(np.argmin(pressures_pa))
    return tuple(float(pressures_pa[lowest + ms] - pressures_pa[lowest]) / MBAR for ms in HOLDS_MS)


def _pair(unit: Unit) -> Pair:
    return Pair(
        unit=unit,
        rig_ms=evacuation_ms(RIG, unit),
        application_ms=evacuation_ms(APPLICATION, unit),
        at_ejector_ms=evacuation_ms(AT_EJECTOR, unit),
        in_cups_ms=evacuation_ms(IN_CUPS, unit),
        big_ms=evacuation_ms(BIG, unit),
        lost_mbar=lost_in_hold(RIG, unit),
        needed_sl_min=_needed_suction(unit),
    )


def _needed_suction(unit: Unit) -> float:
    def excess_ms(suction: float) -> float:
        variant = Unit(suction, unit.film, unit.bulge)
        return evacuation_ms(APPLICATION, variant) - APPLICATION.measured_ms

    return float(brentq(excess_ms, INSTANCE_SL_MIN, MOST_SUCTION, xtol=1e-3))


def _single_changes(unit: Unit) -> list[Alone]:
    changes = (
        ("the paper's model", Unit()),
        (f"wall heat alone, {unit.film:g} W/(m² K)", Unit(film=unit.film)),
        (f"bulge alone, {unit.bulge:.2f}", Unit(bulge=unit.bulge)),
        ("both", unit),
    )
    return [
        Alone(label, evacuation_ms(RIG, variant), evacuation_ms(APPLICATION, variant))
        for label, variant in changes
    ]
