"""The picture over the whole log: how far off each cycle is, and how each cause runs in time."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from twin.diagnosis.drawing import AFTER, BEFORE, EACH, QUIET, as_svg, empty, legend
from twin.diagnosis.evidence import Evidence
from twin.diagnosis.held_out import Judged
from twin.diagnosis.pictures import Found, spread
from twin.diagnosis.text import LONG_S, spoken
from twin.model.courses import Cause, Course
from twin.model.effects import Parameter, effect_of
from twin.monitor.bins import Floats
from twin.signals import MBAR

MOST_CYCLES = 200  # shown of a long log, evenly spread


def draw_log(found: Found, alt: str) -> str:
    """Draw each cycle's rms deviation before and after, and below it the course of each cause."""
    causes = [(cause, known) for cause, known in _sized_causes(found) if known["parameters"]]
    heights = [2.0, *[1.0] * len(causes)]
    with empty("log", 1.1 + 1.1 * sum(heights)) as figure:
        panels = figure.subplots(len(heights), sharex=True, height_ratios=heights, squeeze=False)
        top, *others = panels[:, 0]
        _deviations(top, found)
        for axes, (cause, known), colour in zip(others, causes, EACH, strict=False):
            _course(axes, found.evidence, cause, known, colour)
            _occurs(top, found.evidence, known, colour)
        scale, unit = _scale(found.evidence)
        top.set_xlim(*_into_log(found.evidence, found.evidence.seconds[[0, -1]]) / scale)
        panels[-1, 0].set_xlabel(f"time in the log ({unit})")
        legend(figure, [top])
        return as_svg(figure, alt)


def cycle_rms(evidence: Evidence, judged: Judged) -> Floats:
    """Rms deviation (mbar) of each cycle; NaN where nothing can be compared."""
    used = np.flatnonzero(evidence.bins.number >= 0)
    cycle = np.searchsorted(evidence.starts, used, "right") - 1
    off = (evidence.samples["pressure"][used] - judged.expected[used]) / MBAR
    count = np.bincount(cycle, minlength=evidence.cycles)
    squares = np.bincount(cycle, off**2, minlength=evidence.cycles)
    empty_ones = np.full(evidence.cycles, np.nan)
    rms: Floats = np.sqrt(np.divide(squares, count, out=empty_ones, where=count > 0))
    return rms


def _deviations(axes: Axes, found: Found) -> None:
    """Each cycle's deviation from both models; what was fitted is filled, the rest is not."""
    evidence = found.evidence
    shown = spread(evidence.judged, MOST_CYCLES)
    scale, _ = _scale(evidence)
    at = _middles(evidence)[shown] / scale
    held = np.isin(shown, found.held_out)
    models = [(found.before, BEFORE, 8.0, "twin as it stands")]
    if found.extended:
        models.append((found.after, AFTER, 5.0, f"with {found.name}"))
    for judged, colour, size, label in models:
        rms = cycle_rms(evidence, judged)[shown]
        axes.plot(at, rms, color=colour, lw=0.8, alpha=0.5)
        for chosen, face, said in ((~held, colour, "fitted"), (held, "white", "held out")):
            label_here = f"{label}, {said}"
            axes.plot(
                at[chosen], rms[chosen], "o", color=colour, mfc=face, ms=size, label=label_here
            )
    axes.set_ylabel("rms deviation\nof a cycle (mbar)")
    axes.set_ylim(0.0, 1.1 * axes.get_ylim()[1])


def _sized_causes(found: Found) -> list[tuple[Cause, dict[str, Any]]]:
    """The listed causes with what the answer says of them."""
    return list(zip(found.listed, found.answer["causes"], strict=True))


def _course(
    axes: Axes, evidence: Evidence, cause: Cause, known: dict[str, Any], colour: str
) -> None:
    """Draw how big a cause is over the log, with the interval of its size."""
    sizes = [p for p in effect_of(cause.effect).parameters if not p.shapes]
    several = sum(p.name in known["parameters"] for p in sizes) > 1
    scale, _ = _scale(evidence)
    for p in sizes:
        if p.name not in known["parameters"]:
            continue  # nothing in this log depends on it
        seconds, (value, low, high) = size_over_log(evidence, cause, p, known["parameters"][p.name])
        label = spoken(p.name) if several else ""
        at = _into_log(evidence, seconds) / scale
        axes.fill_between(at, low, high, color=colour, alpha=0.2, lw=0)
        axes.plot(at, value, color=colour, lw=1.6, label=label)
        axes.axhline(p.neutral(evidence.theta), color=QUIET, lw=0.8, ls=":")
        axes.set_ylabel(f"{spoken(cause.effect)}\n({p.unit})")
    if several:
        axes.legend(loc="upper left", fontsize=9)


def size_over_log(
    evidence: Evidence, cause: Cause, parameter: Parameter, known: dict[str, Any]
) -> tuple[Floats, Floats]:
    """Times (s) and how big a cause is then: value and ends of its 95 % interval, (3, times).

    Times count from the first row here.
    """
    seconds = _moments(evidence, cause)
    starts = evidence.seconds[evidence.starts[:-1]]
    cycle = evidence.numbers[np.maximum(np.searchsorted(starts, seconds, "right") - 1, 0)]
    neutral = parameter.neutral(evidence.theta)
    at = [cause.at(evidence.theta, *one) for one in zip(seconds, cycle.tolist(), strict=True)]
    change = np.array([one.get(parameter.name, neutral) - neutral for one in at])
    base = 0.0 if "at_end" in known else neutral  # a ramp's numbers are rates
    numbers = np.array([known[key] - base for key in ("value", "low95", "high95")])
    return seconds, neutral + np.outer(numbers / numbers[0], change)


def _moments(evidence: Evidence, cause: Cause) -> Floats:
    """Times (s) that draw a course: an even spread, and both sides of where it changes."""
    begin, end = evidence.seconds[[0, -1]]
    edges = np.array([cause.onset_s])
    if cause.course == Course.INTERMITTENT:
        edges = evidence.seconds[evidence.starts[:-1]]
    moments = np.concatenate([np.linspace(begin, end, 100), edges - 1e-6, edges])
    return np.unique(np.clip(moments, begin, end))


def _occurs(axes: Axes, evidence: Evidence, known: dict[str, Any], colour: str) -> None:
    """Mark when a step or ramp began, with its interval; or the cycles where a cause is there."""
    scale, _ = _scale(evidence)
    if "cycles" in known:
        at = _middles(evidence)[np.isin(evidence.numbers, known["cycles"])] / scale
        top, label = np.ones(len(at)), f"{spoken(known['effect'])} is there"
        where = axes.get_xaxis_transform()
        axes.plot(at, top, "v", color=colour, transform=where, clip_on=False, label=label)
    if known["onset_s"] is None:
        return
    label = f"{spoken(known['effect'])} begins"
    axes.axvline(known["onset_s"] / scale, color=colour, lw=1.2, ls=":", label=label)
    if "onset_low95_s" in known:
        between = (known[key] / scale for key in ("onset_low95_s", "onset_high95_s"))
        axes.axvspan(*between, color=colour, alpha=0.2, lw=0)


def _scale(evidence: Evidence) -> tuple[float, str]:
    """Seconds in the unit of a time axis over the log."""
    end = _into_log(evidence, evidence.seconds[-1:])[0]
    return (60.0, "min") if end > LONG_S else (1.0, "s")


def _into_log(evidence: Evidence, seconds: Floats) -> Floats:
    """Times (s) since the log began, of those since the first row here."""
    return evidence.before_s + seconds


def _middles(evidence: Evidence) -> Floats:
    """When the middle of each cycle was (s since the log began)."""
    return _into_log(evidence, evidence.seconds[(evidence.starts[:-1] + evidence.starts[1:]) // 2])
