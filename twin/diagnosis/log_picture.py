"""The picture over the whole log: deviation of each cycle, and course of each cause."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from twin.diagnosis.drawing import AFTER, BEFORE, EACH, QUIET, Picture, empty, legend
from twin.diagnosis.evidence import Evidence
from twin.diagnosis.held_out import Judged
from twin.diagnosis.pictures import Found, spread
from twin.diagnosis.text import LONG_S, spoken
from twin.languages.texts import tr
from twin.model.courses import Cause, Course
from twin.model.effects import Parameter, effect_of
from twin.monitor.bins import Floats
from twin.signals import MBAR

LABEL = 14  # letters in a line of a cause's name beside its panel, which is low
MOST_CYCLES = 200  # shown of a long log, evenly spread


def draw_log(diagnosed: Found, alt: str) -> Picture:
    """Draw each cycle's rms deviation before and after, and below it the course of each cause."""
    causes = [(cause, answer) for cause, answer in _sized_causes(diagnosed) if answer["parameters"]]
    heights = [2.0, *[1.0] * len(causes)]
    with empty("log", 1.1 + 1.1 * sum(heights), alt) as figure:
        panels = figure.subplots(len(heights), sharex=True, height_ratios=heights, squeeze=False)
        top, *cause_panels = panels[:, 0]
        _deviations(top, diagnosed)
        for axes, (cause, answer), colour in zip(cause_panels, causes, EACH, strict=False):
            _course(axes, diagnosed.evidence, cause, answer, colour)
            _occurs(top, diagnosed.evidence, answer, colour)
        scale, unit = _scale(diagnosed.evidence)
        top.set_xlim(*_into_log(diagnosed.evidence, diagnosed.evidence.seconds[[0, -1]]) / scale)
        panels[-1, 0].set_xlabel(tr("time in the log ({unit})", unit=unit))
        legend(figure, [top])
        return figure


def cycle_rms(evidence: Evidence, judged: Judged) -> Floats:
    """Rms deviation (mbar) of each cycle; NaN if it cannot be compared."""
    used = np.flatnonzero(evidence.bins.number >= 0)
    cycle = np.searchsorted(evidence.starts, used, "right") - 1
    off = (evidence.samples["pressure"][used] - judged.expected[used]) / MBAR
    count = np.bincount(cycle, minlength=evidence.cycles)
    squares = np.bincount(cycle, off**2, minlength=evidence.cycles)
    blank = np.full(evidence.cycles, np.nan)
    rms: Floats = np.sqrt(np.divide(squares, count, out=blank, where=count > 0))
    return rms


def _deviations(axes: Axes, diagnosed: Found) -> None:
    """Draw each cycle's deviation from both models; fitted cycles are filled, held-out ones not."""
    evidence = diagnosed.evidence
    shown = spread(evidence.judged, MOST_CYCLES)
    scale, _ = _scale(evidence)
    times = _middles(evidence)[shown] / scale
    held = np.isin(shown, diagnosed.held_out)
    models = [(diagnosed.before, BEFORE, 8.0, tr("unchanged twin"))]
    if diagnosed.extended:
        with_causes = tr("with {causes}", causes=diagnosed.name)
        models.append((diagnosed.after, AFTER, 5.0, with_causes))
    for judged, colour, size, label in models:
        rms = cycle_rms(evidence, judged)[shown]
        axes.plot(times, rms, color=colour, lw=0.8, alpha=0.5)
        marks = ((~held, colour, tr("fitted")), (held, "white", tr("held out")))
        for chosen, face, status in marks:
            full_label = f"{label}, {status}"
            axes.plot(
                times[chosen], rms[chosen], "o", color=colour, mfc=face, ms=size, label=full_label
            )
    axes.set_ylabel(tr("rms deviation\nof a cycle (mbar)"))
    axes.set_ylim(0.0, 1.1 * axes.get_ylim()[1])


def _sized_causes(diagnosed: Found) -> list[tuple[Cause, dict[str, Any]]]:
    """The listed causes with their entries in the answer."""
    return list(zip(diagnosed.listed, diagnosed.answer["causes"], strict=True))


def _course(
    axes: Axes, evidence: Evidence, cause: Cause, answer: dict[str, Any], colour: str
) -> None:
    """Draw the size of a cause over the log, with its interval."""
    sizes = [p for p in effect_of(cause.effect).parameters if not p.shapes]
    several = sum(p.name in answer["parameters"] for p in sizes) > 1
    scale, _ = _scale(evidence)
    for p in sizes:
        if p.name not in answer["parameters"]:
            continue  # nothing in this log depends on it
        seconds, (value, low, high) = size_over_log(
            evidence, cause, p, answer["parameters"][p.name]
        )
        label = spoken(p.name) if several else ""
        times = _into_log(evidence, seconds) / scale
        axes.fill_between(times, low, high, color=colour, alpha=0.2, lw=0)
        axes.plot(times, value, color=colour, lw=1.6, label=label)
        axes.axhline(p.neutral(evidence.theta), color=QUIET, lw=0.8, ls=":")
        name = _in_lines(spoken(cause.effect))
        axes.set_ylabel(f"{name}\n({p.unit})")
    if several:
        axes.legend(loc="upper left", fontsize=9)


def size_over_log(
    evidence: Evidence, cause: Cause, parameter: Parameter, answer: dict[str, Any]
) -> tuple[Floats, Floats]:
    """Times (s), and size of a cause then: value and ends of its 95 % interval, (3, times).

    Times count from the first row of the evidence.
    """
    seconds = _moments(evidence, cause)
    starts = evidence.seconds[evidence.starts[:-1]]
    cycle = evidence.numbers[np.maximum(np.searchsorted(starts, seconds, "right") - 1, 0)]
    neutral = parameter.neutral(evidence.theta)
    values = [
        cause.at(evidence.theta, *moment) for moment in zip(seconds, cycle.tolist(), strict=True)
    ]
    change = np.array([sizes.get(parameter.name, neutral) - neutral for sizes in values])
    base = 0.0 if "at_end" in answer else neutral  # a ramp's numbers are rates
    numbers = np.array([answer[key] - base for key in ("value", "low95", "high95")])
    return seconds, neutral + np.outer(numbers / numbers[0], change)


def _moments(evidence: Evidence, cause: Cause) -> Floats:
    """Times (s) at which a course is drawn: evenly spread, and both sides of each change."""
    begin, end = evidence.seconds[[0, -1]]
    edges = np.array([cause.onset_s])
    if cause.course == Course.INTERMITTENT:
        edges = evidence.seconds[evidence.starts[:-1]]
    moments = np.concatenate([np.linspace(begin, end, 100), edges - 1e-6, edges])
    return np.unique(np.clip(moments, begin, end))


def _in_lines(name: str) -> str:
    return textwrap.fill(name, LABEL, break_long_words=False, break_on_hyphens=False)


def _occurs(axes: Axes, evidence: Evidence, answer: dict[str, Any], colour: str) -> None:
    """Mark the onset of a step or ramp with its interval, or the cycles with a cause."""
    scale, _ = _scale(evidence)
    if "cycles" in answer:
        times = _middles(evidence)[np.isin(evidence.numbers, answer["cycles"])] / scale
        label = tr("{cause} is there", cause=spoken(answer["effect"]))
        top = np.ones(len(times))
        transform = axes.get_xaxis_transform()
        axes.plot(times, top, "v", color=colour, transform=transform, clip_on=False, label=label)
    if answer["onset_s"] is None:
        return
    label = tr("{cause} begins", cause=spoken(answer["effect"]))
    axes.axvline(answer["onset_s"] / scale, color=colour, lw=1.2, ls=":", label=label)
    if "onset_low95_s" in answer:
        between = (answer[key] / scale for key in ("onset_low95_s", "onset_high95_s"))
        axes.axvspan(*between, color=colour, alpha=0.2, lw=0)


def _scale(evidence: Evidence) -> tuple[float, str]:
    """Seconds per unit of a time axis over the log, and the unit."""
    end = _into_log(evidence, evidence.seconds[-1:])[0]
    return (60.0, "min") if end > LONG_S else (1.0, "s")


def _into_log(evidence: Evidence, seconds: Floats) -> Floats:
    """Times (s) since the log began, from those since the first row of the evidence."""
    return evidence.before_s + seconds


def _middles(evidence: Evidence) -> Floats:
    """Time of the middle of each cycle (s since the log began)."""
    return _into_log(evidence, evidence.seconds[(evidence.starts[:-1] + evidence.starts[1:]) // 2])
