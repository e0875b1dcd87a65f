"""The truth behind the simulated PLC: three gas volumes, lines, an ejector, its control, sensors.

It shares no code with the twin's model: gas laws, ejector, control and steps are written anew. It
shares assumptions: the ideal gas and ISO 6358 with their constants, and three volumes with a line
between them. CONTRIBUTING.md (Tests) lists them all.

Port (with the sensor), line and vessel each keep mass and energy; the gas in the two line halves
has inertia, which keeps explicit steps of 50 µs stable. Everything is SI and absolute.

All compiled functions stand in this one file, since numba's cache does not see changes in other
files. After a change of ``plant``'s constants, touch this file.
Their arguments p, s and row are records: ``plant.plant``, ``plant.at_rest`` and ``faults.ROW``.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.plc.faults import Rows
from drivers.plc.plant import CV, R_GAS, Record
from twin.cpu_target import njit
from twin.signals import MBAR

SCAN = 1e-3  # s, period of the PLC's task
STEPS = 20  # of the rig in one scan
DT = SCAN / STEPS
CP = CV + R_GAS
CRITICAL = 0.528  # ISO 6358
SUCTION, BLOW_OFF = 1, 2  # command bits
LIP_WIDTH = 50 * MBAR  # over which a lifting lip opens
WALL_LAG = 2e-3  # s, a cup's wall follows the pressure
OPENING_LAG = 5e-3  # s, a part leaves or arrives
OWN_LAG = 2e-3  # s, of the compact ejector's own sensor
THAW = 0.5  # 1/s, ice in the nozzle recovers
NEIGHBOUR_RUNS = 0.4  # share of its period in which a second ejector takes air
NOISES = 5  # columns of normal draws: PLC sensor, own sensor, supply, suction and blow-off valve


@njit(cache=True)
def nozzle_ratio(r: float) -> float:
    """Give the ISO 6358 flow function of downstream over upstream pressure, straight near 1."""
    if r <= CRITICAL:
        return 1.0
    straight = 0.998
    s = min(r, straight)
    psi = math.sqrt(1.0 - ((s - CRITICAL) / (1.0 - CRITICAL)) ** 2)
    return psi * (1.0 - r) / (1.0 - s) if r > straight else psi


@njit(cache=True)
def orifice(conductance: float, outside: float, inside: float, temperature: float) -> float:
    """Mass flow inwards in kg/s; ``conductance`` in kg/(s·Pa) at the outside's temperature.

    Outflow takes ``temperature`` relative to the outside's into account.
    """
    if outside >= inside:
        return conductance * outside * nozzle_ratio(inside / outside)
    return -conductance * inside * nozzle_ratio(outside / inside) / math.sqrt(temperature)


@njit(cache=True)
def bulging(x: float, bulge: float) -> float:
    """Suction over relative pressure: 0 at the end pressure (x = 0), 1 at ambient (x = 1)."""
    if x <= 0.0:
        return 0.0
    saturating = (1.0 - math.exp(-bulge * x)) / (1.0 - math.exp(-bulge))
    return float(0.8 * saturating + 0.2 * x**1.3)


@njit(cache=True)
def suction(p: Any, s: Any, row: Any, ambient: float) -> float:
    """Mass flow in kg/s that the jet draws out of the port; the check valve lets none back."""
    r = max(s.supply, 0.0) / p.optimum
    strength = (r * math.exp(1.0 - r)) ** 2.5 * ambient / p.ambient * s.jet
    strength *= (1.0 - row.suction_loss_loss) * max(1.0 - s.ice, 0.0)
    reach = 1.0 - (1.3 if r < 1.0 else 0.15) * (1.0 - r) ** 2
    depth = ambient * (1.0 - p.end_fraction) * max(reach, 0.0)
    depth -= row.end_vacuum_loss_end_pressure_rise
    depth = max(depth - row.filling_silencer_back_pressure * s.filled, 10 * MBAR)
    drawn = s.port_pressure - ambient
    first = bulging(s.jet + drawn / depth, p.bulge)
    second = bulging(s.jet + drawn / (depth * p.second_stage_depth), p.bulge)
    shape = (1.0 - p.second_stage) * first + p.second_stage * second
    return float(p.nominal_flow * strength * shape)


@njit(cache=True)
def line_flow(p: Any, flow: float, difference: float, density: float, filter_drop: float) -> float:
    """Step a mass flow in kg/s; friction implicit, inertia explicit."""
    clogged = filter_drop * p.nominal_density / p.nominal_flow**2
    friction = (p.laminar + (p.turbulent + clogged) * abs(flow)) / density
    pushed = flow + DT * difference / p.inertance
    return float(pushed / (1.0 + DT * friction / p.inertance))


@njit(cache=True)
def enthalpy(flow: float, upstream: float, downstream: float) -> float:
    """Enthalpy in W that ``flow`` carries from an upstream to a downstream temperature in K."""
    return CP * flow * (upstream if flow >= 0.0 else downstream)


@njit(cache=True)
def move_lines(p: Any, s: Any, row: Any) -> None:
    """Step the gas columns on both sides of the line and carry mass and energy over."""
    port = s.port_energy / (CV * s.port_mass)
    line = s.line_energy / (CV * s.line_mass)
    vessel = s.vessel_energy / (CV * s.vessel_mass)
    middle = s.line_mass / p.line_volume
    near_density = (s.port_mass / p.port_volume + middle) / 2.0
    far_density = (middle + s.vessel_mass / s.vessel_volume) / 2.0
    far = row.filter_clogging_pressure_drop_at_nominal * p.sensor_in_line  # behind the sensor
    near = row.filter_clogging_pressure_drop_at_nominal - far
    pushed = s.port_pressure - s.line_pressure
    s.near_flow = line_flow(p, s.near_flow, pushed, near_density, near)
    pushed = s.line_pressure - s.vessel_pressure
    s.far_flow = line_flow(p, s.far_flow, pushed, far_density, far)
    near, far = enthalpy(s.near_flow, port, line), enthalpy(s.far_flow, line, vessel)
    s.port_mass -= DT * s.near_flow
    s.line_mass += DT * (s.near_flow - s.far_flow)
    s.vessel_mass += DT * s.far_flow
    s.port_energy += DT * (p.port_heat * (p.wall - port) - near)
    s.line_energy += DT * (p.line_heat * (p.wall - line) + near - far)
    film = row.heat_exchange_film_coefficient * p.vessel_area
    s.vessel_energy += DT * (film * (p.wall - vessel) + far)


@njit(cache=True)
def exchange_port(p: Any, s: Any, row: Any, ambient: float) -> None:
    """Step the flows at the port: jet, back-flow, relief and blow-off."""
    temperature = s.port_energy / (CV * s.port_mass)
    out = suction(p, s, row, ambient)
    out += p.relief * max(s.port_pressure - ambient, 0.0)
    back = row.check_valve_leak_sonic_flow / p.ambient * (1.0 - min(s.jet, 1.0))
    into = back * max(ambient, 0.0) * nozzle_ratio(min(s.port_pressure / ambient, 1.0))
    valve = p.blow_off * (1.0 - row.weak_blow_off_loss) * s.blow_off
    valve += row.blow_off_valve_leak_sonic_flow / (p.optimum + p.ambient)
    into += max(orifice(valve, s.supply + ambient, s.port_pressure, 1.0), 0.0)
    s.port_mass += DT * (into - out)
    s.port_energy += DT * CP * (into * p.wall - out * temperature)


@njit(cache=True)
def vessel_inflow(p: Any, s: Any, row: Any, ambient: float) -> float:
    """Mass flow in kg/s from ambient into the vessel; negative where the open cup lets gas out."""
    vacuum = ambient - s.vessel_pressure
    relative = s.vessel_energy / (CV * s.vessel_mass) / p.wall
    lifted = min(max((vacuum - row.lip_lift_above) / LIP_WIDTH, 0.0), 1.0)
    hole = row.leakage_sonic_flow + max(p.seal_leak + row.seal_scatter, 0.0)
    hole += lifted * row.lip_lift_sonic_flow + s.open * p.opening
    porous = row.porous_leakage_flow_at_600mbar * vacuum / (600 * MBAR)
    wet = math.exp(-s.suctioned / row.condensate_used_up_after)
    vapour = row.condensate_vapour_flow * wet * (max(vacuum, 0.0) / p.ambient) ** 2
    vapour += row.adsorbed_moisture_vapour_flow * s.moisture * max(vacuum, 0.0) / p.ambient
    return float(orifice(hole / p.ambient, ambient, s.vessel_pressure, relative) + porous + vapour)


@njit(cache=True)
def shrink(p: Any, s: Any, row: Any, ambient: float) -> None:
    """Step the vessel's walls, which give way at once or creep; both do work on the gas."""
    vacuum = max(ambient - s.vessel_pressure, 0.0) / ambient
    full = min(row.cup_compliance_volume_at_full_vacuum, 0.8 * p.vessel_volume)
    change = (full * vacuum - s.shrunk) * DT / WALL_LAG
    s.shrunk += change
    slow = min(row.creeping_cup_volume_at_full_vacuum, 0.8 * p.vessel_volume - full)
    crept = (slow * vacuum - s.crept) * DT / row.creeping_cup_time_constant
    s.crept += crept
    s.vessel_volume -= change + crept
    s.vessel_energy += s.vessel_pressure * (change + crept)


@njit(cache=True)
def dry(s: Any, row: Any, ambient: float) -> None:
    """Step the moisture on the vessel's walls: vacuum takes it, ambient air renews it.

    Several layers of it adsorb at ambient humidity and hardly any in a deep vacuum.
    """
    held = min(s.vessel_pressure / ambient, 1.0) ** 3
    s.moisture += (held - s.moisture) * DT / row.adsorbed_moisture_time_constant


@njit(cache=True)
def exchange_vessel(p: Any, s: Any, row: Any, ambient: float) -> None:
    """Step the vessel's inflow, its volume and the moisture on its walls."""
    temperature = s.vessel_energy / (CV * s.vessel_mass)
    inflow = vessel_inflow(p, s, row, ambient)
    s.vessel_mass += DT * inflow
    s.vessel_energy += DT * enthalpy(inflow, p.wall, temperature)
    if row.added_volume_volume != s.added_volume:  # joined with gas in the vessel's own state
        grown = 1.0 + (row.added_volume_volume - s.added_volume) / s.vessel_volume
        s.vessel_mass *= grown
        s.vessel_energy *= grown
        s.vessel_volume *= grown
        s.added_volume = row.added_volume_volume
    shrink(p, s, row, ambient)
    dry(s, row, ambient)


@njit(cache=True)
def settle_pressures(p: Any, s: Any) -> None:
    """Pressures from mass and energy."""
    s.port_pressure = s.port_energy * R_GAS / (CV * p.port_volume)
    s.line_pressure = s.line_energy * R_GAS / (CV * p.line_volume)
    s.vessel_pressure = s.vessel_energy * R_GAS / (CV * s.vessel_volume)


@njit(cache=True)
def drive(p: Any, s: Any, row: Any, time: float) -> None:
    """Step the valves, the jet behind them and the supply line before them."""
    if time >= s.suction_due:
        s.suction_open = s.suction_wanted
    if time >= s.blow_off_due:
        s.blow_off_open = s.blow_off_wanted
    slow = p.build_up + row.slow_ramp_up_time_constant
    s.jet_drive += (
        (s.suction_open - s.jet_drive) * DT / (slow if s.suction_open > s.jet_drive else p.collapse)
    )
    s.jet += (s.jet_drive - s.jet) * DT / (p.build_up if s.jet_drive > s.jet else p.collapse)
    s.blow_off += (s.blow_off_open - s.blow_off) * DT / p.blow_off_opening
    swing = math.sin(2 * math.pi * time / row.supply_swing_period)
    supply = p.supply + row.supply_scatter - row.supply_pressure_drop_drop
    supply += row.supply_swing_amplitude * swing - p.droop * max(s.suction_open, s.blow_off_open)
    beat = time / row.second_ejector_period
    supply -= row.second_ejector_drop if beat - math.floor(beat) < NEIGHBOUR_RUNS else 0.0
    s.supply += (max(supply, 0.0) - s.supply) * DT / p.supply_lag
    s.ice += DT * (row.nozzle_icing_loss_rate * s.suction_open - THAW * s.ice)
    s.filled += (s.suction_open - s.filled) * DT / row.filling_silencer_time_constant
    s.open += (s.open_wanted - s.open) * DT / OPENING_LAG


@njit(cache=True)
def sense(p: Any, s: Any, row: Any) -> None:
    """Step both sensors."""
    quick = DT / (p.sensor_lag + DT)
    sensed_pressure = s.line_pressure if p.sensor_in_line > 0.0 else s.port_pressure
    s.sensor_first += (sensed_pressure - s.sensor_first) * quick
    s.sensor_second += (s.sensor_first - s.sensor_second) * quick
    s.sensor_lagged += (
        (s.sensor_second - s.sensor_lagged) * DT / (row.sensor_lag_time_constant + DT)
    )
    play = row.sensor_backlash_width / 2
    s.sensed = min(max(s.sensed, s.sensor_lagged - play), s.sensor_lagged + play)
    s.own += (s.port_pressure - s.own) * DT / OWN_LAG


@njit(cache=True)
def save_air(p: Any, s: Any, row: Any, suctioning: bool, noise: float) -> None:
    """Switch the nozzle between two points of vacuum, and signal a part, on its own sensor."""
    vacuum = p.ambient + row.ambient_pressure_shift - s.own + p.own_noise * noise
    if not suctioning or vacuum < p.on_again + row.threshold_drift_h2_shift:
        s.saving = 0.0
    elif p.air_saving > 0.0 and vacuum >= p.h1 + row.threshold_drift_h1_shift:
        s.saving = 1.0
    s.part_present = 1.0 if vacuum >= (p.h2_back if s.part_present > 0.0 else p.h2) else 0.0


@njit(cache=True)
def normal_share(draw: float) -> float:
    """Share of normal draws below ``draw``, 0 to 1."""
    return 0.5 * (1.0 + math.erf(draw / math.sqrt(2.0)))


@njit(cache=True)
def switch_valves(p: Any, s: Any, row: Any, suctioning: bool, blow_off: bool, noise: Any) -> None:
    """Give the valves their new positions, which they take after their delays.

    Whether a stroke sticks follows from the draw for the supply's reading: a column of its own
    would change every other draw of a seed.
    """
    nozzle = 1.0 if suctioning and s.saving == 0.0 else 0.0
    blown = 1.0 if blow_off else 0.0
    if nozzle != s.suction_wanted:
        delay = (p.suction_on if nozzle > 0.0 else p.suction_off) + p.valve_scatter * noise[3]
        s.suction_wanted = nozzle
        s.suction_due = s.scan * SCAN + delay + row.response_delay_delay
        if normal_share(noise[2]) < row.sticking_valve_stuck_strokes:
            s.suction_due += row.sticking_valve_delay
    if blown != s.blow_off_wanted:
        delay = (p.blow_off_on if blow_off else p.blow_off_off) + p.valve_scatter * noise[4]
        s.blow_off_wanted = blown
        s.blow_off_due = s.scan * SCAN + delay + row.blow_off_delay_delay


@njit(cache=True)
def handle_part(p: Any, s: Any, suctioning: bool, blow_off: bool, ambient: float) -> None:
    """Let the part leave an opening gripper, and bring the next one."""
    s.suctioned = s.suctioned + SCAN if suctioning else 0.0
    if suctioning:
        s.open_wanted = 0.0
    elif p.opens > 0.0 and blow_off and ambient - s.vessel_pressure < p.release:
        s.open_wanted = 1.0


@njit(cache=True)
def read(p: Any, s: Any, row: Any, noise: Any, reading: Any) -> None:
    """Sample the sensors as the PLC's input card does."""
    vacuum = (p.ambient - s.sensed) * (1.0 + row.sensor_gain_error)
    warmth = 1.0 - math.exp(-s.scan * SCAN / row.sensor_thermal_drift_time_constant)
    drift = row.sensor_offset_offset + row.sensor_thermal_drift_offset * warmth
    value = p.ambient - vacuum + drift + p.sensor_noise * noise[0]
    reading.overflow = value > p.full_scale or value < 0.0
    clipped = min(max(value, 0.0), p.full_scale)
    reading.pressure = round(clipped / MBAR / p.sensor_step) * p.sensor_step * MBAR
    supply = round((s.supply + p.supply_noise * noise[2]) / MBAR)
    reading.supply = min(max(supply, -32768), 32767) * MBAR
    nozzle, saving, part = s.suction_wanted > 0.0, s.saving > 0.0, s.part_present > 0.0
    reading.reported = (1 if nozzle else 0) + (2 if saving else 0) + (4 if part else 0)
    reading.ambient, reading.temperature = p.ambient + row.ambient_pressure_shift, p.wall
    reading.vessel, reading.flow = s.vessel_pressure, -s.near_flow


@njit(cache=True)
def observe(s: Any, truth: Any) -> None:
    """Record the truth, for tests."""
    truth.port, truth.vessel = s.port_pressure, s.vessel_pressure
    truth.temperature = s.vessel_energy / (CV * s.vessel_mass)
    truth.mass = s.port_mass + s.line_mass + s.vessel_mass
    truth.energy = s.port_energy + s.line_energy + s.vessel_energy
    truth.supply, truth.jet = s.supply, s.jet
    truth.nozzle, truth.part_present = s.suction_open, s.part_present
    truth.open = s.open_wanted


@njit(cache=True)
def run(
    plant: Record,
    state: Record,
    rows: Rows,
    commands: npt.NDArray[np.uint8],
    noise: npt.NDArray[np.float64],
    readings: Record,
    truths: Record,
) -> None:
    """Run one scan per row: read, control, then step the rig for a millisecond.

    ``state`` is changed in place, ``readings`` and ``truths`` are filled; all arrays but the
    first two are as long as ``rows``, ``noise`` has ``NOISES`` normal draws in each row.
    """
    p, s = plant[0], state[0]
    for scan in range(len(rows)):
        row = rows[scan]
        ambient = p.ambient + row.ambient_pressure_shift
        read(p, s, row, noise[scan], readings[scan])
        observe(s, truths[scan])
        blow_off = (commands[scan] & BLOW_OFF) != 0
        suctioning = (commands[scan] & SUCTION) != 0 and not blow_off  # blow-off wins
        save_air(p, s, row, suctioning, noise[scan, 1])
        switch_valves(p, s, row, suctioning, blow_off, noise[scan])
        handle_part(p, s, suctioning, blow_off, ambient)
        for step in range(STEPS):
            drive(p, s, row, s.scan * SCAN + step * DT)
            move_lines(p, s, row)
            exchange_port(p, s, row, ambient)
            exchange_vessel(p, s, row, ambient)
            settle_pressures(p, s)
            sense(p, s, row)
        s.scan += 1.0
