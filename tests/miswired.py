"""Records with commands or pressure connected wrongly, for what recognises that."""

from collections.abc import Callable

import numpy as np

from twin.signals import Command, Samples


def swapped(samples: Samples) -> None:
    suction, blow_off = (samples["commands"] & bit for bit in (1, 2))
    samples["commands"] = suction * 2 + blow_off // 2


def no_blow_off(samples: Samples) -> None:
    samples["commands"] &= np.uint8(Command.SUCTION)


def counted(scale: float, offset: float) -> Callable[[Samples], None]:
    """The pressure as another unit or reference has it; ``offset`` in ambient pressures."""

    def change(samples: Samples) -> None:
        samples["pressure"] = scale * samples["pressure"] + offset * np.float32(101300.0)

    return change


# What is wrong, and what is said of it, whatever the record is for.
MISWIRED = [
    (swapped, "the two commands are swapped"),
    (counted(-1.0, 2.0), "its sign is wrong"),
    (counted(1.0, -1.0), "gauge pressure, taken for absolute"),
    (counted(1.0, 1.0), "absolute pressure, taken for gauge"),
    (counted(-1.0, 1.0), "vacuum, taken for absolute pressure"),
    (counted(0.1, 0.0), "mbar absolute: too little"),
    (counted(10.0, 0.0), "no vacuum does so"),
    (counted(0.001, 0.999), "no vacuum is made"),
]
