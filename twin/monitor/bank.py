"""A bank of hypotheses stepped beside the twin: what would be expected, were something else so.

Each hypothesis is the data set with a little of one parameter of one effect. What it
expects less what the unchanged one does is the effect's signature in the cycles as they are now.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.model import kernel
from twin.model import theta as c
from twin.model.effects import EFFECTS, Parameter, apply
from twin.model.theta import Theta
from twin.monitor.signatures import steps
from twin.signals import Samples, Ticks

STEP = 0.25  # of a parameter's typical size
GROSS = 1.5  # the same for those that are not linear in it for long: what delays

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Suspect:
    """One thing that may be wrong: a parameter of an effect."""

    effect: str
    parameter: Parameter

    @property
    def both_ways(self) -> bool:
        """Whether it can be less than nothing as well."""
        return self.parameter.low < 0.0 or self.parameter.coefficient is not None

    @property
    def step(self) -> float:
        """The size it has in the bank."""
        return STEP * self.parameter.typical

    def of(self, theta: Theta, steps: float = 1.0) -> Theta:
        """Coefficients of an ejector that has it."""
        size = self.parameter.neutral(theta) + steps * self.step
        return apply(theta, self.effect, {self.parameter.name: size})


SUSPECTS: Sequence[Suspect] = tuple(
    Suspect(effect.name, parameter)
    for effect in EFFECTS.values()
    for parameter in effect.parameters
)


# How suction and end pressure follow the supply is the type's, since only one supply was ever
# measured; of its value, one sigma. So it is not known well what a low supply does.
UNSURE = {c.END_SLOPE: 0.5, c.SUPPLY_CURVATURE: 0.5, c.SUPPLY_OPTIMUM: 0.03}
UNSURE_OF = next(i for i, one in enumerate(SUSPECTS) if one.effect == "supply_pressure_drop")
DELAYS = tuple(i for i, one in enumerate(SUSPECTS) if one.parameter.unit == "ms")


def hypotheses(theta: Theta) -> list[Theta]:
    """The unchanged data set, each suspect, and further ones.

    These are what delays once more, grossly, and a low supply in each way it is unsure.
    """
    low = SUSPECTS[UNSURE_OF].of(theta)
    ways = []
    for number, share in UNSURE.items():
        way = low.copy()
        way[number] *= 1.0 + share
        ways.append(way)
    gross = [SUSPECTS[number].of(theta, GROSS / STEP) for number in DELAYS]
    return [theta, *(one.of(theta) for one in SUSPECTS), *gross, *ways]


class Bank:
    """Takes the rows of the twin, and keeps what each hypothesis expects until it is taken."""

    def __init__(self, theta: Theta) -> None:
        self._theta = np.stack(hypotheses(theta), axis=1)
        self._state = kernel.new_state(self._theta.shape[1])
        self._kept = np.empty((0, self._theta.shape[1]))
        self._last_ns: int | None = None

    def push(self, samples: Samples, ticks: Ticks) -> None:
        """Step on by the twin's rows."""
        if not len(samples):
            return
        expected = np.empty((len(samples), self._theta.shape[1]))
        dt, level = steps(samples, self._last_ns), ticks["level"].astype(np.float64)
        phase = np.ascontiguousarray(ticks["phase"])
        kernel.advance(
            self._state, self._theta, dt, phase, level, expected, tolerance=kernel.ROUGHLY
        )
        self._last_ns = int(samples["time_ns"][-1])
        self._kept = np.concatenate([self._kept, expected])

    def take(self, rows: int) -> Floats:
        """Give the oldest ``rows`` (Pa), (rows, hypotheses)."""
        taken, self._kept = self._kept[:rows], self._kept[rows:]
        return taken
