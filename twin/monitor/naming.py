"""Isolation of large deviations: the probability of each effect, fitted to a single cycle.

``isolation`` names small deviations by signatures that run along with the loop. The response to
a large effect is not in proportion to its signature. So each effect is fitted here by the
response at its fitted size. Covariance, alternative and priors are the same as in ``isolation``
and in the diagnosis.
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

STARTS = (1.0, 2.5, 6.0, 15.0)  # starting points of a fit, in typical sizes
FINALISTS, ROUNDS = 8, 3  # number of effects that are refined, and rounds of it
NOTHING = 0.02  # mbar rms: the cycle does not show an effect whose typical size does less
NOISE = 1.0  # mbar, of a row. Chosen: deviations that are named here are far larger
# Typical sizes of weather: 75 mbar. At one place air pressure differs by less, storms aside; a rig
# that moved to another altitude has to be commissioned again.
MOST_WEATHER = 5.0
EXPLAINED = 0.5  # least share of the squares that a named effect removes


def likenesses(
    theta: Theta,
    healthy: Healthy,
    samples: Samples,
    ticks: Ticks,
    begin: int,
    catalogue: Sequence[Effect] = (),
) -> list[Likeness]:
    """Rank the effects, also those of a ``catalogue`` beside the table, by probability.

    The deviation from row ``begin`` on counts; in the rows before it the model forgets its initial
    state. The unlisted cause stands last. Empty if the best effect explains less than half of the
    squares, if too many effects fit equally well, or if nothing can be compared.
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
    # The uncertainty of an effect's law must not do the explaining.
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
    """Compile the functions of a ranking, so that the first alarm does not wait for them."""
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
    """Probability that a listed effect acts, given the response ``moves`` (mbar) of the best one.

    The best one is ``cause``. The alternative is an unlisted cause. It leaves a share of the
    explained deviation in each cell, smooth over the warped ``time`` of each ``kind`` of stretch.
    Residuals in other cells support neither: a steep edge that comes a row later leaves much
    beside every effect.
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
    """Residuals and responses of a cycle in each compared cell."""

    bins: Bins
    first: Ints  # bin of each cell; a repeated cell counts once
    off: Floats  # mbar, measured less expected, by cell
    moves: Floats  # mbar, response to each change of the coefficients, (cells, changes)
    late: Floats  # mbar per millisecond of the time of contact, (cells, 0 or 1)

    @property
    def kind(self) -> Ints:
        """Kind of stretch of each cell."""
        return self.bins.kind[self.first]

    @property
    def time(self) -> Floats:
        """Warped time since the stretch began, of each cell."""
        return self.bins.time[self.first]

    def squares(self, off: Floats) -> float:
        """Sum of squares (mbar²) over the rows, given the residual of each cell."""
        return float(np.sum(self.bins.count[self.first] * off**2))

    def covariance(self, healthy: Healthy, effects: Sequence[Effect], typical: Floats) -> Floats:
        """Covariance (mbar²) of the cells: scatter of healthy cycles and errors of waveforms.

        ``typical`` are the typical sizes of the effects, at which ``moves`` were computed.
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
    """Simulates a cycle with any sizes of the effects."""

    theta: Theta
    effects: Sequence[Effect]
    samples: Samples  # rows, from before the cycle
    ticks: Ticks
    begin: int  # first row of the cycle
    drawn: Ints  # subsampled rows that are compared

    @classmethod
    def of(
        cls, theta: Theta, effects: Sequence[Effect], samples: Samples, ticks: Ticks, begin: int
    ) -> "_Expected":
        drawn = np.union1d(drawn_rows(samples, ticks), [begin])
        return cls(theta, effects, samples, ticks, begin, drawn)

    def at(self, sizes: Floats) -> _Cycle:
        """The cycle at ``sizes`` (effects, n), in typical sizes; empty if nothing compares."""
        return self._cycle(self._with(np.column_stack([np.zeros(len(sizes)), sizes])))

    def unsure(self, number: int, size: float) -> Floats:
        """Response (mbar, (cells, n)) to one sigma of each uncertainty in an effect's law."""
        sizes = np.zeros((len(self.effects), 1))
        sizes[number] = size
        changed = self._with(sizes)[:, 0]
        off_by_one_sigma = ways(self.effects[number].name, self.theta, changed)
        return self._cycle(np.stack([changed, *off_by_one_sigma], axis=1)).moves

    def _with(self, sizes: Floats) -> Floats:
        """Coefficients with ``sizes`` (effects, n), in typical sizes."""
        changes = [
            (effect.name, {p.name: p.typical for p in effect.parameters if not p.shapes})
            for effect in self.effects
        ]
        return coefficients_at(self.theta, changes, sizes)

    def _cycle(self, theta: Floats) -> _Cycle:
        """The cycle with the first column of coefficients, and the response to the others."""
        here = self.drawn >= self.begin
        expected = self._expected(theta)[here] / MBAR
        expected = np.where(np.isfinite(expected), expected, expected[:, :1])  # solver failed
        off = deviation(self.samples, self.ticks)[self.begin :] / MBAR
        phase = self.ticks["phase"][self.begin :]
        drawn = self.drawn[here] - self.begin
        bins, mean, through = averaged(phase, off, drawn, expected, PER_UNIT)
        first = np.unique(bins.place, return_index=True)[1]
        late = by_contact(bins, first, drawn, expected[:, 0], self.theta, self._period)
        return _Cycle(bins, first, mean[first], derivatives(through[first])[1], late)

    @cached_property
    def _period(self) -> float:
        """Time from row to row (s)."""
        return sampling_ms(self.samples) * MS

    def _expected(self, theta: Theta) -> Floats:
        """Pressure (Pa) at the subsampled rows, (rows, n); ``theta`` is (coefficients, n)."""
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
    """A fit of the size of one effect, in typical sizes."""

    effect: int = 0
    hoped: float = np.inf  # chi-square of the next size, predicted by a linear response

    def begin(self, size: float, moves: Floats, off: Floats) -> None:
        """Consider a size with the response ``moves`` to the residual ``off``; both are whitened.

        The best size so far is kept. The next one is where a linear response would fit best.
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
    """Fit the size of each effect; the few with the best predicted fit are refined.

    Fits start at larger sizes as well: a long delay overlaps little with a short one.
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
    """Refit an effect with the uncertainty of its law; return the covariance with it."""
    before = fits[number]
    wider = Covariance.of(covariance + low_rank(expect.unsure(number, float(before.x[0]))))
    fits[number] = _SizeFit(before.low, before.high, before.x, effect=number)
    _refine([fits[number]], wider, off, expect)
    return wider


def _refine(fits: Sequence[_SizeFit], known: Covariance, off: Floats, expect: _Expected) -> None:
    """Continue some fits for a few rounds."""

    def residuals(requests: Sequence[tuple[_SizeFit, Floats]]) -> Floats:
        sizes = np.zeros((len(expect.effects), len(requests)))
        for column, (fit, x) in enumerate(requests):
            sizes[fit.effect, column] = x[0]
        return known.white(off[:, None] - expect.at(sizes).moves)

    def give_up(round_number: int) -> None:
        for fit in fits:
            fit.done = fit.done or round_number == ROUNDS

    descend(fits, residuals, give_up)
