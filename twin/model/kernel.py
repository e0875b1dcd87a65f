"""The compiled path: many samples through the right-hand side in one call, for many hypotheses.

``advance`` carries everything it needs from call to call in ``state``, so the same samples give the
same expected pressures to the last bit however they are cut into blocks. Hypotheses that run
together share their steps, as fine as the roughest of them needs: each is then within a fraction of
a pascal of itself alone.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.model import theta as c
from twin.model.compiled import compiled, inlined, per_row
from twin.model.control import air_saving, new_timer, nothing_done, part_present, switch, timed
from twin.model.gas import GAMMA, R
from twin.model.mechanism import (
    ABOVE,
    ALSO_ON,
    ALSO_SIZE,
    ALWAYS,
    BEGINS,
    BEYOND,
    ENDS,
    FADES,
    GATHERED,
    NOZZLE_OFF,
    NOZZLE_ON,
    ON,
    PERIOD,
    SETS_IN,
    SHIFT,
    SIZE,
    SLOTS,
    SWINGING,
    USED_UP,
    WHEN,
    WIDTH,
)
from twin.model.mechanism import (
    BLOWING as IN_BLOW_OFF,
)
from twin.model.plant import (
    LOWEST,
    ORDER,
    PREPARED,
    TINY,
    UNMOVED,
    Gas,
    Lags,
    Prepared,
    Valves,
    derive,
    prepare,
    put,
    reading,
    room,
    sensed_at,
    shrinkage,
)
from twin.model.plant import advance as advance_gas
from twin.signals import Command, Phase, Signal

# Rows of the state: what plant carries on ...
PORT, PORT_MASS, LINE, LINE_MASS, VESSEL, VESSEL_MASS, NEAR, FAR, YIELDED = range(9)
DRIVE, JET, BLOWING, DRAINED, SUPPLIED, FELT, SENSED = range(9, ORDER)
# ... then the valves (position, what is commanded, for how long), how roughly the pressures run
# (Pa/s³), the phase, the open cup, whether the model stands on a measurement at all, and the
# switching signals it hands out. Last how far each mechanism has set in (0 to 1), by which share
# of its size it acts, whether the vacuum that it waits for is reached, and for how long (s) the
# model has run.
NOZZLE, NOZZLE_COMMAND, NOZZLE_AGE, BLOW, BLOW_COMMAND, BLOW_AGE = range(ORDER, ORDER + 6)
ROUGH, PHASE, OPEN, VALID, SIGNALS = range(ORDER + 6, ORDER + 11)
SET_IN, ACTS, REACHED = ORDER + 11, ORDER + 11 + SLOTS, ORDER + 11 + 2 * SLOTS
RUN = REACHED + SLOTS
STATE = RUN + 1

# Hypotheses that are run together, with a step that suits them all. LLVM weighs the checks that no
# rows overlap against so many: eight it ran one at a time, three times slower.
LANES = 12
LONGEST_STEP = 0.01  # s
LONGEST_BRIDGE = 0.1  # s; after a longer silence the model waits for the next sync
NEVER = 1e9  # s, an age that is past every delay
AT_ONCE = 1e-4  # s, of a mechanism that sets in or fades without delay
# A step in which a valve moves, a cup opens or blow-off passes ambient pressure (the exhaust opens)
# is done in the most steps; any other in as many as keep each within the tolerance.
FINEST = 24  # steps, within TOLERANCE; as many fewer where it is wider as any step then needs
SQUEEZES = 6  # rounds of Newton's method, from a pressure at most ten times off
TOLERANCE = 0.02  # Pa, of a step, by which a scheme of second order may be off
ROUGHLY = 1.0  # Pa, the same where less would not be seen: far below what a sensor resolves

_IDLE, _SUCTION, _HOLD, _BLOW_OFF = (int(phase) for phase in Phase)
_SUCTION_COMMAND = int(Command.SUCTION)
_PART_PRESENT, _AIR_SAVING = int(Signal.PART_PRESENT), int(Signal.AIR_SAVING)

State = npt.NDArray[np.float64]  # STATE rows; a second axis where there are many hypotheses
Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]


def new_state(hypotheses: int | None = None) -> State:
    """Return a model that waits for its first sync; it expects NaN until then."""
    state = np.zeros(STATE if hypotheses is None else (STATE, hypotheses))
    state[[NOZZLE_AGE, BLOW_AGE]] = NEVER
    return state


def advance(
    state: State,
    theta: c.Theta,
    dt: Floats,
    phase: Bytes,
    level: Floats,
    expected: Floats,
    signals: Bytes | None = None,
    tolerance: float = TOLERANCE,
) -> None:
    """Step the model over a block; write what the sensor should read (Pa) into ``expected``.

    Row by row: ``dt`` seconds since the row before (negative: time does not run on, wait for a
    sync), ``phase`` as found by the cycle finder, ``level`` the pressure to synchronise on (Pa, NaN
    for most rows). Into ``signals`` go the switching signals handed out (``Signal`` bits). With
    many hypotheses ``state`` is (STATE, n), ``theta`` (coefficients, n), what is written (rows, n);
    ``phase`` and ``level`` are (rows, n) where each has its own.
    Each step is within about ``tolerance`` (Pa).
    """
    if len(dt) == 0:
        return
    if signals is None:
        signals = np.empty(expected.shape, np.uint8)
    run = _advance_one if state[0].size == 1 else _advance
    run(
        state.reshape(STATE, -1),
        theta.reshape(len(c.COEFFICIENTS), -1),
        dt,
        np.ascontiguousarray(phase).reshape(len(dt), -1),  # one kind to be compiled for
        np.ascontiguousarray(level).reshape(len(dt), -1),
        expected.reshape(len(dt), -1),
        signals.reshape(len(dt), -1),
        tolerance,
    )


@dataclass
class Control:
    """Where the ejectors' own controls stand: all that a free run carries on beside ``State``."""

    air_saving: Floats  # (hypotheses, CONTROL)
    timer: Floats  # of the blow-off, (hypotheses, 2)

    @classmethod
    def anew(cls, hypotheses: int = 1) -> "Control":
        """Controls that have not done anything for long."""
        return cls(*(np.tile(one, (hypotheses, 1)) for one in (nothing_done(), new_timer())))


def simulate(
    state: State,
    theta: c.Theta,
    dt: Floats,
    commands: Bytes,
    phase: Bytes,
    expected: Floats,
    tolerance: float = TOLERANCE,
) -> None:
    """Run free: the model's own control switches the nozzle; ``phase`` and ``expected`` are out.

    ``commands`` per row are those of ``Command``. ``state`` must stand on something (``at_rest``);
    the control begins anew with every call. Many hypotheses as with ``advance``.
    """
    out = phase, expected, np.empty(expected.shape, np.uint8)
    run_on(state, Control.anew(state[0].size), theta, dt, commands, out, tolerance)


def run_on(
    state: State,
    control: Control,
    theta: c.Theta,
    dt: Floats,
    commands: Bytes,
    out: tuple[Bytes, Floats, Bytes],
    tolerance: float = TOLERANCE,
) -> None:
    """Run free as ``simulate``, from where ``control`` stands too, and leave both where it ends.

    So the same rows give the same to the last bit however they are cut. Into ``out`` go phase,
    pressure (Pa) and ``Signal`` bits, each (rows,) or (rows, hypotheses).
    """
    if len(dt) == 0:
        return
    phase, expected, signals = out
    run = _simulate_one if state[0].size == 1 else _simulate
    run(
        state.reshape(STATE, -1),
        (control.air_saving, control.timer),
        theta.reshape(len(c.COEFFICIENTS), -1),
        (dt, np.ascontiguousarray(commands)),
        (
            phase.reshape(len(dt), -1),
            expected.reshape(len(dt), -1),
            signals.reshape(len(dt), -1),
        ),
        tolerance,
    )


def at_rest(theta: c.Theta) -> State:
    """Return a model that stands at ambient pressure and temperature, nothing commanded."""
    state = new_state(*theta.shape[1:])
    _rest(state.reshape(STATE, -1), prepare(theta.reshape(len(c.COEFFICIENTS), -1)))
    return state


def take_over(state: State, before: c.Theta, after: c.Theta) -> None:
    """Let ``state`` go on under other coefficients.

    Where room is added, gas comes with it; a wall that gives way squeezes the gas that is there.
    """
    for mass, volume in ((PORT_MASS, c.PORT_VOLUME), (LINE_MASS, c.LINE_VOLUME)):
        state[mass] *= after[volume] / before[volume]
    room, _ = _room(state[VESSEL], state[YIELDED], before)
    joined = room + (after[c.VOLUME] - before[c.VOLUME])
    state[VESSEL_MASS] *= joined / room
    walls = after[c.COMPLIANCE] != before[c.COMPLIANCE]
    walls |= after[c.SOFTNESS] != before[c.SOFTNESS]
    walls |= after[c.STIFF_UNTIL] != before[c.STIFF_UNTIL]
    walls |= after[c.AMBIENT] != before[c.AMBIENT]
    moved = walls & (state[VALID] > 0.0)
    if moved.any():
        vessel = np.where(moved, state[VESSEL], LOWEST)
        squeezed = _squeezed(vessel, state[YIELDED], joined, after)
        state[VESSEL] = np.where(moved, squeezed, state[VESSEL])


def _room(vessel: State, yielded: State, theta: c.Theta) -> tuple[State, State]:
    """Volume of the vessel at a pressure (m³), shrunk by its vacuum, and its rise (m³/Pa) at once.

    It has ``yielded`` (m³) of what comes later.
    """
    ambient, stiff = theta[c.AMBIENT], theta[c.STIFF_UNTIL]
    vacuum, most = ambient - vessel, ambient / (1.0 + stiff / ambient)
    held = stiff / (abs(vacuum) + stiff + TINY)
    pull, softness = vacuum * (1.0 - held) / most, theta[c.SOFTNESS]
    left = 1.0 / (1.0 + softness * abs(pull))
    stretch = theta[c.COMPLIANCE] * (1.0 + softness) * left * (1.0 - theta[c.CREEP])
    return theta[c.VOLUME] - stretch * pull - yielded, stretch * left * (1.0 - held * held) / most


def _squeezed(vessel: State, yielded: State, joined: State, theta: c.Theta) -> State:
    """Pressure (Pa) of gas that filled ``joined`` (m³) once its walls stand as they do now.

    Without time for heat: p V^γ stays, and V depends on p. Newton's method on the logarithm.
    """
    pressure = vessel.copy()
    for _ in range(SQUEEZES):
        room, rise = _room(pressure, yielded, theta)
        off = np.log(pressure / vessel) + GAMMA * np.log(room / joined)
        slope = 1.0 / pressure + GAMMA * rise / room
        pressure *= np.exp(-off / slope / pressure)
    return pressure


@inlined
def _valve(state: State, position: int, h: float, k: Prepared, response: int, i: int) -> float:
    """Mean position of a valve over a step of ``h``; it follows its command a response later.

    ``position`` indexes position, command and age in ``state``, ``response`` those for opening and
    closing in ``k``. A command shorter than the response is not acted on, as with a real valve.
    """
    before, command, age = state[position, i], state[position + 1, i], state[position + 2, i]
    opening, closing = k[response, i], k[response + 1, i]
    late = (opening if command > 0.5 else closing) - age
    acts = late < h
    state[position, i] = command if acts else before
    state[position + 2, i] = age + h
    return command + (before - command) * max(late, 0.0) / h if acts else before


@inlined
def _release(state: State, k: Prepared, h: float, i: int) -> bool:
    """Whether blow-off lets the part go within about ``h``, or has just done so."""
    filling = -GAMMA * state[FAR, i] * state[VESSEL, i] / state[VESSEL_MASS, i]  # Pa/s, about
    left = k[c.AMBIENT, i] - state[VESSEL, i] - k[c.RELEASE, i]  # NaN where nothing is let go
    soon = state[BLOW_COMMAND, i] > 0.0 and left < 1.5 * h * filling
    return soon if state[OPEN, i] == 0.0 else state[OPEN, i] > 1.0


@inlined
def _until_met(state: State, k: Prepared, i: int) -> float:
    """Seconds until the cups meet the next part, below zero since; NEVER without suction."""
    left = k[c.CONTACT, i] - state[NOZZLE_AGE, i]
    return left if state[NOZZLE_COMMAND, i] > 0.5 else NEVER


@inlined
def _opened(before: float, gas: Gas, commanded: float, k: Prepared, i: int) -> float:
    """Cup after a step in which the vessel's pressure rose from ``before``: 0 if still closed.

    More than 1 by the share of the step that it was open already: the next one makes up for that.
    """
    beyond = gas.vessel - (k[c.AMBIENT, i] - k[c.RELEASE, i])
    missed = min(beyond / max(gas.vessel - before, 1e-9), 1.0)
    return 1.0 + missed if beyond >= 0.0 and commanded > 0.0 else 0.0


@inlined
def _jumps(state: State, k: Prepared, h: float, i: int) -> bool:
    """Whether a valve moves, a cup opens or meets a part within ``h``, or has just done so."""
    for position, response in ((NOZZLE, c.RESPONSE), (BLOW, c.BLOW_OFF_RESPONSE)):
        command = state[position + 1, i]
        late = k[response if command > 0.5 else response + 1, i] - state[position + 2, i]
        if late < h and (state[position, i] != command or late > -h):
            return True
    if k[c.CONTACT, i] > 0.0 and abs(_until_met(state, k, i)) < h:
        return True
    return _release(state, k, h, i)


@inlined
def _passes(state: State, k: Prepared, h: float, i: int) -> bool:
    """Whether blow-off can bring the port within ``h`` to where the exhaust or the relief opens.

    The sensor's first stage follows it, so the distance between them tells how quickly it moves.
    """
    moves = abs(state[PORT, i] - state[FELT, i]) / k[c.SENSOR_LAG, i] * h
    above = state[PORT, i] - k[c.AMBIENT, i]
    opens = min(abs(above - k[c.CRACKING_PRESSURE, i]), abs(above - k[c.RELIEF_PRESSURE, i]))
    return state[BLOWING, i] > 0.01 and opens < moves


@compiled
def _finer(state: State, k: Prepared, h: float, tolerance: float) -> int:
    """In how many steps the next ``h`` is to be done, for the sake of any hypothesis."""
    rough = 0.0
    finest = math.ceil(FINEST * (TOLERANCE / tolerance) ** (1.0 / 3.0))
    for i in range(state.shape[1]):
        if _jumps(state, k, h, i) or _passes(state, k, h, i):
            return finest
        rough = max(rough, state[ROUGH, i])
    return min(max(math.ceil(h * (rough / tolerance) ** (1.0 / 3.0)), 1), finest)


@inlined
def _substep(state: State, k: Prepared, h: float, guess: int) -> None:
    """Advance every hypothesis by ``h`` seconds; this loop is run on several of them at once.

    From row ``guess`` on is the gas as it may be at the step's first stage: 0 is as it is now, and
    far off. LLVM would run the loop on one at a time, and take three times as long, were that in
    another array, or were something read from an array on one side of a condition only.
    """
    for i in range(state.shape[1]):
        left = _until_met(state, k, i)
        nozzle = _valve(state, NOZZLE, h, k, c.RESPONSE, i)
        blow = _valve(state, BLOW, h, k, c.BLOW_OFF_RESPONSE, i)
        gas = Gas(
            state[PORT, i],
            state[PORT_MASS, i],
            state[LINE, i],
            state[LINE_MASS, i],
            state[VESSEL, i],
            state[VESSEL_MASS, i],
            state[NEAR, i],
            state[FAR, i],
            state[YIELDED, i],
        )
        lags = Lags(
            state[DRIVE, i],
            state[JET, i],
            state[BLOWING, i],
            state[DRAINED, i],
            state[SUPPLIED, i],
            state[FELT, i],
            state[SENSED, i],
        )
        ahead = Gas(
            state[guess + PORT, i],
            state[guess + PORT_MASS, i],
            state[guess + LINE, i],
            state[guess + LINE_MASS, i],
            state[guess + VESSEL, i],
            state[guess + VESSEL_MASS, i],
            state[guess + NEAR, i],
            state[guess + FAR, i],
            state[guess + YIELDED, i],
        )
        before = gas.vessel
        open_cup = state[OPEN, i]
        open_cup = open_cup * max(left, 0.0) / h if left < h else open_cup
        valves, passes = Valves(nozzle, blow, open_cup), 1 if guess else 3
        gas, lags, off = advance_gas(gas, lags, ahead, passes, h, valves, k, i)
        state[PORT, i], state[PORT_MASS, i] = gas.port, gas.port_mass
        state[VESSEL, i], state[VESSEL_MASS, i] = gas.vessel, gas.vessel_mass
        state[LINE, i], state[LINE_MASS, i] = gas.line, gas.line_mass
        state[NEAR, i], state[FAR, i], state[YIELDED, i] = gas.near, gas.far, gas.yielded
        state[DRIVE, i], state[JET, i], state[BLOWING, i] = lags.drive, lags.jet, lags.valve
        state[DRAINED, i], state[SUPPLIED, i] = lags.drained, lags.supply
        state[FELT, i], state[SENSED, i] = lags.felt, lags.sensed
        opened = _opened(before, gas, state[BLOW_COMMAND, i], k, i)
        opened = min(open_cup, 1.0) if open_cup > 0.0 else opened
        state[OPEN, i] = 0.0 if left < h else opened
        state[ROUGH, i] = off / (h * h * h)


@inlined
def _drives(state: State, k: Prepared, slot: int, i: int) -> tuple[float, float]:
    """How strongly, 0 to 1, the mechanism of a slot is driven to set in, and to fade.

    A relay remembers whether its vacuum was reached.
    """
    first = c.MECHANISMS + slot * WIDTH
    when, begins = k[first + WHEN, i], k[first + BEGINS, i]
    ambient = k[c.AMBIENT, i]
    vacuum, jet = ambient - state[VESSEL, i], min(state[JET, i], 1.0)
    reached = 1.0 if vacuum >= begins else 0.0 if vacuum < k[first + ENDS, i] else 2.0
    reached = state[REACHED + slot, i] if reached > 1.0 else reached
    state[REACHED + slot, i] = reached
    beyond = min(max((vacuum - begins) / (ambient - begins), 0.0), 1.0)
    drive = 1.0 if when == ALWAYS else 0.0
    drive = 1.0 if when == SWINGING else drive
    drive = jet if when == NOZZLE_ON else drive
    drive = jet if when == GATHERED else drive
    drive = 1.0 - jet if when == NOZZLE_OFF else drive
    drive = min(state[BLOWING, i], 1.0) if when == IN_BLOW_OFF else drive
    drive = reached if when == ABOVE else drive
    drive = beyond if when == BEYOND else drive
    drive = 1.0 - beyond if when == USED_UP else drive
    return drive, min(state[BLOWING, i], 1.0) if when == GATHERED else 1.0 - drive


@inlined
def _set_in(state: State, k: Prepared, slot: int, h: float, i: int) -> None:
    """Let the mechanism of a slot set in or fade for ``h`` seconds of drives that stay.

    It does so exponentially; meanwhile it acts as it does half-way.
    """
    first, share = c.MECHANISMS + slot * WIDTH, state[SET_IN + slot, i]
    drive, away = _drives(state, k, slot, i)
    rise = drive / max(k[first + SETS_IN, i], AT_ONCE)
    rate = rise + away / max(k[first + FADES, i], AT_ONCE)
    there = rise / rate if rate > 0.0 else share
    passed = (state[RUN, i] + 0.5 * h - k[first + SHIFT, i]) / k[first + PERIOD, i]
    turn = math.sin(2.0 * math.pi * passed) if k[first + WHEN, i] == SWINGING else 1.0
    state[ACTS + slot, i] = turn * (there + (share - there) * np.exp(-0.5 * rate * h))
    state[SET_IN + slot, i] = there + (share - there) * np.exp(-rate * h)


@inlined
def _has_mechanism(k: Prepared, i: int) -> bool:
    """Whether anything acts beside the effects of the table."""
    for slot in range(SLOTS):
        first = c.MECHANISMS + slot * WIDTH
        if k[first + SIZE, i] != 0.0 or k[first + ALSO_SIZE, i] != 0.0:
            return True
    return False


@compiled
def _put_in(state: State, k: Prepared, i: int) -> float:
    """Let coefficients be what they are by what mechanisms make of them; give the vessel's room."""
    for slot in range(SLOTS):
        first, unmoved = c.MECHANISMS + slot * WIDTH, UNMOVED + 2 * slot
        k[int(k[first + ON, i]), i] = k[unmoved, i]
        k[int(k[first + ALSO_ON, i]), i] = k[unmoved + 1, i]
    for slot in range(SLOTS):
        first, share = c.MECHANISMS + slot * WIDTH, state[ACTS + slot, i]
        k[int(k[first + ON, i]), i] += share * k[first + SIZE, i]
        k[int(k[first + ALSO_ON, i]), i] += share * k[first + ALSO_SIZE, i]
    derive(k, i)
    return room(state[VESSEL, i], state[YIELDED, i], k, i)


@compiled
def _mechanisms(state: State, k: Prepared, h: float) -> None:
    """Let mechanisms act for the next ``h`` seconds as they do half-way; for 0 s as they did.

    Where walls give way the gas is squeezed.
    """
    for i in range(state.shape[1]):
        if _has_mechanism(k, i):
            before = _put_in(state, k, i)
            if h > 0.0:
                for slot in range(SLOTS):
                    _set_in(state, k, slot, h, i)
                state[RUN, i] += h
                after = _put_in(state, k, i)
                if state[VALID, i] > 0.0:
                    state[VESSEL, i] *= np.exp(GAMMA * np.log(before / after))


@inlined
def _step(state: State, k: Prepared, dt: float, tolerance: float) -> None:
    """Advance by ``dt`` seconds under the commands of the last sample."""
    count = max(math.ceil(dt / LONGEST_STEP - 1e-6), 1)
    h = dt / count
    for _ in range(count):
        _mechanisms(state, k, h)
        finer = _finer(state, k, h, tolerance)
        for _ in range(finer):
            _substep(state, k, h / finer, 0)


@compiled
def _command(state: State, position: int, value: float, i: int) -> None:
    if state[position + 1, i] != value:
        state[position + 1, i] = value
        state[position + 2, i] = 0.0


@compiled
def _enter(state: State, phases: Bytes, k: Prepared) -> None:
    """Take over the phase of a sample: what it commands, and what was measured of the nozzle."""
    for i in range(state.shape[1]):
        before, phase = int(state[PHASE, i]), int(phases[i])
        if phase == before:
            continue
        state[PHASE, i] = phase
        _command(state, NOZZLE, 1.0 if phase == _SUCTION else 0.0, i)
        _command(state, BLOW, 1.0 if phase == _BLOW_OFF else 0.0, i)
        if (before == _HOLD and phase == _SUCTION) or (before == _SUCTION and phase == _HOLD):
            state[NOZZLE_AGE, i] = NEVER  # seen in the pressure: the valve has already acted
        if phase == _SUCTION and before != _HOLD:  # the next part is there, or comes
            comes = k[c.CONTACT, i] > 0.0 and not math.isnan(k[c.RELEASE, i])
            state[OPEN, i] = state[OPEN, i] if comes else 0.0  # one that is held stays
        if phase == _IDLE and before == _BLOW_OFF and not math.isnan(k[c.RELEASE, i]):
            state[OPEN, i] = 1.0  # blow-off has let the part go, early or late


@compiled
def _settle(state: State, k: Prepared, i: int, pressure: float) -> None:
    """Let gas, sensor and supply stand at ``pressure``, as warm as the wall."""
    temperature = k[c.TEMPERATURE, i]
    shrunk, _ = shrinkage(pressure, k, i)
    state[YIELDED, i] = k[c.CREEP, i] * shrunk
    volume = room(pressure, state[YIELDED, i], k, i)
    state[PORT, i] = state[LINE, i] = state[VESSEL, i] = pressure
    state[FELT, i] = state[SENSED, i] = pressure
    state[PORT_MASS, i] = pressure * k[c.PORT_VOLUME, i] / (R * temperature)
    state[VESSEL_MASS, i] = pressure * volume / (R * temperature)
    state[LINE_MASS, i] = pressure * k[c.LINE_VOLUME, i] / (R * temperature)
    state[NEAR, i] = state[FAR, i] = 0.0
    state[SUPPLIED, i] = k[c.SUPPLY, i]


@compiled
def _rest(state: State, k: Prepared) -> None:
    """Let all stand at ambient pressure, valves at rest for long, cups open."""
    for i in range(state.shape[1]):
        _settle(state, k, i, k[c.AMBIENT, i])
        state[NOZZLE_AGE, i] = state[BLOW_AGE, i] = NEVER
        state[OPEN, i] = 1.0 if not math.isnan(k[c.RELEASE, i]) else 0.0
        state[VALID, i] = 1.0


@compiled
def _shift(state: State, shift: float, i: int) -> None:
    """Move all pressures by ``shift`` Pa at the temperatures they have."""
    for node in (PORT, LINE, VESSEL):
        moved = max(state[node, i] + shift, 100.0)
        state[node + 1, i] *= moved / state[node, i]
        state[node, i] = moved
    state[FELT, i] += shift
    state[SENSED, i] += shift


@compiled
def _synchronise(state: State, levels: Floats, k: Prepared) -> None:
    """Set the model onto a measured level (Pa); an open cup is at ambient whatever is read."""
    for i in range(state.shape[1]):
        level = levels[i]
        if math.isnan(level):
            continue
        idle = state[PHASE, i] == _IDLE
        open_cup = state[OPEN, i] > 0.0 and state[PHASE, i] != _SUCTION
        if not math.isnan(k[c.RELEASE, i]) and (idle or open_cup):
            _settle(state, k, i, k[c.AMBIENT, i])
            state[OPEN, i] = 1.0
        elif state[VALID, i] > 0.0:
            _shift(state, sensed_at(level, k, i) - state[SENSED, i], i)
        else:
            _settle(state, k, i, sensed_at(level, k, i))
        if state[VALID, i] == 0.0:
            state[DRIVE, i] = state[JET, i] = state[NOZZLE, i] = state[NOZZLE_COMMAND, i]
            state[BLOWING, i] = state[BLOW, i] = state[BLOW_COMMAND, i]
        state[VALID, i] = 1.0


@per_row
def _read(state: State, k: Prepared, expected: Floats, signals: Bytes) -> None:
    """Write what each hypothesis expects, and the signals it hands out: none where it waits."""
    for i in range(state.shape[1]):
        known = state[VALID, i] > 0.0
        expected[i] = reading(state[SENSED, i], k, i) if known else math.nan
        vacuum = k[c.AMBIENT, i] - state[PORT, i] if known else 0.0
        before = int(state[SIGNALS, i])
        present = part_present(1 if before & _PART_PRESENT else 0, vacuum, k, i)
        reached = air_saving(1 if before & _AIR_SAVING else 0, vacuum, k, i)
        state[SIGNALS, i] = signals[i] = present * _PART_PRESENT + reached * _AIR_SAVING


@inlined
def _together(
    state: State,
    all_k: Prepared,
    driven: tuple[Floats, Bytes, Floats],
    out: tuple[Floats, Bytes],
    first: int,
    width: int,
    tolerance: float,
) -> None:
    """Advance ``width`` hypotheses from ``first`` on; where there are fewer, copies of the last.

    Copied to where rows have a length that the compiler knows: it then sees that no two of them
    overlap, and need not have that checked before each step.
    """
    (dt, phase, level), (expected, signals) = driven, out
    last = state.shape[1] - 1
    mine, k = np.empty((STATE, width)), np.empty((PREPARED, width))
    said, handed = np.empty(width), np.empty(width, np.uint8)
    phases, levels = np.empty(width, np.uint8), np.empty(width)
    for i in range(width):
        put(mine, i, state, min(first + i, last))
        put(k, i, all_k, min(first + i, last))
    _mechanisms(mine, k, 0.0)
    for row in range(dt.shape[0]):
        if dt[row] < 0.0 or dt[row] > LONGEST_BRIDGE:
            mine[VALID] = 0.0
        elif mine[VALID, 0] > 0.0 and dt[row] > 0.0:
            _step(mine, k, dt[row], tolerance)
        for i in range(width):  # all alike, or each its own
            phases[i] = phase[row, min(first + i, last) % phase.shape[1]]
            levels[i] = level[row, min(first + i, last) % level.shape[1]]
        _enter(mine, phases, k)
        _synchronise(mine, levels, k)
        _read(mine, k, said, handed)
        for i in range(width):
            expected[row, min(first + i, last)] = said[i]
            signals[row, min(first + i, last)] = handed[i]
    for i in range(width):
        put(state, min(first + i, last), mine, i)


# One hypothesis and many are compiled apart: who needs only one of them waits for no other.
@compiled
def _advance_one(
    state: State,
    theta: c.Theta,
    dt: Floats,
    phase: Bytes,
    level: Floats,
    expected: Floats,
    signals: Bytes,
    tolerance: float,
) -> None:
    driven, out = (dt, phase, level), (expected, signals)
    _together(state, prepare(theta), driven, out, 0, 1, tolerance)


@compiled
def _advance(
    state: State,
    theta: c.Theta,
    dt: Floats,
    phase: Bytes,
    level: Floats,
    expected: Floats,
    signals: Bytes,
    tolerance: float,
) -> None:
    k, driven, out = prepare(theta), (dt, phase, level), (expected, signals)
    for first in range(0, state.shape[1], LANES):
        _together(state, k, driven, out, first, LANES, tolerance)


@per_row
def _seen_by_control(state: State, k: Prepared, i: int) -> float:
    """Vacuum (Pa) at the sensor that the ejector's own control acts on."""
    if k[c.CONTROL_SENSOR, i] == c.PLC:
        return k[c.AMBIENT_NOMINAL, i] - reading(state[SENSED, i], k, i)
    return k[c.AMBIENT, i] - state[PORT, i]


@per_row
def _decide(
    state: State, controls: Floats, told: Bytes, dt: float, k: Prepared, phases: Bytes
) -> None:
    """Say which phases the ejectors' own controls make of what the valves are told."""
    for i in range(state.shape[1]):
        asked = told[i] == _SUCTION_COMMAND  # blow-off wins
        on = switch(controls[i], asked, _seen_by_control(state, k, i), max(dt, 0.0), k, i)
        phases[i] = _SUCTION if on else _HOLD if asked else _BLOW_OFF if told[i] else _IDLE


@compiled
def _act(state: State, k: Prepared, phases: Bytes) -> None:
    """Enter the phases that the ejectors' own controls made."""
    before = state[PHASE].copy()
    _enter(state, phases, k)
    for i in range(state.shape[1]):
        if phases[i] + before[i] == _SUCTION + _HOLD and phases[i] != before[i]:
            state[NOZZLE_AGE, i] = 0.0  # nothing was measured yet: the valve takes its response


@compiled
def _control(
    state: State, controls: Floats, told: Bytes, dt: float, k: Prepared, phases: Bytes
) -> None:
    """Let the ejectors' own controls switch the nozzle, and enter the phases that result."""
    _decide(state, controls, told, dt, k, phases)
    _act(state, k, phases)


@inlined
def _free(
    state: State,
    all_k: Prepared,
    driven: tuple[Floats, Bytes, Floats, Floats],
    out: tuple[Bytes, Floats, Bytes],
    first: int,
    width: int,
    tolerance: float,
) -> None:
    """Let ``width`` hypotheses from ``first`` on run free, copied as in ``_together``."""
    (dt, commands, control, timer), (phase, expected, signals) = driven, out
    last = state.shape[1] - 1
    mine, k = np.empty((STATE, width)), np.empty((PREPARED, width))
    said, handed, phases = np.empty(width), np.empty(width, np.uint8), np.empty(width, np.uint8)
    controls, timers = np.empty((width, control.shape[1])), np.empty((width, timer.shape[1]))
    told = np.empty((len(dt), width), np.uint8)
    for i in range(width):
        put(mine, i, state, min(first + i, last))
        put(k, i, all_k, min(first + i, last))
        controls[i], timers[i] = control[min(first + i, last)], timer[min(first + i, last)]
        mode, pulse = k[c.BLOW_OFF_MODE, i], k[c.BLOW_OFF_TIME, i]
        timed(timers[i], commands, dt, mode, pulse, told[:, i])
    _mechanisms(mine, k, 0.0)
    for row in range(dt.shape[0]):
        if dt[row] > 0.0:
            _step(mine, k, dt[row], tolerance)
        _control(mine, controls, told[row], dt[row], k, phases)
        _read(mine, k, said, handed)
        for i in range(width):
            phase[row, min(first + i, last)] = phases[i]
            expected[row, min(first + i, last)] = said[i]
            signals[row, min(first + i, last)] = handed[i]
    for i in range(width):
        put(state, min(first + i, last), mine, i)
        control[min(first + i, last)], timer[min(first + i, last)] = controls[i], timers[i]


@compiled
def _simulate_one(
    state: State,
    control: tuple[Floats, Floats],
    theta: c.Theta,
    driven: tuple[Floats, Bytes],
    out: tuple[Bytes, Floats, Bytes],
    tolerance: float,
) -> None:
    _free(state, prepare(theta), driven + control, out, 0, 1, tolerance)


@compiled
def _simulate(
    state: State,
    control: tuple[Floats, Floats],
    theta: c.Theta,
    driven: tuple[Floats, Bytes],
    out: tuple[Bytes, Floats, Bytes],
    tolerance: float,
) -> None:
    k = prepare(theta)
    for first in range(0, state.shape[1], LANES):
        _free(state, k, driven + control, out, first, LANES, tolerance)
