"""Constants of air, each with its source. SI units throughout."""

import math

R_AIR = 287.05  # J/(kg·K), specific gas constant of dry air (ISO 2533)
GAMMA = 1.4  # ratio of specific heats of a diatomic gas
CP = GAMMA * R_AIR / (GAMMA - 1.0)  # J/(kg·K)
CV = R_AIR / (GAMMA - 1.0)  # J/(kg·K)
PRANDTL = 0.71  # air at room temperature (VDI Heat Atlas, D2.2)
GRAVITY = 9.80665  # m/s² (ISO 80000-3)

# Choked flux = CHOKED · p / √T through 1 m² (Shapiro, Compressible Fluid Flow, eq. 4.18)
CHOKED = math.sqrt(GAMMA / R_AIR) * (2.0 / (GAMMA + 1.0)) ** ((GAMMA + 1.0) / (2 * (GAMMA - 1.0)))

SUTHERLAND_VISCOSITY = 1.716e-5  # Pa·s at SUTHERLAND_T0 (White, Viscous Fluid Flow, table 1-2)
SUTHERLAND_T0 = 273.15  # K
SUTHERLAND_S = 110.4  # K

STANDARD_PRESSURE = 1.0e5  # Pa (ISO 8778)
STANDARD_TEMPERATURE = 293.15  # K (ISO 8778)
STANDARD_DENSITY = 1.185  # kg/m³ at 65 % relative humidity (ISO 8778)

MBAR = 100.0  # Pa
BAR = 1.0e5  # Pa
ML = 1.0e-6  # m³
MS = 1.0e-3  # s
ZERO_CELSIUS = 273.15  # K
SL_PER_MIN = STANDARD_DENSITY * 1.0e-3 / 60.0  # kg/s in one sl/min
