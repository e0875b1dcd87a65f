"""One unit's model in strides: steps as long as it allows, and rows that are read between them.

The kernel steps from row to row, as whoever looks at its state needs. Where one model runs beside a
stream, rows are mostly closer together than its steps have to be. Here a step may reach beyond the
newest row, and rows at which nothing happens are read from the course between its ends. At a row
where something does (another phase, a level to be set on, a break) the step is done anew from its
beginning, to end there. A step under way is carried on, so the same samples give the same to the
last bit however they are cut into blocks.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from twin.model import kernel
from twin.model import theta as c
from twin.model.compiled import compiled, per_row
from twin.model.control import timed
from twin.model.kernel import (
    BLOW,
    BLOWING,
    FELT,
    LONGEST_BRIDGE,
    NEVER,
    NOZZLE,
    OPEN,
    PHASE,
    PORT,
    ROUGH,
    SENSED,
    SIGNALS,
    STATE,
    VALID,
    VESSEL,
    Bytes,
    Floats,
    State,
)
from twin.model.plant import G, Gas, Prepared, at_sensor, prepare, put

TOLERANCE = 0.05  # Pa, of a step: within 0.4 of the exact solution on the shipped rigs
LONGEST_STEP = 15e-3  # s; the course between its ends does not follow further
MECHANISM_STEP = 2e-3  # s, where a mechanism acts: it changes from step to step
SHORTEST_STEP = 40e-6  # s, after a jump of a valve or a cup, and where the exhaust opens
LONGER = 2.0  # at most so many times as long as the step before
TOO_FAR = 1.5  # times the tolerance: the step is done again, shorter

# The clock of a step under way: how long ago it began, its length, that of the last one (s), and
# the course of what is read, as polynomials of how much of the step has passed (0 to 1).
_SINCE, _LENGTH, _BEFORE = range(3)
_SENSED, _PORT = 3, 9
CLOCK = 11
GAS = len(Gas._fields)  # rows of the state, the first ones
# While a step is made there are behind the state where the gas may be and how it moved before.
_GUESS, _RATE = STATE, STATE + GAS


def _nowhere() -> State:
    return kernel.new_state(1)


def _clock() -> Floats:
    clock = np.zeros(CLOCK)
    clock[_BEFORE] = SHORTEST_STEP  # rates are taken over it
    return clock


@dataclass
class DenseSolver:
    """A model, and what it carries from call to call; by itself it waits for its first sync."""

    now: State = field(default_factory=_nowhere)  # at the newest row, as far as it is read
    begin: State = field(default_factory=_nowhere)  # of the step under way
    end: State = field(default_factory=_nowhere)
    clock: Floats = field(default_factory=_clock)

    @classmethod
    def at_rest(cls, theta: c.Theta) -> "DenseSolver":
        """A model that stands at ambient pressure and temperature, nothing commanded."""
        state = kernel.at_rest(theta.reshape(-1, 1))
        return cls(state, state.copy(), state.copy())


def advance(
    strides: DenseSolver,
    theta: c.Theta,
    dt: Floats,
    phase: Bytes,
    level: Floats,
    expected: Floats,
    signals: Bytes,
    tolerance: float = TOLERANCE,
) -> None:
    """Step over a block as ``kernel.advance`` does, within ``tolerance`` (Pa) per step."""
    driven, out = (dt, np.ascontiguousarray(phase), level), (expected, signals)
    _advance(_carried(strides), theta.reshape(-1, 1), driven, out, tolerance)


def run_on(
    strides: DenseSolver,
    control: kernel.Control,
    theta: c.Theta,
    dt: Floats,
    commands: Bytes,
    out: tuple[Bytes, Floats, Bytes],
    tolerance: float = TOLERANCE,
) -> None:
    """Run free over a block as ``kernel.run_on`` does; its control sees what the rows show."""
    driven = dt, np.ascontiguousarray(commands)
    controls = control.air_saving, control.timer
    _run_on(_carried(strides), controls, theta.reshape(-1, 1), driven, out, tolerance)


def simulate(theta: c.Theta, dt: Floats, commands: Bytes) -> tuple[Bytes, Floats]:
    """Phase and expected pressure (Pa) of a free run from rest, where little precision matters."""
    phase, expected, signals = (np.empty(len(dt), kind) for kind in ("u1", "f8", "u1"))
    out = phase, expected, signals
    run_on(
        DenseSolver.at_rest(theta), kernel.Control.anew(), theta, dt, commands, out, kernel.ROUGHLY
    )
    return phase, expected


Carried = tuple[State, State, State, Floats]  # now, begin, end and clock of a DenseSolver


def _carried(strides: DenseSolver) -> Carried:
    return strides.now, strides.begin, strides.end, strides.clock


@per_row
def _until_jump(state: State, k: Prepared) -> float:
    """Seconds until the next valve acts, or the cups meet a part."""
    first = max(kernel._until_met(state, k, 0), 0.0) if state[OPEN, 0] > 0.0 else NEVER
    for position, response in ((NOZZLE, c.RESPONSE), (BLOW, c.BLOW_OFF_RESPONSE)):
        command = state[position + 1, 0]
        late = k[response if command > 0.5 else response + 1, 0] - state[position + 2, 0]
        first = min(first, max(late, 0.0)) if state[position, 0] != command else first
    return first


@per_row
def _planned(begin: State, k: Prepared, moving: float, before: float, tolerance: float) -> float:
    """Length of the next step (s): smooth within, and ending where a valve acts.

    So it ends where blow-off brings the port, ``moving`` by so much (Pa/s), to the pressure at
    which the exhaust or the relief opens.
    """
    rough = begin[ROUGH, 0]
    longest = LONGEST_STEP * (tolerance / TOLERANCE) ** (1.0 / 6.0)  # for what is read
    h = min(longest, LONGER * before)
    h = min(h, MECHANISM_STEP) if kernel._has_mechanism(k, 0) else h
    h = min(h, (tolerance / rough) ** (1.0 / 3.0)) if rough > 0.0 else h
    while h > SHORTEST_STEP and kernel._release(begin, k, h, 0):
        h *= 0.5
    for opening in (c.CRACKING_PRESSURE, c.RELIEF_PRESSURE):
        opens = (k[c.AMBIENT, 0] + k[opening, 0] - begin[PORT, 0]) / moving
        if begin[BLOWING, 0] > 0.01 and 0.0 < opens < h:
            h = opens
    h = max(h, SHORTEST_STEP)
    jump = _until_jump(begin, k)
    if jump < 1e-9:
        return SHORTEST_STEP
    return jump if jump < h else 0.5 * jump if jump < 1.5 * h else h


@compiled
def _stride(
    begin: State, end: State, clock: Floats, k: Prepared, longest: float, tolerance: float
) -> None:
    """Make a step of at most ``longest`` seconds from ``end`` on, which becomes its beginning.

    Where the gas stands at its first stage is guessed by going on as in the step before.
    """
    mine = np.empty((_RATE + GAS, 1))  # a shape that the compiler knows
    for row in range(GAS):
        mine[_RATE + row, 0] = (end[row, 0] - begin[row, 0]) / clock[_BEFORE]
    put(begin, 0, end, 0)
    h = min(_planned(begin, k, mine[_RATE + PORT, 0], clock[_BEFORE], tolerance), longest)
    while True:
        put(mine, 0, begin, 0)
        for row in range(GAS):
            mine[_GUESS + row, 0] = begin[row, 0] + G * h * mine[_RATE + row, 0]
        kernel._mechanisms(mine, k, h)
        kernel._substep(mine, k, h, _GUESS)
        off = mine[ROUGH, 0] * h * h * h
        if not off > TOO_FAR * tolerance or h <= SHORTEST_STEP:  # what is no number ends as well
            break
        h = max(h * (tolerance / off) ** (1.0 / 3.0), SHORTEST_STEP)
    put(end, 0, mine, 0)
    clock[_LENGTH] = clock[_BEFORE] = h


@per_row
def _moving(state: State, length: float, k: Prepared) -> tuple[float, float]:
    """How the sensor's reading moves, and how that changes, for steps of ``length`` seconds.

    It follows, by way of what it feels, the pressure where it sits.
    """
    first = k[c.SENSOR_LAG, 0] / length
    second = first + k[c.SLOW_SENSOR, 0] / length
    felt, sensed = state[FELT, 0], state[SENSED, 0]
    there = at_sensor(state[PORT, 0], state[VESSEL, 0], k, 0)
    moving = (felt - sensed) / second
    return moving, ((there - felt) / first - moving) / second


@per_row
def _drawn(begin: State, end: State, clock: Floats, k: Prepared) -> None:
    """Draw the course over a step of what is read: of fifth order, and straight at the port."""
    first, rise = begin[SENSED, 0], end[SENSED, 0] - begin[SENSED, 0]
    leaving, bends = _moving(begin, clock[_LENGTH], k)
    arriving, bent = _moving(end, clock[_LENGTH], k)
    clock[_SENSED], clock[_SENSED + 1], clock[_SENSED + 2] = first, leaving, 0.5 * bends
    clock[_SENSED + 3] = 10.0 * rise - 6.0 * leaving - 4.0 * arriving - 1.5 * bends + 0.5 * bent
    clock[_SENSED + 4] = -15.0 * rise + 8.0 * leaving + 7.0 * arriving + 1.5 * bends - bent
    clock[_SENSED + 5] = 6.0 * rise - 3.0 * leaving - 3.0 * arriving - 0.5 * bends + 0.5 * bent
    clock[_PORT], clock[_PORT + 1] = begin[PORT, 0], end[PORT, 0] - begin[PORT, 0]


@per_row
def _on(carried: Carried, k: Prepared, dt: float, tolerance: float) -> None:
    """Go on by ``dt`` seconds, and read."""
    now, begin, end, clock = carried
    clock[_SINCE] += dt
    while clock[_SINCE] > clock[_LENGTH]:
        clock[_SINCE] -= clock[_LENGTH]
        _stride(begin, end, clock, k, NEVER, tolerance)
        _drawn(begin, end, clock, k)
    if clock[_LENGTH] > 0.0:
        x = clock[_SINCE] / clock[_LENGTH]
        sensed = clock[_PORT - 1]
        for power in range(_PORT - 2, _SENSED - 1, -1):
            sensed = clock[power] + x * sensed
        now[SENSED, 0] = sensed
        now[PORT, 0] = clock[_PORT] + x * clock[_PORT + 1]


@compiled
def _arrive(carried: Carried, k: Prepared, tolerance: float) -> None:
    """Let all of the state stand at the newest row, by steps that end there."""
    now, begin, end, clock = carried
    signals, left = now[SIGNALS, 0], clock[_SINCE]
    put(end, 0, begin, 0)
    while left > 0.0:
        _stride(begin, end, clock, k, left, tolerance)
        left -= clock[_LENGTH]
    put(now, 0, end, 0)
    now[SIGNALS, 0] = signals
    clock[_SINCE] = clock[_LENGTH] = 0.0


@per_row
def _set_out(carried: Carried) -> None:
    """Go on from where ``now`` was put, by the shortest steps first."""
    now, begin, end, clock = carried
    now[ROUGH, 0] = 0.0
    put(begin, 0, now, 0)
    put(end, 0, now, 0)
    clock[_SINCE] = clock[_LENGTH] = 0.0
    clock[_BEFORE] = SHORTEST_STEP


@compiled
def _advance(
    carried: Carried,
    theta: c.Theta,
    driven: tuple[Floats, Bytes, Floats],
    out: tuple[Floats, Bytes],
    tolerance: float,
) -> None:
    k, now = prepare(theta), carried[0]
    (dt, phase, level), (expected, signals) = driven, out
    said, handed = np.empty(1), np.empty(1, np.uint8)
    kernel._mechanisms(now, k, 0.0)
    for row in range(dt.shape[0]):
        broken = dt[row] < 0.0 or dt[row] > LONGEST_BRIDGE
        if not broken and now[VALID, 0] > 0.0 and dt[row] > 0.0:
            _on(carried, k, dt[row], tolerance)
        if broken or phase[row] != now[PHASE, 0] or not math.isnan(level[row]):
            _arrive(carried, k, tolerance)
            now[VALID, 0] = 0.0 if broken else now[VALID, 0]
            kernel._enter(now, phase[row : row + 1], k)
            kernel._synchronise(now, level[row : row + 1], k)
            _set_out(carried)
        kernel._read(now, k, said, handed)
        expected[row], signals[row] = said[0], handed[0]


@compiled
def _run_on(
    carried: Carried,
    controls: tuple[Floats, Floats],
    theta: c.Theta,
    driven: tuple[Floats, Bytes],
    out: tuple[Bytes, Floats, Bytes],
    tolerance: float,
) -> None:
    k, now = prepare(theta), carried[0]
    (air_saving, timer), (dt, commands), (phase, expected, signals) = controls, driven, out
    told, mode, pulse = np.empty(len(dt), np.uint8), k[c.BLOW_OFF_MODE, 0], k[c.BLOW_OFF_TIME, 0]
    timed(timer[0], commands, dt, mode, pulse, told)
    said, handed = np.empty(1), np.empty(1, np.uint8)
    asked, decided = np.empty(1, np.uint8), np.empty(1, np.uint8)
    kernel._mechanisms(now, k, 0.0)
    for row in range(dt.shape[0]):
        if dt[row] > 0.0:
            _on(carried, k, dt[row], tolerance)
        asked[0] = told[row]
        kernel._decide(now, air_saving, asked, dt[row], k, decided)
        if decided[0] != now[PHASE, 0]:
            _arrive(carried, k, tolerance)
            kernel._act(now, k, decided)
            _set_out(carried)
        kernel._read(now, k, said, handed)
        phase[row], expected[row], signals[row] = decided[0], said[0], handed[0]
