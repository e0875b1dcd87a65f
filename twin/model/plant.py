"""The physics of ejector, line and vessel: one right-hand side for everything that simulates.

A lumped vessel with mass and energy balance and wall heat hangs behind a series resistance on the
port, where the ejector draws and the sensor reads. Resistance stores no gas, so port pressure
follows from the vessel's at every instant. Pressures are absolute, units SI.
"""

import math

import numpy as np

from twin.model import dataset as c
from twin.model.compiled import compiled
from twin.model.gas import CP, GAMMA, R, orifice

OPEN_TIME = 2e-3  # s, in which an open cup takes ambient pressure


@compiled
def at_supply(theta):  # type: ignore[no-untyped-def]
    """Suction at ambient (kg/s), end pressure (Pa) and blow-off (kg/s) at the supply in ``theta``.

    Suction capacity peaks at the optimum supply pressure; end pressure rises when supply is
    missing; blow-off is sonic, hence proportional to absolute supply pressure.
    """
    ambient, nominal = theta[c.AMBIENT], theta[c.AMBIENT_NOMINAL]
    supply, supply_nominal = max(theta[c.SUPPLY], 0.0), theta[c.SUPPLY_NOMINAL]
    optimum, curvature = theta[c.SUPPLY_OPTIMUM], theta[c.SUPPLY_CURVATURE]
    peak = max(1.0 - curvature * (supply / optimum - 1.0) ** 2, 0.0)
    peak_nominal = max(1.0 - curvature * (supply_nominal / optimum - 1.0) ** 2, 1e-3)
    suction = theta[c.SUCTION] * (peak / peak_nominal) * (ambient / nominal)
    end = theta[c.END_RATIO] * ambient * (1.0 + theta[c.END_SLOPE] * (supply_nominal - supply))
    blow_off = theta[c.BLOW_OFF] * ((supply + ambient) / (supply_nominal + nominal))
    return suction, min(max(end, 0.0), 0.98 * ambient), blow_off


@compiled
def characteristic(x, bulge, skew):  # type: ignore[no-untyped-def]
    """Suction flow as a share of its value at ambient, and its slope, over ``x``.

    ``x`` runs from 0 at end pressure to 1 at ambient. Straight (the founding paper's shape) with
    ``bulge`` and ``skew`` zero. Below end pressure the check valve closes: no flow back.
    """
    if x <= 0.0:
        return 0.0, 0.0
    bend = bulge + skew * x
    share = x * (1.0 + (1.0 - x) * bend)
    slope = 1.0 + (1.0 - 2.0 * x) * bend + x * (1.0 - x) * skew
    return max(share, 0.0), slope


@compiled
def port(p, jet, flow_in, theta, suction, end):  # type: ignore[no-untyped-def]
    """Port pressure (Pa) and flow from vessel to port (kg/s) at vessel pressure ``p``.

    The flow w is suction and exhaust (above ambient the port breathes out) less ``flow_in`` at the
    port; only w reaches the vessel. With isothermal pipe flow, p_port² = p² − K w|w|. Each pass
    takes the tangent w = a + b p_port and solves the quadratic exactly, so it cannot run away.
    Without resistance the port has the vessel's pressure to the last bit.
    """
    ambient, resistance = theta[c.AMBIENT], theta[c.RESISTANCE]
    span = ambient - end
    p_port, a, b = p, 0.0, 0.0
    floor = min(p, end + 1e-6 * span)  # the ejector draws no deeper, whatever a tangent says
    for _ in range(4):
        share, slope = characteristic((p_port - end) / span, theta[c.BULGE], theta[c.SKEW])
        b = max(jet * suction * slope / span, 0.0)
        a = jet * suction * share - b * p_port - flow_in
        if p_port > ambient:
            a -= theta[c.RELIEF] * ambient
            b += theta[c.RELIEF]
        if resistance == 0.0:
            return p, a + b * p
        sign = resistance if a + b * p >= 0.0 else -resistance
        root = math.sqrt(max(p * p + sign * (b * b * p * p - a * a), 1.0))
        p_port = max((p * p - sign * a * a) / (sign * a * b + root), floor)
    return p_port, a + b * p_port


@compiled
def rates(y, open_cup, nozzle, blow, theta, supplied, dy):  # type: ignore[no-untyped-def]
    """Write d/dt of ``y`` = pressure, temperature, jet, blow-off valve, sensor into ``dy``.

    ``nozzle`` and ``blow`` are the valve positions (0 to 1), ``supplied`` the result of
    ``at_supply``. Mass and energy balance of an ideal gas in a volume that shrinks linearly with
    vacuum: dp/dt (V + γ p dV/dp) = (γ − 1)(Σ w cp T + Q).
    """
    p, temperature, jet, valve, sensed = y[0], y[1], y[2], y[3], y[4]
    ambient, outside = theta[c.AMBIENT], theta[c.TEMPERATURE]
    suction, end, blow_off = supplied

    flow_back = 0.0
    if theta[c.BACK_FLOW] > 0.0 and p < ambient:
        flow_back = theta[c.BACK_FLOW] * (1.0 - min(jet, 1.0)) * orifice(p / ambient)
    p_port, through = port(p, jet, blow_off * valve + flow_back, theta, suction, end)

    flow_in = theta[c.LAMINAR_LEAK] * (ambient - p) + max(-through, 0.0)
    if p < ambient:
        flow_in += theta[c.LEAK] * orifice(p / ambient)
    flow_out = max(through, 0.0)

    volume = theta[c.VOLUME] - theta[c.COMPLIANCE] * (1.0 - p / ambient)
    stretch = theta[c.COMPLIANCE] / ambient
    heat = theta[c.FILM] * theta[c.AREA] * (outside - temperature)
    enthalpy = CP * (flow_in * outside - flow_out * temperature)
    dp = (GAMMA - 1.0) * (enthalpy + heat) / (volume + GAMMA * p * stretch)
    mass = p * volume / (R * temperature)
    dtemperature = temperature * (dp / p + stretch * dp / volume - (flow_in - flow_out) / mass)
    if open_cup > 0.0:
        dp = (ambient - p) / OPEN_TIME
        dtemperature = (flow_in * (outside - temperature) + heat / CP) / mass

    dy[0] = dp
    dy[1] = dtemperature
    dy[2] = (nozzle - jet) / (theta[c.RAMP_UP] if nozzle > jet else theta[c.RAMP_DOWN])
    dy[3] = (blow - valve) / theta[c.BLOW_OFF_RAMP]
    dy[4] = (p_port - sensed) / theta[c.SENSOR_LAG]


@compiled
def reading(sensed, theta):  # type: ignore[no-untyped-def]
    """Absolute pressure the PLC reads (Pa); span and offset errors act on what is sensed."""
    vacuum = theta[c.AMBIENT] - sensed
    return sensed - (theta[c.SENSOR_GAIN] - 1.0) * vacuum + theta[c.SENSOR_OFFSET]


@compiled
def sensed_at(value, theta):  # type: ignore[no-untyped-def]
    """Pressure (Pa) at the sensor when it reads ``value``: the inverse of ``reading``."""
    gain = theta[c.SENSOR_GAIN]
    return (value - theta[c.SENSOR_OFFSET] + (gain - 1.0) * theta[c.AMBIENT]) / gain


WORK = 5  # rows of scratch that ``runge_kutta`` needs
ORDER = 5  # length of the continuous state


@compiled
def runge_kutta(y, h, open_cup, nozzle, blow, theta, supplied, work):  # type: ignore[no-untyped-def]
    """Advance the first ``ORDER`` entries of ``y`` by ``h`` seconds, classical fourth order."""
    k1, k2, k3, k4, mid = work[0], work[1], work[2], work[3], work[4]
    rates(y, open_cup, nozzle, blow, theta, supplied, k1)
    for i in range(ORDER):
        mid[i] = y[i] + 0.5 * h * k1[i]
    rates(mid, open_cup, nozzle, blow, theta, supplied, k2)
    for i in range(ORDER):
        mid[i] = y[i] + 0.5 * h * k2[i]
    rates(mid, open_cup, nozzle, blow, theta, supplied, k3)
    for i in range(ORDER):
        mid[i] = y[i] + h * k3[i]
    rates(mid, open_cup, nozzle, blow, theta, supplied, k4)
    for i in range(ORDER):
        y[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
    y[0] = max(y[0], 1.0)  # a runaway hypothesis stays a number
    y[1] = min(max(y[1], 100.0), 1000.0)


def scratch() -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Room for the stages of one step."""
    return np.empty((WORK, ORDER))
