"""Fault isolation while the loop runs: the probability of every effect, and of none, per cycle.

Sums over cycles detect that anything has changed (``change_detection``). The effect is isolated
from the mean deviation of the cycles since the change, less the usual mean before it. Each suspect
is fitted to that difference alone, and its likelihood gives its probability. The first of these
cycles is left out: the change may have begun within it, and a part of one effect looks like the
whole of another. Scatter from cycle to cycle averages out of the mean. An error of the modelled
signature does not, so a share of the explained deviation counts as error.
"""

import math
from collections import deque
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from twin.inference.priors import penalty
from twin.inference.unmodelled import LEAST_SURE, MISMATCH
from twin.inference.whitening import Covariance, fading, low_rank
from twin.model import effects
from twin.model import theta as c
from twin.model.dataset import DataSet
from twin.model.effects import EFFECTS, UNKNOWN, Effect, effect_of
from twin.model.term import AGAIN, KINDS
from twin.monitor.another_day import ALIKE, Day
from twin.monitor.bins import Floats, averaged
from twin.monitor.change_detection import (
    MOST,
    ChangeDetector,
    LearningGuard,
    NormalScores,
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
from twin.monitor.score_prediction import FARTHEST, ScorePredictor
from twin.monitor.statistics import LEVELS, CycleResidual, ScoreExtractor
from twin.monitor.surroundings import told
from twin.signals import MBAR, SAMPLE, TICK, Samples, Ticks

KEPT = 400  # cycles whose scores are kept: an earlier change is not searched
RECENT = 60  # last cycles whose deviations are kept as well: the cause is isolated from them
LEARNED = 10  # cycles to learn from before the first verdict
SHOWN = 3.0  # sigmas of a change in the cycles after its first; below it no cause is searched
DAY = 2.0  # sigmas of the model's error on another day that are no change
LEAST_APART = 0.1  # steps of weather, 0.4 mbar or 0.2 K: a day that is less apart is the same
# Share of a size that is worth an alarm, below which sums raise none: they find a steady change of
# any size in the end, and nothing of a rig is the same for days.
WORTH = 0.02
ALIKE_ENOUGH = 0.5  # cosine, from which another suspect may have found the same change
DOUBTED = 0.05  # probability of any change, from which a cause is searched
RETURNED = float(np.log(1000.0))  # log odds of a healthy unit at which a change has ended
DELAYS_AT = np.array([0.0, *DELAY_STEPS]) / DELAY_STEPS[0]  # evaluated sizes of a delay, in steps
FEWEST_BACK = 3  # least cycles until a change counts as ended, however large it was
WEATHER_NUMBER = next(i for i, suspect in enumerate(SUSPECTS) if suspect.effect == effects.WEATHER)
WEATHER = SUSPECTS[WEATHER_NUMBER]
SUCTION = KINDS.index("suction")


class CycleScores(NamedTuple):
    """Residual and scores of a cycle that can be evaluated."""

    residual: CycleResidual
    scores: Floats
    seconds: float  # duration of the cycle
    day: Day


@dataclass(frozen=True)
class Verdict:
    """Probabilities of the causes after a cycle."""

    none: float  # probability that nothing has changed
    causes: Sequence[Likeness]  # the most probable first; empty while a change is improbable
    raised: bool = False  # the statistic exceeded its limit in this cycle
    since: int = 0  # cycles since the change
    sigmas: float = 0.0  # size of the change per cycle, in the foremost suspect

    def unnamed(self) -> "Verdict":
        """The verdict without names: one unknown cause has all the probability of a change."""
        share = sum(cause.share for cause in self.causes)
        return replace(self, causes=[Likeness(UNKNOWN, None, "", share)] if self.causes else ())

    def where_changed(self) -> "Verdict":
        """The verdict given that something has changed."""
        total = sum(cause.share for cause in self.causes) or 1.0
        return replace(
            self,
            none=0.0,
            causes=[replace(cause, share=cause.share / total) for cause in self.causes],
        )

    def plain(self) -> dict[str, float]:
        """Probabilities by cause, of those with at least 0.01."""
        shown = {cause.effect: round(cause.share, 3) for cause in self.causes}
        likely = {effect: share for effect, share in shown.items() if share >= 0.01}
        return {"none": round(self.none, 3), **likely}


@dataclass
class _Usual:
    """Running mean of the deviation in each cell (kind of stretch, time) of the cycles so far."""

    count: Floats = field(default_factory=lambda: np.zeros(len(KINDS) << 16))  # by cell
    mean: Floats = field(default_factory=lambda: np.zeros(len(KINDS) << 16))

    def add(self, residual: CycleResidual) -> None:
        at = residual.place  # levels have negative numbers: they index from the end
        self.count[at] += 1.0
        self.mean[at] += (residual.off - self.mean[at]) / self.count[at]

    def of(self, residual: CycleResidual) -> tuple[Floats, Floats]:
        """Mean (mbar) in the cells of a cycle, and the number of cycles that showed each."""
        return self.mean[residual.place], self.count[residual.place]


class Isolation:
    """Takes the rows of the twin and its cycles; gives the probabilities of the causes.

    ``days`` is the mean time between false alarms of any kind, for one ejector.
    """

    def __init__(self, bank: ModelBank, extractor: ScoreExtractor, days: float) -> None:
        self._bank, self._extractor = bank, extractor
        self.days = days
        self._suspects, count = extractor.suspects, len(extractor.suspects)
        self._predictor, self._usual = ScorePredictor(count), _Usual()
        self._ahead = self._predictor  # the same, with the wander of cycles that are not learned
        self._normalizer = ScoreNormalizer(count)
        self._learned = 0  # number of learned cycles
        self._usual_day = self._last_day = Day(0.0, 0.0, 0.0)  # mean of the learned cycles; last
        self._guard = LearningGuard[tuple[CycleScores, NormalScores]]()
        self._changes: ChangeDetector | None = None  # from when the signatures' cosines are known
        self._kept: deque[CycleResidual] = deque(maxlen=RECENT)  # some 40 kB each
        self._scored: deque[Floats] = deque(maxlen=KEPT)  # normal scores, of more cycles
        self._scores_of: deque[Floats] = deque(maxlen=KEPT)  # scores of these cycles
        self._cycles, self._seconds = 0, 0.0
        self._ambient_is_measured = self._temperature_is_measured = False
        # Suspect, and size in sigmas per cycle and in scores.
        self._raised: tuple[int, float, float] | None = None
        self._since = 0  # cycles since the change, while raised
        self._back = 0.0  # log odds that the unit is healthy again
        self._alike = np.zeros((count, count))  # cosines between signatures; 0 if unknown
        touched = [suspect.parameter.touches for suspect in self._suspects]
        self._zeros = [c.SENSOR_OFFSET in coefficients for coefficients in touched]
        ends = [suspect.parameter.range(extractor.theta) for suspect in self._suspects]
        steps = np.array([suspect.step for suspect in self._suspects])
        self._bounds = np.array(ends) / steps[:, None]

    @property
    def stands(self) -> bool:
        """Whether the statistic exceeded its limit, and the unit is not healthy again."""
        return self._raised is not None

    @property
    def known(self) -> list[Effect]:
        """Effects of the catalogue beside the table that are searched."""
        names = dict.fromkeys(
            suspect.effect for suspect in self._suspects if suspect.effect not in EFFECTS
        )
        return [effect_of(name) for name in names]

    @property
    def last_scores(self) -> tuple[CycleResidual, Floats]:
        """Residual of the last cycle, and its scores as standard normal values."""
        return self._kept[-1], self._scored[-1]

    def run_ahead(self, samples: Samples, ticks: Ticks, at_edge: bool) -> None:
        """Process the rows so far of the next piece, to spread the work."""
        self._bank.run_ahead(samples, ticks, at_edge)

    @classmethod
    def of(cls, data: DataSet, healthy: Healthy, days: float) -> "Isolation":
        """The isolation for a data set's twin; compiles all functions, so that no block waits."""
        extractor = ScoreExtractor.of(data, healthy)
        first = ModelBank(extractor.theta, extractor.suspects)
        drawn, expected = first.take(
            Cycle(0, np.zeros(2, SAMPLE), np.zeros(2, TICK), complete=False)
        )
        averaged(np.zeros(2, np.uint8), np.zeros(2), drawn, expected)
        return cls(ModelBank(extractor.theta, extractor.suspects), extractor, days)

    def extract(self, views: Sequence[CycleView]) -> list[CycleScores | None]:
        """Take views of cycles and pieces, in order; return scores, None if not comparable."""
        drawn = [self._bank.take(view.cycle) for view in views]
        measured = frozenset[str]().union(*(told(view.cycle.samples) for view in views))
        self._ambient_is_measured = "ambient" in measured
        self._temperature_is_measured = "temperature" in measured
        residuals = [
            self._extractor.extract(view.cycle, *rows, view.figures)
            if view.fit and view.cycle.complete
            else None
            for view, rows in zip(views, drawn, strict=True)
        ]
        return [
            CycleScores(
                residual,
                residual.scores(),
                view.cycle.seconds,
                Day.of(view.theta, view.cycle.samples["host_ns"][-1]),
            )
            if residual
            else None
            for view, residual in zip(views, residuals, strict=True)
        ]

    def judge(
        self, cycle: CycleScores, far: float = 0.0, *, begins: bool = False
    ) -> Verdict | None:
        """Update the probabilities with the next cycle in order.

        ``far`` is the deviation (sigmas) of this cycle alone if its figures are out: such a cycle
        is not learned. If another change ``begins`` with it, the cause is searched from it on.
        """
        self._cycles += 1
        self._seconds += cycle.seconds
        scores = self._ahead.normal(cycle.scores, cycle.day.seconds, self._doubt(cycle))
        step = self._normalizer.take(scores)
        normal = step.normal
        self._last_day = cycle.day
        self._kept.append(cycle.residual)
        self._scored.append(normal)
        self._scores_of.append(cycle.scores)
        verdict = self._conclude(self._changes, normal, far, begins) if self._changes else None
        if self.stands:
            self._guard.forget()
        ready = [] if far or self.stands else self._ready(cycle, step, verdict)
        for learned in ready:
            self._learn(*learned)
        if ready or self.stands:
            self._ahead = self._predictor
        elif not far:
            self._ahead = copy(self._ahead)
            self._ahead.follow(cycle.scores, cycle.day.seconds)
        return verdict

    def _ready(
        self, cycle: CycleScores, step: NormalScores, verdict: Verdict | None
    ) -> list[tuple[CycleScores, NormalScores]]:
        """Cycles to learn now, after one that is not out by itself."""
        if self._changes is None:
            return [(cycle, step)]
        if verdict is not None and verdict.causes:
            return []
        return self._guard.take((cycle, step), step.normal)

    def doubts(self, cycle: CycleScores) -> dict[str, float]:
        """What the figures of a cycle may be off on its day (mbar, at most), by figure."""
        ways = self._ways(cycle.residual, cycle.day)
        if ways is None:
            return {}
        most = {
            kind: DAY
            * float(np.sqrt(np.sum(np.abs(ways[cycle.residual.kind == kind]).max(0) ** 2)))
            for kind in np.unique(cycle.residual.kind).tolist()
        }
        most[SUCTION] = max(most.get(SUCTION, 0.0), most.pop(AGAIN, 0.0))
        names = {kind: (f"{KINDS[kind]}_mean", f"{KINDS[kind]}_rms") for kind in most if kind >= 0}
        names |= {kind: (LEVELS[kind],) for kind in most if kind < 0}
        return {name: doubt for kind, doubt in most.items() for name in names[kind]}

    def _doubt(self, cycle: CycleScores) -> Floats | float:
        """By how much each score may be off by the model's error on the day of a cycle."""
        ways = self._ways(cycle.residual, cycle.day)
        return 0.0 if ways is None else DAY * cycle.residual.moved_by(ways)

    def _ways(self, residual: CycleResidual, day: Day) -> Floats | None:
        """Model's errors (mbar, one sigma each) on another day than that of the learned cycles.

        They are (places, ways); None on the same day. The twin follows surroundings that are
        measured; rigs follow them in other ways.
        """
        if not self._learned:
            return None
        higher, denser = self._usual_day.until(
            day, temperature_is_measured=self._temperature_is_measured
        )
        step = WEATHER.step * MBAR
        pressure, density = higher / step, denser * day.ambient / step
        if density < LEAST_APART:
            return None
        ways = residual.unsure[:, self._extractor.variant_of == WEATHER_NUMBER]
        # The last of these ways are those of flows, as ``of_the_day`` gives them.
        flows = np.arange(ways.shape[1]) >= ways.shape[1] - len(ALIKE)
        scaled: Floats = ways * np.where(flows, density, pressure)
        return scaled

    def _learn(self, cycle: CycleScores, step: NormalScores) -> None:
        """Learn a healthy cycle; suspects that it is the first to show are searched from now on."""
        new = np.isfinite(cycle.scores) & (self._predictor.count == 0.0)
        self._predictor.learn(cycle.scores, cycle.day.seconds)
        self._normalizer.learn(step)
        self._usual.add(cycle.residual)
        self._learned += 1
        days = zip(self._usual_day, cycle.day, strict=True)
        self._usual_day = Day(*(mean + (value - mean) / self._learned for mean, value in days))
        if new.any():
            alike = cycle.residual.alike()
            self._alike = np.where(alike != 0.0, alike, self._alike)
            self._predictor.expect_wander(np.abs(self._alike[:, self._zeros]).max(axis=1))
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
        log_odds = log_sum - math.log(cycles)  # prior: a fault is as rare as a false alarm
        none = 1.0 / (1.0 + math.exp(min(log_odds, 700.0)))
        raised = self._raised is None and log_sum >= limit(cycles)
        if raised and not self._is_worth_an_alarm(changes):
            changes.begin_some(np.abs(self._alike[changes.foremost()[0]]) > ALIKE_ENOUGH)
            return Verdict(1.0, ())
        if raised:
            self._raise(changes)
        elif self._raised is not None:
            self._since = 1 if begins else self._since + 1
            if self._is_back(normal):
                changes.begin()
                self._kept.clear()
                self._scored.clear()
                self._scores_of.clear()
                return Verdict(1.0, ())
        if self._raised is None and 1.0 - none < DOUBTED:
            return Verdict(none, ())
        if self._raised is not None and np.isnan(normal[self._raised[0]]):
            return Verdict(none, ())  # this cycle does not show the change
        since, sigmas = self._differ(changes)
        return Verdict(none, self._causes(changes, since, 1.0 - none), raised, since, sigmas)

    def _is_worth_an_alarm(self, changes: ChangeDetector) -> bool:
        """Whether the change is large enough, if the foremost suspect is all of it."""
        number, _ = changes.foremost()
        suspect, since = self._suspects[number], self._differ(changes)[0]
        worth = WORTH * suspect.parameter.typical_on(self._extractor.theta) / suspect.step
        sigmas = next(
            (step for kept in reversed(self._kept) if (step := kept.sigmas()[number]) > 0.0), 0.0
        )
        return abs(self._moved(number, since)) >= worth * float(sigmas)

    def _moved(self, number: int, since: int) -> float:
        """Mean score of a suspect in so many last cycles, less the usual one."""
        scores = np.array([scores[number] for scores in list(self._scores_of)[-since:]])
        return float(np.nanmean(scores) - self._predictor.mean[number])

    def _raise(self, changes: ChangeDetector) -> None:
        self._since, sigmas = self._differ(changes)
        number, _ = changes.foremost()
        self._raised = (number, sigmas, self._moved(number, self._since))
        self._back = 0.0

    def _is_back(self, normal: Floats) -> bool:
        """Whether the unit is healthy again, by a likelihood ratio over the cycles since.

        While nothing is learned, a wander makes predictions less sure: the same change is fewer
        sigmas then.
        """
        assert self._raised is not None
        suspect, sigmas, moved = self._raised
        if np.isnan(normal[suspect]):
            return False
        now = abs(moved) / float(self._ahead.sigma(self._last_day.seconds)[suspect])
        sigmas = math.copysign(min(abs(sigmas), now), sigmas)
        gain = sigmas * (0.5 * sigmas - float(normal[suspect]))
        self._back = max(self._back + min(gain, RETURNED / FEWEST_BACK), 0.0)
        if self._back < RETURNED:
            return False
        self._raised, self._since = None, 0
        return True

    def _differ(self, changes: ChangeDetector) -> tuple[int, float]:
        """Number of last cycles since the change, and its size in sigmas per cycle."""
        suspect, sign = changes.foremost()
        scores = self._scores(suspect)
        since = min(self._since, len(scores)) if self._raised else began(sign * scores)
        shown = scores[-since:][np.isfinite(scores[-since:])]
        return since, float(np.mean(shown)) if len(shown) else 0.0

    def _scores(self, suspect: int) -> Floats:
        """Normal scores of one suspect in the kept cycles."""
        return np.array([float(normal[suspect]) for normal in self._scored])

    def _whole(self, changes: ChangeDetector, since: int) -> int:
        """Number of last cycles that lie wholly after the change; 0 if they do not show it."""
        whole = since - 1
        scores = self._scores(changes.foremost()[0])[-whole:] if whole else np.empty(0)
        shown = scores[np.isfinite(scores)]
        return whole if abs(shown.sum()) >= SHOWN * math.sqrt(max(len(shown), 1)) else 0

    def _causes(self, changes: ChangeDetector, since: int, changed: float) -> list[Likeness]:
        """Probability of each effect, and of an unlisted cause, which comes last.

        They add up to the probability ``changed`` that something has changed.
        """
        whole = self._whole(changes, since)
        if not whole:
            return [Likeness(UNKNOWN, None, "", changed)]
        mean, covariance = self._mean(min(whole, RECENT))
        of_the_day = self._ways(mean, self._last_day)
        if of_the_day is not None:
            covariance = covariance + low_rank(of_the_day)
        columns = np.column_stack([mean.off, mean.signatures, mean.larger])
        known = Covariance.of(covariance)
        white = known.white(columns)
        off, signatures, larger = np.split(white, [1, 1 + len(self._suspects)], axis=1)
        sizes, left = _fitted(off, signatures, self._bounds)
        for number in DELAYS:
            grows, most = _grows(number, signatures, larger), float(self._bounds[number, 1])
            sizes[number], left[number] = _fitted_along(off, grows, most)
        left += known.log_pdet
        # The laws of a low supply and of weather are uncertain in proportion to their size.
        wider = {}
        for number in UNCERTAIN:
            ways = sizes[number] * mean.unsure[:, self._extractor.variant_of == number]
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
        """Mean residual of the last cycles less the usual mean, and its covariance (mbar²)."""
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
        """Add the shares of an effect's parameters; the most probable one gives the size."""
        causes: dict[str, Likeness] = {}
        for number in np.argsort(-share).tolist():
            suspect, probability = self._suspects[number], float(share[number])
            if first := causes.get(suspect.effect):
                causes[suspect.effect] = replace(first, share=first.share + probability)
                continue
            size = suspect.parameter.reported(
                float(sizes[number]) * suspect.step, self._extractor.theta
            )
            causes[suspect.effect] = Likeness(
                suspect.effect, size, suspect.parameter.unit, probability
            )
        return sorted(causes.values(), key=lambda likeness: -likeness.share)


def looked_for(suspects: Sequence[Suspect] = SUSPECTS) -> ChangeDetector:
    """A change detector for all suspects, without any cycle."""
    both_ways = np.array([suspect.both_ways for suspect in suspects])
    return ChangeDetector(both_ways, np.array([suspect.often for suspect in suspects]))


def _fitted(off: Floats, signatures: Floats, bounds: Floats) -> tuple[Floats, Floats]:
    """Best size of each signature within bounds, and the residual sum of squares."""
    power = np.maximum(np.sum(signatures**2, axis=0), 1e-12)
    sizes = np.clip(np.sum(signatures * off, axis=0) / power, *bounds.T)
    return sizes, np.sum((off - sizes * signatures) ** 2, axis=0)


def _explains(known: Covariance, off: Floats, effect: Floats) -> bool:
    """Whether an effect removes most of the significant part of the residual ``off`` (mbar)."""
    before, after = np.sum(known.white(np.column_stack([off, off - effect])) ** 2, axis=0)
    return bool(before - after >= EXPLAINED * (before - len(off)))


def _effect(number: int, size: float, signatures: Floats, larger: Floats) -> Floats:
    """Response (mbar per cell) to a suspect at a size, which is in its steps."""
    if number not in DELAYS:
        return signatures[:, number] * size
    grows = _grows(number, signatures, larger)
    here = int(np.clip(np.searchsorted(DELAYS_AT, size) - 1, 0, len(DELAYS_AT) - 2))
    share = (size - DELAYS_AT[here]) / (DELAYS_AT[here + 1] - DELAYS_AT[here])
    effect: Floats = grows[:, here] * (1.0 - share) + grows[:, here + 1] * share
    return effect


def _grows(number: int, signatures: Floats, larger: Floats) -> Floats:
    """Response (mbar) to a delay at each of DELAYS_AT, (cells, sizes)."""
    columns = np.split(larger, len(DELAYS), axis=1)[DELAYS.index(number)]
    return np.column_stack([np.zeros(len(columns)), signatures[:, number], columns])


def _fitted_along(off: Floats, grows: Floats, most: float) -> tuple[float, float]:
    """``_fitted`` for a delay: its response is interpolated linearly between the sizes."""
    at = DELAYS_AT
    wide, reach = np.diff(at), np.ones(len(DELAY_STEPS))
    reach[-1] = (most - at[-2]) / wide[-1]
    bounds = np.column_stack([np.zeros(len(reach)), reach])
    shares, left = _fitted(off - grows[:, :-1], np.diff(grows, axis=1), bounds)
    best = int(np.argmin(left))
    return float(at[best] + shares[best] * wide[best]), float(left[best])
