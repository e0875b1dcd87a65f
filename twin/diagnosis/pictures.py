"""The report's pictures: SVG text that can stand inside a page and needs nothing from outside."""

import html
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.diagnosis.answer import Diagnosis
from twin.diagnosis.evidence import Evidence, Floats
from twin.model import theta as c
from twin.signals import MBAR, MS, NS, Phase

POINTS = 1000  # of a line; more cannot be seen
MOST_CYCLES = 200  # shown of a long log, evenly spread
LABELLED = 0.06  # of a picture's width: a narrower phase has no room for its name
MEASURED, BEFORE, AFTER, QUIET = "#1a1a1a", "#c8500a", "#0a62a8", "#8a8a8a"
HEALTHY_SIGMAS = 3.0  # to either side of what healthy cycles have in the mean
SHADES = {
    Phase.IDLE: "#ffffff",
    Phase.SUCTION: "#e6f0f8",
    Phase.HOLD: "#f5f5f5",
    Phase.BLOW_OFF: "#fdeee2",
}
STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.fonttype": "none",  # text stays text: small, selectable, in the reader's own font
}
ANONYMOUS = dict.fromkeys(("Creator", "Date", "Format", "Type"))  # the same input, the same bytes


def spoken(name: str) -> str:
    """A name as people say it."""
    return name.replace("blow_off", "blow-off").replace("_", " ")


@dataclass(frozen=True)
class Comparison:
    """A diagnosis with what its twins expect, before and after: all the pictures draw from it."""

    diagnosis: Diagnosis
    before: Floats  # Pa, of each row: the twin as it stands
    after: Floats  # Pa, the twin with the cause; as before where none was found
    off_before: Floats  # mbar, of each bin
    off_after: Floats

    @classmethod
    def of(cls, diagnosis: Diagnosis) -> "Comparison":
        """Run both twins over the log."""
        evidence = diagnosis.evidence
        before = after = evidence.expect([(0, evidence.theta)])
        if diagnosis.cause is not None:
            after = evidence.expect(diagnosis.cause.course(evidence))
        return cls(diagnosis, before, after, evidence.off(before), evidence.off(after))


def worst_cycle(found: Comparison) -> int:
    """The held-out cycle in which the twin as it stands is furthest off."""
    bins = found.diagnosis.evidence.bin_starts
    off = found.off_before
    return max(
        found.diagnosis.held_out, key=lambda i: float(np.mean(off[bins[i] : bins[i + 1]] ** 2))
    )


def worst_phase(found: Comparison) -> Phase:
    """The phase in which the twin as it stands is furthest off on the held-out cycles."""
    off = by_phase(found.diagnosis.evidence, found.off_before)
    size = np.abs(np.nan_to_num(off[found.diagnosis.held_out])).mean(axis=0)
    return Phase(int(size.argmax()))


def draw_cycle(found: Comparison, cycle: int, alt: str) -> str:
    """Draw vacuum measured and expected over one cycle, and the deviation below."""
    evidence = found.diagnosis.evidence
    first, last = evidence.starts[cycle], evidence.starts[cycle + 1]
    rows = np.unique(np.linspace(first, last - 1, POINTS).astype(np.int64))
    times = evidence.samples["time_ns"]
    ms = (times[rows] - times[first]) * (NS / MS)
    measured = np.where(evidence.bins[rows] < 0, np.nan, evidence.samples["pressure"][rows])
    with _figure("cycle", 5.2) as figure:
        above, below = figure.subplots(2, sharex=True, height_ratios=(2, 1))
        _shade(above, below, ms, evidence.ticks["phase"][rows])
        ambient = float(evidence.theta[c.AMBIENT])
        above.plot(ms, (ambient - measured) / MBAR, color=MEASURED, lw=2.2, label="measured")
        for expectation, colour, style, label in _expectations(found):
            expected = expectation[rows]
            above.plot(ms, (ambient - expected) / MBAR, style, color=colour, lw=1.4, label=label)
            off = (measured - expected) / MBAR
            below.plot(ms, off, style, color=colour, lw=1.4, label=label)
        above.set_ylabel("vacuum\n(mbar below ambient)")
        above.legend(loc="lower center", fontsize=9)
        below.set_ylabel("measured − expected\n(mbar absolute)")
        below.axhline(0.0, color=QUIET, lw=0.8)
        below.set_xlabel("time since the suction edge (ms)")
        return _svg(figure, alt)


def draw_phases(found: Comparison, alt: str) -> str:
    """Draw the mean deviation of each phase, cycle by cycle, and what the cause would make it."""
    evidence = found.diagnosis.evidence
    judged = np.array(evidence.judged)
    shown = judged[np.unique(np.linspace(0, len(judged) - 1, MOST_CYCLES).astype(np.int64))]
    off = by_phase(evidence, found.off_before)[shown]
    made = off - by_phase(evidence, found.off_after)[shown]
    seconds = _middles(evidence)[shown]
    fitted = ~np.isin(shown, found.diagnosis.held_out)
    phases = [phase for phase in Phase if np.isfinite(off[:, phase]).any()]
    with _figure("phases", 3.6) as figure:
        panels = figure.subplots(1, len(phases), sharey=True, squeeze=False)[0]
        for axes, phase in zip(panels, phases, strict=True):
            axes.set_title(spoken(phase.name.lower()), fontsize=10)
            axes.set_xlabel("time in the log (s)")
            _healthy(axes, evidence, phase)
            _signature(axes, found.diagnosis, seconds, made[:, phase])
            _dots(axes, seconds, off[:, phase], fitted)
        panels[0].set_ylabel("measured − expected\n(mbar absolute, mean)")
        handles, labels = panels[-1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=5)
        return _svg(figure, alt)


def draw_ranking(found: Comparison, look_alikes: list[str], alt: str) -> str:
    """Draw what each fitted cause leaves on the fitted cycles, beside the twin as it stands."""
    bars = [("no cause: the twin as it stands", _leftover(found), "#ffffff", "")]
    for finding in reversed(found.diagnosis.ranking):
        name = spoken(finding.effect)
        if finding is found.diagnosis.cause:
            bars.append((f"▶ {name}", finding.leftover, AFTER, ""))
        elif finding.effect in look_alikes:
            bars.append((f"≈ {name} (look-alike)", finding.leftover, "#9cc4e4", "///"))
        else:
            bars.append((name, finding.leftover, "#c9c9c9", ""))
    names, leftovers, colours, hatches = zip(*bars, strict=True)
    with _figure("ranking", 0.9 + 0.3 * len(bars)) as figure:
        axes = figure.subplots()
        drawn = axes.barh(
            names, leftovers, height=0.7, color=colours, hatch=hatches, edgecolor="#444444", lw=0.7
        )
        axes.bar_label(drawn, fmt="%.2f", padding=5)
        axes.axvline(1.0, color=MEASURED, lw=1.2, ls="--")
        axes.text(1.0, 1.01, "healthy", transform=axes.get_xaxis_transform(), ha="center")
        axes.set_xlabel("leftover on the fitted cycles (sigma of what healthy cycles scatter)")
        axes.grid(visible=False, axis="y")
        axes.margins(x=0.1)
        return _svg(figure, alt)


def by_phase(evidence: Evidence, off: Floats) -> Floats:
    """Mean of the bins ``off`` for each cycle and Phase; NaN where there is none."""
    rows = np.flatnonzero(evidence.bins >= 0)
    rows = rows[np.unique(evidence.bins[rows], return_index=True)[1]]  # the first of each bin
    cycle = np.searchsorted(evidence.starts, rows, "right") - 1
    label = cycle * len(Phase) + evidence.ticks["phase"][rows]
    size = evidence.cycles * len(Phase)
    count = np.bincount(label, minlength=size)
    total = np.bincount(label, off, minlength=size)
    mean: Floats = np.divide(total, count, out=np.full(size, np.nan), where=count > 0)
    return mean.reshape(evidence.cycles, len(Phase))


def _expectations(found: Comparison) -> list[tuple[Floats, str, str, str]]:
    before = (found.before, BEFORE, "--", "expected: twin as it stands")
    if found.diagnosis.cause is None:
        return [before]
    label = f"expected with {spoken(found.diagnosis.cause.effect)}"
    return [before, (found.after, AFTER, "-", label)]


def _shade(above: Axes, below: Axes, ms: Floats, phase: npt.NDArray[np.uint8]) -> None:
    """Tint the phases, and name those that have room for it."""
    edges = [0, *(np.flatnonzero(np.diff(phase)) + 1), len(phase) - 1]
    for first, last in pairwise(edges):
        name = Phase(phase[first])
        for axes in (above, below):
            axes.axvspan(ms[first], ms[last], color=SHADES[name], lw=0, zorder=0)
        if ms[last] - ms[first] > LABELLED * ms[-1]:
            middle = (ms[first] + ms[last]) / 2.0
            where = above.get_xaxis_transform()
            above.text(middle, 1.02, spoken(name.name.lower()), transform=where, ha="center")
    above.set_xlim(0.0, ms[-1])


def _healthy(axes: Axes, evidence: Evidence, phase: Phase) -> None:
    """Draw the band in which healthy cycles are, where it is known."""
    if known := evidence.healthy.get(f"{phase.name.lower()}_mean"):
        mean, reach = known[0], HEALTHY_SIGMAS * known[1]
        axes.axhspan(mean - reach, mean + reach, color="#d5ead8", lw=0, label="healthy")


def _signature(axes: Axes, diagnosis: Diagnosis, seconds: Floats, made: Floats) -> None:
    """Draw what the cause makes of the deviation, and when it began."""
    if diagnosis.cause is None:
        return
    label = f"signature of {spoken(diagnosis.cause.effect)}"
    axes.step(seconds, made, where="mid", color=AFTER, lw=1.4, label=label)
    if diagnosis.cause.onset is not None:
        began = _seconds(diagnosis.evidence, np.array([diagnosis.cause.onset]))[0]
        axes.axvline(began, color=BEFORE, lw=1.2, ls=":", label="onset")


def _dots(axes: Axes, x: Floats, y: Floats, fitted: npt.NDArray[np.bool_]) -> None:
    for chosen, face, label in ((fitted, MEASURED, "fitted"), (~fitted, "white", "held out")):
        axes.plot(
            x[chosen], y[chosen], "o", ms=6, mec=MEASURED, mfc=face, label=f"deviation, {label}"
        )


def _leftover(found: Comparison) -> float:
    """What the twin as it stands leaves on the fitted cycles, in sigmas."""
    evidence = found.diagnosis.evidence
    fitted = [cycle for cycle in evidence.judged if cycle not in found.diagnosis.held_out]
    waveform = [evidence.whitened(found.off_before, cycle) for cycle in fitted]
    levels = [evidence.levels(evidence.theta, cycle) for cycle in fitted]
    return float(np.sqrt(np.mean(np.concatenate(waveform + levels) ** 2)))


def _seconds(evidence: Evidence, rows: npt.NDArray[np.int64]) -> Floats:
    seconds: Floats = (evidence.samples["time_ns"][rows] - evidence.begin_ns) * NS
    return seconds


def _middles(evidence: Evidence) -> Floats:
    return _seconds(evidence, (evidence.starts[:-1] + evidence.starts[1:]) // 2)


@contextmanager
def _figure(name: str, height: float) -> Iterator[Figure]:
    """Give an empty figure; ``name`` keeps the marks in it apart from those of other pictures."""
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        yield Figure(figsize=(9.6, height), layout="constrained")


def _svg(figure: Figure, alt: str) -> str:
    """The figure as an svg element with a text alternative."""
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata=ANONYMOUS)
    svg = text.getvalue()
    svg = re.sub(r'<g id="[^"]*"', "<g", svg[svg.index("<svg") :])  # unique in one picture only
    return svg.replace("<svg", f'<svg role="img" aria-label="{html.escape(alt)}"', 1)
