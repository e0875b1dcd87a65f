"""The model's coefficients: a vector in SI units, by name.

The kernel works on it, a data set is turned into it, effects change it.
"""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

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
    "BULGE": ("1", "how far the characteristic bulges above a straight line"),
    "SKEW": ("1", "towards which end it bulges"),
    "BEND_2": ("1", "how it bends, finer"),
    "BEND_3": ("1", "how it bends, finer still"),
    "RESPONSE": ("s", "from the command to the suction valve's action"),
    "RESPONSE_OFF": ("s", "the same for its end"),
    "RAMP_UP": ("s", "time constant of each of the jet's two stages"),
    "SLOW_RAMP_UP": ("s", "more, of the first one"),
    "JET_DEPTH": ("1", "how much less deep a jet of half its strength draws: 0 as deep, 1 half"),
    "RAMP_DOWN": ("s", "time constant of each stage in its collapse"),
    "BLOW_OFF": ("kg/s", "blow-off flow at nominal supply"),
    "BLOW_OFF_RESPONSE": ("s", "from the command to the blow-off valve's action"),
    "BLOW_OFF_RESPONSE_OFF": ("s", "the same for its end"),
    "BLOW_OFF_RAMP": ("s", "time constant of the blow-off valve"),
    "RELIEF": ("kg/(s Pa)", "out through the exhaust while the port is above ambient"),
    "EXHAUST": ("kg/s", "sonic, the same where the exhaust is an opening"),
    "PORT_VOLUME": ("m³", "of the node at the port"),
    "PORT_HEAT": ("W/K", "between its gas and the wall"),
    "LINE_VOLUME": ("m³", "of the node half-way"),
    "LINE_HEAT": ("W/K", "between its gas and the wall"),
    "VOLUME": ("m³", "of the node at the far end, the vessel"),
    "COMPLIANCE": ("m³", "less at full vacuum"),
    "FILM": ("W/(m² K)", "between the vessel's gas and the wall"),
    "AREA": ("m²", "of that wall"),
    "NEAR_RESISTANCE": ("Pa²/(kg/s)²", "port to line: what grows with the square of the flow"),
    "NEAR_LAMINAR": ("Pa²/(kg/s)", "port to line: what grows with the flow"),
    "NEAR_INERTANCE": ("1/m", "port to line: length over bore, its gas has inertia"),
    "RESISTANCE": ("Pa²/(kg/s)²", "line to vessel: what grows with the square of the flow"),
    "LAMINAR": ("Pa²/(kg/s)", "line to vessel: what grows with the flow"),
    "INERTANCE": ("1/m", "line to vessel: length over bore"),
    "PLACE": ("Pa²/(kg/s)²", "what of the resistance lies between port and sensor"),
    "LEAK": ("kg/s", "sonic, opening to ambient"),
    "LAMINAR_LEAK": ("kg/(s Pa)", "what seeps in, proportional to vacuum"),
    "INFLOW": ("kg/s", "into the vessel from something else that hangs on it"),
    "BACK_FLOW": ("kg/s", "sonic, through the ejector while its nozzle is off"),
    "OPENING": ("kg/(s Pa)", "rims of the cups when they stand open"),
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
    "CONTROL_SENSOR": ("1", "OWN or PLC"),
    "AIR_SAVING": ("1", "OFF to WITHOUT_CONTINUOUS"),
    "PERMITTED_LEAKAGE": ("Pa/s", "for leak monitoring"),
    "BLOW_OFF_MODE": ("1", "EXTERNAL to TIMED"),
    "BLOW_OFF_TIME": ("s", "of a timed pulse"),
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
    BULGE,
    SKEW,
    BEND_2,
    BEND_3,
    RESPONSE,
    RESPONSE_OFF,
    RAMP_UP,
    SLOW_RAMP_UP,
    JET_DEPTH,
    RAMP_DOWN,
    BLOW_OFF,
    BLOW_OFF_RESPONSE,
    BLOW_OFF_RESPONSE_OFF,
    BLOW_OFF_RAMP,
    RELIEF,
    EXHAUST,
    PORT_VOLUME,
    PORT_HEAT,
    LINE_VOLUME,
    LINE_HEAT,
    VOLUME,
    COMPLIANCE,
    FILM,
    AREA,
    NEAR_RESISTANCE,
    NEAR_LAMINAR,
    NEAR_INERTANCE,
    RESISTANCE,
    LAMINAR,
    INERTANCE,
    PLACE,
    LEAK,
    LAMINAR_LEAK,
    INFLOW,
    BACK_FLOW,
    OPENING,
    SENSOR_LAG,
    SLOW_SENSOR,
    SENSOR_OFFSET,
    SENSOR_GAIN,
    H1,
    H1_LOW,
    H2,
    H2_LOW,
    RELEASE,
    CONTROL_SENSOR,
    AIR_SAVING,
    PERMITTED_LEAKAGE,
    BLOW_OFF_MODE,
    BLOW_OFF_TIME,
) = range(len(COEFFICIENTS))

Theta = npt.NDArray[np.float64]  # one value per coefficient

# Air-saving modes, blow-off modes, and whose sensor the ejector's control acts on.
OFF, ON, LEAK_MONITORING, WITHOUT_CONTINUOUS = range(4)
EXTERNAL, INTERNAL, TIMED = range(3)
OWN, PLC = range(2)


def resistance(theta: Theta, drop: float) -> float:
    """Resistance that takes ``drop`` Pa at nominal suction from ambient (isothermal pipe flow)."""
    ambient = theta[AMBIENT_NOMINAL]
    return float((ambient**2 - (ambient - drop) ** 2) / theta[SUCTION] ** 2)
