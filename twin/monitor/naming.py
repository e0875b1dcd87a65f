"""Which cause a large deviation has: the probability of each effect in the size that it has there.

What is small is named by the signatures that run along with the loop (``isolation``). What is large
is not in proportion to them: here each effect is fitted to one cycle alone, by what it does in the
size found. Covariance, alternative and priors are the same in both, and in the diagnosis.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin.inference.covariance import Covariance, fading
from twin.inference.sensitivities import coefficients_at, derivatives, points
from twin.inference.unmodelled import MISMATCH, Odds, hats, knots_over, log_likelihoods
from twin.model import kernel
from twin.model.effects import EFFECTS, UNKNOWN, Effect
from twin.model.theta import Theta
from twin.monitor.bins import Bins, Floats, Ints, averaged
from twin.monitor.cycles import Cycle
from twin.monitor.healthy import Healthy
from twin.monitor.likeness import Likeness
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
    known: Sequence[Effect] = (),
) -> list[Likeness]:
    """Rank the effects, also ``known`` ones beside the table, by how probable each is.

    That is by the deviation from row ``begin`` on; the rows before it let the model swing in.
    Something that nobody listed stands last. Empty where the best effect does not explain half of
    what differs, where too many fit alike, or where nothing can be compared.
    """
    effects = [*EFFECTS.values(), *known]
    firsts = [effect.parameters[0] for effect in effects]
    typical = np.array([first.typical for first in firsts])
    bounds = np.array([first.range(theta) for first in firsts]) / typical[:, None]
    expect = _Expected.of(theta, effects, samples, ticks, begin)
    cycle = expect.at(np.ones(len(effects)))
    if not len(cycle.off):
        return []
    known_by = Covariance.of(cycle.covariance(healthy, effects, typical))
    fits = _Fits.of(known_by, cycle, bounds)
    fits.search(expect)
    best = int(np.argmin(fits.left))
    rest = cycle.squares(cycle.off - fits.does[:, best])
    if rest > (1.0 - EXPLAINED) * cycle.squares(cycle.off):
        return []
    listed = listed_share(known_by, cycle.off, fits.does[:, best], cycle.kind, cycle.time)
    shares = np.exp(0.5 * (fits.left[best] - fits.left))
    shares *= listed / shares.sum()
    if shares[best] < LEAST_SURE:
        return []
    found = [
        Likeness(one.name, first.reported(size, theta), first.unit, share)
        for one, first, size, share in zip(
            effects, firsts, (fits.size * typical).tolist(), shares.tolist(), strict=True
        )
    ]
    found.sort(key=lambda likeness: -likeness.share)
    return [*found, Likeness(UNKNOWN, None, "", 1.0 - listed)]


def compiled_for(cycle: Cycle) -> None:
    """Compile what a ranking needs, so that the first alarm does not wait for it."""
    rows = drawn_rows(cycle.samples, cycle.ticks)
    averaged(cycle.ticks["phase"], cycle.off, rows, np.zeros((len(rows), 1)), PER_UNIT)


def listed_share(known: Covariance, off: Floats, effect: Floats, kind: Ints, time: Floats) -> float:
    """Probability that a listed effect acts, where the best of them does ``effect`` (mbar).

    The alternative is something that nobody listed: smooth courses over the warped ``time`` of
    each ``kind`` of stretch, in what is ``off`` (mbar).
    """
    courses = [np.zeros((len(kind), 0))]
    for one in np.unique(kind[kind >= 0]):
        here = kind == one
        courses.append(hats(time, knots_over(time[here])) * here[:, None])
    white = known.white(np.column_stack([off - effect, effect, *courses]))
    likely = log_likelihoods(white[:, 2:], white[:, 0], white[:, 1], 1.0)
    return Odds.of(likely[None]).of_cause(1, 0.0)


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
            [healthy.scatter.get(one.name, SCATTER.get(one.name, ("", 0.0))[1]) for one in effects]
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
        changes = [
            (one.name, {p.name: p.typical for p in one.parameters if not p.shapes})
            for one in self.effects
        ]
        theta = coefficients_at(self.theta, changes, points(np.zeros(len(sizes)), sizes))
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
    off: Floats  # whitened, (places, 1)
    bounds: Floats
    size: Floats
    does: Floats  # mbar in that size, (places, effects)
    left: Floats  # sigmas² that it leaves
    wanted: Floats  # sizes to be tried next
    hoped: Floats  # sigmas² that they would leave, were they in proportion

    @classmethod
    def of(cls, known: Covariance, cycle: _Cycle, bounds: Floats) -> "_Fits":
        """With what each effect does in its typical size, in which ``cycle`` is."""
        off, shape = known.white(cycle.off[:, None]), cycle.slopes.shape
        count, total = shape[1], float(np.sum(off**2))
        none, all_left = np.zeros(count), np.full(count, total)
        fits = cls(
            known, off, bounds, none, np.zeros(shape), all_left, none.copy(), all_left.copy()
        )
        fits._take(np.arange(count), np.ones(count), cycle.slopes)
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
        some = replace(expect, effects=[expect.effects[one] for one in finalists])
        for _ in range(ROUNDS):
            trial = self.wanted[finalists]
            trial = np.where(trial == 0.0, NEARLY_NONE, trial)
            self._take(finalists, trial, some.at(trial).slopes, back=True)

    def _take(self, which: Ints, trial: Floats, slopes: Floats, *, back: bool = False) -> None:
        """Take what some effects do in sizes on trial, ``slopes`` (mbar) for each typical size.

        A size is taken only where it leaves less than that before, as an effect may set in
        suddenly: that of a blow-off too weak to release a part. Where it does not, the next one is
        half the way ``back``.
        """
        white = self.known.white(slopes)
        seen = np.sqrt(np.mean((slopes * trial) ** 2, axis=0)) > NOTHING
        power = np.where(seen, np.sum(white**2, axis=0), np.inf)
        best = np.clip(np.sum(white * self.off, axis=0) / power, *self.bounds[which].T) * seen
        leaves = np.sum((self.off - trial * white) ** 2, axis=0)
        hoped = np.sum((self.off - best * white) ** 2, axis=0)
        better = (leaves < self.left[which]) & seen
        self.size[which] = np.where(better, trial, self.size[which])
        self.left[which] = np.where(better, leaves, self.left[which])
        self.does[:, which] = np.where(better, trial * slopes, self.does[:, which])
        further = better if back else hoped < self.hoped[which]
        other = 0.5 * (self.size[which] + trial) if back else self.wanted[which]
        self.wanted[which] = np.where(further, best, other)
        self.hoped[which] = np.where(further, hoped, self.hoped[which])
