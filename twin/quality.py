"""Quality of samples: the flags, what they rule out, and how they are set.

Every source marks the faults of its samples here: nothing bad is dropped, nothing is invented.
"""

from collections.abc import Sequence
from enum import IntFlag

import numpy as np
import numpy.typing as npt

Flags = npt.NDArray[np.uint8]  # bits of ``Quality``, one byte a row


class Quality(IntFlag):
    """Faults of a sample, or of the stream just before it; 0 is good."""

    GAP = 1  # samples are missing before this one
    RESTART = 2  # the PLC restarted before this one
    CLOCK = 4  # PLC time jumped before this one
    OUT_OF_RANGE = 8  # outside the range the tag declares
    OVERFLOW = 16  # the input is beyond what it can measure: not a pressure
    STALE = 32  # the PLC answers, but its value is no longer fresh
    BAD = 64  # the PLC or the server marks the value as bad
    OURS = 128  # the twin caused the pause before its receipt: it was late, or its clock was set


# Plain numbers: with an IntFlag NumPy would convert every byte to 64 bits.
UNUSABLE = int(Quality.OVERFLOW | Quality.STALE | Quality.BAD)  # no pressure to compare with
BREAK = int(Quality.GAP | Quality.RESTART | Quality.CLOCK)  # time does not run on from before
NEW_TIME = int(Quality.RESTART | Quality.CLOCK)  # another PLC time begins, earlier or later


Rows = npt.NDArray[np.bool_] | npt.NDArray[np.intp] | Sequence[int]  # a mask, or numbers of rows


def mark(flags: Flags, rows: Rows, flag: Quality) -> None:
    """Set a flag of some rows, in place."""
    flags[rows] |= np.uint8(flag)


def flags_where(rows: npt.NDArray[np.bool_], flag: Quality) -> Flags:
    """Flags that are set in the rows of a mask, and 0 elsewhere."""
    return np.where(rows, np.uint8(flag), np.uint8(0))
