"""What no listed effect explains: where it is, on what it depends, and a term that takes it away.

Straight lines between knots, over the time since a switching or over the vacuum, are fitted to what
is left on the fitted cycles. Where they take much away on the held-out ones something is there that
comes again in every cycle; where much is left all the same, it follows a time of its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from twin.diagnosis.covariance import Covariance, Weights, levels
from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis
from twin.inference.unmodelled import hats, knots_over
from twin.model import theta as c
from twin.model.courses import Cause
from twin.model.term import KINDS, Term
from twin.monitor.bins import Bins, Floats, unwarped
from twin.signals import MBAR, MS

Over = Literal["time", "vacuum"]
OVER: Mapping[Over, str] = {"time": "time in the cycle", "vacuum": "vacuum"}
_ALL = range(len(KINDS))
STRANGE = 0.4  # chi-square per residual that terms must take away on cycles they have not seen
DROP_BAR = 0.1
TERM_MBAR = 30.0  # how large a term may be, one sigma
KNOT_MBAR = 60.0  # between knots over vacuum
FEWEST = 3  # cycles that a kind of stretch must be in
SURE = 0.9  # correlation above which what is left follows the measured supply


@dataclass(frozen=True)
class Unlisted:
    """Something that no listed effect explains."""

    where: str  # idle, suction, hold or blow_off
    depends_on: str  # vacuum, time in the cycle, absolute time or supply
    terms: tuple[Term, ...]  # what takes it away; none where it does not come again in every cycle
    gain: float  # in chi-square that terms have on the held-out cycles, per residual

    @property
    def shape(self) -> str:
        """Its shape in words."""
        mine = [term for term in self.terms if _phase(term.where) == self.where]
        if not mine:
            return "another one in each cycle: no term of the model can take it away"
        term = max(mine, key=lambda one: max(map(abs, one.mbar)))
        most = int(np.argmax(np.abs(term.mbar)))
        place = f"{term.at[most]:.0f} " + (
            "ms after it begins" if term.over == "time" else "mbar vacuum"
        )
        return f"up to {term.mbar[most]:+.1f} mbar of pressure, at {place}"


@dataclass(frozen=True)
class _Left:
    """What a hypothesis leaves on some cycles: bins in mbar, and whitened with the levels."""

    weights: Weights
    off: Floats
    white: Floats


def look(
    known: Covariance,
    hypothesis: Hypothesis,
    fitted: Sequence[int],
    held_out: Sequence[int],
    least: float = STRANGE,
) -> Unlisted:
    """Fit terms to what a hypothesis leaves on the fitted cycles; judge on the others.

    ``known`` is about the same hypothesis. Terms must take away the ``least`` there (chi-square
    per residual). Over what they run the fitted cycles say among themselves: the held-out ones
    choose nothing.
    """
    evidence = known.evidence
    off = evidence.off([hypothesis])

    def left(cycles: Sequence[int]) -> _Left:
        weights = known.of(cycles)
        level = levels(evidence, cycles, [hypothesis])
        return _Left(weights, off[:, 0], weights.white(off, level)[:, 0])

    here, there = left(fitted), left(held_out)
    some, others = (left(fitted[i::2]) for i in (0, 1)) if len(fitted) > 1 else (here, here)
    over = max(OVER, key=lambda one: _tried(evidence, some, others, one).gain)
    best = _tried(evidence, here, there, over)
    if best.gain >= least:
        return best
    return Unlisted(_worst(evidence, there), _driver(evidence, off[:, 0]), (), best.gain)


def _tried(evidence: Evidence, here: _Left, there: _Left, over: Over) -> Unlisted:
    """Terms over time or vacuum."""
    shapes = smooth(evidence, here.off, over)
    knots, hats = (
        {name: at for name, (at, _) in shapes.items()},
        [one for _, one in shapes.values()],
    )
    columns = here.weights.white(np.concatenate(hats, axis=1))
    prior = np.eye(columns.shape[1]) / TERM_MBAR**2
    size = np.linalg.solve(columns.T @ columns + prior, columns.T @ here.white)
    parts = np.split(size, np.cumsum([len(at) for at in knots.values()])[:-1])
    taken = [there.weights.white(one) @ part for one, part in zip(hats, parts, strict=True)]
    after = there.white - np.sum(taken, axis=0)
    alone = [float(np.sum((after + one) ** 2)) for one in taken]  # without each of them
    names = list(knots)
    terms = tuple(
        _term(name, over, at, part) for (name, at), part in zip(knots.items(), parts, strict=True)
    )
    gain = float(there.white @ there.white - after @ after) / len(after)
    where = _phase(names[int(np.argmax(alone))])
    return Unlisted(where, OVER[over], terms, gain)


def smooth(evidence: Evidence, off: Floats, over: Over) -> dict[str, tuple[Floats, Floats]]:
    """Knots of each kind of stretch, and the share of each in each bin, (bins, knots).

    ``off`` is what a hypothesis leaves (mbar), which tells the vacuum that it expects.
    """
    bins, values = evidence.bins, _over(evidence, off, over)
    knots = {name: _knots(bins, values, kind, over) for kind, name in enumerate(KINDS)}
    return {name: (at, _hats(bins, values, name, at)) for name, at in knots.items() if len(at)}


def _term(name: str, over: Over, at: Floats, sizes: Floats) -> Term:
    ends = unwarped(at) / MS if over == "time" else at
    short = [tuple(float(f"{value:.4g}") for value in values) for values in (ends, sizes)]
    return Term(where=name, over=over, at=short[0], mbar=short[1])


def _worst(evidence: Evidence, left: _Left) -> str:
    """The phase in which most is left."""
    kind = evidence.bins.kind[left.weights.bins]
    white = left.white[: len(kind)]
    most = [float(np.mean(white[kind == k] ** 2)) if (kind == k).any() else 0.0 for k in _ALL]
    return _phase(KINDS[int(np.argmax(most))])


def _driver(evidence: Evidence, off: Floats) -> str:
    """What something follows that differs from cycle to cycle: the measured supply, or time."""
    drop = (Cause("supply_pressure_drop", {"drop": DROP_BAR}),)
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
    """What terms run over, in each bin: warped time, or the vacuum that is expected (mbar)."""
    if over == "time":
        return evidence.bins.time
    measured = evidence.bins.mean(evidence.samples["pressure"].astype(np.float64))
    vacuum: Floats = evidence.theta[c.AMBIENT] / MBAR - (measured / MBAR - off)
    return vacuum


def _knots(bins: Bins, values: Floats, kind: int, over: Over) -> Floats:
    """Knots of a kind of stretch, each with bins about it; none where it is too rare."""
    here = values[bins.kind == kind]
    if len(np.unique(bins.cycle[bins.kind == kind])) < FEWEST:
        return np.empty(0)
    if over == "time":
        return knots_over(here)
    count = max(int(np.ptp(here) / KNOT_MBAR), 1) + 1
    spread: Floats = np.quantile(here, np.linspace(0.0, 1.0, count))
    return spread[np.diff(spread, prepend=-np.inf) > KNOT_MBAR / 4.0]


def _hats(bins: Bins, values: Floats, name: str, knots: Floats) -> Floats:
    """Share of each knot in each bin, (bins, knots): straight lines between them."""
    shares: Floats = hats(values, knots) * (bins.kind == KINDS.index(name))[:, None]
    return shares


def extended(evidence: Evidence, terms: Sequence[Term]) -> Evidence:
    """The same beside a twin that has terms more."""
    return replace(evidence, terms=(*evidence.terms, *terms))
