"""The run of one record, compiled: commands, valves, air saving, plant and the sensors' lags.

The compiled entry is kept on disk. Numba's key does not see the functions that the entry calls, so
the sources' hash goes into the entry's closure, which the key does see.
"""

import hashlib
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from second_world import faults
from second_world.compiled import compiled
from second_world.plant import approach, coefficients, memories, step
from second_world.state import CELLS, HEAD, HOSE, QUEUE

SUCTION, BLOW_OFF = 1, 2  # bits of the commands
CONTACT, STRIP = 1, 2  # events at the seal
SWITCHES = 20000  # strokes of the nozzle that a record can hold
WARM_UP = 20.0  # s until the sensor's electronics are warm

_RESPONSE = faults.INDEX["response_delay", "delay"]
_BLOW_DELAY = faults.INDEX["blow_off_delay", "delay"]
_STICKING = faults.INDEX["sticking_valve", "delay"]
_H1 = faults.INDEX["threshold_drift", "h1_shift"]
_H2 = faults.INDEX["threshold_drift", "h2_shift"]
_LAG = faults.INDEX["sensor_lag", "time_constant"]
_AMBIENT = faults.INDEX["ambient_pressure", "shift"]
_SWING = faults.INDEX["supply_swing", "amplitude"]


class Course(NamedTuple):
    """What is given for every millisecond."""

    commands: npt.NDArray[np.uint8]
    seal: npt.NDArray[np.uint8]  # events
    source: npt.NDArray[np.float64]  # Pa above ambient at the regulator
    ambient: npt.NDArray[np.float64]  # Pa
    leak: npt.NDArray[np.float64]  # scale of the healthy leak
    neighbour: npt.NDArray[np.float64]  # 0 to 1, the second ejector on the supply
    swing: npt.NDArray[np.float64]  # −1 to 1, the compressor's cycle
    own_noise: npt.NDArray[np.float64]  # Pa, at the ejector's own sensor


class Chance(NamedTuple):
    """What is drawn per stroke; used again from the start when it runs out."""

    jitter: npt.NDArray[np.float64]  # standard normal, valve x strokes
    sticking: npt.NDArray[np.float64]  # 0 or 1


class Traces(NamedTuple):
    """What comes out for every millisecond, and the nozzle's strokes."""

    seen: npt.NDArray[np.float64]  # Pa, at the PLC's sensor behind its lags
    head: npt.NDArray[np.float64]  # Pa
    vessel: npt.NDArray[np.float64]  # Pa
    supply: npt.NDArray[np.float64]  # Pa
    warmth: npt.NDArray[np.float64]  # 0 to 1, of the sensor
    flow: npt.NDArray[np.float64]  # kg/s, out of the hose into the ejector
    switch_time: npt.NDArray[np.float64]  # s
    switch_on: npt.NDArray[np.float64]
    switches: npt.NDArray[np.int64]  # how many of them


class Lags(NamedTuple):
    """How the PLC's sensor follows, and where it sits."""

    cell: int
    first: float  # s
    second: float  # s


@compiled
def command(strokes, which, target, at):
    """Queue a stroke of a valve; strokes never overtake each other."""
    ends = strokes.ends[which]
    if ends[1] > ends[0]:
        at = max(at, strokes.time[which, (ends[1] - 1) % QUEUE])
    strokes.time[which, ends[1] % QUEUE] = at
    strokes.target[which, ends[1] % QUEUE] = target
    ends[1] += 1
    ends[2] += 1


@compiled
def opening(strokes, which, now, open_time, close_time):
    """Opening of a valve, 0 to 1, with the stroke that is under way."""
    ends = strokes.ends[which]
    while True:
        rising = strokes.goal[which] > strokes.start[which]
        duration = open_time if rising else close_time
        distance = (now - strokes.begun[which]) / duration
        span = strokes.goal[which] - strokes.start[which]
        waiting = ends[0] < ends[1] and strokes.time[which, ends[0] % QUEUE] <= now
        if not waiting:
            moved = min(max(distance, 0.0), abs(span))
            return strokes.start[which] + math.copysign(moved, span)
        begin = strokes.time[which, ends[0] % QUEUE]
        moved = min(max((begin - strokes.begun[which]) / duration, 0.0), abs(span))
        strokes.start[which] += math.copysign(moved, span)
        strokes.goal[which] = strokes.target[which, ends[0] % QUEUE]
        strokes.begun[which] = begin
        ends[0] += 1


@compiled
def air_saving(plant, rest, size, wanted, now, noise):
    """Two-point control on the ejector's own sensor; returns whether the nozzle shall run."""
    if not wanted:
        rest.saving = 0.0
        return False
    if plant.air_saving < 0.5:
        return True
    reference = rest.ambient if plant.own_gauge > 0.5 else plant.ambient_pressure
    vacuum = reference - (rest.own_reading + plant.own_offset + noise)
    if rest.saving < 0.5 and vacuum >= plant.h1 + size[_H1]:
        rest.saving, rest.saving_since = 1.0, now
    elif (
        rest.saving > 0.5
        and vacuum <= plant.h1 - plant.hysteresis + size[_H2]
        and now - rest.saving_since >= plant.min_pause
    ):
        rest.saving = 0.0
    return rest.saving < 0.5


@compiled
def seal(plant, rest, gas, event, blowing):
    """Cups touch the part, lift off it when blown free, or are pulled off at last."""
    if plant.released < 0.5:
        return
    last = gas.pressure.size - 1
    if event == CONTACT:
        rest.sealed = 1.0
    elif event == STRIP or (blowing and gas.pressure[last] > rest.ambient + plant.lift_pressure):
        rest.sealed = 0.0


@compiled
def order_nozzle(plant, strokes, size, chance, running, now, traces):
    """Command the suction valve and note when its stroke begins."""
    stroke = strokes.ends[0, 2]
    dead = plant.open_dead_time if running else plant.close_dead_time
    dead += plant.dead_time_jitter * chance.jitter[0, stroke % chance.jitter.shape[1]]
    stuck = chance.sticking[stroke % chance.sticking.size]
    at = now + max(dead, 0.0002) + size[_RESPONSE] + size[_STICKING] * stuck
    command(strokes, 0, 1.0 if running else 0.0, at)
    if traces.switches[0] < SWITCHES:
        traces.switch_time[traces.switches[0]] = strokes.time[0, (strokes.ends[0, 1] - 1) % QUEUE]
        traces.switch_on[traces.switches[0]] = 1.0 if running else 0.0
        traces.switches[0] += 1


@compiled
def order_blow_off(plant, strokes, size, chance, blowing, now):
    """Command the blow-off valve."""
    stroke = strokes.ends[1, 2]
    dead = plant.blow_dead_time if blowing else plant.blow_close_dead_time
    dead += plant.blow_jitter * chance.jitter[1, stroke % chance.jitter.shape[1]]
    command(strokes, 1, 1.0 if blowing else 0.0, now + max(dead, 0.0002) + size[_BLOW_DELAY])


@compiled
def sense(rest, gas, size, lags, own_lag, dt):
    """Move the sensors on by a step."""
    rest.own_reading = approach(rest.own_reading, gas.pressure[HEAD], dt, own_lag)
    rest.lag_1 = approach(rest.lag_1, gas.pressure[lags.cell], dt, lags.first)
    rest.lag_2 = approach(rest.lag_2, rest.lag_1, dt, lags.second)
    rest.lag_3 = approach(rest.lag_3, rest.lag_2, dt, size[_LAG])


@compiled
def note(traces, rest, gas, row):
    """Keep what holds at the end of a millisecond's start."""
    traces.seen[row] = rest.lag_3
    traces.head[row] = gas.pressure[HEAD]
    traces.vessel[row] = gas.pressure[gas.pressure.size - 1]
    traces.supply[row] = rest.p_supply
    traces.warmth[row] = rest.warmth
    traces.flow[row] = -gas.flow[HOSE]


@compiled
def run(  # noqa: PLR0917
    plant, rest, gas, strokes, course, chance, starts, sizes, lags, steps, traces
):
    """Run the whole course; `steps` per millisecond, an even number."""
    dt = 1e-3 / steps
    active, blow_was, wanted_was, running, running_was = 0, False, False, False, False
    for row in range(course.commands.size):
        while active + 1 < starts.size and starts[active + 1] <= row:
            active += 1
        size = sizes[active]
        now = row * 1e-3
        wanted = (course.commands[row] & SUCTION) != 0
        blowing = (course.commands[row] & BLOW_OFF) != 0
        rest.ambient = course.ambient[row] + size[_AMBIENT]
        rest.leak_scale = course.leak[row]
        seal(plant, rest, gas, course.seal[row], blowing)
        if row % plant.own_period_ms < 0.5 or wanted != wanted_was:
            running = air_saving(plant, rest, size, wanted, now, course.own_noise[row])
        if running != running_was:
            order_nozzle(plant, strokes, size, chance, running, now, traces)
        if blowing != blow_was:
            order_blow_off(plant, strokes, size, chance, blowing, now)
        running_was, wanted_was, blow_was = running, wanted, blowing
        note(traces, rest, gas, row)
        source = course.source[row] + size[_SWING] * course.swing[row]
        for k in range(steps):
            if k % (steps // 2) == 0:
                coefficients(plant, gas, size)
                memories(plant, rest, gas, blowing, 0.5e-3)
            then = now + (k + 1) * dt
            rest.valve = opening(strokes, 0, then, plant.opening_time, plant.closing_time)
            rest.blow_valve = opening(
                strokes, 1, then, plant.blow_opening_time, plant.blow_closing_time
            )
            step(plant, rest, gas, size, source, course.neighbour[row], dt)
            sense(rest, gas, size, lags, plant.own_lag, dt)
        rest.warmth = approach(rest.warmth, 1.0, 1e-3, WARM_UP)


def middle_of_hose(cells: int) -> int:
    """Cell in the middle of a hose of so many cells."""
    return CELLS + cells // 2


def _sources() -> str:
    """Hash of this package's sources."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _entry(stamp):
    @njit(cache=True, error_model="numpy")
    def simulate(  # noqa: PLR0917
        plant, rest, gas, strokes, course, chance, starts, sizes, lags, steps, traces
    ):
        _ = stamp
        run(plant, rest, gas, strokes, course, chance, starts, sizes, lags, steps, traces)

    return simulate


simulate = _entry(_sources())
