"""Data of the report, and its pictures of one cycle and of the ranking."""

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill

import numpy as np

from twin.diagnosis.answer import Diagnosis
from twin.diagnosis.curves import Expected, draw_curves
from twin.diagnosis.drawing import (
    AFTER,
    BEFORE,
    MEASURED,
    PALE,
    Picture,
    empty,
    logarithmic,
)
from twin.diagnosis.evidence import Evidence, Hypothesis
from twin.diagnosis.fit import Fitted
from twin.diagnosis.held_out import Judged
from twin.diagnosis.search import Search
from twin.diagnosis.text import Answer, listed, spoken
from twin.languages.texts import numeral, tr
from twin.model import theta as c
from twin.model.term import Term
from twin.monitor.bins import Ints
from twin.signals import MBAR, MS, NS

POINTS = 1000  # of a line; more do not show
LONGEST = 32  # letters in a line of a name, which leave a phone as much for the axis
MOST_RANKED = 12
WIDE, NARROW = (1.0, 2.0, 3.0, 5.0), (1.0, 1.1, 1.2, 1.3, 1.5, 2.0, 2.5, 3.0, 5.0, 7.0)  # labels


@dataclass(frozen=True)
class Found:
    """A diagnosis with an answer: the data of all pictures.

    Cycles are positions in the evidence; people see their ``numbers`` in the log.
    """

    evidence: Evidence
    search: Search
    causes: Hypothesis  # and the mechanism, if there is one
    terms: Sequence[Term]  # fitted to what no listed effect explains
    before: Judged
    after: Judged
    held_out: Sequence[int]
    answer: Answer

    @classmethod
    def of(cls, diagnosis: Diagnosis) -> "Found":
        """Take a diagnosis whose verdict is not insufficient."""
        search, before, after = diagnosis.search, diagnosis.before, diagnosis.after
        assert search is not None
        assert before is not None
        assert after is not None
        return cls(
            evidence=diagnosis.evidence,
            search=search,
            causes=diagnosis.acting,
            terms=diagnosis.terms,
            before=before,
            after=after,
            held_out=diagnosis.held_out,
            answer=diagnosis.json,
        )

    @property
    def extended(self) -> bool:
        """Whether the extended model differs from the unchanged twin."""
        return bool(self.causes or self.terms)

    @property
    def listed(self) -> Hypothesis:
        """The causes that are in the table of effects."""
        return self.causes[: len(self.answer["causes"])]

    @property
    def name(self) -> str:
        """Short text of what the extended model adds."""
        names = [spoken(cause.effect) for cause in self.listed]
        if len(names) > 1:
            names = [tr("all causes")]
        names += [tr("the mechanism")] * (len(self.causes) - len(self.listed))
        return listed([*names, *[tr("a term from data")] * bool(self.terms)])

    def numbers(self, cycles: Sequence[int] | Ints) -> list[int]:
        """Numbers of cycles in the log."""
        return [int(self.evidence.numbers[cycle]) for cycle in cycles]


def spread(cycles: Sequence[int], most: int) -> Ints:
    """At most ``most`` of the cycles, evenly spread."""
    return np.array(cycles)[np.unique(np.linspace(0, len(cycles) - 1, most).astype(np.int64))]


def worst_cycle(diagnosed: Found) -> int:
    """The held-out cycle with the largest deviation of the unchanged twin."""
    return diagnosed.held_out[int(np.argmax(diagnosed.before.squares))]


def draw_cycle(diagnosed: Found, cycle: int, alt: str) -> Picture:
    """Draw measured and expected vacuum over one cycle, and the deviation below."""
    evidence = diagnosed.evidence
    first, last = evidence.starts[cycle], evidence.starts[cycle + 1]
    rows = np.unique(np.linspace(first, last - 1, POINTS).astype(np.int64))
    times = evidence.samples["time_ns"]
    ms = (times[rows] - times[first]) * (NS / MS)
    comparable = evidence.bins.number[rows] >= 0
    measured = np.where(comparable, evidence.samples["pressure"][rows], np.nan)
    ambient = float(evidence.theta[c.AMBIENT])
    models = [
        Expected((ambient - judged.expected[rows]) / MBAR, label, colour, style)
        for judged, label, colour, style in _models(diagnosed)
    ]
    with empty("cycle", 5.2, alt) as figure:
        phase = evidence.ticks["phase"][rows]
        below = draw_curves(figure, ms, (ambient - measured) / MBAR, models, phase)
        below.set_xlabel(tr("time since the suction edge (ms)"))
        return figure


def _models(diagnosed: Found) -> list[tuple[Judged, str, str, str]]:
    before = (diagnosed.before, tr("expected: unchanged twin"), BEFORE, "--")
    if not diagnosed.extended:
        return [before]
    with_causes = tr("expected with {causes}", causes=diagnosed.name)
    return [before, (diagnosed.after, with_causes, AFTER, "-")]


def draw_ranking(diagnosed: Found, alt: str) -> Picture:
    """Draw the residual of each fitted hypothesis on the fitted cycles, the best on top."""
    rows = _ranked(diagnosed)
    names, leftovers, colours = zip(*reversed(rows), strict=True)
    names = tuple(fill(name, LONGEST) for name in names)
    lines = 1 + max(name.count("\n") for name in names)
    with empty("ranking", 1.2 + (0.13 + 0.14 * lines) * len(rows), alt) as figure:
        axes = figure.subplots()
        positions = np.arange(len(rows))
        axes.hlines(positions, 1.0, leftovers, color=PALE, lw=1.0)
        axes.scatter(leftovers, positions, c=colours, s=60, edgecolors="#444444", zorder=3)
        for x, y in zip(leftovers, positions, strict=True):
            axes.annotate(
                numeral(x, ".2f"), (x, y), (8, 0), textcoords="offset points", va="center"
            )
        axes.set_yticks(positions, names)
        logarithmic(axes, WIDE if max(leftovers) > 3.0 * min(1.0, *leftovers) else NARROW)
        axes.axvline(1.0, color=MEASURED, lw=1.2, ls="--")
        axes.text(1.0, 1.01, tr("healthy"), transform=axes.get_xaxis_transform(), ha="center")
        text = tr("leftover on the fitted cycles\n(sigma of what healthy cycles scatter)")
        figure.supxlabel(text, fontsize=10)
        axes.margins(x=0.1)
        axes.set_ylim(-0.6, len(rows) - 0.3)
        return figure


def _ranked(diagnosed: Found) -> list[tuple[str, float, str]]:
    """Name, leftover and colour of what was found, its rivals, other causes, and no cause."""
    best, search = diagnosed.search.found, diagnosed.search
    rivals = [fitted for fits in search.rivals for fitted in fits]
    shown = {_key(fitted) for fitted in rivals}
    rows = [] if best is None else [(f"▶ {_named(best)}", best.leftover, AFTER)]
    rows += [
        (tr("≈ {cause} (look-alike)", cause=_named(fitted)), fitted.leftover, "#9cc4e4")
        for fitted in rivals
    ]
    shown |= {_key(best)} if best else set()
    rest = [fitted for fitted in search.ranking if _key(fitted) not in shown]
    rows += [(_named(fitted), fitted.leftover, PALE) for fitted in rest[:MOST_RANKED]]
    count = search.ranking[0].count
    none = float(np.sqrt(search.healthy / count))
    return [*rows, (tr("no cause: the unchanged twin"), none, "#ffffff")]


def _key(fitted: Fitted) -> tuple[str, ...]:
    return tuple(sorted(fitted.effects))


def _named(fitted: Fitted) -> str:
    return " + ".join(spoken(effect) for effect in fitted.effects)
