"""A bank of hypotheses stepped beside the twin: expected pressures with one thing changed.

Each hypothesis is the data set with a small size of one parameter of one effect. Its expected
pressure less that of the unchanged data set is the effect's signature in the present cycles.
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
from twin.monitor.another_day import of_the_day
from twin.monitor.bins import Floats, Ints, sparse_rows
from twin.monitor.cycles import Cycle
from twin.monitor.prediction_cache import CachedPrediction, PredictionCache, Stretches
from twin.monitor.rows import time_steps
from twin.monitor.uncertain_data import SUPPLY_LAW
from twin.signals import MS, NS, Phase, Samples, Ticks

SWUNG_IN = 2  # cycles after which the initial state no longer matters
STEP = 0.25  # size in the bank, over a parameter's typical size
# The same for delays. A delay shifts steep edges; the response is linear only while the shift is
# shorter than the edge. So delays have a smaller step, and further hypotheses with larger sizes.
DELAY_STEPS = (0.05, 0.25, 1.5)
# Prior weight of effects that nobody can mend: weather and set-up. It is small, so that they hardly
# delay the detection of the others.
SELDOM = 0.2
NO_PHASE = 255  # phase before the first row

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Suspect:
    """A candidate cause: a parameter of an effect."""

    effect: str
    parameter: Parameter
    often: float = 1.0  # prior weight, relative to wear

    @property
    def both_ways(self) -> bool:
        """Whether its size can also be negative."""
        return self.parameter.low < 0.0 or self.parameter.coefficient is not None

    @property
    def delays(self) -> bool:
        """Whether it is a delay or a time constant."""
        return self.parameter.is_time

    @property
    def step(self) -> float:
        """Its size in the bank."""
        return (DELAY_STEPS[0] if self.delays else STEP) * self.parameter.typical

    def of(self, theta: Theta, steps: float = 1.0) -> Theta:
        """Coefficients of an ejector with ``steps`` of it."""
        size = self.parameter.neutral(theta) + steps * self.step
        return apply(theta, self.effect, {self.parameter.name: size})


def _suspects(effects: Iterable[Effect]) -> tuple[Suspect, ...]:
    return tuple(
        Suspect(effect.name, p, 1.0 if effect.can_be_mended else SELDOM)
        for effect in effects
        for p in effect.parameters
        if not p.shapes
    )


SUSPECTS: Sequence[Suspect] = _suspects(EFFECTS.values())


def suspects_of(data: DataSet, theta: Theta) -> Sequence[Suspect]:
    """Suspects from the table of effects, then from the data set's own catalogue."""
    return (
        *SUSPECTS,
        *_suspects(suspect for suspect in effects_in(data.catalogue) if suspect.acts(theta)),
    )


# Effects with an uncertain law (SUPPLY_LAW): a low supply, and another ambient pressure, which
# changes the ratio of supply to ambient as well.
UNCERTAIN_LAWS = frozenset(
    effect.name for effect in EFFECTS.values() if {c.SUPPLY, c.AMBIENT} & effect.touches
)
UNCERTAIN = tuple(i for i, suspect in enumerate(SUSPECTS) if suspect.effect in UNCERTAIN_LAWS)
DELAYS = tuple(i for i, suspect in enumerate(SUSPECTS) if suspect.delays)
LARGER = len(DELAY_STEPS) - 1  # number of further sizes of a delay
# Coefficients whose step delays a breakpoint by a row after the switching: time constants of the
# sensor, and of the jet while it builds up.
SEEN_LATER = {Phase.HOLD: {c.SLOW_SENSOR}, Phase.SUCTION: {c.SLOW_SENSOR, c.SLOW_RAMP_UP}}


def hypotheses(theta: Theta, suspects: Sequence[Suspect] = SUSPECTS) -> list[Theta]:
    """Coefficients: the unchanged data set, each suspect, and further hypotheses.

    Further hypotheses are the larger sizes of delays, and the ``variants`` of uncertain laws.
    """
    steps = [size / DELAY_STEPS[0] for size in DELAY_STEPS[1:]]
    larger = [SUSPECTS[number].of(theta, factor) for number in DELAYS for factor in steps]
    varied = [changed for _, changed in variants(theta)]
    return [theta, *(suspect.of(theta) for suspect in suspects), *larger, *varied]


def variants(theta: Theta) -> list[tuple[int, Theta]]:
    """Numbers of the suspects whose law is uncertain, each with one way in which it may differ."""
    return [
        (number, changed)
        for number in UNCERTAIN
        for changed in ways(SUSPECTS[number].effect, theta, SUSPECTS[number].of(theta))
    ]


def ways(effect: str, theta: Theta, changed: Theta) -> list[Theta]:
    """Coefficients ``changed`` by an effect, each with one uncertainty of its law at one sigma.

    Another ambient pressure changes the ratio of the supply to it, as a low supply does.
    """
    if effect not in UNCERTAIN_LAWS:
        return []
    varied = []
    for number, share in SUPPLY_LAW.values():
        other = changed.copy()
        other[number] *= 1.0 + share
        varied.append(other)
    if EFFECTS[effect].is_weather:
        varied += [up for up, _ in of_the_day(theta, changed, float(changed[c.AMBIENT]))]
    return varied


class ModelBank:
    """Gives the expected pressures of each hypothesis in the twin's cycles.

    Signatures are smooth except where a phase or a stretch begins, so the bank steps over
    subsampled rows (``bins.sparse``). For a cycle like a cached one, it uses the cached prediction
    and the state at its end, and steps over nothing.
    """

    def __init__(self, theta: Theta, suspects: Sequence[Suspect] = SUSPECTS) -> None:
        self._theta = np.stack(hypotheses(theta, suspects), axis=1)
        self._state = kernel.new_state(self._theta.shape[1])
        self._cache = PredictionCache()
        self._last_ns: int | None = None  # PLC time of the newest row
        self._phase = NO_PHASE  # phase of the newest row
        self._since = 0  # rows from the last breakpoint to the newest row
        self._drawn_until_ns = 0  # PLC time of the newest subsampled row
        self._clean_cycles = 0  # successive cycles without an odd row
        self._stepped = 0  # rows of the next piece that were stepped over
        self._expected = np.empty((0, self._theta.shape[1]))  # Pa, at their subsampled rows

    def run_ahead(self, samples: Samples, ticks: Ticks, at_edge: bool) -> None:
        """Process the rows so far of the next piece, to spread the work.

        ``at_edge``: they begin with a suction edge. Nothing is stepped while the piece may still
        run like a cached cycle.
        """
        drawn, stretches, _ = self._look(samples, ticks)
        if not (at_edge and stretches and self._cache.could_hit(stretches)):
            end = len(samples) - 1  # the phase after the last row is not known yet
            self._step_to(end, samples, ticks, drawn)

    def take(self, cycle: Cycle) -> tuple[Ints, Floats]:
        """Subsampled rows of a cycle or piece, and expected pressures (Pa) there.

        Pressures are (subsampled rows, hypotheses). For a cycle like a cached one they are those of
        the cached cycle: then only the differences between hypotheses are right.
        """
        samples, ticks = cycle.samples, cycle.ticks
        drawn, stretches, since = self._look(samples, ticks)
        if not cycle.complete:
            stretches = None
        cached = self._cache.lookup(stretches) if stretches else None
        if stretches and cached:
            expected, self._state = cached.at(stretches, drawn), cached.state.copy()
            self._drawn_until_ns = cycle.end_ns
        else:
            self._step_to(len(samples), samples, ticks, drawn)
            expected = self._expected
            if stretches and self._clean_cycles >= SWUNG_IN:
                self._cache.add(CachedPrediction(stretches, drawn, expected, self._state.copy()))
        self._clean_cycles = self._clean_cycles + 1 if stretches else 0
        self._last_ns, self._phase, self._since = cycle.end_ns, int(ticks["phase"][-1]), since
        self._stepped, self._expected = 0, self._expected[:0]
        return drawn, expected

    def _look(self, samples: Samples, ticks: Ticks) -> tuple[Ints, Stretches | None, int]:
        """Subsampled rows of a piece, its stretches, and rows since the last breakpoint.

        Stretches are None if a row has a quality flag, or if time steps are uneven.
        """
        dt = time_steps(samples, self._last_ns)
        result = _analyse(samples, ticks, dt, self._phase, self._since)
        drawn, has_odd_rows, first, shapes, since = result
        phases = ticks["phase"][first].tobytes()
        return drawn, None if has_odd_rows else Stretches(first, phases, shapes), since

    def _step_to(self, end: int, samples: Samples, ticks: Ticks, drawn: Ints) -> None:
        """Step over the rows of a piece before ``end``, at those in ``drawn``."""
        rows = drawn[(drawn >= self._stepped) & (drawn < end)]
        self._stepped = end
        if not len(rows):
            return
        samples, after = samples[rows], ticks["phase"][np.minimum(rows + 1, len(ticks) - 1)]
        dt = time_steps(samples, self._drawn_until_ns)
        dt[dt < 0.0] = -1.0
        expected = np.empty((len(rows), self._theta.shape[1]))
        phase = _phases(ticks["phase"][rows], after, self._theta.shape[1])
        level = ticks["level"][rows].astype(np.float64)
        kernel.advance(
            self._state, self._theta, dt, phase, level, expected, tolerance=kernel.COARSE_TOLERANCE
        )
        self._drawn_until_ns = int(samples["time_ns"][-1])
        self._expected = np.concatenate([self._expected, expected])


@compiled
def _analyse(
    samples: Samples, ticks: Ticks, dt: Floats, phase: int, since: int
) -> tuple[Ints, bool, Ints, Floats, int]:
    """Subsampled rows, whether any row is odd, stretches, and rows since the last breakpoint.

    A stretch has its first row and its shape (``Stretches``). ``dt`` are the rows' ``time_steps``.
    ``phase`` is that of the row before; ``since`` counts rows from the last breakpoint to it.
    """
    bends, first = np.empty(len(samples), np.bool_), np.empty(len(samples), np.int64)
    shapes = np.empty((len(samples), 3))
    has_odd_rows, count, since_bend = False, 0, since
    for i in range(len(samples)):
        row, row_phase, level = samples[i], ticks[i].phase, ticks[i].level
        is_uneven = dt[i] < 0.5 * MS or dt[i] > 1.5 * MS  # a break has a negative step
        bends[i] = is_uneven or math.isfinite(level) or row_phase != phase
        has_odd_rows |= is_uneven or row.quality != 0
        since_bend += 1
        if bends[i]:
            first[count], shapes[count, 2] = i, level if math.isfinite(level) else 0.0
            count, since_bend = count + 1, 0
        if count > 0:
            begin = first[count - 1]
            shapes[count - 1, 0] = i - begin
            shapes[count - 1, 1] = (row.time_ns - samples[begin].time_ns) * (NS / MS)  # pyright: ignore[reportAttributeAccessIssue]
        phase = row_phase
    return (
        sparse_rows(bends, since),
        has_odd_rows,
        first[:count].copy(),
        shapes[:count].copy(),
        since_bend,
    )


def _phases(phase: Bytes, after: Bytes, count: int) -> Bytes:
    """Phases (rows, hypotheses), with late switchings (``SEEN_LATER``) moved a row earlier.

    ``after`` is the phase of the row after each.
    """
    phases = np.repeat(phase[:, None], count, axis=1)
    for entered, before in ((Phase.HOLD, Phase.SUCTION), (Phase.SUCTION, Phase.HOLD)):
        switches = np.flatnonzero((after == entered) & (phase == before))
        later = [
            1 + i
            for i, suspect in enumerate(SUSPECTS)
            if SEEN_LATER[entered].intersection(suspect.parameter.touches)
        ]
        phases[switches[:, None], later] = entered
    return phases
