"""What the bench writes: docs/bench.md with the pictures of its lines, docs/bench.json."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from math import ceil
from statistics import median

from matplotlib.figure import Figure as Picture

from benchmarks.figures import Benchmark, Figure, Line, Measured, kept
from benchmarks.processes import ROOT

DOCS = ROOT / "docs"
PICTURE = "pictures/growth.svg"
COLUMNS = 3

Result = tuple[Figure, Measured]


def write(results: Sequence[Result], notes: Sequence[str], benchmarks: Sequence[Benchmark]) -> None:
    """Write page, picture and JSON."""
    page = ["# Benchmarks", "", *_summary(results), ""]
    page += ["Written by `make bench` (tools/bench.py). Every figure stands"]
    page += ["beside its floor, measured in the same run on the same machine: use the ratios."]
    page += ["Median of the repetitions, least to most in brackets.", "", table(results, notes), ""]
    if lines := _lines(results):
        page += [f"![Costs against sizes, with straight lines]({PICTURE})", ""]
        _draw(lines)
    page += ["## How it is measured", ""]
    page += [*(f"- **{one.name}**: {one.how}" for one in benchmarks), ""]
    (DOCS / "bench.md").write_text("\n".join(page), encoding="utf-8")
    figures = [asdict(figure) | asdict(measured) for figure, measured in results]
    written = {"circumstances": notes, "figures": figures}
    text = json.dumps(written, indent=1, ensure_ascii=False)
    (DOCS / "bench.json").write_text(text + "\n", encoding="utf-8")


def _summary(results: Sequence[Result]) -> list[str]:
    """How many limits are kept; which are not, and by how much; which could not be judged."""
    verdicts = [
        (figure, one, kept(figure, one)) for figure, one in results if figure.limit is not None
    ]
    good = sum(verdict is True for *_, verdict in verdicts)
    judged = sum(verdict is not None for *_, verdict in verdicts)
    lines = [f"**{good} of the {judged} limits that were judged are kept.**", ""]
    broken = [(figure, one) for figure, one, verdict in verdicts if verdict is False]
    lines += [f"- Not kept: {figure.name}, {_beyond(figure, one)}." for figure, one in broken]
    untold: dict[str, Counter[str]] = {}
    for figure, one, verdict in verdicts:
        if verdict is None:
            of = figure.name.partition(":")[0]
            untold.setdefault(one.note or "no floor", Counter())[of] += 1
    for why, counts in untold.items():
        names = (f"{count} of {of}" for of, count in counts.items())
        lines.append(f"- Not judged ({why}): {'; '.join(names)}.")
    return lines


def _beyond(figure: Figure, measured: Measured) -> str:
    """A figure and its limit."""
    if figure.limits_ratio and measured.ratio is not None:
        return f"{measured.ratio:.2f} × {figure.floor}, limit {figure.limit:g} ×"
    return f"{_spread(measured.values, figure.unit)}, limit {figure.limit:g} {figure.unit}".strip()


def table(results: Sequence[Result], notes: Sequence[str]) -> str:
    """Circumstances and figures in Markdown."""
    rows = ["| figure | measured | floor | ratio | limit | kept |", "|" + " --- |" * 6]
    rows += [_row(figure, measured) for figure, measured in results]
    text = "\n".join([*(f"- {note}" for note in notes), "", *rows])
    lines = _lines(results)
    return f"{text}\n\n{growth(lines)}" if lines else text


def _row(figure: Figure, measured: Measured) -> str:
    floor = f"{_spread(measured.floors, figure.unit)}: {figure.floor}" if measured.floors else ""
    ratio = "" if measured.ratio is None else f"{measured.ratio:.2f}"
    limit = "" if figure.limit is None else f"{figure.limit:g} {figure.unit}".strip()
    if figure.limits_ratio:
        limit = f"ratio {figure.limit:g}"
    verdict = {None: "", True: "yes", False: "**no**"}[kept(figure, measured)]
    value = " ".join(filter(None, (_spread(measured.values, figure.unit), measured.note)))
    return f"| {figure.name} | {value} | {floor} | {ratio} | {limit} | {verdict} |"


def _spread(values: Sequence[float], unit: str) -> str:
    """Median, and from least to most where there are several; nothing of none."""
    if not values:
        return ""
    spread = f" ({_number(min(values))}–{_number(max(values))})" if len(values) > 1 else ""
    return f"{_number(median(values))}{spread} {unit}".strip()


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:,.0f}"


def _lines(results: Sequence[Result]) -> list[Line]:
    return [measured.line for _, measured in results if measured.line is not None]


def growth(lines: Sequence[Line]) -> str:
    """How cost grows, a line each: by what, how straight, and where it ends."""
    rows = ["## How cost grows", "", "| cost | measured | straight line | furthest off | ends at |"]
    rows += ["|" + " --- |" * 5]
    for line in lines:
        pairs = zip(line.sizes, line.costs, strict=True)
        points = ", ".join(f"{_number(size)}: {_number(cost)}" for size, cost in pairs)
        end = "" if line.limit is None else f"{_number(line.limit)} {line.of} ({line.spent})"
        formula = f"{_number(line.rest)} + {_number(line.slope)} × {line.of}"
        rows += [f"| {line.what} | {points} | {formula} | {_number(line.off)} % | {end} |"]
    return "\n".join(rows)


def _draw(lines: Sequence[Line]) -> None:
    rows = ceil(len(lines) / COLUMNS)
    picture = Picture(figsize=(3.2 * COLUMNS, 2.6 * rows), layout="constrained")
    for place, line in enumerate(lines):
        axes = picture.add_subplot(rows, COLUMNS, place + 1)
        ends = [0.0, max(line.sizes)]
        axes.plot(ends, [line.rest + line.slope * size for size in ends], color="0.6")
        axes.plot(line.sizes, line.costs, "o", color="C0")
        axes.set(xlabel=line.of, ylabel=line.what, xlim=(0.0, None))
        axes.set_ylim(0.0, 1.1 * max(line.costs))
    picture.savefig(DOCS / PICTURE, metadata={"Date": None})
