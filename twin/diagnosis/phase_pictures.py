"""The pictures of cycles laid over each other: by phase, over the time since it began."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from twin.diagnosis.covariance import covariance
from twin.diagnosis.drawing import (
    AFTER,
    BAND,
    BEFORE,
    EACH,
    MEASURED,
    QUIET,
    as_svg,
    empty,
    legend,
    logarithmic,
)
from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis, of_cycles
from twin.diagnosis.held_out import Judged
from twin.diagnosis.pictures import Found, spread
from twin.diagnosis.text import spoken
from twin.model import theta as c
from twin.model.term import KINDS, Term
from twin.monitor.bins import PER_UNIT, Floats, Ints
from twin.signals import MBAR

MOST_LAID_OVER = 12  # cycles laid over each other
ACTING = 0.5  # of the greatest signature, from which on a cause is at work in a cycle
EARLIEST_MS = 0.5  # on a logarithmic axis
COMMON = 0.5  # of the cycles, that must have a place in time for a mean to be drawn there
OVER = ("time", "vacuum")  # what a term runs over


@dataclass(frozen=True)
class Laid:
    """Bins of cycles laid over each other: those as long after a switching of one kind."""

    bins: Ints
    place: Ints  # of each of them
    kind: Ints  # of each place, index into KINDS
    ms: Floats  # since the switching, of each place
    enough: npt.NDArray[np.bool_]  # whether most cycles come that far
    cycles: Ints

    def mean(self, values: Floats) -> Floats:
        """Mean over cycles, by place; one of the ``values`` belongs to each of the bins."""
        mean: Floats = np.bincount(self.place, values) / np.bincount(self.place)
        return mean


def laid_over(evidence: Evidence, cycles: Ints) -> Laid:
    """Lay the bins of ``cycles`` over each other."""
    bins = evidence.bins
    here = np.flatnonzero(np.isin(bins.cycle, cycles))
    turn = (bins.kind[here] << 32) + np.floor(bins.time[here] * PER_UNIT).astype(np.int64)
    turns, place, count = np.unique(turn, return_inverse=True, return_counts=True)
    kind = turns >> 32
    ms: Floats = np.bincount(place, bins.mean(_since(evidence))[here]) / count
    most = np.array([count[kind == one].max() for one in kind])
    return Laid(here, place, kind, np.maximum(ms, EARLIEST_MS), count > COMMON * most, cycles)


def unseen(found: Found) -> Ints:
    """Held-out cycles."""
    return spread(found.held_out, MOST_LAID_OVER)


def acting(found: Found) -> Ints:
    """Cycles in which the causes are at work: held-out ones, where there are any."""
    bins = found.evidence.bins
    made = found.before.off - found.after.off
    squares = np.bincount(bins.cycle, made**2, minlength=found.evidence.cycles)
    size = np.sqrt(squares / np.maximum(np.bincount(bins.cycle, minlength=len(squares)), 1))
    judged = np.array(found.evidence.judged)
    at_work = judged[size[judged] >= ACTING * size[judged].max()]
    held_out = at_work[np.isin(at_work, found.held_out)]
    return spread((held_out if len(held_out) else at_work).tolist(), MOST_LAID_OVER)


def healthy_sigma(evidence: Evidence, laid: Laid) -> Floats:
    """One sigma (mbar) of the mean at each place in as many healthy cycles."""
    part = of_cycles(evidence, laid.cycles.tolist())
    weights = covariance(part).of(part.judged)
    share = np.zeros((len(laid.kind), len(laid.bins)))
    share[laid.place, np.arange(len(laid.bins))] = 1.0 / np.bincount(laid.place)[laid.place]
    size = len(laid.bins)
    sigma: Floats = np.sqrt(np.sum((share @ weights.covariance.factor[:size, :size]) ** 2, axis=1))
    return sigma


def worst_kind(found: Found, laid: Laid) -> tuple[str, float, float]:
    """In which kind of stretch the twin as it stands is furthest off; rms before, after (mbar)."""
    before, after = (laid.mean(one.off[laid.bins]) for one in (found.before, found.after))
    rms = {kind: _rms(before[laid.kind == kind]) for kind in np.unique(laid.kind).tolist()}
    worst = max(rms, key=lambda kind: rms[kind])
    return KINDS[worst], rms[worst], _rms(after[laid.kind == worst])


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def draw_phases(found: Found, laid: Laid, alt: str) -> str:
    """Draw the deviation of each phase over the time since switching, with the causes' signature.

    Below it what is left with the causes, where there are any.
    """
    reach = 2.0 * healthy_sigma(found.evidence, laid)
    made_by = signatures(found, laid)
    kinds = np.unique(laid.kind[laid.enough]).tolist()
    rows = 2 if found.extended else 1
    with empty("phases", 0.9 + 2.2 * rows) as figure:
        panels = figure.subplots(rows, len(kinds), sharex="col", sharey="row", squeeze=False)
        for column, kind in enumerate(kinds):
            chosen = (laid.kind == kind) & laid.enough
            panels[0, column].set_title(spoken(KINDS[kind]), fontsize=10)
            for row, judged in zip(panels, (found.before, found.after), strict=False):
                _band(row[column], laid, chosen, reach)
                _laid_line(row[column], laid, chosen, judged)
            for made, colour, style, label in made_by:
                panels[0, column].plot(
                    laid.ms[chosen], made[chosen], style, color=colour, lw=1.4, label=label
                )
            logarithmic(panels[-1, column])
        panels[0, 0].set_ylabel("measured − expected\n(mbar absolute)")
        if rows > 1:
            panels[1, 0].set_ylabel(f"left with {found.name}\n(mbar absolute)")
        figure.supxlabel("time since the phase began (ms)", fontsize=10)
        legend(figure, panels.flat)
        return as_svg(figure, alt)


def _band(axes: Axes, laid: Laid, chosen: npt.NDArray[np.bool_], reach: Floats) -> None:
    """Where the mean of healthy cycles is, 95 times in 100."""
    x, y = laid.ms[chosen], reach[chosen]
    axes.fill_between(x, -y, y, color=BAND, lw=0, label="healthy (95 %)")
    axes.axhline(0.0, color=QUIET, lw=0.8)


def _laid_line(axes: Axes, laid: Laid, chosen: npt.NDArray[np.bool_], judged: Judged) -> None:
    mean = laid.mean(judged.off[laid.bins])
    label = f"deviation, mean of {len(laid.cycles)} cycles"
    axes.plot(laid.ms[chosen], mean[chosen], color=MEASURED, lw=2.2, label=label)


def signatures(found: Found, laid: Laid) -> list[tuple[Floats, str, str, str]]:
    """What the causes make of the deviation (mbar) at each place, with how to draw it.

    All of them together, then one by one; nothing where there is none.
    """
    if not found.extended:
        return []
    total = laid.mean((found.before.off - found.after.off)[laid.bins])
    result = [(total, AFTER, "-", f"signature of {found.name}")]
    if len(found.causes) > 1:
        alone: list[Hypothesis] = [(cause,) for cause in found.causes]
        before, *off = off_in(found.evidence, laid, [HEALTHY, *alone]).T
        for cause, one, colour in zip(found.causes, off, EACH, strict=False):
            result.append((laid.mean(before - one), colour, "--", f"of {spoken(cause.effect)}"))
    return result


def off_in(evidence: Evidence, laid: Laid, hypotheses: Sequence[Hypothesis]) -> Floats:
    """Deviation (mbar) from hypotheses in the bins laid over each other, (bins, hypotheses)."""
    part = of_cycles(evidence, laid.cycles.tolist())  # of a long log only what is drawn
    return part.off(hypotheses)


def _since(evidence: Evidence) -> Floats:
    """Time (ms) since the phase began, of each row."""
    phase, rows = evidence.ticks["phase"], np.arange(len(evidence.samples))
    begins = np.diff(phase, prepend=255) != 0
    since = rows - np.maximum.accumulate(np.where(begins, rows, 0))  # one row is one ms
    return since.astype(np.float64)


def draw_left(found: Found, laid: Laid, alt: str) -> str:
    """Draw what the causes leave in the phase where most is left, over time and over vacuum.

    The terms that take it away are drawn over it.
    """
    evidence = found.evidence
    off = off_in(evidence, laid, [found.listed])[:, 0]
    ambient = float(evidence.theta[c.AMBIENT])
    vacuum = evidence.bins.mean(ambient - evidence.samples["pressure"])[laid.bins] / MBAR
    where = found.answer["unlisted"]["where"]
    kinds = [kind for kind, name in enumerate(KINDS) if name.startswith(where)]
    with empty("left", 3.4) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, x, over in zip(panels, (laid.ms[laid.place], vacuum), OVER, strict=True):
            for kind, colour in zip(kinds, (MEASURED, BEFORE), strict=False):
                chosen = laid.kind[laid.place] == kind
                label = f"left in {spoken(KINDS[kind])}"
                axes.plot(x[chosen], off[chosen], ".", color=colour, ms=3, label=label)
            axes.axhline(0.0, color=QUIET, lw=0.8)
            here = [term for term in found.terms if KINDS.index(term.where) in kinds]
            _terms(axes, [term for term in here if term.over == over])
        panels[0].set_xlabel("time since the phase began (ms)")
        logarithmic(panels[0])
        panels[0].set_ylabel("measured − expected\n(mbar absolute)")
        panels[1].set_xlabel("vacuum (mbar below ambient)")
        legend(figure, panels)
        return as_svg(figure, alt)


def _terms(axes: Axes, terms: Sequence[Term]) -> None:
    for term in terms:
        x = np.maximum(term.at, EARLIEST_MS) if term.over == "time" else np.array(term.at)
        label = f"term in {spoken(term.where)}"
        axes.plot(x, term.mbar, "o--", color=AFTER, ms=4, lw=1.4, label=label)
