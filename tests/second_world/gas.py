"""Compiled laws of flow, friction and heat, each small enough to check against a textbook."""

import math

from second_world.compiled import compiled
from second_world.constants import (
    CHOKED,
    GAMMA,
    GRAVITY,
    PRANDTL,
    R_AIR,
    STANDARD_TEMPERATURE,
    SUTHERLAND_S,
    SUTHERLAND_T0,
    SUTHERLAND_VISCOSITY,
)
from second_world.constants import CP as _CP

LAMINAR_RATIO = 0.999  # above it an orifice is laminar: the ellipse has no slope at ratio 1
EARLY_TURBULENCE = 1500.0  # Reynolds number; hoses with fittings trip early
_CRITICAL_AIR = 0.5283  # critical pressure ratio of an ideal nozzle, (2/(γ+1))^(γ/(γ−1))


@compiled
def expansion(ratio, critical):
    """Flow through an orifice as a share of its choked flow (ISO 6358-1, eq. 2)."""
    if ratio <= critical:
        return 1.0
    if ratio > LAMINAR_RATIO:
        edge = (LAMINAR_RATIO - critical) / (1.0 - critical)
        return math.sqrt(1.0 - edge * edge) * (1.0 - ratio) / (1.0 - LAMINAR_RATIO)
    share = (ratio - critical) / (1.0 - critical)
    return math.sqrt(1.0 - share * share)


@compiled
def orifice(conductance, critical, p_from, p_to, t_from):
    """Mass flow in kg/s, never backwards. `conductance`: kg/(s·Pa) choked at 20 °C."""
    if p_to >= p_from:
        return 0.0
    hot = math.sqrt(STANDARD_TEMPERATURE / t_from)
    return conductance * hot * p_from * expansion(p_to / p_from, critical)


@compiled
def secant(conductance, critical, p_left, p_right, t_left, t_right):
    """Flow through an orifice per pressure difference, in kg/(s·Pa); always positive."""
    high, low, t_from = p_left, p_right, t_left
    if p_right > p_left:
        high, low, t_from = p_right, p_left, t_right
    hot = math.sqrt(STANDARD_TEMPERATURE / t_from)
    ratio = low / high
    if ratio > LAMINAR_RATIO:
        edge = (LAMINAR_RATIO - critical) / (1.0 - critical)
        return conductance * hot * math.sqrt(1.0 - edge * edge) / (1.0 - LAMINAR_RATIO)
    return conductance * hot * high * expansion(ratio, critical) / (high - low)


@compiled
def nozzle_flow(area, p_from, p_to, t_from):
    """Mass flow in kg/s of an ideal convergent nozzle of effective `area` (m²)."""
    if p_to >= p_from or area <= 0.0:
        return 0.0
    return area * CHOKED * p_from / math.sqrt(t_from) * expansion(p_to / p_from, _CRITICAL_AIR)


@compiled
def viscosity(t):
    """Dynamic viscosity in Pa·s (Sutherland)."""
    warm = t / SUTHERLAND_T0
    return (
        SUTHERLAND_VISCOSITY
        * warm
        * math.sqrt(warm)
        * (SUTHERLAND_T0 + SUTHERLAND_S)
        / (t + SUTHERLAND_S)
    )


@compiled
def conductivity(mu):
    """Heat conductivity in W/(m·K) from the Prandtl number."""
    return mu * _CP / PRANDTL


@compiled
def turbulent_factor(reynolds, relative_roughness):
    """Darcy's friction factor of a turbulent pipe (Haaland 1983)."""
    re = max(reynolds, EARLY_TURBULENCE)
    root = -1.8 * math.log10((relative_roughness / 3.7) ** 1.11 + 6.9 / re)
    return 1.0 / (root * root)


@compiled
def tube_nusselt(reynolds):
    """Nusselt number in a tube: laminar 3.66, turbulent Dittus-Boelter, whichever is more."""
    return max(3.66, 0.023 * reynolds**0.8 * PRANDTL**0.4)


@compiled
def vessel_nusselt(length, p, t_gas, t_wall, inflow_reynolds):
    """Nusselt number in a vessel: conduction, free convection (McAdams 1954), a jet's stirring."""
    mu = viscosity(t_gas)
    density = p / (R_AIR * t_gas)
    lift = GRAVITY * abs(t_wall - t_gas) / t_gas * length**3
    rayleigh = lift * density * density * PRANDTL / (mu * mu)
    return 4.0 + 0.13 * rayleigh ** (1.0 / 3.0) + 0.1 * inflow_reynolds**0.6


@compiled
def jet_velocity(p_from, p_to, t_from):
    """Speed in m/s of an isentropic expansion from rest."""
    if p_to >= p_from:
        return 0.0
    cold = (p_to / p_from) ** ((GAMMA - 1.0) / GAMMA)
    return math.sqrt(2.0 * _CP * t_from * (1.0 - cold))
