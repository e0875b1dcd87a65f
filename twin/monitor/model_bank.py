"""A bank of hypotheses stepped beside the twin: what would be expected, were something else so.

Each hypothesis is the data set with a little of one parameter of one effect. What it
expects less what the unchanged one does is the effect's signature in the cycles as they are now.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.model import kernel
from twin.model import theta as c
from twin.model.catalogue import effects_in
from twin.model.compiled import compiled
from twin.model.dataset import DataSet
from twin.model.effects import EFFECTS, Effect, Parameter, apply
from twin.model.theta import Theta
from twin.monitor.bins import Floats, Ints, sparse_rows
from twin.monitor.cycles import Cycle
from twin.monitor.prediction_cache import CachedPrediction, PredictionCache, Stretches
from twin.signals import BREAK, MS, NS, Phase, Samples, Ticks, joined

BATCH = 250  # rows that are looked at together: what many calls cost is spared
SWUNG_IN = 2  # cycles after which nothing shows any more where the models came from
STEP = 0.25  # of a parameter's typical size
# What delays moves steep edges: they differ in proportion to it only while it is shorter than they
# are. So it has a smaller step, and larger sizes beside it.
DELAY_STEPS = (0.05, 0.25, 1.5)
# What changes with the weather or another set-up, and is nothing to mend: looked for as well, and
# not so that all else is found later.
NO_WEAR = ("ambient_pressure", "heat_exchange")
SELDOM = 0.2
NO_PHASE = 255  # before the first row

Bytes = npt.NDArray[np.uint8]


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


def _suspects(effects: Iterable[Effect]) -> tuple[Suspect, ...]:
    return tuple(Suspect(one.name, p) for one in effects for p in one.parameters if not p.shapes)


SUSPECTS: Sequence[Suspect] = _suspects(EFFECTS.values())


def suspects_of(data: DataSet, theta: Theta) -> Sequence[Suspect]:
    """Those of the table of effects, then those of the data set's own catalogue."""
    return (*SUSPECTS, *_suspects(one for one in effects_in(data.catalogue) if one.acts(theta)))


# How suction and end pressure follow the supply is the type's, since only one supply was ever
# measured; of its value, one sigma. So it is not known well what a low supply does.
UNSURE = {c.END_SLOPE: 0.5, c.SUPPLY_CURVATURE: 0.5, c.SUPPLY_OPTIMUM: 0.03}
SUPPLY = "supply_pressure_drop"
UNSURE_OF = next(i for i, one in enumerate(SUSPECTS) if one.effect == SUPPLY)
DELAYS = tuple(i for i, one in enumerate(SUSPECTS) if one.delays)
LARGER = len(DELAY_STEPS) - 1  # sizes beside the step
# With a step of these the air saving's switching off, or on, is seen a row later than it acts.
SEEN_LATER = {Phase.HOLD: ("sensor_lag",), Phase.SUCTION: ("sensor_lag", "slow_ramp_up")}


def hypotheses(theta: Theta, suspects: Sequence[Suspect] = SUSPECTS) -> list[Theta]:
    """The unchanged data set, each of the suspects, and further ones.

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
    return [theta, *(one.of(theta) for one in suspects), *larger, *ways]


class ModelBank:
    """Takes the twin's cycles, and says what each hypothesis expects in them.

    Signatures are smooth but where a phase or a stretch begins, so the bank steps from one to the
    next of the rows that suffice to draw them (``bins.sparse``). Where a cycle goes as one that is
    known, nothing is stepped: what was drawn then is given again (``drawings``), and the models
    stand where that one ended.
    """

    def __init__(self, theta: Theta, suspects: Sequence[Suspect] = SUSPECTS) -> None:
        self._theta = np.stack(hypotheses(theta, suspects), axis=1)
        self._state = kernel.new_state(self._theta.shape[1])
        self._drawings = PredictionCache()
        self._last_ns: int | None = None  # PLC time of the newest row
        self._phase = NO_PHASE  # and its phase
        self._since = 0  # rows since a bend began, of the newest one
        self._drawn_ns = 0  # PLC time of the newest row that was drawn
        self._whole = 0  # cycles in a row in which nothing was wrong
        self._seen = 0  # rows of the next piece
        self._stepped = 0  # how many of them were stepped over
        self._expected = np.empty((0, self._theta.shape[1]))  # at those of them that were drawn

    def ahead(self, parts: Sequence[tuple[Samples, Ticks]], at_edge: bool) -> None:
        """See the rows so far of the next piece, to have less to do when it is taken.

        ``at_edge`` says that they begin with a suction edge. While it may still turn out to go as
        a known cycle, nothing is stepped.
        """
        rows = sum(len(samples) for samples, _ in parts)
        if rows - self._seen < BATCH:
            return
        self._seen = rows
        samples, ticks = (joined(*column) for column in zip(*parts, strict=True))
        drawn, stretches, _ = self._look(samples, ticks)
        if not (at_edge and stretches and self._drawings.may_be(stretches)):
            self._step_to(rows - 1, samples, ticks, drawn)  # what comes after is not known yet

    def take(self, cycle: Cycle) -> tuple[Ints, Floats]:
        """Of the rows of a cycle or piece those that are drawn, and what is expected there (Pa).

        These are (drawn, hypotheses). In a cycle that goes as a known one it is what was expected
        in that: right is what one hypothesis expects less what another does.
        """
        samples, ticks = cycle.samples, cycle.ticks
        drawn, stretches, since = self._look(samples, ticks)
        if not cycle.complete:
            stretches = None
        known = self._drawings.like(stretches) if stretches else None
        if stretches and known:
            expected, self._state = known.at(stretches, drawn), known.state.copy()
            self._drawn_ns = cycle.end_ns
        else:
            self._step_to(len(samples), samples, ticks, drawn)
            expected = self._expected
            if stretches and self._whole >= SWUNG_IN:
                self._drawings.add(CachedPrediction(stretches, drawn, expected, self._state.copy()))
        self._whole = self._whole + 1 if stretches else 0
        self._last_ns, self._phase, self._since = cycle.end_ns, int(ticks["phase"][-1]), since
        self._seen, self._stepped, self._expected = 0, 0, self._expected[:0]
        return drawn, expected

    def _look(self, samples: Samples, ticks: Ticks) -> tuple[Ints, Stretches | None, int]:
        """Which rows of a piece are drawn, how it goes, and how long the newest bend is ago.

        It is None how it goes where something is wrong with a row, or time does not run on evenly.
        """
        last_ns = int(samples["time_ns"][0]) if self._last_ns is None else self._last_ns
        found = _look_at(samples, ticks, last_ns, self._phase, self._since)
        drawn, odd, first, how, since = found
        phases = ticks["phase"][first].tobytes()
        return drawn, None if odd else Stretches(first, phases, how), since

    def _step_to(self, end: int, samples: Samples, ticks: Ticks, drawn: Ints) -> None:
        """Step over the rows of a piece that come before ``end``; some are ``drawn``."""
        rows = drawn[(drawn >= self._stepped) & (drawn < end)]
        self._stepped = end
        if not len(rows):
            return
        samples, after = samples[rows], ticks["phase"][np.minimum(rows + 1, len(ticks) - 1)]
        dt = np.diff(samples["time_ns"], prepend=self._drawn_ns) * NS
        dt[(dt < 0.0) | (samples["quality"] & BREAK != 0)] = -1.0
        expected = np.empty((len(rows), self._theta.shape[1]))
        phase = _phases(ticks["phase"][rows], after, self._theta.shape[1])
        level = ticks["level"][rows].astype(np.float64)
        kernel.advance(
            self._state, self._theta, dt, phase, level, expected, tolerance=kernel.ROUGHLY
        )
        self._drawn_ns = int(samples["time_ns"][-1])
        self._expected = np.concatenate([self._expected, expected])


@compiled
def _look_at(samples, ticks, last_ns, phase, since):  # type: ignore[no-untyped-def]
    """Rows that are drawn, whether one is odd, and the stretches between bends.

    Of each the first row, and how it goes (``Stretches``); then how many rows ago the last began.
    Given are time and phase of the row before, and how many rows before it a bend began.
    """
    bends, first = np.empty(len(samples), np.bool_), np.empty(len(samples), np.int64)
    how = np.empty((len(samples), 3))
    odd, count, ago = False, 0, since
    for i in range(len(samples)):
        row, here, level = samples[i], ticks[i].phase, ticks[i].level
        dt = (row.time_ns - last_ns) * NS
        jumps = row.quality & BREAK != 0 or dt < 0.5 * MS or dt > 1.5 * MS
        bends[i] = jumps or math.isfinite(level) or here != phase
        odd |= jumps or row.quality != 0
        ago += 1
        if bends[i]:
            first[count], how[count, 2] = i, level if math.isfinite(level) else 0.0
            count, ago = count + 1, 0
        if count > 0:
            begin = first[count - 1]
            how[count - 1, 0] = i - begin
            how[count - 1, 1] = (row.time_ns - samples[begin].time_ns) * (NS / MS)
        last_ns, phase = row.time_ns, here
    return sparse_rows(bends, since), odd, first[:count].copy(), how[:count].copy(), ago


def _phases(phase: Bytes, after: Bytes, count: int) -> Bytes:
    """Phases (rows, hypotheses): what is seen a row later than it acts was a row earlier.

    ``after`` is the phase of the row after each.
    """
    phases = np.repeat(phase[:, None], count, axis=1)
    for into, before in ((Phase.HOLD, Phase.SUCTION), (Phase.SUCTION, Phase.HOLD)):
        switches = np.flatnonzero((after == into) & (phase == before))
        later = [1 + i for i, one in enumerate(SUSPECTS) if one.effect in SEEN_LATER[into]]
        phases[switches[:, None], later] = into
    return phases
