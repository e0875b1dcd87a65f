"""A fleet's report for people: lines for a terminal, and a page that needs no network."""

import html
from collections.abc import Iterable, Sequence
from pathlib import Path

from matplotlib.ticker import FuncFormatter

from twin.diagnosis.drawing import AFTER, BEFORE, QUIET, as_svg, empty, legend, logarithmic
from twin.diagnosis.page import PAGE, paragraph, picture, section, table
from twin.diagnosis.words import spoken
from twin.files import write_text
from twin.fleet.kinds import Estimate
from twin.fleet.peers import FEWEST_PEERS
from twin.fleet.report import STANDS_OUT, Report, Row

MOST_LISTED = 15  # units, in the terminal
GOOD, BAD = "#2e7d4f", "#b3261e"
HEAD = ("unit", "batch", "stands out by", "most like", "drift", "diagnosis")


def in_words(report: Report) -> str:
    """Worst units first, then types and batches, then what the units say of their type."""
    lines = [headline(report), ""]
    noticed = [row for row in report.rows if row.noticed]
    listed = noticed[:MOST_LISTED]
    lines += _columns([("", *HEAD), *((str(n), *_cells(row)) for n, row in enumerate(listed, 1))])
    if len(noticed) > len(listed):
        lines.append(f"and {len(noticed) - len(listed)} more; --json and --html have all")
    if any(not row.verdict for row in noticed):
        lines += ["", _DIAGNOSE]
    lines += ["", *_columns([("type", "batch", "units", "noticed", "causes"), *_groups(report)])]
    for kind, rows in _kinds(report):
        lines += ["", f"{kind} by its calibrated units", *_columns(rows)]
    return "\n".join(lines)


def headline(report: Report) -> str:
    """The whole in one sentence."""
    noticed = sum(row.noticed for row in report.rows)
    units = f"{len(report.rows)} unit{'s' * (len(report.rows) != 1)}"
    if not noticed:
        return f"{units}, none stands out"
    return f"{units}, {noticed} to look at"


def write_page(report: Report, path: Path) -> None:
    """Write the report as one HTML file; SourceError if it cannot be written."""
    noticed = [row for row in report.rows if row.noticed]
    parts = []
    if noticed:
        rows = [(str(rank), *_cells(row)) for rank, row in enumerate(noticed, 1)]
        parts.append(section("Worst first", table("Units to look at", ("", *HEAD), rows, (0,))))
    parts += _drawn(report)
    head = ("type", "batch", "units", "noticed", "causes")
    parts.append(section("By type and batch", table("", head, _groups(report), (2, 3))))
    for kind, (top, *values) in _kinds(report):
        body = table("", top, values, range(1, 6))
        parts.append(section(f"{kind}, by its calibrated units", body + paragraph(_MEAN)))
    page = PAGE.substitute(
        title="Fleet",
        colour=BAD if noticed else GOOD,
        mark="▲" if noticed else "✓",
        verdict="Fleet",
        headline=html.escape(headline(report)),
        body="\n".join(parts),
        footer=html.escape(
            f"A unit stands out from {STANDS_OUT:g} sigmas of the others of its type on, judged by "
            f"its newest log; of a type with fewer than {FEWEST_PEERS} units the diagnosis counts."
        ),
    )
    write_text(path, page)


_DIAGNOSE = "What stands out says little of the cause: twin fleet diagnose LOGS names it."
_MEAN = (
    "Mean of the units, each counting by how well its log determines the value; the spread is from "
    "unit to unit. Values that too few logs determine are left out."
)


def _cells(row: Row) -> tuple[str, ...]:
    standing, drift = row.standing, row.drifts[0] if row.drifts else None
    beyond = f"{standing.beyond:.1f} sigma" if standing else ""
    what = f"{spoken(standing.effect)} {standing.size:+.3g} {standing.unit}" if standing else ""
    moves = f"{spoken(drift.effect)} {drift.per_day:+.2g} {drift.unit}/day" if drift else ""
    causes = ", ".join(spoken(str(one["effect"])) for one in row.causes) or row.verdict
    name = row.id or Path(row.log).stem
    return name, row.batch, beyond, what, moves, causes or "not yet"


def _groups(report: Report) -> list[tuple[str, ...]]:
    return [
        (
            group["type"],
            group["batch"],
            str(group["units"]),
            str(group["noticed"]),
            ", ".join(f"{spoken(cause)} ({count})" for cause, count in group["causes"].items()),
        )
        for group in report.groups()
    ]


def _kinds(report: Report) -> list[tuple[str, list[tuple[str, ...]]]]:
    head: tuple[str, ...] = ("value", "units", "mean", "± 1 sigma", "spread", "type has", "unit")
    return [(kind, [head, *map(_value, every)]) for kind, every in report.kinds.items() if every]


def _value(one: Estimate) -> tuple[str, ...]:
    has = "" if one.type_has is None else f"{one.type_has:.4g}"
    known = f"{one.mean:.4g}", f"{one.sigma:.2g}", f"{one.spread:.2g}"
    return one.parameter, str(one.units), *known, has, one.unit


def _drawn(report: Report) -> list[str]:
    """How far every unit stands from the others, where any was watched."""
    ranked = [row for row in report.rows if row.standing is not None]
    if not ranked:
        return []
    ranked.sort(key=lambda row: -_beyond(row))
    noticed = sum(_beyond(row) >= STANDS_OUT for row in ranked)
    title = f"{noticed} of {len(ranked)} units stand out from the others of their type"
    with empty("fleet", 3.6) as figure:
        axes = figure.subplots()
        for colour, label, some in (
            (BEFORE, "stands out", ranked[:noticed]),
            (AFTER, "as the others", ranked[noticed:]),
        ):
            first = 1 if colour == BEFORE else noticed + 1
            place = range(first, first + len(some))
            axes.plot(place, [_beyond(row) for row in some], ".", color=colour, label=label)
        axes.axhline(STANDS_OUT, color=QUIET, lw=0.8, ls="--")
        logarithmic(axes)
        axes.set_yscale("symlog", linthresh=STANDS_OUT)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("rank")
        axes.set_ylabel("furthest from the others\n(sigmas of their scatter)")
        legend(figure, [axes])
        svg = as_svg(figure, title)
    caption = "Each unit by the effect in which it is furthest from the others of its type."
    return [picture(title, svg, caption)]


def _beyond(row: Row) -> float:
    return max(row.standing.beyond, 0.0) if row.standing else 0.0


def _columns(rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines with their cells below each other."""
    every = list(rows)
    wide = [max(len(cell) for cell in column) for column in zip(*every, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, wide, strict=True)).rstrip()
        for row in every
    ]
