"""The compiled model: one call steps over many samples, for one hypothesis or many.

``state`` holds everything that ``advance`` needs from call to call. So the same samples give the
same expected pressures to the last bit, however they are divided into blocks. Hypotheses that run
together share their steps; the one that changes fastest sets the step size. Each result is within
a fraction of a pascal of the hypothesis run alone.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.model import theta as c
from twin.model.air import GAMMA, R
from twin.model.compiled import compiled, inlined, per_row
from twin.model.control import (
    air_saving,
    effective_commands,
    new_timer,
    nothing_done,
    part_present,
    switch,
)
from twin.model.mechanism import (
    ABOVE,
    ALSO_ON,
    ALSO_SIZE,
    ALWAYS,
    BEGINS,
    BEYOND,
    DUTY,
    ENDS,
    FADES,
    GATHERED,
    NOZZLE_OFF,
    NOZZLE_ON,
    ON,
    PERIOD,
    PULSED,
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
    copy_column,
    derive,
    prepare,
    reading,
    sensed_at,
    shrinkage,
    vessel_volume,
)
from twin.model.plant import advance as advance_gas
from twin.signals import Command, Phase, Signal

# Rows of the state. First, gas and lags of the plant:
PORT, PORT_MASS, LINE, LINE_MASS, VESSEL, VESSEL_MASS, NEAR, FAR, YIELDED = range(9)
DRIVE, JET, BLOWING, DRAINED, SUPPLIED, SENSOR_STAGE, SENSED = range(9, ORDER)
# Then the two valves, each with position, command and time since the command (s). The local error
# of a step is ERROR_COEFFICIENT (Pa/s³) times the cube of its length. OPEN is above 0 while the cup
# is open. VALID is 1 once the model was set to a measured level. SIGNALS are Signal bits. Last, for
# each mechanism: its state (0 to 1), the share of its size that acts, and whether its vacuum is
# reached. RUN is the time (s) since the state was new; gaps count, breaks of time do not.
NOZZLE, NOZZLE_COMMAND, NOZZLE_AGE, BLOW, BLOW_COMMAND, BLOW_AGE = range(ORDER, ORDER + 6)
ERROR_COEFFICIENT, PHASE, OPEN, VALID, SIGNALS = range(ORDER + 6, ORDER + 11)
SET_IN, ACTS, REACHED = ORDER + 11, ORDER + 11 + SLOTS, ORDER + 11 + 2 * SLOTS
RUN = REACHED + SLOTS
JUST_OPEN = 1.0 + 1e-9  # of OPEN: marks an event, so that the next step has the most substeps
STATE = RUN + 1

# Hypotheses that run together with the same steps. LLVM vectorises the loop over them only if it is
# long enough to pay for the overlap checks: with eight, the loop stays scalar, three times slower.
LANES = 12
LONGEST_STEP = 0.01  # s
LONGEST_BRIDGE = 0.1  # s; after a longer gap the model waits for the next synchronisation
NEVER = 1e9  # s, longer than every delay
AT_ONCE = 1e-4  # s, time constant of a mechanism without delay
# A step with an event has the most substeps: a valve moves, a cup opens, or blow-off passes ambient
# pressure, where the exhaust opens. Any other step has as many as the tolerance requires.
MOST_SUBSTEPS = 24  # at TOLERANCE; a wider tolerance reduces it in proportion, as for other steps
NEWTON_PASSES = 6  # of Newton's method; enough from a start within a factor of ten
TOLERANCE = 0.02  # Pa, permitted local error of a step, estimated at second order
COARSE_TOLERANCE = 1.0  # Pa; still far below what a sensor resolves

_IDLE, _SUCTION, _HOLD, _BLOW_OFF = (int(phase) for phase in Phase)
_SUCTION_COMMAND = int(Command.SUCTION)
_PART_PRESENT, _AIR_SAVING = int(Signal.PART_PRESENT), int(Signal.AIR_SAVING)

State = npt.NDArray[np.float64]  # (STATE,) or (STATE, hypotheses)
Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]


def new_state(hypotheses: int | None = None) -> State:
    """The state of a model before its first synchronisation; until then it expects NaN."""
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

    Each row has ``dt``, the seconds since the row before (negative after a break of time: then the
    model waits for a synchronisation), the ``phase``, and ``level``, the pressure to synchronise to
    (Pa; NaN in most rows). ``signals`` receives ``Signal`` bits. For n hypotheses, ``state`` is
    (STATE, n), ``theta`` is (coefficients, n) and the results are (rows, n). ``phase`` and
    ``level`` are (rows,), or (rows, n) if each hypothesis has its own. The local error of each
    step is about ``tolerance`` (Pa).
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
        np.ascontiguousarray(phase).reshape(len(dt), -1),  # one array type to compile for
        np.ascontiguousarray(level).reshape(len(dt), -1),
        expected.reshape(len(dt), -1),
        signals.reshape(len(dt), -1),
        tolerance,
    )


@dataclass
class Control:
    """State of the ejectors' own controls, which a free run needs beside ``State``."""

    air_saving: Floats  # (hypotheses, CONTROL)
    timer: Floats  # state of the timed blow-off, (hypotheses, 2)

    @classmethod
    def anew(cls, hypotheses: int = 1) -> "Control":
        """Controls that have not switched anything for a long time."""
        return cls(
            *(np.tile(rest_state, (hypotheses, 1)) for rest_state in (nothing_done(), new_timer()))
        )


def simulate(
    state: State,
    theta: c.Theta,
    dt: Floats,
    commands: Bytes,
    phase: Bytes,
    expected: Floats,
    tolerance: float = TOLERANCE,
) -> None:
    """Run free: the model's own control switches the nozzle.

    Writes ``phase`` and ``expected`` (Pa). ``commands`` are ``Command`` bits per row. ``state``
    must be valid, as from ``at_rest``. The control starts anew with every call. Shapes are those of
    ``advance``.
    """
    outputs = phase, expected, np.empty(expected.shape, np.uint8)
    run_on(state, Control.anew(state[0].size), theta, dt, commands, outputs, tolerance)


def run_on(
    state: State,
    control: Control,
    theta: c.Theta,
    dt: Floats,
    commands: Bytes,
    outputs: tuple[Bytes, Floats, Bytes],
    tolerance: float = TOLERANCE,
) -> None:
    """Run free as ``simulate`` does, and continue both ``state`` and ``control``.

    The same rows give the same results to the last bit, however they are divided into blocks.
    ``outputs`` receives phase, pressure (Pa) and ``Signal`` bits, each (rows,) or
    (rows, hypotheses).
    """
    if len(dt) == 0:
        return
    phase, expected, signals = outputs
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
    """The state of a model at ambient pressure and temperature, with nothing commanded."""
    state = new_state(*theta.shape[1:])
    _reset_to_ambient(state.reshape(STATE, -1), prepare(theta.reshape(len(c.COEFFICIENTS), -1)))
    return state


def take_over(state: State, before: c.Theta, after: c.Theta) -> None:
    """Continue ``state`` with other coefficients.

    Added volume brings its gas at the present pressure. A wall that yields compresses the gas.
    """
    for mass, volume in ((PORT_MASS, c.PORT_VOLUME), (LINE_MASS, c.LINE_VOLUME)):
        state[mass] *= after[volume] / before[volume]
    old_volume, _ = _vessel_volume(state[VESSEL], state[YIELDED], before)
    new_volume = old_volume + (after[c.VOLUME] - before[c.VOLUME])
    state[VESSEL_MASS] *= new_volume / old_volume
    walls_differ = after[c.COMPLIANCE] != before[c.COMPLIANCE]
    walls_differ |= after[c.SOFTNESS] != before[c.SOFTNESS]
    walls_differ |= after[c.STIFF_UNTIL] != before[c.STIFF_UNTIL]
    walls_differ |= after[c.AMBIENT] != before[c.AMBIENT]
    is_squeezed = walls_differ & (state[VALID] > 0.0)
    if is_squeezed.any():
        vessel = np.where(is_squeezed, state[VESSEL], LOWEST)
        squeezed = _adiabatic_pressure(vessel, state[YIELDED], new_volume, after)
        state[VESSEL] = np.where(is_squeezed, squeezed, state[VESSEL])


def _vessel_volume(vessel: State, yielded: State, theta: c.Theta) -> tuple[State, State]:
    """Volume of the vessel (m³) at a pressure, and its immediate change with pressure (m³/Pa).

    Vacuum shrinks the volume. ``yielded`` (m³) is the part that has come by creep.
    """
    ambient, stiff = theta[c.AMBIENT], theta[c.STIFF_UNTIL]
    vacuum, most = ambient - vessel, ambient / (1.0 + stiff / ambient)
    stiffness = stiff / (abs(vacuum) + stiff + TINY)
    pull, softness = vacuum * (1.0 - stiffness) / most, theta[c.SOFTNESS]
    softening = 1.0 / (1.0 + softness * abs(pull))
    stretch = theta[c.COMPLIANCE] * (1.0 + softness) * softening * (1.0 - theta[c.CREEP])
    return theta[c.VOLUME] - stretch * pull - yielded, stretch * softening * (
        1.0 - stiffness * stiffness
    ) / most


def _adiabatic_pressure(
    vessel: State, yielded: State, volume_before: State, theta: c.Theta
) -> State:
    """Pressure (Pa) of gas that filled ``volume_before`` (m³), after its walls have moved.

    The change is adiabatic: p V^γ is constant, and V depends on p. Newton's method solves for the
    logarithm of p.
    """
    pressure = vessel.copy()
    for _ in range(NEWTON_PASSES):
        volume, rise = _vessel_volume(pressure, yielded, theta)
        mismatch = np.log(pressure / vessel) + GAMMA * np.log(volume / volume_before)
        slope = 1.0 / pressure + GAMMA * rise / volume
        pressure *= np.exp(-mismatch / slope / pressure)
    return pressure


@inlined
def _valve_position(
    state: State, position: int, h: float, k: Prepared, response: int, i: int
) -> float:
    """Mean position of a valve (0 to 1) over a step of ``h`` seconds.

    The valve follows its command after its response time. ``position`` is its first of three rows
    in ``state``: position, command, time since the command. ``response`` is the first of two rows
    in ``k``, for opening and closing. As in a real valve, a command shorter than the response has
    no effect.
    """
    before, command, age = state[position, i], state[position + 1, i], state[position + 2, i]
    opening, closing = k[response, i], k[response + 1, i]
    delay = (opening if command > 0.5 else closing) - age
    acts = delay < h
    state[position, i] = command if acts else before
    state[position + 2, i] = age + h
    return command + (before - command) * max(delay, 0.0) / h if acts else before


@inlined
def _releases_part(state: State, k: Prepared, h: float, i: int) -> bool:
    """Whether blow-off releases the part within about ``h`` seconds, or has just done so."""
    filling = (
        -GAMMA * state[FAR, i] * state[VESSEL, i] / state[VESSEL_MASS, i]
    )  # Pa/s, approximately
    remaining = k[c.AMBIENT, i] - state[VESSEL, i] - k[c.RELEASE, i]  # NaN if no part is released
    soon = state[BLOW_COMMAND, i] > 0.0 and remaining < 1.5 * h * filling
    return soon if state[OPEN, i] == 0.0 else state[OPEN, i] > 1.0


@inlined
def _time_to_contact(state: State, k: Prepared, i: int) -> float:
    """Seconds until the cups meet the next part; negative afterwards, NEVER without suction."""
    remaining = k[c.CONTACT, i] - state[NOZZLE_AGE, i]
    return remaining if state[NOZZLE_COMMAND, i] > 0.5 else NEVER


@inlined
def _cup_opening(before: float, gas: Gas, commanded: float, k: Prepared, i: int) -> float:
    """Opening of the cup after a step; ``before`` is the vessel's pressure at its start. 0: closed.

    A cup that opened within the step gets 1 plus the share of the step for which it was open; the
    next step makes up for that share.
    """
    beyond = gas.vessel - (k[c.AMBIENT, i] - k[c.RELEASE, i])
    share = min(beyond / max(gas.vessel - before, 1e-9), 1.0)
    return 1.0 + share if beyond >= 0.0 and commanded > 0.0 else 0.0


@inlined
def _has_event(state: State, k: Prepared, h: float, i: int) -> bool:
    """Whether a valve moves, or a cup opens or meets a part, within ``h``, or has just done so."""
    for position, response in ((NOZZLE, c.RESPONSE), (BLOW, c.BLOW_OFF_RESPONSE)):
        command = state[position + 1, i]
        delay = k[response if command > 0.5 else response + 1, i] - state[position + 2, i]
        if delay < h and (state[position, i] != command or delay > -h):
            return True
    if k[c.CONTACT, i] > 0.0 and abs(_time_to_contact(state, k, i)) < h:
        return True
    return _releases_part(state, k, h, i)


@inlined
def _may_cross_exhaust(state: State, k: Prepared, h: float, i: int) -> bool:
    """Whether blow-off may bring the port within ``h`` to where exhaust or relief opens.

    The sensor's first stage follows the port, so their difference tells how fast the port moves.
    """
    movement = abs(state[PORT, i] - state[SENSOR_STAGE, i]) / k[c.SENSOR_LAG, i] * h
    above = state[PORT, i] - k[c.AMBIENT, i]
    distance = min(abs(above - k[c.CRACKING_PRESSURE, i]), abs(above - k[c.RELIEF_PRESSURE, i]))
    return state[BLOWING, i] > 0.01 and distance < movement


@compiled
def _substep_count(state: State, k: Prepared, h: float, tolerance: float) -> int:
    """Number of substeps of the next ``h`` seconds that is enough for every hypothesis."""
    error_coefficient = 0.0
    most = math.ceil(MOST_SUBSTEPS * (TOLERANCE / tolerance) ** (1.0 / 3.0))
    for i in range(state.shape[1]):
        if _has_event(state, k, h, i) or _may_cross_exhaust(state, k, h, i):
            return most
        error_coefficient = max(error_coefficient, state[ERROR_COEFFICIENT, i])
    return min(max(math.ceil(h * (error_coefficient / tolerance) ** (1.0 / 3.0)), 1), most)


@inlined
def _substep(state: State, k: Prepared, h: float, guess: int) -> None:
    """Advance every hypothesis by ``h`` seconds in one vectorised loop.

    The rows from ``guess`` on hold a guess of the gas at the first stage; with ``guess`` 0 the
    present gas is the guess, which needs more passes. Two things would make LLVM give up
    vectorisation, which takes three times as long: a guess in another array, and a read from an
    array on only one side of a condition.
    """
    for i in range(state.shape[1]):
        contact_in = _time_to_contact(state, k, i)
        nozzle = _valve_position(state, NOZZLE, h, k, c.RESPONSE, i)
        blow = _valve_position(state, BLOW, h, k, c.BLOW_OFF_RESPONSE, i)
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
            state[SENSOR_STAGE, i],
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
        open_cup = open_cup * max(contact_in, 0.0) / h if contact_in < h else open_cup
        valves, passes = Valves(nozzle, blow, open_cup), 1 if guess else 3
        gas, lags, error = advance_gas(gas, lags, ahead, passes, h, valves, k, i)
        state[PORT, i], state[PORT_MASS, i] = gas.port, gas.port_mass
        state[VESSEL, i], state[VESSEL_MASS, i] = gas.vessel, gas.vessel_mass
        state[LINE, i], state[LINE_MASS, i] = gas.line, gas.line_mass
        state[NEAR, i], state[FAR, i], state[YIELDED, i] = gas.near, gas.far, gas.yielded
        state[DRIVE, i], state[JET, i], state[BLOWING, i] = lags.drive, lags.jet, lags.valve
        state[DRAINED, i], state[SUPPLIED, i] = lags.drained, lags.supply
        state[SENSOR_STAGE, i], state[SENSED, i] = lags.sensor_stage, lags.sensed
        opened = _cup_opening(before, gas, state[BLOW_COMMAND, i], k, i)
        opened = min(open_cup, 1.0) if open_cup > 0.0 else opened
        state[OPEN, i] = 0.0 if contact_in < h else opened
        state[ERROR_COEFFICIENT, i] = error / (h * h * h)


@inlined
def _mechanism_drives(state: State, k: Prepared, slot: int, i: int) -> tuple[float, float]:
    """How strongly (0 to 1) the mechanism of a slot is driven to set in, and to fade.

    A mechanism with two thresholds remembers whether its vacuum was reached.
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
    drive = 1.0 if when == PULSED else drive
    drive = jet if when == NOZZLE_ON else drive
    drive = jet if when == GATHERED else drive
    drive = 1.0 - jet if when == NOZZLE_OFF else drive
    drive = min(state[BLOWING, i], 1.0) if when == IN_BLOW_OFF else drive
    drive = reached if when == ABOVE else drive
    drive = beyond if when == BEYOND else drive
    drive = 1.0 - beyond if when == USED_UP else drive
    return drive, min(state[BLOWING, i], 1.0) if when == GATHERED else 1.0 - drive


@inlined
def _wave(k: Prepared, first: int, time: float, h: float, i: int) -> float:
    """Factor (-1 to 1) of the mechanism at ``first`` in the step of ``h`` seconds from ``time`` on.

    One that is on and off has its mean over the step: the deviation is then continuous in the
    instants at which it switches, and a fit finds them. 1 for a mechanism without a rhythm.
    """
    when, begin = k[first + WHEN, i], (time - k[first + SHIFT, i]) / k[first + PERIOD, i]
    length = h / k[first + PERIOD, i]
    if when == SWINGING:
        return math.sin(2.0 * math.pi * (begin + 0.5 * length))
    if when == PULSED:
        end, duty = begin + length, k[first + DUTY, i]
        return (_periods_on(end, duty) - _periods_on(begin, duty)) / length
    return 1.0


@inlined
def _periods_on(periods: float, duty: float) -> float:
    """Sum (in periods) of the time until ``periods`` for which a pulse is on, from 0 on."""
    whole = math.floor(periods)
    return whole * duty + min(periods - whole, duty)


@inlined
def _advance_mechanism(state: State, k: Prepared, slot: int, h: float, i: int) -> None:
    """Let the mechanism of a slot set in or fade for ``h`` seconds, with constant drives.

    The change is exponential. Over the step the mechanism acts with its value at half time.
    """
    first, share = c.MECHANISMS + slot * WIDTH, state[SET_IN + slot, i]
    drive, fade = _mechanism_drives(state, k, slot, i)
    rise = drive / max(k[first + SETS_IN, i], AT_ONCE)
    rate = rise + fade / max(k[first + FADES, i], AT_ONCE)
    target = rise / rate if rate > 0.0 else share
    wave = _wave(k, first, state[RUN, i], h, i)
    state[ACTS + slot, i] = wave * (target + (share - target) * np.exp(-0.5 * rate * h))
    state[SET_IN + slot, i] = target + (share - target) * np.exp(-rate * h)


@inlined
def _has_mechanism(k: Prepared, i: int) -> bool:
    """Whether any mechanism acts on a hypothesis."""
    for slot in range(SLOTS):
        first = c.MECHANISMS + slot * WIDTH
        if k[first + SIZE, i] != 0.0 or k[first + ALSO_SIZE, i] != 0.0:
            return True
    return False


@inlined
def _remove_mechanisms(k: Prepared, i: int) -> None:
    """Make the coefficients what they are without the mechanisms that change them."""
    for slot in range(SLOTS):
        first, unmoved = c.MECHANISMS + slot * WIDTH, UNMOVED + 2 * slot
        k[int(k[first + ON, i]), i] = k[unmoved, i]
        k[int(k[first + ALSO_ON, i]), i] = k[unmoved + 1, i]


@compiled
def _apply_mechanisms(state: State, k: Prepared, i: int) -> float:
    """Put the mechanisms' shares into the coefficients; return the vessel's volume (m³)."""
    _remove_mechanisms(k, i)
    for slot in range(SLOTS):
        first, share = c.MECHANISMS + slot * WIDTH, state[ACTS + slot, i]
        k[int(k[first + ON, i]), i] += share * k[first + SIZE, i]
        k[int(k[first + ALSO_ON, i]), i] += share * k[first + ALSO_SIZE, i]
    derive(k, i)
    return vessel_volume(state[VESSEL, i], state[YIELDED, i], k, i)


@compiled
def _advance_mechanisms(state: State, k: Prepared, h: float) -> None:
    """Advance all mechanisms by ``h`` seconds; with ``h`` 0, only put in their present shares.

    A wall that yields compresses the gas adiabatically.
    """
    for i in range(state.shape[1]):
        if _has_mechanism(k, i):
            before = _apply_mechanisms(state, k, i)
            if h > 0.0:
                for slot in range(SLOTS):
                    _advance_mechanism(state, k, slot, h, i)
                after = _apply_mechanisms(state, k, i)
                if state[VALID, i] > 0.0:
                    state[VESSEL, i] *= np.exp(GAMMA * np.log(before / after))
        state[RUN, i] += h


@compiled
def _wait(state: State, k: Prepared, dt: float) -> None:
    """Let ``dt`` seconds pass without a step, since the model waits for a synchronisation.

    Rhythms go on, and what time alone drives sets in. Any other mechanism keeps its share: what
    drove it meanwhile is not known.
    """
    for i in range(state.shape[1]):
        state[RUN, i] += dt
        if _has_mechanism(k, i):
            for slot in range(SLOTS):
                first = c.MECHANISMS + slot * WIDTH
                if k[first + WHEN, i] in (ALWAYS, SWINGING, PULSED):
                    missing = np.exp(-dt / max(k[first + SETS_IN, i], AT_ONCE))
                    state[SET_IN + slot, i] = 1.0 - (1.0 - state[SET_IN + slot, i]) * missing
                wave = _wave(k, first, state[RUN, i], AT_ONCE, i)
                state[ACTS + slot, i] = wave * state[SET_IN + slot, i]
            _apply_mechanisms(state, k, i)


@inlined
def _step(state: State, k: Prepared, dt: float, tolerance: float) -> None:
    """Advance all hypotheses by ``dt`` seconds under the commands of the last sample."""
    count = max(math.ceil(dt / LONGEST_STEP - 1e-6), 1)
    h = dt / count
    for _ in range(count):
        _advance_mechanisms(state, k, h)
        substeps = _substep_count(state, k, h, tolerance)
        for _ in range(substeps):
            _substep(state, k, h / substeps, 0)


@compiled
def _command(state: State, position: int, value: float, i: int) -> None:
    if state[position + 1, i] != value:
        state[position + 1, i] = value
        state[position + 2, i] = 0.0


@compiled
def _enter_phases(state: State, phases: Bytes, k: Prepared) -> None:
    """Take the phases of a sample: the commands to the valves, and the measured nozzle."""
    for i in range(state.shape[1]):
        before, phase = int(state[PHASE, i]), int(phases[i])
        if phase == before:
            continue
        state[PHASE, i] = phase
        _command(state, NOZZLE, 1.0 if phase == _SUCTION else 0.0, i)
        _command(state, BLOW, 1.0 if phase == _BLOW_OFF else 0.0, i)
        if (before == _HOLD and phase == _SUCTION) or (before == _SUCTION and phase == _HOLD):
            state[NOZZLE_AGE, i] = NEVER  # the pressure has shown it: the valve has already acted
        if phase == _SUCTION and before != _HOLD:  # the next part is there or comes
            meets_part = k[c.CONTACT, i] > 0.0 and not math.isnan(k[c.RELEASE, i])
            state[OPEN, i] = state[OPEN, i] if meets_part else 0.0  # a part that is held stays
        if phase == _IDLE and before == _BLOW_OFF and not math.isnan(k[c.RELEASE, i]):
            state[OPEN, i] = JUST_OPEN  # the part is released by the end of blow-off at the latest


@compiled
def _settle(state: State, k: Prepared, i: int, pressure: float) -> None:
    """Set gas and sensor to ``pressure`` at wall temperature, and the supply to its set value."""
    temperature = k[c.TEMPERATURE, i]
    shrunk, _ = shrinkage(pressure, k, i)
    state[YIELDED, i] = k[c.CREEP, i] * shrunk
    volume = vessel_volume(pressure, state[YIELDED, i], k, i)
    state[PORT, i] = state[LINE, i] = state[VESSEL, i] = pressure
    state[SENSOR_STAGE, i] = state[SENSED, i] = pressure
    state[PORT_MASS, i] = pressure * k[c.PORT_VOLUME, i] / (R * temperature)
    state[VESSEL_MASS, i] = pressure * volume / (R * temperature)
    state[LINE_MASS, i] = pressure * k[c.LINE_VOLUME, i] / (R * temperature)
    state[NEAR, i] = state[FAR, i] = 0.0
    state[SUPPLIED, i] = k[c.SUPPLY, i]


@compiled
def _reset_to_ambient(state: State, k: Prepared) -> None:
    """Set everything to ambient pressure, with valves long at rest and cups open."""
    for i in range(state.shape[1]):
        _settle(state, k, i, k[c.AMBIENT, i])
        state[NOZZLE_AGE, i] = state[BLOW_AGE, i] = NEVER
        state[OPEN, i] = 1.0 if not math.isnan(k[c.RELEASE, i]) else 0.0
        state[VALID, i] = 1.0


@compiled
def _shift_pressures(state: State, shift: float, i: int) -> None:
    """Move all pressures by ``shift`` (Pa) at constant temperatures."""
    for node in (PORT, LINE, VESSEL):
        pressure = max(state[node, i] + shift, 100.0)
        state[node + 1, i] *= pressure / state[node, i]
        state[node, i] = pressure
    state[SENSOR_STAGE, i] += shift
    state[SENSED, i] += shift


@compiled
def _synchronise(state: State, levels: Floats, k: Prepared) -> None:
    """Set the model to a measured level (Pa); with an open cup, to ambient pressure instead."""
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
            _shift_pressures(state, sensed_at(level, k, i) - state[SENSED, i], i)
        else:
            _settle(state, k, i, sensed_at(level, k, i))
        if state[VALID, i] == 0.0:
            state[DRIVE, i] = state[JET, i] = state[NOZZLE, i] = state[NOZZLE_COMMAND, i]
            state[BLOWING, i] = state[BLOW, i] = state[BLOW_COMMAND, i]
        state[VALID, i] = 1.0


@per_row
def _read_sensors(state: State, k: Prepared, expected: Floats, signals: Bytes) -> None:
    """Write each hypothesis' reading (Pa) and its signals; NaN and no signals while it waits."""
    for i in range(state.shape[1]):
        is_valid = state[VALID, i] > 0.0
        expected[i] = reading(state[SENSED, i], k, i) if is_valid else math.nan
        vacuum = k[c.AMBIENT, i] - state[PORT, i] if is_valid else 0.0
        before = int(state[SIGNALS, i])
        present = part_present(1 if before & _PART_PRESENT else 0, vacuum, k, i)
        reached = air_saving(1 if before & _AIR_SAVING else 0, vacuum, k, i)
        state[SIGNALS, i] = signals[i] = present * _PART_PRESENT + reached * _AIR_SAVING


@inlined
def _advance_lanes(
    state: State,
    prepared: Prepared,
    inputs: tuple[Floats, Bytes, Floats],
    outputs: tuple[Floats, Bytes],
    first: int,
    width: int,
    tolerance: float,
) -> None:
    """Advance ``width`` hypotheses from ``first`` on; missing ones are copies of the last.

    They are copied into arrays whose row length the compiler knows. So it sees that rows do not
    overlap, and checks nothing before each step.
    """
    (dt, phase, level), (expected, signals) = inputs, outputs
    last = state.shape[1] - 1
    lanes, k = np.empty((STATE, width)), np.empty((PREPARED, width))
    readings, signal_bits = np.empty(width), np.empty(width, np.uint8)
    phases, levels = np.empty(width, np.uint8), np.empty(width)
    for i in range(width):
        copy_column(lanes, i, state, min(first + i, last))
        copy_column(k, i, prepared, min(first + i, last))
    _advance_mechanisms(lanes, k, 0.0)
    for row in range(dt.shape[0]):
        if dt[row] < 0.0 or dt[row] > LONGEST_BRIDGE:
            lanes[VALID] = 0.0
        if dt[row] > 0.0 and lanes[VALID, 0] > 0.0:
            _step(lanes, k, dt[row], tolerance)
        elif dt[row] > 0.0:
            _wait(lanes, k, dt[row])
        for i in range(width):  # one column for all hypotheses, or one for each
            phases[i] = phase[row, min(first + i, last) % phase.shape[1]]
            levels[i] = level[row, min(first + i, last) % level.shape[1]]
        _enter_phases(lanes, phases, k)
        _synchronise(lanes, levels, k)
        _read_sensors(lanes, k, readings, signal_bits)
        for i in range(width):
            expected[row, min(first + i, last)] = readings[i]
            signals[row, min(first + i, last)] = signal_bits[i]
    for i in range(width):
        copy_column(state, min(first + i, last), lanes, i)


# One hypothesis and many are compiled separately: a caller waits only for what it needs.
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
    inputs, outputs = (dt, phase, level), (expected, signals)
    _advance_lanes(state, prepare(theta), inputs, outputs, 0, 1, tolerance)


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
    k, inputs, outputs = prepare(theta), (dt, phase, level), (expected, signals)
    for first in range(0, state.shape[1], LANES):
        _advance_lanes(state, k, inputs, outputs, first, LANES, tolerance)


@per_row
def _control_vacuum(state: State, k: Prepared, i: int) -> float:
    """Vacuum (Pa) at the sensor that the ejector's own control acts on."""
    if k[c.CONTROL_SENSOR, i] == c.PLC:
        return k[c.AMBIENT_NOMINAL, i] - reading(state[SENSED, i], k, i)
    return k[c.AMBIENT, i] - state[PORT, i]


@per_row
def _decide(
    state: State, controls: Floats, effective: Bytes, dt: float, k: Prepared, phases: Bytes
) -> None:
    """Write the phases by which the ejectors' own controls follow the effective commands."""
    for i in range(state.shape[1]):
        suction_on = effective[i] == _SUCTION_COMMAND  # blow-off has priority
        nozzle_on = switch(
            controls[i], suction_on, _control_vacuum(state, k, i), max(dt, 0.0), k, i
        )
        phases[i] = (
            _SUCTION if nozzle_on else _HOLD if suction_on else _BLOW_OFF if effective[i] else _IDLE
        )


@compiled
def _enter_decided_phases(state: State, k: Prepared, phases: Bytes) -> None:
    """Enter the phases that the ejectors' own controls have decided."""
    before = state[PHASE].copy()
    _enter_phases(state, phases, k)
    for i in range(state.shape[1]):
        if phases[i] + before[i] == _SUCTION + _HOLD and phases[i] != before[i]:
            state[NOZZLE_AGE, i] = 0.0  # not measured: the valve still has its response time


@compiled
def _run_controls(
    state: State, controls: Floats, effective: Bytes, dt: float, k: Prepared, phases: Bytes
) -> None:
    """Let the ejectors' own controls decide the phases, and enter them."""
    _decide(state, controls, effective, dt, k, phases)
    _enter_decided_phases(state, k, phases)


@inlined
def _simulate_lanes(
    state: State,
    prepared: Prepared,
    inputs: tuple[Floats, Bytes, Floats, Floats],
    outputs: tuple[Bytes, Floats, Bytes],
    first: int,
    width: int,
    tolerance: float,
) -> None:
    """Let ``width`` hypotheses from ``first`` on run free, copied as in ``_advance_lanes``."""
    (dt, commands, control, timer), (phase, expected, signals) = inputs, outputs
    last = state.shape[1] - 1
    lanes, k = np.empty((STATE, width)), np.empty((PREPARED, width))
    readings, signal_bits, phases = (
        np.empty(width),
        np.empty(width, np.uint8),
        np.empty(width, np.uint8),
    )
    controls, timers = np.empty((width, control.shape[1])), np.empty((width, timer.shape[1]))
    effective = np.empty((len(dt), width), np.uint8)
    for i in range(width):
        copy_column(lanes, i, state, min(first + i, last))
        copy_column(k, i, prepared, min(first + i, last))
        controls[i], timers[i] = control[min(first + i, last)], timer[min(first + i, last)]
        mode, pulse = k[c.BLOW_OFF_MODE, i], k[c.BLOW_OFF_TIME, i]
        effective_commands(timers[i], commands, dt, mode, pulse, effective[:, i])
    _advance_mechanisms(lanes, k, 0.0)
    for row in range(dt.shape[0]):
        if dt[row] > 0.0:
            _step(lanes, k, dt[row], tolerance)
        _run_controls(lanes, controls, effective[row], dt[row], k, phases)
        _read_sensors(lanes, k, readings, signal_bits)
        for i in range(width):
            phase[row, min(first + i, last)] = phases[i]
            expected[row, min(first + i, last)] = readings[i]
            signals[row, min(first + i, last)] = signal_bits[i]
    for i in range(width):
        copy_column(state, min(first + i, last), lanes, i)
        control[min(first + i, last)], timer[min(first + i, last)] = controls[i], timers[i]


@compiled
def _simulate_one(
    state: State,
    control: tuple[Floats, Floats],
    theta: c.Theta,
    inputs: tuple[Floats, Bytes],
    outputs: tuple[Bytes, Floats, Bytes],
    tolerance: float,
) -> None:
    _simulate_lanes(state, prepare(theta), inputs + control, outputs, 0, 1, tolerance)


@compiled
def _simulate(
    state: State,
    control: tuple[Floats, Floats],
    theta: c.Theta,
    inputs: tuple[Floats, Bytes],
    outputs: tuple[Bytes, Floats, Bytes],
    tolerance: float,
) -> None:
    k = prepare(theta)
    for first in range(0, state.shape[1], LANES):
        _simulate_lanes(state, k, inputs + control, outputs, first, LANES, tolerance)
