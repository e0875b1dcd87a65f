"""The compiled path: many samples through the right-hand side in one call.

``advance`` carries everything it needs from call to call in ``state``, so the same samples give the
same expected pressures to the last bit however they are cut into blocks.
"""

import math

import numpy as np
import numpy.typing as npt

from twin.model import dataset as c
from twin.model.compiled import compiled
from twin.model.plant import ORDER, WORK, at_supply, reading, runge_kutta, sensed_at
from twin.signals import Phase

# State: the continuous part first (pressure, temperature, jet, blow-off valve, sensor) ...
PRESSURE, TEMPERATURE, JET, BLOWING, SENSED = range(ORDER)
# ... then the valves (position, what is commanded, for how long), phase, open cup, and whether the
# model stands on a measurement at all.
NOZZLE, NOZZLE_COMMAND, NOZZLE_AGE, BLOW, BLOW_COMMAND, BLOW_AGE, PHASE, OPEN, VALID = range(5, 14)
STATE = 14

LONGEST_STEP = 1e-3  # s
LONGEST_BRIDGE = 0.1  # s; after a longer silence the model waits for the next sync
NEVER = 1e9  # s, an age that is past every delay

_IDLE, _SUCTION, _HOLD, _BLOW_OFF = (int(phase) for phase in Phase)

State = npt.NDArray[np.float64]


def new_state() -> State:
    """Return a model that waits for its first sync; it expects NaN until then."""
    state = np.zeros(STATE)
    state[NOZZLE_AGE] = state[BLOW_AGE] = NEVER
    return state


@compiled
def _valve(state, position, h, response):  # type: ignore[no-untyped-def]
    """Mean position of a valve over a step of ``h``; it follows its command ``response`` later.

    ``position`` indexes position, command and age in ``state``. A command shorter than the response
    is not acted on, as with a real valve.
    """
    age = state[position + 2]
    state[position + 2] = age + h
    before, command = state[position], state[position + 1]
    late = response - age
    if before == command or late >= h:
        return before
    state[position] = command
    return command + (before - command) * max(late, 0.0) / h


@compiled
def _step(state, dt, theta, supplied, work):  # type: ignore[no-untyped-def]
    """Advance by ``dt`` seconds under the commands of the last sample."""
    count = max(math.ceil(dt / LONGEST_STEP - 1e-6), 1)
    h = dt / count
    for _ in range(count):
        nozzle = _valve(state, NOZZLE, h, theta[c.RESPONSE])
        blow = _valve(state, BLOW, h, theta[c.BLOW_OFF_RESPONSE])
        runge_kutta(state, h, state[OPEN], nozzle, blow, theta, supplied, work)
        released = theta[c.AMBIENT] - state[PRESSURE] <= theta[c.RELEASE]  # never if that is NaN
        if released and state[BLOW_COMMAND] > 0.0:
            state[OPEN] = 1.0


@compiled
def _command(state, position, value):  # type: ignore[no-untyped-def]
    if state[position + 1] != value:
        state[position + 1] = value
        state[position + 2] = 0.0


@compiled
def _enter(state, phase, theta):  # type: ignore[no-untyped-def]
    """Take over the phase of a sample: what it commands, and what was measured of the nozzle."""
    before = int(state[PHASE])
    if phase == before:
        return
    state[PHASE] = phase
    _command(state, NOZZLE, 1.0 if phase == _SUCTION else 0.0)
    _command(state, BLOW, 1.0 if phase == _BLOW_OFF else 0.0)
    if (before == _HOLD and phase == _SUCTION) or (before == _SUCTION and phase == _HOLD):
        state[NOZZLE_AGE] = NEVER  # seen in the pressure: the valve has already acted
    if phase == _SUCTION and before != _HOLD:
        state[OPEN] = 0.0  # the next part is there
    if phase == _IDLE and before == _BLOW_OFF and theta[c.RELEASE] >= 0.0:
        state[OPEN] = 1.0  # blow-off has let the part go, early or late


@compiled
def _synchronise(state, level, theta):  # type: ignore[no-untyped-def]
    """Set the model onto a measured ``level`` (Pa); an open cup is at ambient whatever is read."""
    idle = state[PHASE] == _IDLE
    if theta[c.RELEASE] >= 0.0 and (idle or state[OPEN] > 0.0):
        state[PRESSURE] = state[SENSED] = theta[c.AMBIENT]
        state[TEMPERATURE] = theta[c.TEMPERATURE]
        state[OPEN] = 1.0
    elif state[VALID] > 0.0:
        shift = sensed_at(level, theta) - state[SENSED]
        state[PRESSURE] = max(state[PRESSURE] + shift, 100.0)
        state[SENSED] += shift
    else:
        state[PRESSURE] = state[SENSED] = sensed_at(level, theta)
        state[TEMPERATURE] = theta[c.TEMPERATURE]
    if state[VALID] == 0.0:
        state[JET] = state[NOZZLE] = state[NOZZLE_COMMAND]
        state[BLOWING] = state[BLOW] = state[BLOW_COMMAND]
    state[VALID] = 1.0


@compiled
def advance(state, theta, dt, phase, level, expected):  # type: ignore[no-untyped-def]
    """Step the model over a block; write what the sensor should read (Pa) into ``expected``.

    Row by row: ``dt`` seconds since the row before (negative: time does not run on, wait for a
    sync), ``phase`` as found by the cycle finder, ``level`` the pressure to synchronise on (Pa, NaN
    for most rows).
    """
    work = np.empty((WORK, ORDER))
    supplied = at_supply(theta)
    for row in range(dt.shape[0]):
        if dt[row] < 0.0 or dt[row] > LONGEST_BRIDGE:
            state[VALID] = 0.0
        elif state[VALID] > 0.0 and dt[row] > 0.0:
            _step(state, dt[row], theta, supplied, work)
        _enter(state, phase[row], theta)
        if not math.isnan(level[row]):
            _synchronise(state, level[row], theta)
        expected[row] = reading(state[SENSED], theta) if state[VALID] > 0.0 else math.nan


@compiled
def simulate(state, theta, dt, commands, phase, expected):  # type: ignore[no-untyped-def]
    """Run free: the model's own air saving switches the nozzle; ``phase`` and ``expected`` are out.

    ``commands`` per row are those of ``Command``; blow-off wins over suction. ``state`` must stand
    on something (``at_rest``).
    """
    work = np.empty((WORK, ORDER))
    supplied = at_supply(theta)
    for row in range(dt.shape[0]):
        if dt[row] > 0.0:
            _step(state, dt[row], theta, supplied, work)
        vacuum = theta[c.AMBIENT] - state[SENSED]
        now = _IDLE
        if commands[row] & 2:
            now = _BLOW_OFF
        elif commands[row] & 1:
            now = _HOLD if state[PHASE] == _HOLD else _SUCTION
            if now == _SUCTION and vacuum >= theta[c.H1]:
                now = _HOLD
            elif now == _HOLD and vacuum < theta[c.H1_LOW]:
                now = _SUCTION
        switched = now + int(state[PHASE]) == _SUCTION + _HOLD and now != state[PHASE]
        _enter(state, now, theta)
        if switched:
            state[NOZZLE_AGE] = 0.0  # nothing was measured yet: the valve takes its response
        phase[row] = now
        expected[row] = reading(state[SENSED], theta)


def at_rest(theta: c.Theta) -> State:
    """Return a model that stands at ambient pressure and temperature, nothing commanded."""
    state = new_state()
    _synchronise(state, reading(theta[c.AMBIENT], theta), theta)
    return state
