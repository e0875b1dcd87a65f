"""Which cause it is, while the loop runs: probabilities of every effect, and of none, per cycle.

That anything differs is judged by sums over cycles (``change_detection``). Which effect it is, by
the mean of the cycles since it began, less what was usual before: each suspect is fitted to it
alone, and its likelihood tells how probable it is. The first of these cycles is left out: the
change may have begun inside of it, and a part of one effect looks like the whole of another.
Cycle-to-cycle scatter averages out of that mean; what the model has wrong about a signature does
not, so a share of what is explained counts as error.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from twin.inference.priors import penalty
from twin.inference.unmodelled import LEAST_SURE, MISMATCH
from twin.inference.whitening import Covariance, fading, low_rank
from twin.model.dataset import DataSet
from twin.model.effects import EFFECTS, UNKNOWN, Effect, effect_of
from twin.model.term import KINDS
from twin.monitor.bins import Floats, averaged
from twin.monitor.change_detection import (
    FARTHEST,
    MOST,
    ChangeDetector,
    LearningGuard,
    NormalScores,
    Reference,
    ScoreNormalizer,
    began,
    limit,
)
from twin.monitor.cycles import Cycle, CycleView
from twin.monitor.false_alarm_budget import SUMS, cycles_between
from twin.monitor.healthy import Healthy
from twin.monitor.likeness import Likeness
from twin.monitor.model_bank import DELAY_STEPS, DELAYS, SUSPECTS, UNCERTAIN, ModelBank, Suspect
from twin.monitor.naming import EXPLAINED, listed_share
from twin.monitor.statistics import CycleResidual, ScoreExtractor
from twin.monitor.surroundings import told
from twin.signals import SAMPLE, TICK, Samples, Ticks

KEPT = 400  # cycles whose scores are remembered: a change is not sought further back
RECENT = 60  # of them, the last ones that are remembered whole: from them a cause is named
LEARNED = 10  # cycles before which nothing is said
SHOWN = 3.0  # sigmas: less by the cycles after the first, and it is not asked what differs
DOUBTED = 0.05  # probability that anything differs, from which on it is asked what
RETURNED = float(np.log(1000.0))  # of the odds that it is as before, for it to be over
DELAYS_AT = np.array([0.0, *DELAY_STEPS]) / DELAY_STEPS[0]  # sizes of delays that are looked at
FEWEST_BACK = 3  # cycles to be sure of that, however far it was


class Heard(NamedTuple):
    """What a cycle that is fit to be judged says."""

    said: CycleResidual
    scores: Floats
    seconds: float  # how long it was


@dataclass(frozen=True)
class Verdict:
    """What is held of the causes after a cycle."""

    none: float  # probability that nothing differs
    causes: Sequence[Likeness]  # the most probable first, by share; empty while nothing is doubted
    raised: bool = False  # with this cycle it is beyond the limit
    since: int = 0  # cycles that differ
    sigmas: float = 0.0  # by which a cycle differs, in what is foremost

    def unnamed(self) -> "Verdict":
        """The same without names: what differs is one unknown cause."""
        share = sum(cause.share for cause in self.causes)
        return replace(self, causes=[Likeness(UNKNOWN, None, "", share)] if self.causes else ())

    def where_changed(self) -> "Verdict":
        """The same where it is known that something differs."""
        total = sum(cause.share for cause in self.causes) or 1.0
        return replace(
            self,
            none=0.0,
            causes=[replace(cause, share=cause.share / total) for cause in self.causes],
        )

    def plain(self) -> dict[str, float]:
        """The probabilities, of what has at least one in a hundred."""
        shown = {cause.effect: round(cause.share, 3) for cause in self.causes}
        likely = {effect: share for effect, share in shown.items() if share >= 0.01}
        return {"none": round(self.none, 3), **likely}


@dataclass
class _Usual:
    """Mean deviation at each place in the cycles so far."""

    count: Floats = field(default_factory=lambda: np.zeros(len(KINDS) << 16))  # by place
    mean: Floats = field(default_factory=lambda: np.zeros(len(KINDS) << 16))

    def add(self, residual: CycleResidual) -> None:
        at = residual.place  # levels, which are below zero, at the end
        self.count[at] += 1.0
        self.mean[at] += (residual.off - self.mean[at]) / self.count[at]

    def of(self, residual: CycleResidual) -> tuple[Floats, Floats]:
        """Mean (mbar) at the places of a cycle, and in how many cycles they were seen."""
        return self.mean[residual.place], self.count[residual.place]


class Isolation:
    """Takes the rows of the twin and its cycles; gives what is held of the causes.

    ``days`` between false alarms of any kind, for one ejector.
    """

    def __init__(self, bank: ModelBank, listener: ScoreExtractor, days: float) -> None:
        self._bank, self._listener = bank, listener
        self.days = days
        self._suspects, count = listener.suspects, len(listener.suspects)
        self._reference, self._usual = Reference.of(count), _Usual()
        self._normalizer = ScoreNormalizer(count)
        self._learned = 0  # cycles
        self._guard = LearningGuard[
            tuple[CycleResidual, Floats, NormalScores]
        ]()  # with their scores
        self._changes: ChangeDetector | None = None  # once it is known which suspects look alike
        self._kept: deque[CycleResidual] = deque(maxlen=RECENT)  # some 40 kB each
        self._scored: deque[Floats] = deque(maxlen=KEPT)  # their normal scores, and of more cycles
        self._cycles, self._seconds = 0, 0.0
        self._ambient_is_measured = False
        self._raised: tuple[int, float] | None = None  # suspect, and sigmas a cycle
        self._since = 0  # cycles since it began, while raised
        self._back = 0.0  # logarithm of the odds that it is as before
        self._alike = np.zeros((count, count))  # cosines, as far as known
        ends = [suspect.parameter.range(listener.theta) for suspect in self._suspects]
        steps = np.array([suspect.step for suspect in self._suspects])
        self._bounds = np.array(ends) / steps[:, None]

    @property
    def stands(self) -> bool:
        """Whether it was beyond the limit, and has not come back since."""
        return self._raised is not None

    @property
    def known(self) -> list[Effect]:
        """The effects beside the table that are looked for."""
        names = dict.fromkeys(
            suspect.effect for suspect in self._suspects if suspect.effect not in EFFECTS
        )
        return [effect_of(name) for name in names]

    @property
    def heard(self) -> tuple[CycleResidual, Floats]:
        """What the last cycle said, and its scores as standard normal variables."""
        return self._kept[-1], self._scored[-1]

    def run_ahead(self, samples: Samples, ticks: Ticks, at_edge: bool) -> None:
        """Process the rows so far of the next piece, to spread the work."""
        self._bank.run_ahead(samples, ticks, at_edge)

    @classmethod
    def of(cls, data: DataSet, healthy: Healthy, days: float) -> "Isolation":
        """The isolation beside the twin of a data set; compiled, not to fall into a block."""
        listener = ScoreExtractor.of(data, healthy)
        first = ModelBank(listener.theta, listener.suspects)
        drawn, expected = first.take(
            Cycle(0, np.zeros(2, SAMPLE), np.zeros(2, TICK), complete=False)
        )
        averaged(np.zeros(2, np.uint8), np.zeros(2), drawn, expected)
        return cls(ModelBank(listener.theta, listener.suspects), listener, days)

    def hear(self, views: Sequence[CycleView]) -> list[Heard | None]:
        """Take cycles and pieces, in order, and what the monitor has of them; say what they say."""
        drawn = [self._bank.take(view.cycle) for view in views]
        self._ambient_is_measured = any("ambient" in told(view.cycle.samples) for view in views)
        residuals = [
            self._listener.hear(view.cycle, *rows, view.figures)
            if view.fit and view.cycle.complete
            else None
            for view, rows in zip(views, drawn, strict=True)
        ]
        return [
            Heard(residual, residual.scores(), view.cycle.seconds) if residual else None
            for view, residual in zip(views, residuals, strict=True)
        ]

    def judge(self, heard: Heard, far: float = 0.0, *, begins: bool = False) -> Verdict | None:
        """Say what is held after a cycle, the next one in order.

        ``far`` are the sigmas by which it alone is out, if it is: from such a one nothing is
        learned. Where something else ``begins`` with it, the cause is sought from it on.
        """
        residual, scores, seconds = heard
        self._cycles += 1
        self._seconds += seconds
        step = self._normalizer.take(self._reference.standard(scores))
        normal = step.normal
        self._kept.append(residual)
        self._scored.append(normal)
        verdict = self._conclude(self._changes, normal, far, begins) if self._changes else None
        if self.stands:
            self._guard.forget()
        elif self._changes is None and not far:
            self._learn(residual, scores, step)
        elif not far and (verdict is None or not verdict.causes):
            for learned in self._guard.take((residual, scores, step), normal):
                self._learn(*learned)
        return verdict

    def _learn(self, residual: CycleResidual, scores: Floats, step: NormalScores) -> None:
        """Take a cycle as usual; what is shown for the first time is looked for from now on."""
        new = np.isfinite(scores) & (self._reference.count == 0.0)
        self._reference.add(scores)
        self._normalizer.learn(step)
        self._usual.add(residual)
        self._learned += 1
        if new.any():
            alike = residual.alike()
            self._alike = np.where(alike != 0.0, alike, self._alike)
        if self._learned == LEARNED:
            self._changes = looked_for(self._suspects)
        if self._changes and (new.any() or self._learned == LEARNED):
            self._changes.weigh(self._alike)

    def _conclude(
        self, changes: ChangeDetector, normal: Floats, far: float, begins: bool
    ) -> Verdict:
        changes.take(normal, FARTHEST if far else MOST)
        log_sum = changes.log_sum
        cycles = cycles_between(self.days, SUMS, self._seconds / self._cycles)
        log_odds = log_sum - math.log(cycles)  # a fault is as rare as a false alarm
        none = 1.0 / (1.0 + math.exp(min(log_odds, 700.0)))
        raised = self._raised is None and log_sum >= limit(cycles)
        if raised:
            self._raise(changes)
        elif self._raised is not None:
            self._since = 1 if begins else self._since + 1
            if self._is_back(normal):
                changes.begin()
                self._kept.clear()
                self._scored.clear()
                return Verdict(1.0, ())
        if self._raised is None and 1.0 - none < DOUBTED:
            return Verdict(none, ())
        if self._raised is not None and np.isnan(normal[self._raised[0]]):
            return Verdict(none, ())  # this cycle does not show it
        since, sigmas = self._differ(changes)
        return Verdict(none, self._causes(changes, since, 1.0 - none), raised, since, sigmas)

    def _raise(self, changes: ChangeDetector) -> None:
        self._since, sigmas = self._differ(changes)
        self._raised = (changes.foremost()[0], sigmas)
        self._back = 0.0

    def _is_back(self, normal: Floats) -> bool:
        """Whether it is as before, by a likelihood ratio of its own."""
        assert self._raised is not None
        suspect, sigmas = self._raised
        if np.isnan(normal[suspect]):
            return False
        gain = sigmas * (0.5 * sigmas - float(normal[suspect]))
        self._back = max(self._back + min(gain, RETURNED / FEWEST_BACK), 0.0)
        if self._back < RETURNED:
            return False
        self._raised, self._since = None, 0
        return True

    def _differ(self, changes: ChangeDetector) -> tuple[int, float]:
        """How many of the last cycles differ, and by how many sigmas each."""
        suspect, sign = changes.foremost()
        scores = self._scores(suspect)
        since = min(self._since, len(scores)) if self._raised else began(sign * scores)
        shown = scores[-since:][np.isfinite(scores[-since:])]
        return since, float(np.mean(shown)) if len(shown) else 0.0

    def _scores(self, suspect: int) -> Floats:
        """Of the cycles that are kept."""
        return np.array([float(normal[suspect]) for normal in self._scored])

    def _whole(self, changes: ChangeDetector, since: int) -> int:
        """How many of the last cycles have it from their beginning; 0 if they do not show it."""
        whole = since - 1
        scores = self._scores(changes.foremost()[0])[-whole:] if whole else np.empty(0)
        shown = scores[np.isfinite(scores)]
        return whole if abs(shown.sum()) >= SHOWN * math.sqrt(max(len(shown), 1)) else 0

    def _causes(self, changes: ChangeDetector, since: int, changed: float) -> list[Likeness]:
        """How probable each effect is, and one that nobody listed, which comes last.

        Together they are as probable as that something ``changed``.
        """
        whole = self._whole(changes, since)
        if not whole:
            return [Likeness(UNKNOWN, None, "", changed)]
        mean, covariance = self._mean(min(whole, RECENT))
        columns = np.column_stack([mean.off, mean.signatures, mean.larger])
        known = Covariance.of(covariance)
        white = known.white(columns)
        off, signatures, larger = np.split(white, [1, 1 + len(self._suspects)], axis=1)
        sizes, left = _fitted(off, signatures, self._bounds)
        for number in DELAYS:
            grows, most = _grows(number, signatures, larger), float(self._bounds[number, 1])
            sizes[number], left[number] = _fitted_along(off, grows, most)
        left += known.log_pdet
        # What a low supply or weather does is not known well: in proportion to its size.
        wider = {}
        for number in UNCERTAIN:
            ways = sizes[number] * mean.unsure[:, self._listener.variant_of == number]
            wider[number] = Covariance.of(covariance + low_rank(ways))
            white = wider[number].white(np.column_stack([mean.off, mean.signatures[:, number]]))
            here = slice(number, number + 1)
            sizes[here], left[here] = _fitted(white[:, :1], white[:, 1:], self._bounds[here])
            left[here] += wider[number].log_pdet
        left += [
            penalty(
                effect_of(suspect.effect),
                size * suspect.step / suspect.parameter.typical,
                ambient_is_measured=self._ambient_is_measured,
            )
            for suspect, size in zip(self._suspects, sizes.tolist(), strict=True)
        ]
        share = np.exp(0.5 * (left.min() - left))
        best = int(np.argmin(left))
        suits = wider.get(best, known)
        effect = _effect(best, float(sizes[best]), mean.signatures, mean.larger)
        if not _explains(suits, mean.off, effect):
            return [Likeness(UNKNOWN, None, "", changed)]
        listed = changed * listed_share(
            suits,
            mean.off,
            effect,
            mean.kind,
            mean.time,
            effect_of(self._suspects[best].effect),
            ambient_is_measured=self._ambient_is_measured,
        )
        causes = self._by_effect(share * (listed / share.sum()), sizes)
        if causes[0].share < LEAST_SURE * changed:
            return [Likeness(UNKNOWN, None, "", changed)]
        return [*causes, Likeness(UNKNOWN, None, "", changed - listed)]

    def _mean(self, since: int) -> tuple[CycleResidual, Floats]:
        """The mean of the last cycles, less what was usual; and its covariance."""
        last = self._kept[-1]
        residuals = list(self._kept)[-since:]
        often = (
            np.mean([np.isin(last.place, residual.place) for residual in residuals], axis=0) > 0.5
        )
        last = last.at(often)
        columns = np.column_stack([last.off, last.signatures, last.larger]) * 0.0
        counts = np.zeros(len(last.place))
        for residual in residuals:
            _, at, there = np.intersect1d(last.place, residual.place, True, True)
            values = np.column_stack([residual.off, residual.signatures, residual.larger])
            columns[at] += values[there]
            counts[at] += 1.0
        columns /= counts[:, None]
        usual, seen = self._usual.of(last)
        off = columns[:, 0] - usual
        signatures, larger = np.split(columns[:, 1:], [len(self._suspects)], axis=1)
        own = np.hypot(last.common / np.sqrt(1.0 + seen), MISMATCH * off)
        usually = 1.0 / np.sqrt(1.0 + seen)
        scatter = last.alone / len(residuals) + last.alone * np.outer(usually, usually)
        covariance = scatter + fading(own, last.time, last.kind)
        return replace(last, off=off, signatures=signatures, larger=larger), covariance

    def _by_effect(self, share: Floats, sizes: Floats) -> list[Likeness]:
        """Parameters of one effect belong together; the most probable one gives the size."""
        causes: dict[str, Likeness] = {}
        for number in np.argsort(-share).tolist():
            suspect, probability = self._suspects[number], float(share[number])
            if first := causes.get(suspect.effect):
                causes[suspect.effect] = replace(first, share=first.share + probability)
                continue
            size = suspect.parameter.reported(
                float(sizes[number]) * suspect.step, self._listener.theta
            )
            causes[suspect.effect] = Likeness(
                suspect.effect, size, suspect.parameter.unit, probability
            )
        return sorted(causes.values(), key=lambda likeness: -likeness.share)


def looked_for(suspects: Sequence[Suspect] = SUSPECTS) -> ChangeDetector:
    """Sums for all suspects, with nothing seen yet."""
    both_ways = np.array([suspect.both_ways for suspect in suspects])
    return ChangeDetector(both_ways, np.array([suspect.often for suspect in suspects]))


def _fitted(off: Floats, signatures: Floats, bounds: Floats) -> tuple[Floats, Floats]:
    """Of each signature the size within bounds that fits best, and the squares that are left."""
    power = np.maximum(np.sum(signatures**2, axis=0), 1e-12)
    sizes = np.clip(np.sum(signatures * off, axis=0) / power, *bounds.T)
    return sizes, np.sum((off - sizes * signatures) ** 2, axis=0)


def _explains(known: Covariance, off: Floats, effect: Floats) -> bool:
    """Whether an effect takes away most of what is ``off`` (mbar) beyond chance."""
    before, after = np.sum(known.white(np.column_stack([off, off - effect])) ** 2, axis=0)
    return bool(before - after >= EXPLAINED * (before - len(off)))


def _effect(number: int, size: float, signatures: Floats, larger: Floats) -> Floats:
    """What a suspect does at a size, in its steps."""
    if number not in DELAYS:
        return signatures[:, number] * size
    grows = _grows(number, signatures, larger)
    here = int(np.clip(np.searchsorted(DELAYS_AT, size) - 1, 0, len(DELAYS_AT) - 2))
    share = (size - DELAYS_AT[here]) / (DELAYS_AT[here + 1] - DELAYS_AT[here])
    effect: Floats = grows[:, here] * (1.0 - share) + grows[:, here + 1] * share
    return effect


def _grows(number: int, signatures: Floats, larger: Floats) -> Floats:
    """What a delay does at each of DELAYS_AT, (places, sizes)."""
    columns = np.split(larger, len(DELAYS), axis=1)[DELAYS.index(number)]
    return np.column_stack([np.zeros(len(columns)), signatures[:, number], columns])


def _fitted_along(off: Floats, grows: Floats, most: float) -> tuple[float, float]:
    """The same for what delays: from nothing on through its sizes, straight between them."""
    at = DELAYS_AT
    wide, reach = np.diff(at), np.ones(len(DELAY_STEPS))
    reach[-1] = (most - at[-2]) / wide[-1]
    bounds = np.column_stack([np.zeros(len(reach)), reach])
    shares, left = _fitted(off - grows[:, :-1], np.diff(grows, axis=1), bounds)
    best = int(np.argmin(left))
    return float(at[best] + shares[best] * wide[best]), float(left[best])
