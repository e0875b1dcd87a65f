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
from twin.monitor.bins import drawn
from twin.monitor.signatures import steps
from twin.signals import MS, NS, Phase, Samples, Ticks, joined

BATCH = 250  # rows that are stepped together: what many calls cost is spared
STEP = 0.25  # of a parameter's typical size
# What delays moves steep edges: they differ in proportion to it only while it is shorter than they
# are. So it has a smaller step, and larger sizes beside it.
DELAY_STEPS = (0.05, 0.25, 1.5)
# What changes with the weather or another set-up, and is nothing to mend: looked for as well, and
# not so that all else is found later.
NO_WEAR = ("ambient_pressure", "heat_exchange")
SELDOM = 0.2

Floats = npt.NDArray[np.float64]
_ROW = np.dtype(
    [
        ("time_ns", "i8"),
        ("dt", "f8"),
        ("level", "f8"),
        ("phase", "u1"),
        ("next", "u1"),  # the phase of the row after it
        ("bends", "?"),  # here a bend of what is expected begins
        ("since", "i8"),  # rows, then
    ]
)


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
    def often(self) -> float:
        """How frequent it is thought to be, beside what wears."""
        return SELDOM if self.effect in NO_WEAR else 1.0

    @property
    def delays(self) -> bool:
        """Whether it is a time by which something is late."""
        return self.parameter.unit == "ms"

    @property
    def step(self) -> float:
        """The size it has in the bank."""
        return (DELAY_STEPS[0] if self.delays else STEP) * self.parameter.typical

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
DELAYS = tuple(i for i, one in enumerate(SUSPECTS) if one.delays)
LARGER = len(DELAY_STEPS) - 1  # sizes beside the step
# With a step of these the air saving's switching off, or on, is seen a row later than it acts.
SEEN_LATER = {Phase.HOLD: ("sensor_lag",), Phase.SUCTION: ("sensor_lag", "slow_ramp_up")}


def hypotheses(theta: Theta) -> list[Theta]:
    """The unchanged data set, each suspect, and further ones.

    These are the larger sizes of what delays, and a low supply in each way it is unsure.
    """
    low = SUSPECTS[UNSURE_OF].of(theta)
    ways = []
    for number, share in UNSURE.items():
        way = low.copy()
        way[number] *= 1.0 + share
        ways.append(way)
    steps = [size / DELAY_STEPS[0] for size in DELAY_STEPS[1:]]
    larger = [SUSPECTS[number].of(theta, some) for number in DELAYS for some in steps]
    return [theta, *(one.of(theta) for one in SUSPECTS), *larger, *ways]


class Bank:
    """Takes the rows of the twin, and keeps what each hypothesis expects until it is taken.

    Signatures are smooth but where a phase or a stretch begins, so the bank steps from one to the
    next of the rows that suffice to draw them (``bins.drawn``); to know them it is one row behind.
    """

    def __init__(self, theta: Theta) -> None:
        self._theta = np.stack(hypotheses(theta), axis=1)
        self._state = kernel.new_state(self._theta.shape[1])
        self._parts: list[tuple[Samples, Ticks]] = []  # rows that are not stepped yet
        self._fresh = 0  # how many
        self._waits = np.empty(0, _ROW)  # the newest row: the one after it is not known yet
        self._last_ns: int | None = None  # PLC time of the newest row
        self._phase = -1  # and its phase
        self._since = 0  # rows since a bend began, of the newest one
        self._drawn_ns = 0  # PLC time of the newest row that was drawn
        self._count = 0  # rows that were pushed and not taken
        self._rows = np.empty(0, np.int64)  # of these, that were drawn
        self._expected = np.empty((0, self._theta.shape[1]))

    def push(self, samples: Samples, ticks: Ticks) -> None:
        """Step on by the twin's rows, some time; nothing is kept of a silence."""
        if not len(samples):
            return
        self._parts.append((samples, ticks))
        self._fresh += len(samples)
        if self._fresh >= BATCH:
            self._step_on()

    def _step_on(self) -> None:
        if not self._fresh:
            return
        samples, ticks = (joined(*column) for column in zip(*self._parts, strict=True))
        self._parts, self._fresh = [], 0
        fresh = np.empty(len(samples), _ROW)
        fresh["time_ns"], fresh["level"] = samples["time_ns"], ticks["level"]
        fresh["phase"], fresh["dt"] = ticks["phase"], steps(samples, self._last_ns)
        fresh["bends"] = np.diff(ticks["phase"], prepend=self._phase) != 0
        fresh["bends"] |= np.isfinite(ticks["level"]) | (fresh["dt"] < 0.5 * MS)
        fresh["bends"] |= fresh["dt"] > 1.5 * MS
        number = np.arange(len(fresh))
        begun = np.where(fresh["bends"], number, -1 - self._since)
        fresh["since"] = number - np.maximum.accumulate(begun)
        self._last_ns, self._phase = int(samples["time_ns"][-1]), int(ticks["phase"][-1])
        self._since = int(fresh["since"][-1])
        rows = joined(self._waits, fresh)
        drawn_now = drawn(rows["since"][:-1]) | rows["bends"][1:]
        first = self._count - len(self._waits)
        self._count += len(samples)
        rows["next"][:-1] = rows["phase"][1:]
        self._waits = rows[-1:]
        self._step(rows[:-1][drawn_now], first + np.flatnonzero(drawn_now))

    def _step(self, rows: npt.NDArray[np.void], numbers: npt.NDArray[np.int64]) -> None:
        if not len(rows):
            return
        before = np.concatenate([[self._drawn_ns], rows["time_ns"][:-1]])
        dt = np.where(rows["dt"] < 0.0, -1.0, (rows["time_ns"] - before) * NS)
        expected = np.empty((len(rows), self._theta.shape[1]))
        phase, level = _phases(rows, self._theta.shape[1]), np.ascontiguousarray(rows["level"])
        kernel.advance(
            self._state, self._theta, dt, phase, level, expected, tolerance=kernel.ROUGHLY
        )
        self._drawn_ns = int(rows["time_ns"][-1])
        self._rows = np.concatenate([self._rows, numbers])
        self._expected = np.concatenate([self._expected, expected])

    def take(self, count: int) -> tuple[npt.NDArray[np.int64], Floats]:
        """Of the oldest ``count`` rows those that were drawn, and what is expected there (Pa).

        These are (drawn, hypotheses).
        """
        self._step_on()
        if count == self._count and len(self._waits):
            self._waits["next"] = self._waits["phase"]
            self._step(self._waits, np.array([count - 1]))
            self._waits = self._waits[:0]
        mine = self._rows < count
        taken = self._rows[mine], self._expected[mine]
        self._rows, self._expected = self._rows[~mine] - count, self._expected[~mine]
        self._count -= count
        return taken


def _phases(rows: npt.NDArray[np.void], count: int) -> npt.NDArray[np.uint8]:
    """Phases (rows, hypotheses): what is seen a row later than it acts was a row earlier."""
    phases = np.repeat(rows["phase"][:, None], count, axis=1)
    for into, before in ((Phase.HOLD, Phase.SUCTION), (Phase.SUCTION, Phase.HOLD)):
        switches = np.flatnonzero((rows["next"] == into) & (rows["phase"] == before))
        later = [1 + i for i, one in enumerate(SUSPECTS) if one.effect in SEEN_LATER[into]]
        phases[switches[:, None], later] = into
    return phases
