"""The bench's output: docs/bench.json, and from it docs/bench.md with a picture of its lines."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import ceil
from statistics import median
from typing import Any

from matplotlib.figure import Figure as Picture

from benchmarks.figures import Benchmark, Figure, Line, Measured, kept
from benchmarks.processes import ROOT

DOCS = ROOT / "docs"
DATA = DOCS / "bench.json"
PICTURE = "pictures/growth.svg"
COLUMNS = 3

NEVER = Measured((), note="not measured")

Result = tuple[Figure, Measured]


@dataclass(frozen=True)
class Session:
    """One run of the bench: its circumstances and its figures."""

    circumstances: Sequence[str]
    results: Sequence[Result]


def write(sessions: Sequence[Session], benchmarks: Sequence[Benchmark]) -> None:
    """Write page, picture and JSON from the runs, the newest first."""
    text = json.dumps({"runs": _runs(sessions)}, indent=1, ensure_ascii=False)
    DATA.write_text(text + "\n", encoding="utf-8")
    (DOCS / "bench.md").write_text(page(sessions, benchmarks), encoding="utf-8")
    if lines := _lines(_newest(sessions, benchmarks)):
        _draw(lines)


def read(benchmarks: Sequence[Benchmark]) -> list[Session]:
    """The runs in docs/bench.json, without figures that the bench no longer has."""
    figures = {_key(figure): figure for benchmark in benchmarks for figure in benchmark.figures}
    return [
        Session(
            run["circumstances"],
            [
                (figures[key], _measured(entry))
                for entry in run["figures"]
                if (key := (entry["name"], entry["floor"])) in figures
            ],
        )
        for run in json.loads(DATA.read_text(encoding="utf-8"))["runs"]
    ]


def with_newer(sessions: Sequence[Session], newer: Session) -> list[Session]:
    """A newer run before the others, which keep only figures that it did not measure.

    A run without figures is dropped. A figure that was judged is not replaced by one that cannot be
    judged.
    """
    judged = {
        _key(figure)
        for session in sessions
        for figure, measured in session.results
        if kept(figure, measured) is not None
    }
    newest = [
        (figure, measured)
        for figure, measured in newer.results
        if kept(figure, measured) is not None or _key(figure) not in judged
    ]
    taken = {_key(figure) for figure, _ in newest}
    older = [
        Session(
            session.circumstances,
            [result for result in session.results if _key(result[0]) not in taken],
        )
        for session in sessions
    ]
    return [
        session for session in (Session(newer.circumstances, newest), *older) if session.results
    ]


def page(sessions: Sequence[Session], benchmarks: Sequence[Benchmark]) -> str:
    """The text of docs/bench.md."""
    results = _newest(sessions, benchmarks)
    lines = ["# Benchmarks", "", *_summary(results), ""]
    lines += [
        "`python tools/bench.py` writes this page from docs/bench.json. A floor was measured in"
    ]
    lines += [
        "the same run as the figure beside it, on the same machine: use the ratios. Figures are"
    ]
    lines += ["medians of the repetitions, least to most in brackets.", ""]
    for session in sessions:
        lines += [*_circumstances(session, benchmarks), ""]
    lines += [table(results), ""]
    if _lines(results):
        lines += [f"![Costs against sizes, with straight lines]({PICTURE})", ""]
    lines += ["## How it is measured", ""]
    lines += [*(f"- **{benchmark.name}**: {benchmark.how}" for benchmark in benchmarks), ""]
    return "\n".join(lines)


def _circumstances(session: Session, benchmarks: Sequence[Benchmark]) -> list[str]:
    """The benchmarks of a run, and its circumstances."""
    measured = {_key(figure) for figure, _ in session.results}
    names = [
        benchmark.name
        for benchmark in benchmarks
        if any(_key(figure) in measured for figure in benchmark.figures)
    ]
    return [
        f"Measured in this run: {', '.join(names)}.",
        "",
        *(f"- {note}" for note in session.circumstances),
    ]


def _newest(sessions: Sequence[Session], benchmarks: Sequence[Benchmark]) -> list[Result]:
    """Each figure of the bench with its newest measurement, in the bench's order."""
    newest = {
        _key(figure): measured for session in sessions[::-1] for figure, measured in session.results
    }
    figures = [figure for benchmark in benchmarks for figure in benchmark.figures]
    return [(figure, newest.get(_key(figure), NEVER)) for figure in figures]


def _key(figure: Figure) -> tuple[str, str]:
    """Key of a figure; name and floor, as some names have two floors."""
    return figure.name, figure.floor


def _runs(sessions: Sequence[Session]) -> list[dict[str, Any]]:
    return [
        {
            "circumstances": session.circumstances,
            "figures": [asdict(figure) | asdict(measured) for figure, measured in session.results],
        }
        for session in sessions
    ]


def _measured(entry: Mapping[str, Any]) -> Measured:
    line = entry["line"] and Line(**entry["line"])
    return Measured(entry["values"], entry["floors"], entry["note"], entry["valid"], line)


def _summary(results: Sequence[Result]) -> list[str]:
    """How many limits are kept, which are not and by how much, and which were not judged."""
    verdicts = [
        (figure, measured, kept(figure, measured))
        for figure, measured in results
        if figure.limit is not None
    ]
    good = sum(verdict is True for *_, verdict in verdicts)
    judged = sum(verdict is not None for *_, verdict in verdicts)
    lines = [f"**{good} of the {judged} limits that were judged are kept.**", ""]
    broken = [(figure, measured) for figure, measured, verdict in verdicts if verdict is False]
    lines += [
        f"- Not kept: {figure.name}, {_beyond(figure, measured)}." for figure, measured in broken
    ]
    untold: dict[str, Counter[str]] = {}
    for figure, measured, verdict in verdicts:
        if verdict is None:
            group = figure.name.partition(":")[0]
            untold.setdefault(measured.note or "no floor", Counter())[group] += 1
    for why, counts in untold.items():
        names = (f"{count} of {group}" for group, count in counts.items())
        lines.append(f"- Not judged ({why}): {'; '.join(names)}.")
    return lines


def _beyond(figure: Figure, measured: Measured) -> str:
    """A broken limit in words: the measured value and the limit."""
    if figure.limits_ratio and measured.ratio is not None:
        return f"{measured.ratio:.2f} × {figure.floor}, limit {figure.limit:g} ×"
    return f"{_spread(measured.values, figure.unit)}, limit {figure.limit:g} {figure.unit}".strip()


def table(results: Sequence[Result]) -> str:
    """Figures in Markdown."""
    rows = ["| figure | measured | floor | ratio | limit | kept |", "|" + " --- |" * 6]
    text = "\n".join([*rows, *(_row(figure, measured) for figure, measured in results)])
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
    """Median with unit, and the range of several values; empty without values."""
    if not values:
        return ""
    spread = f" ({_number(min(values))}–{_number(max(values))})" if len(values) > 1 else ""
    return f"{_number(median(values))}{spread} {unit}".strip()


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:,.0f}"


def _lines(results: Sequence[Result]) -> list[Line]:
    return [measured.line for _, measured in results if measured.line is not None]


def growth(lines: Sequence[Line]) -> str:
    """Growth of cost in Markdown: points, straight line, largest distance, and limit."""
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
    for position, line in enumerate(lines):
        axes = picture.add_subplot(rows, COLUMNS, position + 1)
        ends = [0.0, max(line.sizes)]
        axes.plot(ends, [line.rest + line.slope * size for size in ends], color="0.6")
        axes.plot(line.sizes, line.costs, "o", color="C0")
        axes.set(xlabel=line.of, ylabel=line.what, xlim=(0.0, None))
        axes.set_ylim(0.0, 1.1 * max(line.costs))
    picture.savefig(DOCS / PICTURE, metadata={"Date": None})
