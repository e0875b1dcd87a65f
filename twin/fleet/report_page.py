"""A fleet's report for people: lines for a terminal, and a page that needs no network."""

import html
from collections.abc import Iterable, Sequence
from pathlib import Path

from matplotlib.ticker import FuncFormatter

from twin.diagnosis.drawing import AFTER, BEFORE, QUIET, empty, legend, logarithmic
from twin.diagnosis.page import PAGE, english_card, paragraph, picture, section, table
from twin.diagnosis.retelling import retold
from twin.diagnosis.text import spoken
from twin.files import write_text
from twin.fleet.peers import FEWEST_PEERS, Drift
from twin.fleet.report import STANDS_OUT, Report, Row, State
from twin.fleet.type_statistics import Estimate
from twin.instants import dated
from twin.languages.texts import ENGLISH, Language, language_code, ntr, numeral, speaking, tr

MOST_LISTED = 15  # units, in the terminal
GOOD, BAD, UNKNOWN = "#2e7d4f", "#b3261e", "#555555"


def in_words(report: Report) -> str:
    """The worst units first, then unjudged units, types and batches, and the types' values."""
    lines = [headline(report)]
    outliers = [
        (str(rank), *_cells(row)) for rank, row in enumerate(report.of(State.STANDS_OUT), 1)
    ]
    lines += _listed("", _head(), outliers)
    if any(not row.verdict for row in report.of(State.STANDS_OUT)):
        lines += ["", _DIAGNOSE_ADVICE]
    lines += _listed("could not be judged", _not_judged_head(), _reasons(report))
    if advice := _advice(report):
        lines += ["", advice]
    lines += _listed("log cut off", _cut_head(), _cut(report))
    lines += _listed("could not be used", ("log", "why"), _refused(report))
    lines += ["", *_columns([_groups_head(), *_groups(report)])]
    for kind, rows in _kinds(report):
        lines += ["", f"{kind} by its calibrated units", *_columns(rows)]
    return "\n".join(lines)


def headline(report: Report) -> str:
    """The whole report in one sentence with all counts."""
    outliers, normal, unknown = (len(report.of(state)) for state in State)
    phrases = [
        ntr("{count} stands out", "{count} stand out", outliers)
        if outliers
        else tr("none stands out")
    ]
    if normal and (outliers or unknown):
        phrases.append(ntr("{count} does not", "{count} do not", normal))
    if unknown:
        phrases.append(tr("{count} could not be judged", count=unknown))
    logs = []
    if cut := len(report.cut()):
        logs.append(
            ntr(
                "{count} log cut off: judged by what is there",
                "{count} logs cut off: judged by what is there",
                cut,
            )
        )
    if unusable := len(report.refused):
        logs.append(
            ntr("{count} log could not be used", "{count} logs could not be used", unusable)
        )
    units = ntr("{count} unit", "{count} units", len(report.rows))
    return f"{units}: {'; '.join([', '.join(phrases), *logs])}"


def write_page(report: Report, path: Path, language: Language = ENGLISH) -> None:
    """Write the report as one HTML file; SourceError if it cannot be written."""
    with speaking(language):
        write_text(path, _page(report))


def _page(report: Report) -> str:
    outliers = report.of(State.STANDS_OUT)
    parts = []
    if outliers:
        rows = [(str(rank), *_cells(row)) for rank, row in enumerate(outliers, 1)]
        units = table(tr("Units to look at"), _head(), rows, (0,))
        parts.append(section(tr("Worst first"), units))
    if unjudged := _reasons(report):
        advice = paragraph(_advice(report)) if _advice(report) else ""
        body = table("", _not_judged_head(), unjudged) + advice
        parts.append(section(tr("Could not be judged"), body))
    if cut_off := _cut(report):
        parts.append(section(tr("Log cut off"), table("", _cut_head(), cut_off)))
    if unusable := _refused(report):
        cards = "\n".join(english_card(log, reason) for log, reason in unusable)
        parts.append(section(tr("Logs that could not be used"), cards))
    parts += _distance_picture(report)
    groups = table("", _groups_head(), _groups(report), range(2, 7))
    parts.append(section(tr("By type and batch"), groups))
    for kind, (top, *values) in _kinds(report):
        body = table("", top, values, range(1, 6)) + paragraph(_mean_caption())
        parts.append(section(tr("{type}, by its calibrated units", type=kind), body))
    colour, mark = (
        (BAD, "▲")
        if outliers
        else (UNKNOWN, "?")
        if unjudged or cut_off or unusable
        else (GOOD, "✓")
    )
    return PAGE.substitute(
        language=language_code(),
        title=html.escape(tr("Fleet")),
        colour=colour,
        mark=mark,
        verdict=html.escape(tr("Fleet")),
        headline=html.escape(headline(report)),
        body="\n".join(parts),
        footer=html.escape(
            tr(
                "A unit stands out from {sigmas} sigmas of the others of its type on, judged by its"
                " newest log; of a type with fewer than {count} units the diagnosis counts.",
                sigmas=numeral(STANDS_OUT, "g"),
                count=FEWEST_PEERS,
            )
        ),
    )


_DIAGNOSE_ADVICE = "What stands out says little of the cause: twin fleet diagnose LOGS names it."


def _mean_caption() -> str:
    return tr(
        "Mean of the units, each counting by how well its log determines the value; the spread is"
        " from unit to unit. Values that too few logs determine are left out."
    )


def _head() -> tuple[str, ...]:
    """The columns of the units to look at; the first is the rank."""
    columns = (tr("ejector"), tr("batch"), tr("stands out by"), tr("most like"))
    return "", *columns, tr("drift"), tr("diagnosis")


def _not_judged_head() -> tuple[str, ...]:
    return tr("ejector"), tr("batch"), tr("why")


def _cut_head() -> tuple[str, ...]:
    return tr("ejector"), tr("batch"), tr("log"), tr("judged by what is there")


def _groups_head() -> tuple[str, ...]:
    counts = (tr("units"), tr("stand out"), tr("do not"), tr("not judged"), tr("log cut off"))
    return tr("type"), tr("batch"), *counts, tr("causes")


def _state_in_words(state: State) -> str:
    words = {
        State.STANDS_OUT: tr("stands out"),
        State.DOES_NOT: tr("does not stand out"),
        State.NOT_JUDGED: tr("could not be judged"),
    }
    return words[state]


def _name(row: Row) -> str:
    return row.id or Path(row.log).stem


def _reasons(report: Report) -> list[tuple[str, ...]]:
    """The units that could not be judged, each with the reason."""
    return [(_name(row), row.batch, retold(row.reason)) for row in report.of(State.NOT_JUDGED)]


def _advice(report: Report) -> str:
    """How to judge units that have too few peers; empty if there are none."""
    uncompared = (row.standing and not row.compared for row in report.of(State.NOT_JUDGED))
    if not any(uncompared):
        return ""
    return tr(
        "Fewer than {count} units of a type cannot be compared. Their diagnoses judge them: run"
        " twin fleet diagnose LOGS, then this report again.",
        count=FEWEST_PEERS,
    )


def _cut(report: Report) -> list[tuple[str, ...]]:
    """The units whose newest log was cut off, with their judgement."""
    rows = report.cut()
    return [(_name(row), row.batch, Path(row.log).name, _state_in_words(row.state)) for row in rows]


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
    remark = [f"and {omitted} more; --json and --report have all"] if omitted > 0 else []
    return ["", *([title] if title else []), *_columns([header, *rows[:MOST_LISTED]]), *remark]


def _cells(row: Row) -> tuple[str, ...]:
    standing, drift = row.compared, row.drifts[0] if row.drifts else None
    beyond = _sigmas(standing.beyond) if standing else ""
    most_like = spoken(standing.effect) if standing else ""
    if standing and standing.size is not None:
        most_like += f" {numeral(standing.size, '+.3g')} {standing.unit}"
    movement = _moves(drift) if drift else ""
    causes = ", ".join(spoken(str(cause["effect"])) for cause in row.causes) or spoken(row.verdict)
    return _name(row), row.batch, beyond, most_like, movement, causes or tr("not yet")


def _sigmas(beyond: float) -> str:
    return tr("{value} sigma", value=numeral(beyond, ".1f"))


def _moves(drift: Drift) -> str:
    if drift.step is not None and drift.step_ns is not None:
        size = f"{numeral(drift.step, '+.2g')} {drift.unit}"
        time = dated(drift.step_ns)
        return tr(
            "{effect} stepped {size} by {time}", effect=spoken(drift.effect), size=size, time=time
        )
    return ntr(
        "{effect} {rate}/day over {count} day",
        "{effect} {rate}/day over {count} days",
        round(drift.days),
        effect=spoken(drift.effect),
        rate=f"{numeral(drift.per_day or 0.0, '+.2g')} {drift.unit}",
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
    numbers = (tr("units"), tr("mean"), tr("± 1 sigma"), tr("spread"), tr("type has"))
    header = (tr("key"), *numbers, tr("unit"))
    return [
        (kind, [header, *map(_value, estimates)])
        for kind, estimates in report.kinds.items()
        if estimates
    ]


def _value(estimate: Estimate) -> tuple[str, ...]:
    type_value = "" if estimate.type_has is None else numeral(estimate.type_has, ".4g")
    numbers = [numeral(estimate.mean, ".4g")]
    numbers += [numeral(value, ".2g") for value in (estimate.sigma, estimate.spread)]
    return estimate.parameter, str(estimate.units), *numbers, type_value, estimate.unit


def _distance_picture(report: Report) -> list[str]:
    """The picture of the units' distances from their peers; empty if none has enough peers."""
    compared = [(row, standing.beyond) for row in report.rows if (standing := row.compared)]
    if not compared:
        return []
    compared.sort(key=lambda pair: -pair[1])
    name, sigmas = _name(compared[0][0]), _sigmas(compared[0][1])
    title = tr("Furthest from the others: {unit}, by {sigmas}", unit=name, sigmas=sigmas)
    with empty("fleet", 3.6, title) as figure:
        axes = figure.subplots()
        for colour, label, is_outlier in (
            (BEFORE, tr("stands out"), True),
            (AFTER, tr("does not stand out"), False),
        ):
            ranks = [n for n, (row, _) in enumerate(compared) if row.stands_out is is_outlier]
            beyond = [max(compared[n][1], 0.0) for n in ranks]
            axes.plot([n + 1 for n in ranks], beyond, ".", color=colour, label=label)
        axes.axhline(STANDS_OUT, color=QUIET, lw=0.8, ls="--")
        logarithmic(axes)
        axes.set_yscale("symlog", linthresh=STANDS_OUT)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: numeral(y, "g")))
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel(tr("rank"))
        axes.set_ylabel(tr("furthest from the others\n(sigmas of their scatter)"))
        legend(figure, [axes])
    caption = tr(
        "Each unit by the effect in which it is furthest from the others of its type. The dashed"
        " line is at {sigmas} sigma; a unit below it may stand out by its drift.",
        sigmas=numeral(STANDS_OUT, "g"),
    )
    return [picture(title, figure, caption)]


def _columns(rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines with aligned cells."""
    lines = list(rows)
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in lines
    ]
