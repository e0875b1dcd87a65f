"""Residuals that no listed effect explains: phase, dependence, and a term that removes them.

Terms are straight lines between knots, over the time since a switching or over the vacuum. They are
fitted to the residual of the fitted cycles. If they remove much of it on the held-out cycles, the
unlisted effect repeats in every cycle; if much remains, it has its own course in time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis
from twin.diagnosis.residual_covariance import Covariance, ResidualWhitener, levels
from twin.inference.unmodelled import hats, knots_over
from twin.model import theta as c
from twin.model.courses import Cause
from twin.model.effects import standing_for
from twin.model.term import KINDS, Term
from twin.monitor.bins import Bins, Floats, unwarped
from twin.signals import MBAR, MS

Over = Literal["time", "vacuum"]
OVER: Mapping[Over, str] = {"time": "time in the cycle", "vacuum": "vacuum"}
_ALL = range(len(KINDS))
STRANGE = 0.4  # chi-square per residual that terms must remove on held-out cycles
DROP_BAR = 0.1
TERM_MBAR = 30.0  # prior sigma of a term
KNOT_MBAR = 60.0  # between knots over vacuum
FEWEST = 3  # cycles that must have a kind of stretch
SURE = 0.9  # correlation above which the residual follows the measured supply


@dataclass(frozen=True)
class Unlisted:
    """Something that no listed effect explains."""

    where: str  # idle, suction, hold or blow_off
    depends_on: str  # vacuum, time in the cycle, absolute time or supply
    terms: tuple[Term, ...]  # that remove it; empty if it does not repeat in every cycle
    gain: float  # of terms on the held-out cycles, in chi-square per residual

    @property
    def shape(self) -> str:
        """Its shape as text."""
        terms_there = [term for term in self.terms if _phase(term.where) == self.where]
        if not terms_there:
            return "another one in each cycle: no term of the model can take it away"
        term = max(terms_there, key=lambda candidate: max(map(abs, candidate.mbar)))
        most = int(np.argmax(np.abs(term.mbar)))
        place_text = f"{term.at[most]:.0f} " + (
            "ms after it begins" if term.over == "time" else "mbar vacuum"
        )
        return f"up to {term.mbar[most]:+.1f} mbar of pressure, at {place_text}"


@dataclass(frozen=True)
class _Residual:
    """Residual of a hypothesis on some cycles: bins in mbar, and whitened with the levels."""

    weights: ResidualWhitener
    off: Floats
    white: Floats


def look(
    residual_covariance: Covariance,
    hypothesis: Hypothesis,
    fitted: Sequence[int],
    held_out: Sequence[int],
    least: float = STRANGE,
) -> Unlisted:
    """Fit terms to the residual of a hypothesis on the fitted cycles; judge on the others.

    ``residual_covariance`` is about the same hypothesis. Terms must remove at least ``least`` there
    (chi-square per residual). The fitted cycles alone choose time or vacuum, by cross-validation:
    the held-out ones choose nothing.
    """
    evidence = residual_covariance.evidence
    off = evidence.off([hypothesis])

    def residual_of(cycles: Sequence[int]) -> _Residual:
        weights = residual_covariance.of(cycles)
        level = levels(evidence, cycles, [hypothesis])
        return _Residual(weights, off[:, 0], weights.white(off, level)[:, 0])

    fitted_residual, held_out_residual = residual_of(fitted), residual_of(held_out)
    first_half, second_half = (
        (residual_of(fitted[i::2]) for i in (0, 1))
        if len(fitted) > 1
        else (fitted_residual, fitted_residual)
    )
    over = max(OVER, key=lambda variable: _tried(evidence, first_half, second_half, variable).gain)
    best = _tried(evidence, fitted_residual, held_out_residual, over)
    if best.gain >= least:
        return best
    return Unlisted(
        _worst(evidence, held_out_residual), _driver(evidence, off[:, 0]), (), best.gain
    )


def _tried(evidence: Evidence, fitted: _Residual, held_out: _Residual, over: Over) -> Unlisted:
    """Fit terms over time or vacuum on one residual, and judge them on another."""
    shapes = smooth(evidence, fitted.off, over)
    knots, hats = (
        {name: at for name, (at, _) in shapes.items()},
        [block for _, block in shapes.values()],
    )
    columns = fitted.weights.white(np.concatenate(hats, axis=1))
    prior = np.eye(columns.shape[1]) / TERM_MBAR**2
    size = np.linalg.solve(columns.T @ columns + prior, columns.T @ fitted.white)
    parts = np.split(size, np.cumsum([len(at) for at in knots.values()])[:-1])
    contributions = [
        held_out.weights.white(block) @ part for block, part in zip(hats, parts, strict=True)
    ]
    after = held_out.white - np.sum(contributions, axis=0)
    chi2_without = [
        float(np.sum((after + block) ** 2)) for block in contributions
    ]  # without each of them
    names = list(knots)
    terms = tuple(
        _term(name, over, at, part)  # pyright: ignore[reportArgumentType]
        for (name, at), part in zip(knots.items(), parts, strict=True)
    )
    gain = float(held_out.white @ held_out.white - after @ after) / len(after)
    where = _phase(names[int(np.argmax(chi2_without))])
    return Unlisted(where, OVER[over], terms, gain)


def smooth(evidence: Evidence, off: Floats, over: Over) -> dict[str, tuple[Floats, Floats]]:
    """Knots of each kind of stretch, and the share of each in each bin, (bins, knots).

    ``off`` is the residual of a hypothesis (mbar), from which the expected vacuum follows.
    """
    bins, values = evidence.bins, _over(evidence, off, over)
    knots = {name: _knots(bins, values, kind, over) for kind, name in enumerate(KINDS)}
    return {name: (at, _hats(bins, values, name, at)) for name, at in knots.items() if len(at)}


def _term(name: str, over: Over, at: Floats, sizes: Floats) -> Term:
    ends = unwarped(at) / MS if over == "time" else at
    short = [tuple(float(f"{value:.4g}") for value in values) for values in (ends, sizes)]
    return Term(where=name, over=over, at=short[0], mbar=short[1])  # pyright: ignore[reportArgumentType]


def _worst(evidence: Evidence, residual: _Residual) -> str:
    """The phase with the largest residual."""
    kind = evidence.bins.kind[residual.weights.bins]
    white = residual.white[: len(kind)]
    mean_squares = [
        float(np.mean(white[kind == k] ** 2)) if (kind == k).any() else 0.0 for k in _ALL
    ]
    return _phase(KINDS[int(np.argmax(mean_squares))])


def _driver(evidence: Evidence, off: Floats) -> str:
    """What an effect that differs from cycle to cycle follows: the measured supply, or time."""
    lower_supply, parameter = standing_for(c.SUPPLY)
    drop = (Cause(lower_supply.name, {parameter.name: DROP_BAR}),)
    moves = np.diff(evidence.off([HEALTHY, drop]), axis=1)[:, 0]
    sizes, supplies = [], []
    for cycle in evidence.judged:
        bins = evidence.bins.cycle == cycle
        rows = slice(evidence.starts[cycle], evidence.starts[cycle + 1])
        sizes.append(float(moves[bins] @ off[bins] / (moves[bins] @ moves[bins])))
        supplies.append(float(np.mean(evidence.samples["supply"][rows])))
    if not np.isfinite(supplies).all() or np.std(supplies) == 0.0:
        return "absolute time"
    return "supply" if abs(np.corrcoef(sizes, supplies)[0, 1]) > SURE else "absolute time"


def _phase(name: str) -> str:
    return "suction" if name == "suction_again" else name


def _over(evidence: Evidence, off: Floats, over: Over) -> Floats:
    """Independent variable of terms in each bin: warped time, or expected vacuum (mbar)."""
    if over == "time":
        return evidence.bins.time
    measured = evidence.bins.mean(evidence.samples["pressure"].astype(np.float64))
    vacuum: Floats = evidence.theta[c.AMBIENT] / MBAR - (measured / MBAR - off)
    return vacuum


def _knots(bins: Bins, values: Floats, kind: int, over: Over) -> Floats:
    """Knots of a kind of stretch, each with bins about it; empty if the kind is too rare."""
    of_kind = values[bins.kind == kind]
    if len(np.unique(bins.cycle[bins.kind == kind])) < FEWEST:
        return np.empty(0)
    if over == "time":
        return knots_over(of_kind)
    count = max(int(np.ptp(of_kind) / KNOT_MBAR), 1) + 1
    spread: Floats = np.quantile(of_kind, np.linspace(0.0, 1.0, count))
    return spread[np.diff(spread, prepend=-np.inf) > KNOT_MBAR / 4.0]


def _hats(bins: Bins, values: Floats, name: str, knots: Floats) -> Floats:
    """Share of each knot in each bin, (bins, knots): straight lines between them."""
    shares: Floats = hats(values, knots) * (bins.kind == KINDS.index(name))[:, None]
    return shares


def extended(evidence: Evidence, terms: Sequence[Term]) -> Evidence:
    """Evidence for a twin with further terms."""
    return replace(evidence, terms=(*evidence.terms, *terms))
