"""Which cause a large deviation has: the probability of each effect in the size that it has there.

What is small is named by the signatures that run along with the loop (``isolation``). What is large
is not in proportion to them: here each effect is fitted to one cycle alone, by what it does in the
size found. Covariance, alternative and priors are the same in both, and in the diagnosis.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin.inference.covariance import Covariance, fading, low_rank
from twin.inference.sensitivities import coefficients_at, derivatives, points
from twin.inference.unmodelled import MISMATCH, Odds, hats, knots_over, log_likelihoods_in_place
from twin.model import kernel
from twin.model.effects import EFFECTS, UNKNOWN, Effect
from twin.model.theta import Theta
from twin.monitor.bins import Bins, Floats, Ints, averaged
from twin.monitor.cycles import Cycle
from twin.monitor.healthy import Healthy
from twin.monitor.likeness import Likeness
from twin.monitor.model_bank import SUPPLY, UNSURE
from twin.monitor.rows import drawn_rows, time_steps
from twin.monitor.scatter_covariance import SCATTER, from_cycle_to_cycle, lasting, model_error
from twin.monitor.statistics import PER_UNIT
from twin.signals import MBAR, NS, Samples, Ticks, deviation

LARGER = (2.5, 6.0, 15.0)  # typical sizes in which a fit begins as well
FINALISTS, ROUNDS = 8, 3  # effects that go on from the best of these, and for how many rounds
NEARLY_NONE = 1e-3  # of a typical size, in place of none: slopes are over a size
NOTHING = 0.02  # mbar rms: what moves the pressure by less in its typical size is not seen in it
NOISE = 1.0  # mbar, of a row. Chosen: what is named here is far larger
LEAST_SURE = 0.2  # a name that is right less than once in five is none
EXPLAINED = 0.5  # of the squares, that a name takes away at least: more than it leaves


def likenesses(
    theta: Theta,
    healthy: Healthy,
    samples: Samples,
    ticks: Ticks,
    begin: int,
    catalogue: Sequence[Effect] = (),
) -> list[Likeness]:
    """Rank the effects, also those of a ``catalogue`` beside the table, by how probable each is.

    That is by the deviation from row ``begin`` on; the rows before it let the model swing in.
    Something that nobody listed stands last. Empty where the best effect does not explain half of
    what differs, where too many fit alike, or where nothing can be compared.
    """
    effects = [*EFFECTS.values(), *catalogue]
    firsts = [effect.parameters[0] for effect in effects]
    typical = np.array([first.typical for first in firsts])
    bounds = np.array([first.range(theta) for first in firsts]) / typical[:, None]
    expect = _Expected.of(theta, effects, samples, ticks, begin)
    cycle = expect.at(np.ones(len(effects)))
    if not len(cycle.off):
        return []
    covariance = cycle.covariance(healthy, effects, typical)
    known = Covariance.of(covariance)
    fits = _Fits.of(known, cycle.off, bounds, np.ones(len(effects)), cycle.slopes)
    fits.search(expect)
    low = next(number for number, effect in enumerate(effects) if effect.name == SUPPLY)
    wider = fits.widen(low, expect, covariance)
    best = int(np.argmin(fits.left))
    rest = cycle.squares(cycle.off - fits.does[:, best])
    if rest > (1.0 - EXPLAINED) * cycle.squares(cycle.off):
        return []
    suits = wider if best == low else known
    listed = listed_share(suits, cycle.off, fits.does[:, best], cycle.kind, cycle.time)
    shares = np.exp(0.5 * (fits.left[best] - fits.left))
    shares *= listed / shares.sum()
    if shares[best] < LEAST_SURE:
        return []
    causes = [
        Likeness(effect.name, first.reported(size, theta), first.unit, share)
        for effect, first, size, share in zip(
            effects, firsts, (fits.size * typical).tolist(), shares.tolist(), strict=True
        )
    ]
    causes.sort(key=lambda likeness: -likeness.share)
    return [*causes, Likeness(UNKNOWN, None, "", 1.0 - listed)]


def compiled_for(cycle: Cycle) -> None:
    """Compile what a ranking needs, so that the first alarm does not wait for it."""
    rows = drawn_rows(cycle.samples, cycle.ticks)
    averaged(cycle.ticks["phase"], cycle.off, rows, np.zeros((len(rows), 1)), PER_UNIT)


def listed_share(known: Covariance, off: Floats, effect: Floats, kind: Ints, time: Floats) -> float:
    """Probability that a listed effect acts, where the best of them does ``effect`` (mbar).

    The alternative is something that nobody listed. Of what is explained in each place it leaves a
    share, smooth over the warped ``time`` of each ``kind`` of stretch. What is off elsewhere speaks
    for neither: a steep edge that comes a row later leaves much beside every effect.
    """
    courses = [np.zeros((len(kind), 0))]
    for number in np.unique(kind[kind >= 0]):
        here = kind == number
        courses.append(hats(time, knots_over(time[here])) * (here * effect)[:, None])
    white = known.white(np.column_stack([off - effect, *courses]))
    return Odds.of(log_likelihoods_in_place(white[:, 1:], white[:, 0])[None]).of_cause(1, 0.0)


@dataclass(frozen=True)
class _Cycle:
    """What is compared of a cycle, place by place."""

    bins: Bins
    first: Ints  # bins; what comes again counts once
    off: Floats  # mbar, measured less expected
    slopes: Floats  # mbar by the typical size of each effect, (places, effects)

    @property
    def kind(self) -> Ints:
        """Of stretch, at each place."""
        return self.bins.kind[self.first]

    @property
    def time(self) -> Floats:
        """Warped, since the stretch began."""
        return self.bins.time[self.first]

    def squares(self, off: Floats) -> float:
        """Sum (mbar²) over the rows of what is off at each place."""
        return float(np.sum(self.bins.count[self.first] * off**2))

    def covariance(self, healthy: Healthy, effects: Sequence[Effect], typical: Floats) -> Floats:
        """Covariance (mbar²): healthy cycles scatter, and waveforms are a little wrong."""
        common, alone = model_error(healthy.error, self.kind, self.time)
        scatter = np.array(
            [
                healthy.scatter.get(effect.name, SCATTER.get(effect.name, ("", 0.0))[1])
                for effect in effects
            ]
        )
        moves = self.slopes * (scatter / typical)
        goes_on = lasting(self.bins, self.first, alone)
        usual = from_cycle_to_cycle(self.bins, self.first, goes_on, moves, NOISE)
        own = np.hypot(common, MISMATCH * self.off)
        return usual * healthy.leftover**2 + fading(own, self.time, self.kind)


@dataclass(frozen=True)
class _Expected:
    """What the model expects of a cycle with any size of each effect."""

    theta: Theta
    effects: Sequence[Effect]
    samples: Samples  # from before the cycle on
    ticks: Ticks
    begin: int  # row of the cycle
    drawn: Ints  # rows that suffice

    @classmethod
    def of(
        cls, theta: Theta, effects: Sequence[Effect], samples: Samples, ticks: Ticks, begin: int
    ) -> "_Expected":
        drawn = np.union1d(drawn_rows(samples, ticks), [begin])
        return cls(theta, effects, samples, ticks, begin, drawn)

    def at(self, sizes: Floats) -> _Cycle:
        """The cycle with each effect in a size, in typical ones; empty where nothing compares."""
        return self._cycle(self._with(points(np.zeros(len(sizes)), sizes)), sizes)

    def unsure(self, size: float) -> Floats:
        """What its law leaves open of the first effect, a low supply: mbar by one sigma each."""
        sizes = np.zeros((len(self.effects), 1))
        sizes[0] = size
        theta = np.repeat(self._with(sizes), 1 + len(UNSURE), axis=1)
        for way, (coefficient, share) in enumerate(UNSURE.items(), start=1):
            theta[coefficient, way] *= 1.0 + share
        return self._cycle(theta, np.ones(len(UNSURE))).slopes

    def _with(self, sizes: Floats) -> Floats:
        """Coefficients with so many typical sizes of each effect, (effects, n)."""
        changes = [
            (effect.name, {p.name: p.typical for p in effect.parameters if not p.shapes})
            for effect in self.effects
        ]
        return coefficients_at(self.theta, changes, sizes)

    def _cycle(self, theta: Floats, sizes: Floats) -> _Cycle:
        """The cycle by the first coefficients, and slopes to the others, so far from it."""
        here = self.drawn >= self.begin
        expected = self._expected(theta)[here] / MBAR
        expected = np.where(np.isfinite(expected), expected, expected[:, :1])  # it has no answer
        off = deviation(self.samples, self.ticks)[self.begin :] / MBAR
        phase = self.ticks["phase"][self.begin :]
        bins, mean, through = averaged(
            phase, off, self.drawn[here] - self.begin, expected, PER_UNIT
        )
        first = np.unique(bins.place, return_index=True)[1]
        return _Cycle(bins, first, mean[first], derivatives(through[first], sizes)[1])

    def _expected(self, theta: Theta) -> Floats:
        """Pressure (Pa) at the drawn rows, (rows, n); ``theta`` is (coefficients, n)."""
        rows = self.drawn
        breaks = time_steps(self.samples, None)[rows] < 0.0
        dt = np.where(breaks, -1.0, np.diff(self.samples["time_ns"][rows], prepend=0) * NS)
        dt[:1] = 0.0
        driven = dt, self.ticks["phase"][rows], self.ticks["level"][rows].astype(np.float64)
        state, expected = kernel.new_state(theta.shape[1]), np.empty((len(rows), theta.shape[1]))
        kernel.advance(state, theta, *driven, expected, tolerance=kernel.ROUGHLY)
        return expected


@dataclass(frozen=True)
class _Fits:
    """Of each effect the size that fits best so far; sizes are in typical ones."""

    known: Covariance
    off: Floats  # mbar
    bounds: Floats
    size: Floats
    does: Floats  # mbar in that size, (places, effects)
    left: Floats  # sigmas² that it leaves
    wanted: Floats  # sizes to be tried next
    hoped: Floats  # sigmas² that they would leave, were they in proportion

    @classmethod
    def of(
        cls, known: Covariance, off: Floats, bounds: Floats, sizes: Floats, slopes: Floats
    ) -> "_Fits":
        """With what each effect does in a size, by its ``slopes`` (mbar) for a typical one."""
        left = np.full(len(sizes), float(np.sum(known.white(off[:, None]) ** 2)))
        none = np.zeros(len(sizes))
        does = np.zeros(slopes.shape)
        fits = cls(known, off, bounds, none, does, left, none.copy(), left.copy())
        fits._take(np.arange(len(sizes)), sizes, slopes)
        return fits

    def search(self, expect: "_Expected") -> None:
        """Begin in larger sizes as well, as what is late by much overlaps little with a bit of it.

        Then go on with those effects that promise most.
        """
        every = np.arange(len(self.size))
        for start in LARGER:
            trial = np.clip(np.full(len(every), start), *self.bounds.T)
            self._take(every, trial, expect.at(trial).slopes)
        finalists = np.argsort(self.hoped)[:FINALISTS]
        self._refine(finalists, replace(expect, effects=[expect.effects[i] for i in finalists]))

    def widen(self, low: int, expect: "_Expected", covariance: Floats) -> Covariance:
        """Fit a low supply again with what its law leaves open; give the covariance with that."""
        alone, bounds = replace(expect, effects=[expect.effects[low]]), self.bounds[[low]]
        size = np.clip(self.size[[low]], NEARLY_NONE, None)
        wider = Covariance.of(covariance + low_rank(alone.unsure(float(size[0]))))
        fits = _Fits.of(wider, self.off, bounds, size, alone.at(size).slopes)
        fits._refine(np.zeros(1, np.int64), alone)
        self.size[low], self.does[:, low] = fits.size[0], fits.does[:, 0]
        self.left[low] = fits.left[0] + wider.log_pdet - self.known.log_pdet
        return wider

    def _refine(self, which: Ints, expect: "_Expected") -> None:
        """Go on with some effects, which are those of ``expect``."""
        for _ in range(ROUNDS):
            trial = self.wanted[which]
            trial = np.where(trial == 0.0, NEARLY_NONE, trial)
            self._take(which, trial, expect.at(trial).slopes, back=True)

    def _take(self, which: Ints, trial: Floats, slopes: Floats, *, back: bool = False) -> None:
        """Take what some effects do in sizes on trial, ``slopes`` (mbar) for each typical size.

        A size is taken only where it leaves less than that before, as an effect may set in
        suddenly: that of a blow-off too weak to release a part. Where it does not, the next one is
        half the way ``back``.
        """
        white = self.known.white(np.column_stack([slopes, self.off]))
        white, off = white[:, :-1], white[:, -1:]
        seen = np.sqrt(np.mean((slopes * trial) ** 2, axis=0)) > NOTHING
        power = np.where(seen, np.sum(white**2, axis=0), np.inf)
        best = np.clip(np.sum(white * off, axis=0) / power, *self.bounds[which].T) * seen
        leaves = np.sum((off - trial * white) ** 2, axis=0)
        hoped = np.sum((off - best * white) ** 2, axis=0)
        better = (leaves < self.left[which]) & seen
        self.size[which] = np.where(better, trial, self.size[which])
        self.left[which] = np.where(better, leaves, self.left[which])
        self.does[:, which] = np.where(better, trial * slopes, self.does[:, which])
        further = better if back else hoped < self.hoped[which]
        other = 0.5 * (self.size[which] + trial) if back else self.wanted[which]
        self.wanted[which] = np.where(further, best, other)
        self.hoped[which] = np.where(further, hoped, self.hoped[which])
