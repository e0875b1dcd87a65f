"""The compact ejector's own control: blow-off modes, and air saving with its safeguards.

The field's modes. Air saving: off; on, where too frequent switching ends in continuous suction
(valve protection); on with leak monitoring, where too much leakage does as well; on without
continuous suction. Blow-off: external; internal, a timed pulse after suction; timed, a pulse
started from outside. Blow-off wins over suction.
"""

import math

import numpy as np
import numpy.typing as npt

from twin.model import theta as c
from twin.model.compiled import compiled, per_row
from twin.signals import Command

PROTECTED_SWITCHES = 6  # within ...
PROTECTED_S = 3.0  # s, more of them end in continuous suction
LEAK_SETTLE_S = 0.05  # s after the nozzle went off before leakage is judged

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]

# Rows of the control's state: whether air saving has the nozzle off, whether it has given up for
# this cycle, time, when and at which vacuum the nozzle went off, and the last switchings.
SAVING, CONTINUOUS, TIME, OFF_SINCE, OFF_VACUUM, SWITCHES = range(6)
CONTROL = SWITCHES + PROTECTED_SWITCHES
# Rows of the blow-off timer's state: commands before, and what is left of the pulse.
_BEFORE, _LEFT = range(2)

_SUCTION, _BLOW_OFF = int(Command.SUCTION), int(Command.BLOW_OFF)


@per_row
def _two_point(before: float, vacuum: float, high: float, low: float) -> float:
    return 1 if vacuum >= high else (0 if vacuum < low else before)


@per_row
def air_saving(before: float, vacuum: float, k: c.Theta, i: int) -> float:
    """H1: reached from its switching point on, until vacuum is below it by the hysteresis."""
    return _two_point(before, vacuum, k[c.H1, i], k[c.H1_LOW, i])


@per_row
def part_present(before: float, vacuum: float, k: c.Theta, i: int) -> float:
    """H2: the part is there from the switching point on, with its hysteresis."""
    return _two_point(before, vacuum, k[c.H2, i], k[c.H2_LOW, i])


@per_row
def switch(control: Floats, asked: bool, vacuum: float, dt: float, k: c.Theta, i: int) -> bool:
    """Say whether the nozzle is to be on: suction is ``asked`` for and air is not being saved.

    ``control`` is the state (``CONTROL`` values), ``vacuum`` (Pa) what its sensor says, ``dt`` the
    seconds since it was asked last. ``i`` is the hypothesis.
    """
    control[TIME] += dt
    if not asked:
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
    saved = control[TIME] - control[OFF_SINCE]
    watched = mode == c.LEAK_MONITORING and control[SAVING] > 0.0 and saved > LEAK_SETTLE_S
    if watched and control[OFF_VACUUM] - vacuum > k[c.PERMITTED_LEAKAGE, i] * saved:
        control[CONTINUOUS], control[SAVING] = 1.0, 0.0
    return control[SAVING] == 0.0


@per_row
def _protect(control: Floats) -> None:
    """Remember a switching; give up saving air when there were too many."""
    oldest = SWITCHES
    for one in range(SWITCHES + 1, CONTROL):
        if control[one] < control[oldest]:
            oldest = one
    if control[TIME] - control[oldest] < PROTECTED_S:
        control[CONTINUOUS], control[SAVING] = 1.0, 0.0
    control[oldest] = control[TIME]


def new_timer() -> Floats:
    """Return the state of a blow-off timer that has seen nothing yet."""
    return np.zeros(2)


@per_row
def told(timer: Floats, commands: int, dt: float, mode: float, duration: float) -> int:
    """What the valves are told (``Command`` bits), as ``timed`` for one row."""
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
def timed(
    timer: Floats, commands: Bytes, dt: Floats, mode: float, duration: float, effective: Bytes
) -> None:
    """Write into ``effective`` what the valves are told, given what the PLC commands, row by row.

    ``dt`` are seconds since the row before, ``mode`` the blow-off mode, ``duration`` its pulse (s).
    """
    for row in range(commands.shape[0]):
        effective[row] = told(timer, int(commands[row]), dt[row], mode, duration)


def nothing_done() -> Floats:
    """Return a control's state that has not switched anything for long."""
    control = np.zeros(CONTROL)
    control[SWITCHES:] = -math.inf
    return control
