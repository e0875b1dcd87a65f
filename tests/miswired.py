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
