"""Pictures of superimposed cycles: by phase, over the time since it began."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from twin.diagnosis.curves import DEVIATION
from twin.diagnosis.drawing import (
    AFTER,
    BAND,
    BEFORE,
    EACH,
    MEASURED,
    QUIET,
    Picture,
    empty,
    legend,
    logarithmic,
)
from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis, of_cycles
from twin.diagnosis.held_out import Judged
from twin.diagnosis.pictures import Found, spread
from twin.diagnosis.residual_covariance import covariance
from twin.diagnosis.text import spoken
from twin.languages.texts import ntr, tr
from twin.model import theta as c
from twin.model.term import KINDS, Term
from twin.monitor.bins import PER_UNIT, Floats, Ints
from twin.signals import MBAR

MOST_LAID_OVER = 12  # superimposed cycles
ACTING = 0.5  # of the largest signature: least one of a cycle in which a cause acts
EARLIEST_MS = 0.5  # on a logarithmic axis
COMMON = 0.5  # share of the cycles that must have a place in time for a mean there
OVER = ("time", "vacuum")  # independent variables of terms


@dataclass(frozen=True)
class Laid:
    """Superimposed bins of cycles: those of the same kind and time since a switching."""

    bins: Ints
    place: Ints  # of each of them
    kind: Ints  # of each place, index into KINDS
    ms: Floats  # since the switching, of each place
    enough: npt.NDArray[np.bool_]  # whether most cycles have it
    cycles: Ints

    def mean(self, values: Floats) -> Floats:
        """Mean over cycles of the bins' ``values``, by place."""
        mean: Floats = np.bincount(self.place, values) / np.bincount(self.place)
        return mean


def laid_over(evidence: Evidence, cycles: Ints) -> Laid:
    """Superimpose the bins of ``cycles``."""
    bins = evidence.bins
    rows = np.flatnonzero(np.isin(bins.cycle, cycles))
    key = (bins.kind[rows] << 32) + np.floor(bins.time[rows] * PER_UNIT).astype(np.int64)
    keys, place, count = np.unique(key, return_inverse=True, return_counts=True)
    kind = keys >> 32
    ms: Floats = np.bincount(place, bins.mean(_since(evidence))[rows]) / count
    most = np.array([count[kind == stretch_kind].max() for stretch_kind in kind])
    return Laid(rows, place, kind, np.maximum(ms, EARLIEST_MS), count > COMMON * most, cycles)


def unseen(diagnosed: Found) -> Ints:
    """Held-out cycles."""
    return spread(diagnosed.held_out, MOST_LAID_OVER)


def acting(diagnosed: Found) -> Ints:
    """Cycles in which the causes act: held-out ones, if there are any."""
    bins = diagnosed.evidence.bins
    explained = diagnosed.before.off - diagnosed.after.off
    squares = np.bincount(bins.cycle, explained**2, minlength=diagnosed.evidence.cycles)
    size = np.sqrt(squares / np.maximum(np.bincount(bins.cycle, minlength=len(squares)), 1))
    judged = np.array(diagnosed.evidence.judged)
    at_work = judged[size[judged] >= ACTING * size[judged].max()]
    held_out = at_work[np.isin(at_work, diagnosed.held_out)]
    return spread((held_out if len(held_out) else at_work).tolist(), MOST_LAID_OVER)


def healthy_sigma(evidence: Evidence, laid: Laid) -> Floats:
    """One sigma (mbar) of the mean at each place, in the same number of healthy cycles."""
    part = of_cycles(evidence, laid.cycles.tolist())
    weights = covariance(part).of(part.judged)
    share = np.zeros((len(laid.kind), len(laid.bins) + len(weights.sigma)))
    share[laid.place, np.arange(len(laid.bins))] = 1.0 / np.bincount(laid.place)[laid.place]
    return weights.covariance.sigma(share)


def worst_kind(diagnosed: Found, laid: Laid) -> tuple[str, float, float]:
    """Kind of stretch with the largest deviation of the unchanged twin; rms before, after."""
    before, after = (
        laid.mean(judged.off[laid.bins]) for judged in (diagnosed.before, diagnosed.after)
    )
    rms = {kind: _rms(before[laid.kind == kind]) for kind in np.unique(laid.kind).tolist()}
    worst = max(rms, key=lambda kind: rms[kind])
    return KINDS[worst], rms[worst], _rms(after[laid.kind == worst])


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def draw_phases(diagnosed: Found, laid: Laid, alt: str) -> Picture:
    """Draw the deviation of each phase over the time since switching, with the causes' signature.

    If there are causes, the deviation from the extended model is below.
    """
    reach = 2.0 * healthy_sigma(diagnosed.evidence, laid)
    cause_curves = signatures(diagnosed, laid)
    kinds = np.unique(laid.kind[laid.enough]).tolist()
    rows = 2 if diagnosed.extended else 1
    with empty("phases", 0.9 + 2.2 * rows, alt) as figure:
        panels = figure.subplots(rows, len(kinds), sharex="col", sharey="row", squeeze=False)
        for column, kind in enumerate(kinds):
            chosen = (laid.kind == kind) & laid.enough
            panels[0, column].set_title(spoken(KINDS[kind]), fontsize=10)
            for row, judged in zip(panels, (diagnosed.before, diagnosed.after), strict=False):
                _band(row[column], laid, chosen, reach)
                _laid_line(row[column], laid, chosen, judged)
            for explained, colour, style, label in cause_curves:
                panels[0, column].plot(
                    laid.ms[chosen], explained[chosen], style, color=colour, lw=1.4, label=label
                )
            logarithmic(panels[-1, column])
        panels[0, 0].set_ylabel(tr(DEVIATION))
        if rows > 1:
            panels[1, 0].set_ylabel(tr("left over\n(mbar absolute)"))
        figure.supxlabel(tr("time since the phase began (ms)"), fontsize=10)
        legend(figure, panels.flat)
        return figure


def _band(axes: Axes, laid: Laid, chosen: npt.NDArray[np.bool_], reach: Floats) -> None:
    """Draw the 95 % band of the mean of healthy cycles."""
    x, y = laid.ms[chosen], reach[chosen]
    axes.fill_between(x, -y, y, color=BAND, lw=0, label=tr("healthy (95 %)"))
    axes.axhline(0.0, color=QUIET, lw=0.8)


def _laid_line(axes: Axes, laid: Laid, chosen: npt.NDArray[np.bool_], judged: Judged) -> None:
    mean = laid.mean(judged.off[laid.bins])
    label = ntr(
        "deviation, mean of {count} cycle", "deviation, mean of {count} cycles", len(laid.cycles)
    )
    axes.plot(laid.ms[chosen], mean[chosen], color=MEASURED, lw=2.2, label=label)


def signatures(diagnosed: Found, laid: Laid) -> list[tuple[Floats, str, str, str]]:
    """Deviation by the causes (mbar) at each place, with colour, style and label.

    All causes together, then each of several; empty without causes.
    """
    if not diagnosed.extended:
        return []
    total = laid.mean((diagnosed.before.off - diagnosed.after.off)[laid.bins])
    result = [(total, AFTER, "-", tr("signature of {causes}", causes=diagnosed.name))]
    if len(diagnosed.causes) > 1:
        alone: list[Hypothesis] = [(cause,) for cause in diagnosed.causes]
        before, *off = off_in(diagnosed.evidence, laid, [HEALTHY, *alone]).T
        for cause, deviation, colour in zip(diagnosed.causes, off, EACH, strict=False):
            label = tr("of {cause}", cause=spoken(cause.effect))
            result.append((laid.mean(before - deviation), colour, "--", label))
    return result


def off_in(evidence: Evidence, laid: Laid, hypotheses: Sequence[Hypothesis]) -> Floats:
    """Deviation (mbar) from hypotheses in the superimposed bins, (bins, hypotheses)."""
    part = of_cycles(evidence, laid.cycles.tolist())  # only the drawn cycles of a long log
    return part.off(hypotheses)


def _since(evidence: Evidence) -> Floats:
    """Time (ms) since the phase began, of each row."""
    phase, rows = evidence.ticks["phase"], np.arange(len(evidence.samples))
    begins = np.diff(phase, prepend=255) != 0
    since = rows - np.maximum.accumulate(np.where(begins, rows, 0))  # one row is one ms
    return since.astype(np.float64)


def draw_left(diagnosed: Found, laid: Laid, alt: str) -> Picture:
    """Draw the residual of the causes in the worst phase, over time and over vacuum.

    The terms fitted to it are drawn over it.
    """
    evidence = diagnosed.evidence
    off = off_in(evidence, laid, [diagnosed.listed])[:, 0]
    ambient = float(evidence.theta[c.AMBIENT])
    vacuum = evidence.bins.mean(ambient - evidence.samples["pressure"])[laid.bins] / MBAR
    phase_name = diagnosed.answer["unlisted"]["where"]
    kinds = [kind for kind, name in enumerate(KINDS) if name.startswith(phase_name)]
    with empty("left", 3.4, alt) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, x, over in zip(panels, (laid.ms[laid.place], vacuum), OVER, strict=True):
            for kind, colour in zip(kinds, (MEASURED, BEFORE), strict=False):
                chosen = laid.kind[laid.place] == kind
                label = tr("left in {phase}", phase=spoken(KINDS[kind]))
                axes.plot(x[chosen], off[chosen], ".", color=colour, ms=3, label=label)
            axes.axhline(0.0, color=QUIET, lw=0.8)
            shown_terms = [term for term in diagnosed.terms if KINDS.index(term.where) in kinds]
            _terms(axes, [term for term in shown_terms if term.over == over])
        panels[0].set_xlabel(tr("time since\nthe phase began (ms)"))
        logarithmic(panels[0])
        panels[0].set_ylabel(tr(DEVIATION))
        panels[1].set_xlabel(tr("vacuum\n(mbar below ambient)"))
        legend(figure, panels)
        return figure


def _terms(axes: Axes, terms: Sequence[Term]) -> None:
    for term in terms:
        x = np.maximum(term.at, EARLIEST_MS) if term.over == "time" else np.array(term.at)
        label = tr("term in {phase}", phase=spoken(term.where))
        axes.plot(x, term.mbar, "o--", color=AFTER, ms=4, lw=1.4, label=label)
