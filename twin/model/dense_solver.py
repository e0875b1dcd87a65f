"""One unit's model with dense output: steps as long as accuracy permits, read at every row.

The kernel steps from row to row. Beside a live stream, rows are mostly closer together than steps
have to be. Here a step may reach beyond the newest row; rows without an event are read from a
polynomial between the ends of the step. At an event (another phase, a level to synchronise on, a
break), the step is repeated from its beginning and ends at that row. A step under way is kept from
call to call. So the same samples give the same results to the last bit, whatever blocks they come
in.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from twin.model import kernel
from twin.model import theta as c
from twin.model.compiled import compiled, per_row
from twin.model.control import effective_commands
from twin.model.kernel import (
    BLOW,
    BLOWING,
    ERROR_COEFFICIENT,
    LONGEST_BRIDGE,
    NEVER,
    NOZZLE,
    OPEN,
    PHASE,
    PORT,
    SENSED,
    SENSOR_STAGE,
    SIGNALS,
    STATE,
    VALID,
    VESSEL,
    Bytes,
    Floats,
    State,
)
from twin.model.plant import G, Gas, Prepared, copy_column, prepare, sensor_pressure

TOLERANCE = 0.05  # Pa, of a step: within 0.4 of the exact solution on the shipped rigs
LONGEST_STEP = 15e-3  # s; the polynomial is not accurate over a longer step
MECHANISM_STEP = 2e-3  # s, longest step while a mechanism acts: it is constant over a step
SHORTEST_STEP = 40e-6  # s, after an event
GROWTH = 2.0  # limit of a step's length relative to the one before
REJECTED_ABOVE = 1.5  # times the tolerance; a step with a larger error is repeated, shorter

# The clock of a step under way: time since its beginning, its length, and the length of the step
# before (s). Then the coefficients of two polynomials over the share of the step that has passed
# (0 to 1): of fifth order for the sensor, and linear for the port.
_ELAPSED, _LENGTH, _LAST_LENGTH = range(3)
_SENSED, _PORT = 3, 9
CLOCK = 11
GAS = len(Gas._fields)  # number of rows of the gas, the first ones of the state
# During a step, rows behind the state hold a guess of the gas and its rate of change.
_GUESS, _RATE = STATE, STATE + GAS


def _nowhere() -> State:
    return kernel.new_state(1)


def _clock() -> Floats:
    clock = np.zeros(CLOCK)
    clock[_LAST_LENGTH] = SHORTEST_STEP  # rates of change are divided by it
    return clock


@dataclass
class DenseSolver:
    """A model with its state from call to call; it starts by waiting for a synchronisation."""

    now: State = field(default_factory=_nowhere)  # at the newest row; only what is read is current
    begin: State = field(default_factory=_nowhere)  # start of the present step
    end: State = field(default_factory=_nowhere)
    clock: Floats = field(default_factory=_clock)

    @classmethod
    def at_rest(cls, theta: c.Theta) -> "DenseSolver":
        """A model at ambient pressure and temperature, with nothing commanded."""
        state = kernel.at_rest(theta.reshape(-1, 1))
        return cls(state, state.copy(), state.copy())


def advance(
    solver: DenseSolver,
    theta: c.Theta,
    dt: Floats,
    phase: Bytes,
    level: Floats,
    expected: Floats,
    signals: Bytes,
    tolerance: float = TOLERANCE,
) -> None:
    """Step over a block as ``kernel.advance`` does, with a local error of ``tolerance`` (Pa)."""
    inputs, outputs = (dt, np.ascontiguousarray(phase), level), (expected, signals)
    _advance(_arrays(solver), theta.reshape(-1, 1), inputs, outputs, tolerance)


def run_on(
    solver: DenseSolver,
    control: kernel.Control,
    theta: c.Theta,
    dt: Floats,
    commands: Bytes,
    outputs: tuple[Bytes, Floats, Bytes],
    tolerance: float = TOLERANCE,
) -> None:
    """Run free over a block as ``kernel.run_on`` does; the control reads the model at each row."""
    inputs = dt, np.ascontiguousarray(commands)
    controls = control.air_saving, control.timer
    _run_on(_arrays(solver), controls, theta.reshape(-1, 1), inputs, outputs, tolerance)


def simulate(theta: c.Theta, dt: Floats, commands: Bytes) -> tuple[Bytes, Floats]:
    """Phase and expected pressure (Pa) of a free run from rest, at the coarse tolerance."""
    phase, expected, signals = (np.empty(len(dt), kind) for kind in ("u1", "f8", "u1"))
    outputs = phase, expected, signals
    run_on(
        DenseSolver.at_rest(theta),
        kernel.Control.anew(),
        theta,
        dt,
        commands,
        outputs,
        kernel.COARSE_TOLERANCE,
    )
    return phase, expected


Arrays = tuple[State, State, State, Floats]  # now, begin, end and clock of a DenseSolver


def _arrays(solver: DenseSolver) -> Arrays:
    return solver.now, solver.begin, solver.end, solver.clock


@per_row
def _time_to_event(state: State, k: Prepared) -> float:
    """Seconds until the next valve acts or the cups meet a part."""
    remaining = max(kernel._time_to_contact(state, k, 0), 0.0) if state[OPEN, 0] > 0.0 else NEVER
    for position, response in ((NOZZLE, c.RESPONSE), (BLOW, c.BLOW_OFF_RESPONSE)):
        command = state[position + 1, 0]
        delay = k[response if command > 0.5 else response + 1, 0] - state[position + 2, 0]
        remaining = min(remaining, max(delay, 0.0)) if state[position, 0] != command else remaining
    return remaining


@per_row
def _next_step_length(
    begin: State, k: Prepared, port_rate: float, last_length: float, tolerance: float
) -> float:
    """Length of the next step (s). It has no event inside; it ends at the next one.

    Events are a valve that acts, and a port that blow-off brings to the opening pressure of the
    exhaust or the relief. ``port_rate`` (Pa/s) is the rate of change of the port.
    """
    error_coefficient = begin[ERROR_COEFFICIENT, 0]
    longest = LONGEST_STEP * (tolerance / TOLERANCE) ** (1.0 / 6.0)  # for the polynomial
    h = min(longest, GROWTH * last_length)
    h = min(h, MECHANISM_STEP) if kernel._has_mechanism(k, 0) else h
    h = min(h, (tolerance / error_coefficient) ** (1.0 / 3.0)) if error_coefficient > 0.0 else h
    while h > SHORTEST_STEP and kernel._releases_part(begin, k, h, 0):
        h *= 0.5
    for opening in (c.CRACKING_PRESSURE, c.RELIEF_PRESSURE):
        opens = (k[c.AMBIENT, 0] + k[opening, 0] - begin[PORT, 0]) / port_rate
        if begin[BLOWING, 0] > 0.01 and 0.0 < opens < h:
            h = opens
    h = max(h, SHORTEST_STEP)
    event_in = _time_to_event(begin, k)
    if event_in < 1e-9:
        return SHORTEST_STEP
    return event_in if event_in < h else 0.5 * event_in if event_in < 1.5 * h else h


@compiled
def _step(
    begin: State, end: State, clock: Floats, k: Prepared, longest: float, tolerance: float
) -> None:
    """Make a step of at most ``longest`` seconds from ``end`` on, which becomes ``begin``.

    The gas at the first stage is extrapolated from the step before.
    """
    trial = np.empty((_RATE + GAS, 1))  # the compiler knows the number of columns
    for row in range(GAS):
        trial[_RATE + row, 0] = (end[row, 0] - begin[row, 0]) / clock[_LAST_LENGTH]
    copy_column(begin, 0, end, 0)
    h = min(
        _next_step_length(begin, k, trial[_RATE + PORT, 0], clock[_LAST_LENGTH], tolerance), longest
    )
    while True:
        copy_column(trial, 0, begin, 0)
        for row in range(GAS):
            trial[_GUESS + row, 0] = begin[row, 0] + G * h * trial[_RATE + row, 0]
        kernel._advance_mechanisms(trial, k, h)
        kernel._substep(trial, k, h, _GUESS)
        error = trial[ERROR_COEFFICIENT, 0] * h * h * h
        if (
            not error > REJECTED_ABOVE * tolerance or h <= SHORTEST_STEP
        ):  # NaN ends the loop as well
            break
        h = max(h * (tolerance / error) ** (1.0 / 3.0), SHORTEST_STEP)
    copy_column(end, 0, trial, 0)
    clock[_LENGTH] = clock[_LAST_LENGTH] = h


@per_row
def _reading_derivatives(state: State, length: float, k: Prepared) -> tuple[float, float]:
    """First and second derivative of the sensor's pressure over the share of a step (Pa).

    ``length`` is the step's length (s). The sensor follows the pressure at its place through its
    first stage.
    """
    first = k[c.SENSOR_LAG, 0] / length
    second = first + k[c.SLOW_SENSOR, 0] / length
    sensor_stage, sensed = state[SENSOR_STAGE, 0], state[SENSED, 0]
    at_sensor = sensor_pressure(state[PORT, 0], state[VESSEL, 0], k, 0)
    rate = (sensor_stage - sensed) / second
    return rate, ((at_sensor - sensor_stage) / first - rate) / second


@per_row
def _set_dense_output(begin: State, end: State, clock: Floats, k: Prepared) -> None:
    """Set the polynomials of a step: of fifth order for the sensor, linear for the port."""
    first, rise = begin[SENSED, 0], end[SENSED, 0] - begin[SENSED, 0]
    rate, curvature = _reading_derivatives(begin, clock[_LENGTH], k)
    end_rate, end_curvature = _reading_derivatives(end, clock[_LENGTH], k)
    clock[_SENSED], clock[_SENSED + 1], clock[_SENSED + 2] = first, rate, 0.5 * curvature
    clock[_SENSED + 3] = (
        10.0 * rise - 6.0 * rate - 4.0 * end_rate - 1.5 * curvature + 0.5 * end_curvature
    )
    clock[_SENSED + 4] = (
        -15.0 * rise + 8.0 * rate + 7.0 * end_rate + 1.5 * curvature - end_curvature
    )
    clock[_SENSED + 5] = (
        6.0 * rise - 3.0 * rate - 3.0 * end_rate - 0.5 * curvature + 0.5 * end_curvature
    )
    clock[_PORT], clock[_PORT + 1] = begin[PORT, 0], end[PORT, 0] - begin[PORT, 0]


@per_row
def _advance_to_row(arrays: Arrays, k: Prepared, dt: float, tolerance: float) -> None:
    """Advance by ``dt`` seconds, and read sensor and port from the polynomials."""
    now, begin, end, clock = arrays
    clock[_ELAPSED] += dt
    while clock[_ELAPSED] > clock[_LENGTH]:
        clock[_ELAPSED] -= clock[_LENGTH]
        _step(begin, end, clock, k, NEVER, tolerance)
        _set_dense_output(begin, end, clock, k)
    if clock[_LENGTH] > 0.0:
        x = clock[_ELAPSED] / clock[_LENGTH]
        sensed = clock[_PORT - 1]
        for power in range(_PORT - 2, _SENSED - 1, -1):
            sensed = clock[power] + x * sensed
        now[SENSED, 0] = sensed
        now[PORT, 0] = clock[_PORT] + x * clock[_PORT + 1]


@compiled
def _truncate_step(arrays: Arrays, k: Prepared, tolerance: float) -> None:
    """Bring the whole state to the newest row, by steps from ``begin`` that end there."""
    now, begin, end, clock = arrays
    signals, remaining = now[SIGNALS, 0], clock[_ELAPSED]
    copy_column(end, 0, begin, 0)
    while remaining > 0.0:
        _step(begin, end, clock, k, remaining, tolerance)
        remaining -= clock[_LENGTH]
    copy_column(now, 0, end, 0)
    now[SIGNALS, 0] = signals
    clock[_ELAPSED] = clock[_LENGTH] = 0.0


@per_row
def _restart(arrays: Arrays) -> None:
    """Restart at ``now``, with the shortest step first."""
    now, begin, end, clock = arrays
    now[ERROR_COEFFICIENT, 0] = 0.0
    copy_column(begin, 0, now, 0)
    copy_column(end, 0, now, 0)
    clock[_ELAPSED] = clock[_LENGTH] = 0.0
    clock[_LAST_LENGTH] = SHORTEST_STEP


@compiled
def _advance(
    arrays: Arrays,
    theta: c.Theta,
    inputs: tuple[Floats, Bytes, Floats],
    outputs: tuple[Floats, Bytes],
    tolerance: float,
) -> None:
    k, now = prepare(theta), arrays[0]
    (dt, phase, level), (expected, signals) = inputs, outputs
    readings, signal_bits = np.empty(1), np.empty(1, np.uint8)
    kernel._advance_mechanisms(now, k, 0.0)
    for row in range(dt.shape[0]):
        is_broken = dt[row] < 0.0 or dt[row] > LONGEST_BRIDGE
        waits = is_broken or now[VALID, 0] == 0.0
        if not waits and dt[row] > 0.0:
            _advance_to_row(arrays, k, dt[row], tolerance)
        if waits or phase[row] != now[PHASE, 0] or not math.isnan(level[row]):
            _truncate_step(arrays, k, tolerance)
            if waits:
                now[VALID, 0] = 0.0
                kernel._wait(now, k, max(dt[row], 0.0))
            kernel._enter_phases(now, phase[row : row + 1], k)
            kernel._synchronise(now, level[row : row + 1], k)
            _restart(arrays)
        kernel._read_sensors(now, k, readings, signal_bits)
        expected[row], signals[row] = readings[0], signal_bits[0]


@compiled
def _run_on(
    arrays: Arrays,
    controls: tuple[Floats, Floats],
    theta: c.Theta,
    inputs: tuple[Floats, Bytes],
    outputs: tuple[Bytes, Floats, Bytes],
    tolerance: float,
) -> None:
    k, now = prepare(theta), arrays[0]
    (air_saving, timer), (dt, commands), (phase, expected, signals) = controls, inputs, outputs
    effective, mode, pulse = (
        np.empty(len(dt), np.uint8),
        k[c.BLOW_OFF_MODE, 0],
        k[c.BLOW_OFF_TIME, 0],
    )
    effective_commands(timer[0], commands, dt, mode, pulse, effective)
    readings, signal_bits = np.empty(1), np.empty(1, np.uint8)
    commands_now, decided = np.empty(1, np.uint8), np.empty(1, np.uint8)
    kernel._advance_mechanisms(now, k, 0.0)
    for row in range(dt.shape[0]):
        if dt[row] > 0.0:
            _advance_to_row(arrays, k, dt[row], tolerance)
        commands_now[0] = effective[row]
        kernel._decide(now, air_saving, commands_now, dt[row], k, decided)
        if decided[0] != now[PHASE, 0]:
            _truncate_step(arrays, k, tolerance)
            kernel._enter_decided_phases(now, k, decided)
            _restart(arrays)
        kernel._read_sensors(now, k, readings, signal_bits)
        phase[row], expected[row], signals[row] = decided[0], readings[0], signal_bits[0]
