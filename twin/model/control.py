"""The compact ejector's own control: blow-off modes, and air saving with its safeguards.

Air saving has four modes: off; on, with continuous suction after too frequent switching (valve
protection); on with leak monitoring, which also changes to continuous suction after too much
leakage; on without continuous suction. Blow-off has three modes: external; internal, with a timed
pulse after suction; timed, with a pulse that is started from outside. Blow-off has priority over
suction.
"""

import math

import numpy as np
import numpy.typing as npt

from twin.model import theta as c
from twin.model.compiled import compiled, per_row
from twin.model.safeguards import LEAK_SETTLE_S, PROTECTED_S, PROTECTED_SWITCHES
from twin.signals import Command

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]

# Rows of the control's state: whether air saving has switched the nozzle off; whether suction is
# continuous for the rest of the cycle; time (s); time (s) and vacuum (Pa) at which the nozzle went
# off; times of the last switchings (s).
SAVING, CONTINUOUS, TIME, OFF_SINCE, OFF_VACUUM, SWITCHES = range(6)
CONTROL = SWITCHES + PROTECTED_SWITCHES
# Rows of the blow-off timer's state: commands of the row before, and remaining pulse (s).
_BEFORE, _LEFT = range(2)

_SUCTION, _BLOW_OFF = int(Command.SUCTION), int(Command.BLOW_OFF)


@per_row
def _two_point(before: float, vacuum: float, high: float, low: float) -> float:
    return 1 if vacuum >= high else (0 if vacuum < low else before)


@per_row
def air_saving(before: float, vacuum: float, k: c.Theta, i: int) -> float:
    """Whether H1 is reached (0 or 1): from H1 on, until vacuum is below it by the hysteresis."""
    return _two_point(before, vacuum, k[c.H1, i], k[c.H1_LOW, i])


@per_row
def part_present(before: float, vacuum: float, k: c.Theta, i: int) -> float:
    """Whether the part is present (0 or 1): from H2 on, until vacuum is below it by h2."""
    return _two_point(before, vacuum, k[c.H2, i], k[c.H2_LOW, i])


@per_row
def switch(control: Floats, suction_on: bool, vacuum: float, dt: float, k: c.Theta, i: int) -> bool:
    """Whether the nozzle is to be on: suction is commanded, and air saving has not switched it off.

    ``control`` is the state (``CONTROL`` values), ``vacuum`` (Pa) the reading of its sensor, ``dt``
    the seconds since the last call, ``i`` the hypothesis.
    """
    control[TIME] += dt
    if not suction_on:
        control[SAVING] = control[CONTINUOUS] = 0.0
        return False
    mode = k[c.AIR_SAVING, i]
    if mode == c.OFF or control[CONTINUOUS] > 0.0:
        control[SAVING] = 0.0
        return True
    before = control[SAVING]
    control[SAVING] = air_saving(before, vacuum, k, i)
    if control[SAVING] > before:
        control[OFF_SINCE], control[OFF_VACUUM] = control[TIME], vacuum
    if control[SAVING] != before and mode != c.WITHOUT_CONTINUOUS:
        _protect(control)
    off_time = control[TIME] - control[OFF_SINCE]
    judges_leakage = (
        mode == c.LEAK_MONITORING and control[SAVING] > 0.0 and off_time > LEAK_SETTLE_S
    )
    if judges_leakage and control[OFF_VACUUM] - vacuum > k[c.PERMITTED_LEAKAGE, i] * off_time:
        control[CONTINUOUS], control[SAVING] = 1.0, 0.0
    return control[SAVING] == 0.0


@per_row
def _protect(control: Floats) -> None:
    """Remember a switching; after too many, change to continuous suction."""
    oldest = SWITCHES
    for entry in range(SWITCHES + 1, CONTROL):
        if control[entry] < control[oldest]:
            oldest = entry
    if control[TIME] - control[oldest] < PROTECTED_S:
        control[CONTINUOUS], control[SAVING] = 1.0, 0.0
    control[oldest] = control[TIME]


def new_timer() -> Floats:
    """The state of a blow-off timer before its first row."""
    return np.zeros(2)


@per_row
def effective_command(timer: Floats, commands: int, dt: float, mode: float, duration: float) -> int:
    """Commands to the valves (``Command`` bits) at one row; see ``effective_commands``."""
    command, before = commands & (_SUCTION | _BLOW_OFF), int(timer[_BEFORE])
    timer[_LEFT] -= max(dt, 0.0)
    ended = mode == c.INTERNAL and before & _SUCTION and not command & _SUCTION
    started = mode == c.TIMED and command & _BLOW_OFF and not before & _BLOW_OFF
    if ended or started:
        timer[_LEFT] = duration
    timer[_BEFORE] = command
    if mode == c.TIMED:
        command &= _SUCTION
    if timer[_LEFT] > 1e-9:
        command |= _BLOW_OFF
    return command


@compiled
def effective_commands(
    timer: Floats, commands: Bytes, dt: Floats, mode: float, duration: float, effective: Bytes
) -> None:
    """Write the commands to the valves (``Command`` bits) for the PLC's ``commands``, row by row.

    The ejector's blow-off timer adds and removes blow-off. ``dt`` is the time since the row before
    (s), ``mode`` the blow-off mode, ``duration`` the length of its pulse (s).
    """
    for row in range(commands.shape[0]):
        effective[row] = effective_command(timer, int(commands[row]), dt[row], mode, duration)


def nothing_done() -> Floats:
    """The state of a control that has not switched anything for a long time."""
    control = np.zeros(CONTROL)
    control[SWITCHES:] = -math.inf
    return control
