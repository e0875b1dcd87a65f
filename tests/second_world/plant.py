"""One step of the plant: semi-implicit in pressure and flow, conservative in mass and energy.

Each face says its new flow as a linear function of the new pressures: a hose by its momentum
balance, an orifice by its secant. The energy balances of all cells with these flows are one
tridiagonal system, solved exactly, so that sound does not limit the step. Mass and energy then move
with the flows that came out: what leaves a cell enters its neighbour to the last digit.
"""

import math

from second_world import faults
from second_world.compiled import compiled
from second_world.constants import CHOKED, CP, GAMMA, R_AIR
from second_world.ejector import jet, stage
from second_world.gas import (
    conductivity,
    nozzle_flow,
    orifice,
    secant,
    tube_nusselt,
    turbulent_factor,
    vessel_nusselt,
    viscosity,
)
from second_world.state import CELLS, CHECK, FIRST, FLAP, HEAD, HOSE, SECOND

CRITICAL_VALVE = 0.35  # critical pressure ratio of a solenoid valve (catalogue values 0.25 to 0.45)
STILL_FILM = 40.0  # W/(m²·K) in the small chambers, which are always stirred
FULL_VACUUM = 1.0e5  # Pa
LIP_OPENS = 400.0e2  # Pa of vacuum
BACKLASH = 75.0e2  # Pa, half its width
CREEP_TIME = 4.0  # s
ICE_TIME, MELT_TIME = 6.0, 15.0  # s
FILL_TIME = 1.0  # s
WATER_TIME = 8.0  # s of suction until the hose holds its water
DRYING_TIME, MOISTENING_TIME = 1.2, 2.0  # s
RELIEF_WIDTH = 50.0e2  # Pa from closed to open

_LEAK = faults.INDEX["leakage", "sonic_flow"]
_POROUS = faults.INDEX["porous_leakage", "flow_at_600mbar"]
_CHECK_LEAK = faults.INDEX["check_valve_leak", "sonic_flow"]
_SUCTION_LOSS = faults.INDEX["suction_loss", "loss"]
_END_LOSS = faults.INDEX["end_vacuum_loss", "end_pressure_rise"]
_SUPPLY_DROP = faults.INDEX["supply_pressure_drop", "drop"]
_FILTER = faults.INDEX["filter_clogging", "pressure_drop_at_nominal"]
_ADDED = faults.INDEX["added_volume", "volume"]
_COMPLIANCE = faults.INDEX["cup_compliance", "volume_at_full_vacuum"]
_FILM = faults.INDEX["heat_exchange", "film_coefficient"]
_RAMP_UP = faults.INDEX["slow_ramp_up", "time_constant"]
_WEAK = faults.INDEX["weak_blow_off", "loss"]
_ICE = faults.INDEX["nozzle_icing", "blockage"]
_WATER = faults.INDEX["condensate", "blockage"]
_LIP = faults.INDEX["lifting_lip", "sonic_flow"]
_BACKLASH = faults.INDEX["cup_backlash", "volume"]
_CREEP = faults.INDEX["creeping_cup", "volume"]
_BLOW_LEAK = faults.INDEX["blow_off_valve_leak", "sonic_flow"]
_SILENCER = faults.INDEX["filling_silencer", "back_pressure"]
_NEIGHBOUR = faults.INDEX["second_ejector", "flow"]
_OUTGASSING = faults.INDEX["outgassing", "flow"]
_FLAP_LEAK = faults.INDEX["leaking_flap", "sonic_flow"]
_HOSE = faults.INDEX["collapsing_hose", "area_loss"]


@compiled
def approach(value, goal, dt, time_constant):
    """First-order lag, exact for a constant goal; without a time constant the goal itself."""
    if time_constant <= 0.0:
        return goal
    return goal + (value - goal) * math.exp(-dt / time_constant)


@compiled
def supply(plant, rest, size, source, neighbour):
    """Flow in from the regulator, conductance of the valve, flow that a neighbour takes."""
    t = plant.ambient_temperature
    available = rest.ambient + source - size[_SUPPLY_DROP]
    inflow = 0.0
    if available > rest.p_supply:
        half = 0.5 * plant.supply_droop
        quadratic = plant.supply_resistance
        inflow = (
            -half + math.sqrt(half * half + quadratic * (available - rest.p_supply))
        ) / quadratic
    through = secant(
        plant.valve_conductance * rest.valve_lagged,
        CRITICAL_VALVE,
        rest.p_supply,
        rest.p_feed,
        t,
        t,
    )
    return inflow, through, size[_NEIGHBOUR] * neighbour


@compiled
def blow(plant, rest, size, head, dt):
    """Blow-off flow in kg/s, and what it takes from the supply; a reservoir pays for itself."""
    t = plant.ambient_temperature
    opening = plant.blow_conductance * rest.blow_valve * (1.0 - size[_WEAK])
    if plant.from_reservoir == 0.0:
        flow = orifice(opening, CRITICAL_VALVE, rest.p_supply, head, t)
        return flow, flow
    flow = orifice(opening, CRITICAL_VALVE, rest.p_reservoir, head, t)
    refill = orifice(plant.refill_conductance, CRITICAL_VALVE, rest.p_supply, rest.p_reservoir, t)
    rest.p_reservoir += dt * R_AIR * t / plant.reservoir_volume * (refill - flow)
    return flow, refill


@compiled
def feed(plant, rest, gas, size, source, neighbour, dt):
    """Move the supply side on by a step; sets the primary flow and the head's source."""
    t = plant.ambient_temperature
    inflow, through, taken = supply(plant, rest, size, source, neighbour)
    blown, drawn = blow(plant, rest, size, gas.pressure[HEAD], dt)
    weeping = size[_BLOW_LEAK] * rest.p_supply / (rest.ambient + plant.supply_gauge)
    gas.source[HEAD] = blown + weeping
    area = plant.nozzle_area * (1.0 - size[_ICE] * rest.ice)
    primary = nozzle_flow(area, rest.p_feed, gas.pressure[FIRST], t)
    per_pascal = primary / rest.p_feed
    fill = dt * R_AIR * t / plant.feed_volume
    p_feed = (rest.p_feed + fill * through * rest.p_supply) / (1.0 + fill * (through + per_pascal))
    p_feed = max(p_feed, gas.pressure[FIRST])  # air runs back through the nozzle
    passed = through * (rest.p_supply - p_feed)
    rest.p_supply += (
        dt * R_AIR * t / plant.supply_volume * (inflow - passed - drawn - weeping - taken)
    )
    rest.p_supply = max(rest.p_supply, rest.ambient)
    rest.p_feed = p_feed
    rest.primary = per_pascal * p_feed


@compiled
def eject(plant, rest, gas, size, dt):
    """Set what the ejector takes from its chambers, and the pressure behind it."""
    t = plant.ambient_temperature
    first, second = gas.pressure[FIRST], gas.pressure[SECOND]
    momentum, ring = jet(rest.p_feed, first, t, rest.primary, plant.velocity_coefficient)
    two = plant.stages > 1.5
    behind = second if two else rest.p_exhaust
    sucked, slope = stage(
        first,
        gas.temperature[FIRST],
        behind,
        t,
        momentum,
        rest.primary,
        ring,
        plant.first_area,
        plant.first_losses,
    )
    keep = 1.0 - size[_SUCTION_LOSS]
    if sucked > 0.0:
        sucked, slope = sucked * keep, slope * keep
    gas.sucked[FIRST], gas.slope[FIRST] = sucked, slope
    leaving = rest.primary + sucked
    if two:
        push = plant.momentum_kept * max(momentum + (first - second) * plant.first_area, 0.0)
        more, slope = stage(
            second,
            gas.temperature[SECOND],
            rest.p_exhaust,
            t,
            push,
            leaving,
            plant.first_area,
            plant.second_area,
            plant.second_losses,
        )
        if more > 0.0:
            more, slope = more * keep, slope * keep
        gas.sucked[SECOND], gas.slope[SECOND] = more, slope
        leaving += more
    full = plant.nozzle_area * CHOKED * (plant.ambient_pressure + plant.supply_gauge) / math.sqrt(t)
    running = rest.primary / full
    goal = rest.ambient + plant.silencer * max(leaving, 0.0) ** 2
    goal += size[_END_LOSS] * running * running + size[_SILENCER] * rest.filled
    rest.p_exhaust = approach(rest.p_exhaust, goal, dt, plant.silencer_time)


@compiled
def openings(plant, rest, gas, size):
    """Set the conductance to ambient of every cell, and gas that the walls give off."""
    last = gas.pressure.size - 1
    t, ambient = plant.ambient_temperature, rest.ambient
    gas.to_ambient[:] = 0.0
    where = last if plant.leak_at_vessel > 0.5 else (HEAD + last) // 2
    opening = plant.leak * rest.leak_scale + size[_LEAK]
    p, hot = gas.pressure, gas.temperature
    gas.to_ambient[where] += secant(
        opening / FULL_VACUUM, plant.leak_critical, ambient, p[where], t, hot[where]
    )
    vacuum = ambient - p[last]
    lip = size[_LIP] * min(max((vacuum - LIP_OPENS) / 50.0e2, 0.0), 1.0)
    loose = lip / FULL_VACUUM + plant.open_conductance * (1.0 - rest.sealed)
    gas.to_ambient[last] += secant(loose, plant.leak_critical, ambient, p[last], t, hot[last])
    darcy = plant.porous * (ambient + p[last]) / (600.0e2 * (2.0 * ambient - 600.0e2))
    gas.to_ambient[last] += darcy + size[_POROUS] / 600.0e2
    over = (p[HEAD] - ambient - plant.relief_pressure) / RELIEF_WIDTH
    if over > 0.0:
        gas.to_ambient[HEAD] += plant.blow_conductance * min(over, 1.0) * 8.0
    gas.source[last] = size[_OUTGASSING] * rest.moisture * max(vacuum, 0.0) / FULL_VACUUM


@compiled
def move_flaps(plant, rest, gas, dt):
    """Flap and check valve follow the pressure across them with their inertia."""
    p = gas.pressure
    lift = (p[FIRST] - p[SECOND] - plant.flap_opening) / 500.0
    rest.flap = approach(rest.flap, min(max(lift, 0.0), 1.0), dt, plant.flap_time)
    lift = (p[HEAD] - p[FIRST] - plant.check_opening) / 1000.0
    rest.check = approach(rest.check, min(max(lift, 0.0), 1.0), dt, plant.flap_time)
    if plant.has_check_valve < 0.5:
        rest.check = 1.0


@compiled
def valve_faces(plant, rest, gas, size):
    """Linear flow through the flap and the check valve."""
    p, t = gas.pressure, gas.temperature
    flap = 0.0
    if plant.stages > 1.5:
        flap = plant.flap_conductance * rest.flap + size[_FLAP_LEAK] / FULL_VACUUM
    check = plant.check_conductance * rest.check + size[_CHECK_LEAK] / FULL_VACUUM
    gas.fixed[FLAP] = gas.fixed[CHECK] = 0.0
    gas.conductance[FLAP] = secant(flap, CRITICAL_VALVE, p[SECOND], p[FIRST], t[SECOND], t[FIRST])
    gas.conductance[CHECK] = secant(check, CRITICAL_VALVE, p[FIRST], p[HEAD], t[FIRST], t[HEAD])


@compiled
def hose_area(plant, rest, gas, size):
    """Cross-section in m² that water and the collapse under vacuum leave."""
    vacuum = min(max(rest.ambient - gas.pressure[CELLS], 0.0) / FULL_VACUUM, 1.0)
    left = (1.0 - size[_HOSE] * vacuum) * (1.0 - size[_WATER] * rest.water)
    return math.pi / 4.0 * plant.line_diameter**2 * left


@compiled
def hose_faces(plant, rest, gas, size, dt):
    """Momentum balance of the air in the hose, face by face."""
    count = gas.flow.size
    area = hose_area(plant, rest, gas, size)
    diameter = math.sqrt(4.0 * area / math.pi)
    cell = plant.line_length / plant.line_cells
    p, t, flow = gas.pressure, gas.temperature, gas.flow
    filters = size[_FILTER]
    for face in range(HOSE, count):
        outer = face in (HOSE, count - 1)
        length = 0.5 * cell if outer else cell
        density = 0.5 * (p[face] / t[face] + p[face + 1] / t[face + 1]) / R_AIR
        old = abs(flow[face])
        mu = viscosity(t[face])
        dynamic = 0.5 / (density * area * area)
        laminar = 32.0 * mu * length / (density * area * diameter * diameter)
        turbulent = gas.friction[face] * length / diameter * dynamic * old
        resistance = max(laminar, turbulent)
        push = 0.0
        if outer:
            entering = flow[face] > 0.0 if face == HOSE else flow[face] < 0.0
            loss = 0.5 * plant.line_fittings + (1.5 if entering else 0.0)
            resistance += loss * dynamic * old
        else:
            left = 0.5 * (flow[face - 1] + flow[face])
            right = 0.5 * (flow[face] + flow[face + 1])
            push = (
                (left * left * t[face] / p[face] - right * right * t[face + 1] / p[face + 1])
                * R_AIR
                / (area * area)
            )
        if face == HOSE:
            resistance += filters * old / density
        inertia = length / (area * dt)
        gas.conductance[face] = 1.0 / (inertia + resistance)
        gas.fixed[face] = (inertia * flow[face] + push) * gas.conductance[face]
    return area


@compiled
def temperature_at(gas, face, flow):
    """Temperature that a face carries: of the cell the air comes from."""
    return gas.temperature[face] if flow > 0.0 else gas.temperature[face + 1]


@compiled
def new_pressures(plant, rest, gas, dt):
    """Solve the energy balances of all cells for the new pressures (Thomas's algorithm)."""
    count = gas.pressure.size
    p, ambient, outside = gas.pressure, rest.ambient, plant.ambient_temperature
    for i in range(count):
        to_air = gas.to_ambient[i] * (outside if ambient > p[i] else gas.temperature[i])
        taken_at = gas.temperature[i] if gas.sucked[i] > 0.0 else outside
        diagonal = gas.volume[i] / (GAMMA - 1.0) + dt * CP * (to_air + gas.slope[i] * taken_at)
        gain = to_air * ambient + gas.source[i] * outside
        gain -= taken_at * (gas.sucked[i] - gas.slope[i] * p[i])
        lower = 0.0
        gas.upper[i] = 0.0
        if i > 0:
            guess = gas.fixed[i - 1] + gas.conductance[i - 1] * (p[i - 1] - p[i])
            carried = temperature_at(gas, i - 1, guess)
            lower = -dt * CP * carried * gas.conductance[i - 1]
            diagonal -= lower
            gain += carried * gas.fixed[i - 1]
        if i < count - 1:
            guess = gas.fixed[i] + gas.conductance[i] * (p[i] - p[i + 1])
            carried = temperature_at(gas, i, guess)
            gas.upper[i] = -dt * CP * carried * gas.conductance[i]
            diagonal -= gas.upper[i]
            gain -= carried * gas.fixed[i]
        right = gas.energy[i] + dt * CP * gain
        if i > 0:
            diagonal -= lower * gas.upper[i - 1]
            right -= lower * gas.right[i - 1]
        gas.upper[i] /= diagonal
        gas.right[i] = right / diagonal
    for i in range(count - 2, -1, -1):
        gas.right[i] -= gas.upper[i] * gas.right[i + 1]


@compiled
def choked_flow(flow, p_left, p_right, t_left, t_right, area):
    """No more than the speed of sound allows in the hose."""
    if flow > 0.0:
        return min(flow, CHOKED * p_left / math.sqrt(t_left) * area)
    return max(flow, -CHOKED * p_right / math.sqrt(t_right) * area)


@compiled
def transport(plant, rest, gas, area, dt):
    """Move mass and energy with the new flows; the ledger holds what crossed the boundary."""
    count = gas.pressure.size
    new, t, outside = gas.right, gas.temperature, plant.ambient_temperature
    for i in range(count):
        out = gas.to_ambient[i] * (new[i] - rest.ambient)
        taken = gas.sucked[i] + gas.slope[i] * (new[i] - gas.pressure[i])
        mass = gas.source[i] - out - taken
        heat = gas.source[i] * outside
        heat -= out * (t[i] if out > 0.0 else outside)
        heat -= taken * (t[i] if taken > 0.0 else outside)
        gas.mass[i] += dt * mass
        gas.energy[i] += dt * CP * heat
        rest.mass_in += dt * mass
        rest.energy_in += dt * CP * heat
    for face in range(count - 1):
        flow = gas.fixed[face] + gas.conductance[face] * (new[face] - new[face + 1])
        if face >= HOSE:
            left, right = gas.pressure[face], gas.pressure[face + 1]
            flow = choked_flow(flow, left, right, t[face], t[face + 1], area)
        gas.flow[face] = flow
        carried = dt * flow * CP * temperature_at(gas, face, flow)
        gas.mass[face] -= dt * flow
        gas.mass[face + 1] += dt * flow
        gas.energy[face] -= carried
        gas.energy[face + 1] += carried


@compiled
def shut(pressure, softness):
    """Share of a cup's stroke that a vacuum (Pa) takes: S-shaped, like a bellows."""
    u = max(pressure, 0.0)
    return u * u / (u * u + softness * softness + 1.0)


@compiled
def add_volume(rest, gas, size):
    """What is added or taken away holds gas as the rest of the vessel does: nothing expands."""
    last = gas.pressure.size - 1
    share = (size[_ADDED] - rest.added) / gas.volume[last]
    if share == 0.0:
        return
    rest.mass_in += share * gas.mass[last]
    rest.energy_in += share * gas.energy[last]
    for held in (gas.mass, gas.energy, gas.volume):
        held[last] *= 1.0 + share
    rest.added = size[_ADDED]


@compiled
def yield_cups(plant, rest, gas, size, dt):
    """Cups change the vessel's volume; the gas does the work."""
    add_volume(rest, gas, size)
    last = gas.pressure.size - 1
    vacuum = rest.ambient - gas.pressure[last]
    rest.cup_held = min(max(rest.cup_held, vacuum - plant.cup_play), vacuum + plant.cup_play)
    goal = shut(rest.cup_held, plant.cup_softness)
    rest.cup_shut = approach(rest.cup_shut, goal, dt, plant.cup_time)
    rest.backlash_held = min(max(rest.backlash_held, vacuum - BACKLASH), vacuum + BACKLASH)
    goal = shut(rest.backlash_held, 200.0e2)
    rest.backlash_shut = approach(rest.backlash_shut, goal, dt, 0.01)
    u = max(vacuum, 0.0) / FULL_VACUUM
    rest.yielded = approach(rest.yielded, 1.25 * u / (0.25 + u), dt, 0.003)
    rest.creep = approach(rest.creep, u, dt, CREEP_TIME)
    full = plant.rigid_volume + plant.cup_volume
    volume = full - plant.cup_volume * rest.cup_shut + size[_ADDED]
    volume -= size[_COMPLIANCE] * rest.yielded
    volume -= size[_BACKLASH] * rest.backlash_shut + size[_CREEP] * rest.creep
    volume = max(volume, 0.2 * full)
    work = gas.pressure[last] * (volume - gas.volume[last])
    gas.energy[last] -= work
    rest.energy_in -= work
    gas.volume[last] = volume


@compiled
def warm(plant, rest, gas, dt):
    """Heat between gas, walls and ambient."""
    last = gas.pressure.size - 1
    line = vessel = 0.0
    for i in range(last + 1):
        wall = plant.ambient_temperature
        if i >= CELLS:
            wall = rest.vessel_wall if i == last else rest.line_wall
        heat = gas.film[i] * (wall - gas.temperature[i]) * dt
        heat_limit = 0.5 * abs(wall - gas.temperature[i]) * gas.energy[i] / gas.temperature[i]
        heat = min(max(heat, -heat_limit), heat_limit)
        gas.energy[i] += heat
        rest.energy_in += heat
        if i == last:
            vessel = heat
        elif i >= CELLS:
            line += heat
    lost = plant.line_wall_loss * (rest.line_wall - plant.ambient_temperature) * dt
    rest.line_wall -= (line + lost) / plant.line_wall_heat
    lost = plant.vessel_wall_loss * (rest.vessel_wall - plant.ambient_temperature) * dt
    rest.vessel_wall -= (vessel + lost) / plant.vessel_wall_heat


@compiled
def settle(gas):
    """Pressure and temperature from energy, mass and volume."""
    for i in range(gas.pressure.size):
        gas.pressure[i] = (GAMMA - 1.0) * gas.energy[i] / gas.volume[i]
        gas.temperature[i] = gas.pressure[i] * gas.volume[i] / (gas.mass[i] * R_AIR)


@compiled
def step(plant, rest, gas, size, source, neighbour, dt):
    """One step of `dt` seconds. `source`: Pa above ambient that the regulator holds."""
    rest.valve_lagged = (
        approach(rest.valve_lagged, rest.valve, dt, size[_RAMP_UP])
        if rest.valve > rest.valve_lagged
        else rest.valve
    )
    yield_cups(plant, rest, gas, size, dt)
    warm(plant, rest, gas, dt)
    settle(gas)
    feed(plant, rest, gas, size, source, neighbour, dt)
    eject(plant, rest, gas, size, dt)
    openings(plant, rest, gas, size)
    move_flaps(plant, rest, gas, dt)
    valve_faces(plant, rest, gas, size)
    area = hose_faces(plant, rest, gas, size, dt)
    new_pressures(plant, rest, gas, dt)
    transport(plant, rest, gas, area, dt)
    settle(gas)


@compiled
def coefficients(plant, gas, size):
    """Film and friction coefficients, which change slowly beside the pressures."""
    last = gas.pressure.size - 1
    diameter = plant.line_diameter
    area = math.pi / 4.0 * diameter * diameter
    surface = math.pi * diameter * plant.line_length / plant.line_cells
    for i in range(CELLS):
        gas.film[i] = STILL_FILM * 6.0 * gas.volume[i] ** (2.0 / 3.0)
    mu = viscosity(gas.temperature[HEAD])
    for face in range(HOSE, gas.flow.size):
        reynolds = abs(gas.flow[face]) * diameter / (area * mu)
        gas.friction[face] = turbulent_factor(reynolds, plant.line_roughness / diameter)
        if face < last - 1:
            film = tube_nusselt(reynolds) * conductivity(mu) / diameter
            gas.film[face + 1] = film * surface
    entering = max(gas.flow[last - 1], 0.0) * diameter / (area * mu)
    nusselt = vessel_nusselt(
        plant.vessel_length,
        gas.pressure[last],
        gas.temperature[last],
        plant.ambient_temperature,
        entering,
    )
    film = nusselt * conductivity(mu) / plant.vessel_length + size[_FILM]
    gas.film[last] = max(film, 0.0) * plant.vessel_surface


@compiled
def memories(plant, rest, gas, blowing, dt):
    """What the mechanisms outside the table remember: ice, water, moisture, a full silencer."""
    running = rest.valve_lagged > 0.5
    rest.ice = approach(rest.ice, 1.0 if running else 0.0, dt, ICE_TIME if running else MELT_TIME)
    rest.filled = approach(rest.filled, 1.0 if running else 0.0, dt, FILL_TIME)
    if blowing:
        rest.water = approach(rest.water, 0.0, dt, 0.05)
    elif running:
        rest.water = approach(rest.water, 1.0, dt, WATER_TIME)
    vacuum = max(rest.ambient - gas.pressure[gas.pressure.size - 1], 0.0) / FULL_VACUUM
    if vacuum > 0.05:
        rest.moisture = approach(rest.moisture, 0.0, dt, DRYING_TIME)
    else:
        rest.moisture = approach(rest.moisture, 1.0, dt, MOISTENING_TIME)
