"""The model's coefficients: a vector in SI units, by name.

The kernel works on it, a data set is turned into it, effects change it.
"""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt


def _of_mechanism(slot: int) -> Mapping[str, tuple[str, str]]:
    """Coefficients of one of the mechanisms that can act beside the effects (``mechanism.py``)."""
    of = f"mechanism {slot}: "
    return {
        f"MECHANISM_{slot}_ON": ("1", of + "number of the coefficient that it changes"),
        f"MECHANISM_{slot}_SIZE": ("1", of + "added to that where it acts fully; 0: there is none"),
        f"MECHANISM_{slot}_ALSO_ON": ("1", of + "number of another one that it changes as well"),
        f"MECHANISM_{slot}_ALSO_SIZE": ("1", of + "added to that"),
        f"MECHANISM_{slot}_WHEN": ("1", of + "when it acts, one of WHEN"),
        f"MECHANISM_{slot}_BEGINS": ("Pa", of + "vacuum from which on it acts"),
        f"MECHANISM_{slot}_ENDS": ("Pa", of + "vacuum below which it ends again"),
        f"MECHANISM_{slot}_SETS_IN": ("s", of + "time constant with which it sets in"),
        f"MECHANISM_{slot}_FADES": ("s", of + "time constant with which it fades"),
        f"MECHANISM_{slot}_PERIOD": ("s", of + "of one that swings"),
        f"MECHANISM_{slot}_SHIFT": ("s", of + "when its first swing begins"),
    }


# The coefficients by name, each with its unit (1: a plain number) and what it is; the kernel and
# the effects index the vector with the numbers below, in the same order.
COEFFICIENTS: Mapping[str, tuple[str, str]] = {
    "AMBIENT": ("Pa", "ambient pressure, absolute"),
    "AMBIENT_NOMINAL": ("Pa", "ambient pressure at which suction capacity was measured"),
    "TEMPERATURE": ("K", "of ambient, wall and supply air"),
    "SUPPLY": ("Pa", "gauge, at the regulator"),
    "DROOP": ("Pa", "less at the nozzle while a valve is open"),
    "SUPPLY_LAG": ("s", "time constant of the supply line"),
    "SUPPLY_NOMINAL": (
        "Pa",
        "gauge at the nozzle, at which suction capacity and end pressure hold",
    ),
    "SUPPLY_OPTIMUM": ("Pa", "gauge, where suction capacity peaks"),
    "SUPPLY_CURVATURE": ("1", "how sharply it peaks"),
    "END_SLOPE": ("1/Pa", "relative rise of end pressure per drop of supply"),
    "SUCTION": ("kg/s", "suction capacity: flow at ambient pressure in the port"),
    "END_RATIO": ("1", "end pressure over ambient"),
    "EXHAUST_FOLLOWS": ("1", "share of a loss of suction by which the exhaust is narrowed as well"),
    "FILTER_AT": ("1", "where a filter clogs: 0 behind the sensor, 1 between it and the ejector"),
    "END_FOLLOWS": ("1", "times END_SLOPE, by which end pressure rises where supply is missing"),
    "BULGE": ("1", "how far the characteristic bulges above a straight line"),
    "SKEW": ("1", "towards which end it bulges"),
    "BEND_2": ("1", "how it bends, finer"),
    "BEND_3": ("1", "how it bends, finer still"),
    "KINK": ("1", "share of suction at ambient by a stage that closes on the way to end pressure"),
    "KINK_AT": ("1", "where it closes: 0 at end pressure, 1 at ambient"),
    "RESPONSE": ("s", "from the command to the suction valve's action"),
    "RESPONSE_OFF": ("s", "the same for its end"),
    "RAMP_UP": ("s", "time constant of each of the jet's two stages"),
    "SLOW_RAMP_UP": ("s", "more, of the first one"),
    "JET_FULL_AT": ("1", "share of a slow valve's opening at which the jet has full strength"),
    "JET_DEPTH": ("1", "how much less deep a jet of half its strength draws: 0 as deep, 1 half"),
    "RAMP_DOWN": ("s", "time constant of each stage in its collapse"),
    "BLOW_OFF": ("kg/s", "blow-off flow at nominal supply"),
    "BLOW_OFF_SHAPE": ("1", "how much more blow-off flows into full vacuum than at ambient"),
    "BLOW_OFF_RESPONSE": ("s", "from the command to the blow-off valve's action"),
    "BLOW_OFF_RESPONSE_OFF": ("s", "the same for its end"),
    "BLOW_OFF_RAMP": ("s", "time constant of the blow-off valve"),
    "RELIEF": ("kg/(s Pa)", "out through the exhaust while the port is above ambient"),
    "EXHAUST": ("kg/s", "sonic, the same where the exhaust is an opening"),
    "CRACKING_PRESSURE": ("Pa", "above ambient in the port, from where the exhaust lets out"),
    "PORT_VOLUME": ("m³", "of the node at the port"),
    "PORT_HEAT": ("W/K", "between its gas and the wall"),
    "LINE_VOLUME": ("m³", "of the node half-way"),
    "LINE_HEAT": ("W/K", "between its gas and the wall"),
    "VOLUME": ("m³", "of the node at the far end, the vessel"),
    "COMPLIANCE": ("m³", "less at full vacuum"),
    "SOFTNESS": (
        "1",
        "how much of that is gone early: 0 in proportion to vacuum, n half at 1/(n+2)",
    ),
    "STIFF_UNTIL": ("Pa", "vacuum up to which it hardly shrinks"),
    "FILM": ("W/(m² K)", "between the vessel's gas and the wall"),
    "FREE_CONVECTION": ("1", "share of it that is free convection"),
    "FORCED_CONVECTION": ("s/kg", "by whose root, times the flow that enters, it is more"),
    "AREA": ("m²", "of that wall"),
    "NEAR_RESISTANCE": ("Pa²/(kg/s)²", "port to line: what grows with the square of the flow"),
    "NEAR_LAMINAR": ("Pa²/(kg/s)", "port to line: what grows with the flow"),
    "NEAR_INERTANCE": ("1/m", "port to line: length over bore, its gas has inertia"),
    "RESISTANCE": ("Pa²/(kg/s)²", "line to vessel: what grows with the square of the flow"),
    "LAMINAR": ("Pa²/(kg/s)", "line to vessel: what grows with the flow"),
    "INERTANCE": ("1/m", "line to vessel: length over bore"),
    "PLACE": ("Pa²/(kg/s)²", "what of the resistance lies between port and sensor"),
    "LEAK": ("kg/s", "sonic, opening to ambient"),
    "LEAK_CRITICAL": ("1", "pressure ratio up to which that is sonic"),
    "LAMINAR_LEAK": ("kg/(s Pa)", "what seeps in, proportional to vacuum"),
    "INFLOW": ("kg/s", "into the vessel from something else that hangs on it"),
    "BACK_FLOW": ("kg/s", "sonic, through the ejector while its nozzle is off"),
    "OPENING": ("kg/(s Pa)", "rims of the cups when they stand open"),
    "HOLE": ("kg/s", "sonic, the same where a rim is an opening"),
    "SENSOR_LAG": ("s", "time constant of each of the sensor's two stages"),
    "SLOW_SENSOR": ("s", "more, of the second one"),
    "SENSOR_OFFSET": ("Pa", "added to the absolute reading"),
    "SENSOR_GAIN": ("1", "reads this many times the vacuum"),
    "H1": ("Pa", "below ambient, nozzle off"),
    "H1_LOW": ("Pa", "below ambient, nozzle on again"),
    "H2": ("Pa", "below ambient, part present"),
    "H2_LOW": ("Pa", "below ambient, not any more"),
    "RELEASE": (
        "Pa",
        "below ambient, where blow-off lets the part go and the cup stands open; or NaN",
    ),
    "CONTACT": ("s", "after suction is commanded, when open cups meet the next part"),
    "CONTROL_SENSOR": ("1", "OWN or PLC"),
    "AIR_SAVING": ("1", "OFF to WITHOUT_CONTINUOUS"),
    "PERMITTED_LEAKAGE": ("Pa/s", "for leak monitoring"),
    "BLOW_OFF_MODE": ("1", "EXTERNAL to TIMED"),
    "BLOW_OFF_TIME": ("s", "of a timed pulse"),
    **_of_mechanism(1),
    **_of_mechanism(2),
}
(
    AMBIENT,
    AMBIENT_NOMINAL,
    TEMPERATURE,
    SUPPLY,
    DROOP,
    SUPPLY_LAG,
    SUPPLY_NOMINAL,
    SUPPLY_OPTIMUM,
    SUPPLY_CURVATURE,
    END_SLOPE,
    SUCTION,
    END_RATIO,
    EXHAUST_FOLLOWS,
    FILTER_AT,
    END_FOLLOWS,
    BULGE,
    SKEW,
    BEND_2,
    BEND_3,
    KINK,
    KINK_AT,
    RESPONSE,
    RESPONSE_OFF,
    RAMP_UP,
    SLOW_RAMP_UP,
    JET_FULL_AT,
    JET_DEPTH,
    RAMP_DOWN,
    BLOW_OFF,
    BLOW_OFF_SHAPE,
    BLOW_OFF_RESPONSE,
    BLOW_OFF_RESPONSE_OFF,
    BLOW_OFF_RAMP,
    RELIEF,
    EXHAUST,
    CRACKING_PRESSURE,
    PORT_VOLUME,
    PORT_HEAT,
    LINE_VOLUME,
    LINE_HEAT,
    VOLUME,
    COMPLIANCE,
    SOFTNESS,
    STIFF_UNTIL,
    FILM,
    FREE_CONVECTION,
    FORCED_CONVECTION,
    AREA,
    NEAR_RESISTANCE,
    NEAR_LAMINAR,
    NEAR_INERTANCE,
    RESISTANCE,
    LAMINAR,
    INERTANCE,
    PLACE,
    LEAK,
    LEAK_CRITICAL,
    LAMINAR_LEAK,
    INFLOW,
    BACK_FLOW,
    OPENING,
    HOLE,
    SENSOR_LAG,
    SLOW_SENSOR,
    SENSOR_OFFSET,
    SENSOR_GAIN,
    H1,
    H1_LOW,
    H2,
    H2_LOW,
    RELEASE,
    CONTACT,
    CONTROL_SENSOR,
    AIR_SAVING,
    PERMITTED_LEAKAGE,
    BLOW_OFF_MODE,
    BLOW_OFF_TIME,
    *_mechanisms,
) = range(len(COEFFICIENTS))
MECHANISMS = _mechanisms[0]  # where the coefficients of the mechanisms begin

KINK_WIDTH = 0.03  # of the way from end pressure to ambient, over which a stage closes

Theta = npt.NDArray[np.float64]  # one value per coefficient

# Air-saving modes, blow-off modes, and whose sensor the ejector's control acts on.
OFF, ON, LEAK_MONITORING, WITHOUT_CONTINUOUS = range(4)
EXTERNAL, INTERNAL, TIMED = range(3)
OWN, PLC = range(2)


def resistance(theta: Theta, drop: float) -> float:
    """Resistance that takes ``drop`` Pa at nominal suction from ambient (isothermal pipe flow)."""
    ambient = theta[AMBIENT_NOMINAL]
    return float((ambient**2 - (ambient - drop) ** 2) / theta[SUCTION] ** 2)
