"""A fleet's report for people: lines for a terminal, and a page that needs no network."""

import html
from collections.abc import Iterable, Sequence
from pathlib import Path

from matplotlib.ticker import FuncFormatter

from twin.diagnosis.drawing import AFTER, BEFORE, QUIET, as_svg, empty, legend, logarithmic
from twin.diagnosis.page import PAGE, card, paragraph, picture, section, table
from twin.diagnosis.text import spoken
from twin.files import write_text
from twin.fleet.peers import FEWEST_PEERS, Drift
from twin.fleet.report import STANDS_OUT, Report, Row, State
from twin.fleet.type_statistics import Estimate
from twin.instants import dated
from twin.language import ENGLISH

MOST_LISTED = 15  # units, in the terminal
GOOD, BAD, UNKNOWN = "#2e7d4f", "#b3261e", "#555555"
HEAD = ("unit", "batch", "stands out by", "most like", "drift", "diagnosis")
NOT_JUDGED = ("unit", "batch", "why")
REFUSED = ("log", "why")
CUT = ("unit", "batch", "log", "judged by what is there")
GROUPS = ("type", "batch", "units", "stand out", "do not", "not judged", "log cut off", "causes")
STATE_WORDS = {
    State.STANDS_OUT: "stands out",
    State.DOES_NOT: "does not stand out",
    State.NOT_JUDGED: "could not be judged",
}


def in_words(report: Report) -> str:
    """The worst units first, then unjudged units, types and batches, and the types' values."""
    lines = [headline(report)]
    outliers = [
        (str(rank), *_cells(row)) for rank, row in enumerate(report.of(State.STANDS_OUT), 1)
    ]
    lines += _listed("", ("", *HEAD), outliers)
    if any(not row.verdict for row in report.of(State.STANDS_OUT)):
        lines += ["", _DIAGNOSE_ADVICE]
    lines += _listed("could not be judged", NOT_JUDGED, _reasons(report))
    if advice := _advice(report):
        lines += ["", advice]
    lines += _listed("log cut off", CUT, _cut(report))
    lines += _listed("could not be used", REFUSED, _refused(report))
    lines += ["", *_columns([GROUPS, *_groups(report)])]
    for kind, rows in _kinds(report):
        lines += ["", f"{kind} by its calibrated units", *_columns(rows)]
    return "\n".join(lines)


def headline(report: Report) -> str:
    """The whole report in one sentence with all counts."""
    outliers, normal, unknown = (len(report.of(state)) for state in State)
    phrases = [f"{outliers or 'none'} {'stands' if outliers < 2 else 'stand'} out"]
    phrases += (
        [f"{normal} {'does' if normal == 1 else 'do'} not"]
        if normal and (outliers or unknown)
        else []
    )
    phrases += [f"{unknown} could not be judged"] if unknown else []
    counted = (
        (len(report.cut()), "cut off: judged by what is there"),
        (len(report.refused), "could not be used"),
    )
    logs = [f"{count} {_plural('log', count)} {problem}" for count, problem in counted if count]
    units = f"{len(report.rows)} {_plural('unit', len(report.rows))}"
    return f"{units}: {'; '.join([', '.join(phrases), *logs])}"


def write_page(report: Report, path: Path) -> None:
    """Write the report as one HTML file; SourceError if it cannot be written."""
    outliers = report.of(State.STANDS_OUT)
    parts = []
    if outliers:
        rows = [(str(rank), *_cells(row)) for rank, row in enumerate(outliers, 1)]
        parts.append(section("Worst first", table("Units to look at", ("", *HEAD), rows, (0,))))
    if unjudged := _reasons(report):
        advice = paragraph(_advice(report)) if _advice(report) else ""
        parts.append(section("Could not be judged", table("", NOT_JUDGED, unjudged) + advice))
    if cut_off := _cut(report):
        parts.append(section("Log cut off", table("", CUT, cut_off)))
    if unusable := _refused(report):
        cards = "\n".join(card(log, reason, ()) for log, reason in unusable)
        parts.append(section("Logs that could not be used", cards))
    parts += _distance_picture(report)
    parts.append(section("By type and batch", table("", GROUPS, _groups(report), range(2, 7))))
    for kind, (top, *values) in _kinds(report):
        body = table("", top, values, range(1, 6))
        parts.append(section(f"{kind}, by its calibrated units", body + paragraph(_MEAN_CAPTION)))
    colour, mark = (
        (BAD, "▲")
        if outliers
        else (UNKNOWN, "?")
        if unjudged or cut_off or unusable
        else (GOOD, "✓")
    )
    page = PAGE.substitute(
        language=ENGLISH.code,
        title="Fleet",
        colour=colour,
        mark=mark,
        verdict="Fleet",
        headline=html.escape(headline(report)),
        body="\n".join(parts),
        footer=html.escape(
            f"A unit stands out from {STANDS_OUT:g} sigmas of the others of its type on, judged by "
            f"its newest log; of a type with fewer than {FEWEST_PEERS} units the diagnosis counts."
        ),
    )
    write_text(path, page)


_DIAGNOSE_ADVICE = "What stands out says little of the cause: twin fleet diagnose LOGS names it."
_TOO_FEW = (
    f"Fewer than {FEWEST_PEERS} units of a type cannot be compared. Their diagnoses judge them:"
    " run twin fleet diagnose LOGS, then this report again."
)
_MEAN_CAPTION = (
    "Mean of the units, each counting by how well its log determines the value; the spread is from "
    "unit to unit. Values that too few logs determine are left out."
)


def _plural(noun: str, count: int) -> str:
    return noun if count == 1 else f"{noun}s"


def _name(row: Row) -> str:
    return row.id or Path(row.log).stem


def _reasons(report: Report) -> list[tuple[str, ...]]:
    """The units that could not be judged, each with the reason."""
    return [(_name(row), row.batch, row.reason) for row in report.of(State.NOT_JUDGED)]


def _advice(report: Report) -> str:
    """How to judge units that have too few peers; empty if there are none."""
    uncompared = (row.standing and not row.compared for row in report.of(State.NOT_JUDGED))
    return _TOO_FEW if any(uncompared) else ""


def _cut(report: Report) -> list[tuple[str, ...]]:
    """The units whose newest log was cut off, with their judgement."""
    rows = report.cut()
    return [(_name(row), row.batch, Path(row.log).name, STATE_WORDS[row.state]) for row in rows]


def _refused(report: Report) -> list[tuple[str, str]]:
    """The logs that could not be used, each with the reason."""
    return [
        (refusal.log, refusal.why.removeprefix(f"{refusal.log}: ")) for refusal in report.refused
    ]


def _listed(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A section of the text with the first ``MOST_LISTED`` rows; empty without rows."""
    if not rows:
        return []
    omitted = len(rows) - MOST_LISTED
    remark = [f"and {omitted} more; --json and --html have all"] if omitted > 0 else []
    return ["", *([title] if title else []), *_columns([header, *rows[:MOST_LISTED]]), *remark]


def _cells(row: Row) -> tuple[str, ...]:
    standing, drift = row.compared, row.drifts[0] if row.drifts else None
    beyond = f"{standing.beyond:.1f} sigma" if standing else ""
    most_like = spoken(standing.effect) if standing else ""
    if standing and standing.size is not None:
        most_like += f" {standing.size:+.3g} {standing.unit}"
    movement = _moves(drift) if drift else ""
    causes = ", ".join(spoken(str(cause["effect"])) for cause in row.causes) or row.verdict
    return _name(row), row.batch, beyond, most_like, movement, causes or "not yet"


def _moves(drift: Drift) -> str:
    if drift.step is not None and drift.step_ns is not None:
        size = f"{drift.step:+.2g} {drift.unit}"
        return f"{spoken(drift.effect)} stepped {size} by {dated(drift.step_ns)}"
    return (
        f"{spoken(drift.effect)} {drift.per_day:+.2g} {drift.unit}/day over {drift.days:.0f} days"
    )


def _groups(report: Report) -> list[tuple[str, ...]]:
    return [
        (
            group["type"],
            group["batch"],
            str(group["units"]),
            *(str(group[state]) for state in State),
            str(group["log_cut"]),
            ", ".join(f"{spoken(cause)} ({count})" for cause, count in group["causes"].items()),
        )
        for group in report.groups()
    ]


def _kinds(report: Report) -> list[tuple[str, list[tuple[str, ...]]]]:
    header: tuple[str, ...] = ("value", "units", "mean", "± 1 sigma", "spread", "type has", "unit")
    return [
        (kind, [header, *map(_value, estimates)])
        for kind, estimates in report.kinds.items()
        if estimates
    ]


def _value(estimate: Estimate) -> tuple[str, ...]:
    type_value = "" if estimate.type_has is None else f"{estimate.type_has:.4g}"
    numbers = f"{estimate.mean:.4g}", f"{estimate.sigma:.2g}", f"{estimate.spread:.2g}"
    return estimate.parameter, str(estimate.units), *numbers, type_value, estimate.unit


def _distance_picture(report: Report) -> list[str]:
    """The picture of the units' distances from their peers; empty if none has enough peers."""
    compared = [(row, standing.beyond) for row in report.rows if (standing := row.compared)]
    if not compared:
        return []
    compared.sort(key=lambda pair: -pair[1])
    title = f"Furthest from the others: {_name(compared[0][0])}, by {compared[0][1]:.1f} sigma"
    with empty("fleet", 3.6, title) as figure:
        axes = figure.subplots()
        for colour, label, is_outlier in (
            (BEFORE, "stands out", True),
            (AFTER, "does not", False),
        ):
            ranks = [n for n, (row, _) in enumerate(compared) if row.stands_out is is_outlier]
            beyond = [max(compared[n][1], 0.0) for n in ranks]
            axes.plot([n + 1 for n in ranks], beyond, ".", color=colour, label=label)
        axes.axhline(STANDS_OUT, color=QUIET, lw=0.8, ls="--")
        logarithmic(axes)
        axes.set_yscale("symlog", linthresh=STANDS_OUT)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("rank")
        axes.set_ylabel("furthest from the others\n(sigmas of their scatter)")
        legend(figure, [axes])
        svg = as_svg(figure)
    caption = (
        "Each unit by the effect in which it is furthest from the others of its type. The dashed"
        f" line is at {STANDS_OUT:g} sigma; a unit below it may stand out by its drift."
    )
    return [picture(title, svg, caption)]


def _columns(rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines with aligned cells."""
    lines = list(rows)
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in lines
    ]
