"""Which cause a large deviation has: the probability of each effect in the size that it has there.

What is small is named by the signatures that run along with the loop (``isolation``). What is large
is not in proportion to them: here each effect is fitted to one cycle alone, by what it does in the
size found. Covariance, alternative and priors are the same in both, and in the diagnosis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin.inference.gauss_newton import Descent, descend
from twin.inference.priors import penalty, tempered
from twin.inference.sensitivities import coefficients_at, derivatives
from twin.inference.unmodelled import LEAST_SURE, MISMATCH, Odds, hats, knots_over, log_likelihoods
from twin.inference.whitening import Covariance, fading, low_rank
from twin.model import kernel
from twin.model.effects import EFFECTS, UNKNOWN, Effect
from twin.model.theta import Theta
from twin.monitor.bins import Bins, Floats, Ints, averaged
from twin.monitor.cycles import Cycle
from twin.monitor.healthy import Healthy
from twin.monitor.likeness import Likeness
from twin.monitor.model_bank import UNCERTAIN_LAWS, ways
from twin.monitor.rows import drawn_rows, elapsed, time_steps
from twin.monitor.scatter_covariance import (
    SCATTER,
    Reading,
    by_contact,
    from_cycle_to_cycle,
    lasting,
    model_error,
)
from twin.monitor.statistics import PER_UNIT
from twin.monitor.surroundings import told
from twin.signals import MBAR, MS, Samples, Ticks, deviation, sampling_ms

STARTS = (1.0, 2.5, 6.0, 15.0)  # typical sizes in which a fit begins
FINALISTS, ROUNDS = 8, 3  # effects that go on from the best of these, and for how many rounds
NOTHING = 0.02  # mbar rms: what moves the pressure by less in its typical size is not seen in it
NOISE = 1.0  # mbar, of a row. Chosen: what is named here is far larger
# Typical sizes of weather: 75 mbar. At one place air pressure differs by less, storms aside; a rig
# that moved to another altitude has to be commissioned again.
MOST_WEATHER = 5.0
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
    cycle = expect.at(np.eye(len(effects)))
    if not len(cycle.off):
        return []
    covariance = cycle.covariance(healthy, effects, typical)
    known = Covariance.of(covariance)
    fits = _fitted(known, cycle.off, bounds, expect)
    is_measured = "ambient" in told(samples)
    left, suits = np.zeros(len(fits)), [known] * len(fits)
    for number, effect in enumerate(effects):
        if effect.name in UNCERTAIN_LAWS:
            suits[number] = _refit(fits, number, covariance, cycle.off, expect)
        size = float(fits[number].x[0])
        left[number] = fits[number].chi2 + suits[number].log_pdet
        left[number] += penalty(effect, size, ambient_is_measured=is_measured)
    sizes = np.array([fit.x[0] for fit in fits])
    moved = expect.at(np.diag(sizes)).moves
    rest = np.array([cycle.squares(cycle.off - moves) for moves in moved.T])
    # What a law leaves open must not do the explaining.
    left[rest > (1.0 - EXPLAINED) * cycle.squares(cycle.off)] = np.inf
    is_weather = np.array([effect.is_weather for effect in effects])
    left[is_weather & (np.abs(sizes) > MOST_WEATHER)] = np.inf
    best = int(np.argmin(left))
    if np.isinf(left[best]):
        return []
    moves = moved[:, best]
    listed = listed_share(
        suits[best],
        cycle.off,
        moves,
        cycle.kind,
        cycle.time,
        effects[best],
        ambient_is_measured=is_measured,
    )
    shares = np.exp(0.5 * (left[best] - left))
    shares *= listed / shares.sum()
    if shares[best] < LEAST_SURE:
        return []
    causes = [
        Likeness(effect.name, first.reported(size, theta), first.unit, share)
        for effect, first, size, share in zip(
            effects, firsts, (sizes * typical).tolist(), shares.tolist(), strict=True
        )
    ]
    causes.sort(key=lambda likeness: -likeness.share)
    return [*causes, Likeness(UNKNOWN, None, "", 1.0 - listed)]


def compiled_for(cycle: Cycle) -> None:
    """Compile what a ranking needs, so that the first alarm does not wait for it."""
    rows = drawn_rows(cycle.samples, cycle.ticks)
    averaged(cycle.ticks["phase"], cycle.off, rows, np.zeros((len(rows), 1)), PER_UNIT)


def listed_share(
    known: Covariance,
    off: Floats,
    moves: Floats,
    kind: Ints,
    time: Floats,
    cause: Effect,
    *,
    ambient_is_measured: bool,
) -> float:
    """Probability that a listed effect acts, where the best, ``cause``, does ``moves`` (mbar).

    The alternative is something that nobody listed. Of what is explained in each place it leaves a
    share, smooth over the warped ``time`` of each ``kind`` of stretch. What is off elsewhere speaks
    for neither: a steep edge that comes a row later leaves much beside every effect.
    """
    courses = [np.zeros((len(kind), 0))]
    for number in np.unique(kind[kind >= 0]):
        here = kind == number
        courses.append(hats(time, knots_over(time[here])) * (here * moves)[:, None])
    white = known.white(np.column_stack([off - moves, *courses]))
    logs = log_likelihoods(white[:, 1:], white[:, 0])[None]
    frequency = tempered(cause.frequency(ambient_is_measured=ambient_is_measured))
    return Odds.of(logs, cause, frequency).of_cause(1, 0.0)


@dataclass(frozen=True)
class _Cycle:
    """What is compared of a cycle, place by place."""

    bins: Bins
    first: Ints  # bins; what comes again counts once
    off: Floats  # mbar, measured less expected
    moves: Floats  # mbar by each change of the coefficients, (places, changes)
    late: Floats  # mbar by a millisecond of the time of contact, (places, 0 or 1)

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
        """Covariance (mbar²): healthy cycles scatter, and waveforms are a little wrong.

        ``moves`` are those of the ``typical`` size of each effect.
        """
        common, alone = model_error(healthy.error, self.kind, self.time)
        scatter = np.array(
            [
                healthy.scatter.get(effect.name, SCATTER.get(effect.name, ("", 0.0))[1])
                for effect in effects
            ]
        )
        moves = np.hstack([self.moves * (scatter / typical), self.late * healthy.meets_ms])
        goes_on = lasting(self.bins, self.first, alone)
        usual = from_cycle_to_cycle(
            self.bins, self.first, goes_on, moves, Reading(NOISE), healthy.leftover
        )
        own = np.hypot(common, MISMATCH * self.off)
        return usual + fading(own, self.time, self.kind)


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
        """The cycle with sizes (effects, n), in typical ones; empty where nothing compares."""
        return self._cycle(self._with(np.column_stack([np.zeros(len(sizes)), sizes])))

    def unsure(self, number: int, size: float) -> Floats:
        """What its law leaves open of an effect in a size: mbar by one sigma each, (places, n)."""
        sizes = np.zeros((len(self.effects), 1))
        sizes[number] = size
        changed = self._with(sizes)[:, 0]
        off_by_one_sigma = ways(self.effects[number].name, self.theta, changed)
        return self._cycle(np.stack([changed, *off_by_one_sigma], axis=1)).moves

    def _with(self, sizes: Floats) -> Floats:
        """Coefficients with so many typical sizes of each effect, (effects, n)."""
        changes = [
            (effect.name, {p.name: p.typical for p in effect.parameters if not p.shapes})
            for effect in self.effects
        ]
        return coefficients_at(self.theta, changes, sizes)

    def _cycle(self, theta: Floats) -> _Cycle:
        """The cycle by the first coefficients, and what the others move it by."""
        here = self.drawn >= self.begin
        expected = self._expected(theta)[here] / MBAR
        expected = np.where(np.isfinite(expected), expected, expected[:, :1])  # it has no answer
        off = deviation(self.samples, self.ticks)[self.begin :] / MBAR
        phase = self.ticks["phase"][self.begin :]
        drawn = self.drawn[here] - self.begin
        bins, mean, through = averaged(phase, off, drawn, expected, PER_UNIT)
        first = np.unique(bins.place, return_index=True)[1]
        late = by_contact(bins, first, drawn, expected[:, 0], self.theta, self._period)
        return _Cycle(bins, first, mean[first], derivatives(through[first])[1], late)

    @cached_property
    def _period(self) -> float:
        """Seconds from row to row."""
        return sampling_ms(self.samples) * MS

    def _expected(self, theta: Theta) -> Floats:
        """Pressure (Pa) at the drawn rows, (rows, n); ``theta`` is (coefficients, n)."""
        rows = self.drawn
        breaks = time_steps(self.samples)[rows] < 0.0
        dt = np.where(breaks, -1.0, elapsed(self.samples[rows]))
        dt[:1] = 0.0
        driven = dt, self.ticks["phase"][rows], self.ticks["level"][rows].astype(np.float64)
        state, expected = kernel.new_state(theta.shape[1]), np.empty((len(rows), theta.shape[1]))
        kernel.advance(state, theta, *driven, expected, tolerance=kernel.COARSE_TOLERANCE)
        return expected


@dataclass
class _SizeFit(Descent):
    """A fit of the size of one effect, in typical ones."""

    effect: int = 0
    hoped: float = np.inf  # chi-square that the next size would have, were moves in proportion

    def begin(self, size: float, moves: Floats, off: Floats) -> None:
        """Consider a size that moves the cycle by ``moves``; both are whitened.

        The best one so far is kept, and the next one is where the best proportion would lead.
        """
        chi2 = float(np.sum((off - moves) ** 2))
        if chi2 < self.chi2:
            self.x, self.chi2 = np.array([size]), chi2
        times = float(moves @ off) / float(moves @ moves)
        wanted = float(np.clip(times * size, *self.low, *self.high))
        hoped = float(np.sum((off - wanted / size * moves) ** 2))
        if hoped < self.hoped:
            self.next, self.hoped = np.array([wanted]), hoped


def _fitted(known: Covariance, off: Floats, bounds: Floats, expect: _Expected) -> list[_SizeFit]:
    """Fit the size of each effect; the few that promise most are refined.

    Fits begin in larger sizes as well: what is late by much overlaps little with a bit of it.
    """
    white_off = known.white(off[:, None])[:, 0]
    none = float(white_off @ white_off)
    fits = [
        _SizeFit(low, high, np.zeros(1), none, effect=number)
        for number, (low, high) in enumerate(bounds[:, :, None])
    ]
    for start in STARTS:
        sizes = np.clip(np.full(len(fits), start), *bounds.T)
        moves = expect.at(np.diag(sizes)).moves
        is_seen = np.sqrt(np.mean(moves**2, axis=0)) > NOTHING
        white = known.white(moves)
        for number in np.flatnonzero(is_seen).tolist():
            fits[number].begin(float(sizes[number]), white[:, number], white_off)
    finalists = sorted(fits, key=lambda fit: min(fit.hoped, fit.chi2))[:FINALISTS]
    _refine(finalists, known, off, expect)
    return fits


def _refit(
    fits: list[_SizeFit], number: int, covariance: Floats, off: Floats, expect: _Expected
) -> Covariance:
    """Fit an effect again with what its law leaves open; give the covariance with that."""
    before = fits[number]
    wider = Covariance.of(covariance + low_rank(expect.unsure(number, float(before.x[0]))))
    fits[number] = _SizeFit(before.low, before.high, before.x, effect=number)
    _refine([fits[number]], wider, off, expect)
    return wider


def _refine(fits: Sequence[_SizeFit], known: Covariance, off: Floats, expect: _Expected) -> None:
    """Go on with some fits for a few rounds."""

    def residuals(requests: Sequence[tuple[_SizeFit, Floats]]) -> Floats:
        sizes = np.zeros((len(expect.effects), len(requests)))
        for column, (fit, x) in enumerate(requests):
            sizes[fit.effect, column] = x[0]
        return known.white(off[:, None] - expect.at(sizes).moves)

    def give_up(round_number: int) -> None:
        for fit in fits:
            fit.done = fit.done or round_number == ROUNDS

    descend(fits, residuals, give_up)
