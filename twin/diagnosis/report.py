"""The answer for people: a few lines for the terminal, and a page that can be kept and printed.

The page is one file that needs no network: pictures are inlined as SVG, the style stands in it.
"""

import html
from collections.abc import Iterable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from string import Template
from typing import Any

from twin.diagnosis.answer import Diagnosis
from twin.diagnosis.pictures import (
    Comparison,
    draw_cycle,
    draw_phases,
    draw_ranking,
    spoken,
    worst_cycle,
    worst_phase,
)
from twin.errors import SourceError
from twin.model import theta as c
from twin.model.effects import EFFECTS
from twin.model.theta import Theta
from twin.signals import BAR, MBAR, ML, SL_MIN, Phase

MOST_LISTED = 12  # cycles named one by one

# Key in the answer, what it is, unit.
FIGURES = (
    ("rms_mbar", "rms deviation", "mbar"),
    ("max_mbar", "largest deviation", "mbar"),
    ("evacuation_time_error_pct", "evacuation time error", "%"),
    ("leftover_sigma", "leftover (healthy: 1)", "sigma"),
)

# Colour, mark and words of each verdict's banner.
BANNER = {
    "consistent": ("#1b6e2e", "✔", "Nothing wrong"),
    "explained": ("#a31515", "✖", "Cause found"),
    "unlisted": ("#a31515", "?", "Something unknown"),
    "insufficient": ("#555555", "…", "No answer from this log"),
}

PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
:root { color-scheme: light; }
body { font: 16px/1.45 system-ui, "Segoe UI", Roboto, "DejaVu Sans", Arial, sans-serif;
  color: #1a1a1a; background: #fff; max-width: 60rem; margin: 1.5rem auto; padding: 0 1rem; }
.banner { background: $colour; color: #fff; border-radius: .4rem; padding: .8rem 1.2rem;
  print-color-adjust: exact; -webkit-print-color-adjust: exact; }
.banner p { margin: 0; font-weight: 600; letter-spacing: .03em; }
.banner h1 { margin: .2rem 0 0; font-size: 1.35rem; line-height: 1.3; }
h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
figure { margin: 0; }
svg { width: 100%; height: auto; }
figcaption, footer { color: #444; font-size: .88rem; }
table { border-collapse: collapse; margin: .3rem 0 1.4rem; min-width: 50%; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
th, td { text-align: left; padding: .25rem 1.6rem .25rem 0; border-bottom: 1px solid #ddd;
  vertical-align: top; overflow-wrap: anywhere; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1.6rem; }
dt { color: #444; }
dd { margin: 0; overflow-wrap: anywhere; }
thead th { border-bottom: 2px solid #888; font-weight: 600; }
tbody th { font-weight: 400; white-space: nowrap; }
.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
section, figure, table { break-inside: avoid; }
h2 { break-after: avoid; }
@media print { body { margin: 0; max-width: none; font-size: 11pt; } }
</style>
</head>
<body>
<header class="banner">
<p><span aria-hidden="true">$mark</span> $verdict</p>
<h1>$headline</h1>
</header>
<main>
$body
</main>
<footer>
$footer
</footer>
</body>
</html>
""")


def in_words(diagnosis: Diagnosis) -> str:
    """The answer in a few lines of plain text."""
    answer = diagnosis.json
    lines = [f"{answer['verdict']}: {_headline(answer)}"]
    lines += [f"  {label:<14} {text}" for label, text in _facts(answer)]
    return "\n".join(lines)


def write_report(diagnosis: Diagnosis, path: Path) -> None:
    """Write the answer with pictures as one HTML file; SourceError if it cannot be written."""
    page = _page(diagnosis)
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        hint = "check that the directory is there and may be written to"
        raise SourceError(f"{path}: cannot be written: {error.strerror}", hint) from error


# --- what is said ---------------------------------------------------------------------------------


def _headline(answer: dict[str, Any]) -> str:
    """One sentence for the technician."""
    match answer["verdict"]:
        case "consistent":
            left = _number(answer["baseline"]["rms_mbar"])
            return f"The ejector does what its twin expects; {left} mbar rms left over are healthy."
        case "explained":
            return " ".join(cause["why"] for cause in answer["causes"])
        case "unlisted":
            unlisted = answer["unlisted"]
            where = spoken(unlisted["where"])
            return f"No listed cause explains what is left in {where}: {unlisted['shape']}."
    return f"The log cannot answer: {answer['next_experiment']}."


def _facts(answer: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Labelled lines for the terminal."""
    for cause in answer["causes"]:
        yield ("cause" if answer["verdict"] == "explained" else "closest cause"), _cause(cause)
        if answer["verdict"] == "explained":
            yield "how sure", _sure(cause)
    yield from _to_do(answer)
    if answer["verdict"] == "insufficient":
        return
    changes = (f"{_change(answer, key)} {unit}" for key, _, unit in FIGURES)
    names = ("rms", "max", "evacuation time error", "leftover")
    said = (f"{name} {change}" for name, change in zip(names, changes, strict=True))
    yield "unseen cycles", ", ".join(said)
    if answer["causes"]:
        yield "gain", _gain(answer["gain"])
    cycles = answer["cycles"]
    fitted, held_out = _some(cycles["fitted"]), _some(cycles["held_out"])
    yield "cycles", f"{cycles['total']}; fitted: {fitted}; held out: {held_out}"


def _to_do(answer: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """What to look at and to record next."""
    sure = answer["verdict"] == "explained"
    for cause in answer["causes"]:
        yield ("look at" if sure else "perhaps"), EFFECTS[cause["effect"]].look_at
        for name in cause["not_separable_from"]:
            yield "or it may be", f"{spoken(name)}; then look at {EFFECTS[name].look_at}"
    if answer["verdict"] == "unlisted":
        where = spoken(answer["unlisted"]["where"])
        yield "find out", f"what in {where} differs from when the twin was calibrated"
    if answer["verdict"] == "insufficient":
        yield "next", "put this right, record again and diagnose the new log"
    elif answer["next_experiment"]:
        yield "next recording", answer["next_experiment"]


def _cause(cause: dict[str, Any]) -> str:
    sizes = [
        f"{spoken(name)} {_number(p['value'])} {p['unit']}"
        f" (95 %: {_number(p['low95'])} to {_number(p['high95'])})"
        for name, p in cause["parameters"].items()
    ]
    return f"{spoken(cause['effect'])}, {', '.join([*sizes, _since(cause)])}"


def _since(cause: dict[str, Any]) -> str:
    if cause["onset_s"] is None:
        return "there from the beginning"
    return f"since {cause['onset_s']:.1f} s into the log"


def _sure(cause: dict[str, Any]) -> str:
    percent = 100.0 * cause["probability"]
    sure = "more than 99 %" if percent > 99.0 else f"{percent:.0f} %"
    alike = ", ".join(spoken(name) for name in cause["not_separable_from"])
    return f"{sure}; " + (f"this log cannot tell it from {alike}" if alike else "no look-alikes")


def _change(answer: dict[str, Any], key: str) -> str:
    before, after = (_number(answer[part][key]) for part in ("baseline", "extended"))
    return f"{before} → {after}" if answer["causes"] else before


def _gain(gain: dict[str, float]) -> str:
    low, high = _number(gain["low95"]), _number(gain["high95"])
    return f"{_number(gain['rms_reduction_pct'])} % less rms deviation (95 %: {low} to {high})"


def _some(cycles: Sequence[int]) -> str:
    if len(cycles) <= MOST_LISTED:
        return ", ".join(map(str, cycles))
    return f"{', '.join(map(str, cycles[:3]))} … {cycles[-1]} ({len(cycles)} cycles)"


def _number(value: float) -> str:
    """Three significant digits, without an exponent."""
    return f"{float(f'{value:.3g}'):g}"


# --- the page -------------------------------------------------------------------------------------


def _page(diagnosis: Diagnosis) -> str:
    answer = diagnosis.json
    colour, mark, verdict = BANNER[answer["verdict"]]
    asset = f"{answer['asset']['type']} {answer['asset']['id']}"
    parts = [_section("What to do", _steps(answer))]
    if answer["verdict"] != "insufficient":
        parts += [*_pictures(diagnosis), _section("Numbers", "\n".join(_tables(answer)))]
    return PAGE.substitute(
        title=html.escape(f"Diagnosis of {asset}"),
        colour=colour,
        mark=mark,
        verdict=html.escape(f"{verdict} – {asset}"),
        headline=html.escape(_headline(answer)),
        body="\n".join(parts),
        footer=_footer(diagnosis),
    )


def _steps(answer: dict[str, Any]) -> str:
    steps = [f"{label.capitalize()}: {text}." for label, text in _to_do(answer)]
    items = "".join(
        f"<li>{html.escape(step)}</li>" for step in steps or ["Nothing: no cause is worth naming."]
    )
    return f"<ul>{items}</ul>"


def _pictures(diagnosis: Diagnosis) -> Iterator[str]:
    answer = diagnosis.json
    found = Comparison.of(diagnosis)
    cycle = worst_cycle(found)
    title = _verdict_in_numbers(answer)
    alt = f"{title}. Vacuum in cycle {cycle}, measured and expected, and the deviation, over time."
    caption = (
        f"Cycle {cycle} of {answer['cycles']['total']} (counted from 0): of those held out from the"
        " fit, the one furthest off. The rms is over all held-out cycles. A deviation above zero is"
        " too little vacuum."
    )
    yield _figure(title, draw_cycle(found, cycle, alt), caption)
    title = _where(answer, worst_phase(found))
    alt = f"{title}. Mean deviation of every cycle in each phase, over the time in the log."
    caption = (
        "A point is one cycle's mean deviation from the twin as it stands; a line, what the cause"
        " would make it; the band, where healthy cycles are. Cycles in which the model still swings"
        " in are left out."
    )
    yield _figure(title, draw_phases(found, alt), caption)
    title = _ranked(answer)
    look_alikes = [name for cause in answer["causes"] for name in cause["not_separable_from"]]
    alt = f"{title}. Bars: sigmas left by each cause that was fitted, best first."
    caption = "Each cause was fitted alone, with its own size; the shorter the bar, the better."
    yield _figure(title, draw_ranking(found, look_alikes, alt), caption)


def _verdict_in_numbers(answer: dict[str, Any]) -> str:
    rms = f"{_change(answer, 'rms_mbar')} mbar rms"
    if not answer["causes"]:
        fits = answer["verdict"] == "consistent"
        return f"The twin as it stands {'fits' if fits else 'does not fit'}: {rms}"
    said = " and ".join(_sized(cause) for cause in answer["causes"])
    does = "explains" if answer["verdict"] == "explained" else "explains only part of"
    return f"{said} {does} the deviation: {rms}"


def _sized(cause: dict[str, Any]) -> str:
    sizes = [f"{_number(p['value'])} {p['unit']}" for p in cause["parameters"].values()]
    return f"{spoken(cause['effect']).capitalize()} ({', '.join(sizes)})"


def _where(answer: dict[str, Any], phase: Phase) -> str:
    if answer["verdict"] == "consistent":
        return "Every phase is as in healthy cycles"
    onsets = [_since(cause) for cause in answer["causes"] if cause["onset_s"] is not None]
    return ", ".join([f"The deviation is largest in {spoken(phase.name.lower())}", *onsets])


def _ranked(answer: dict[str, Any]) -> str:
    if not answer["causes"]:
        return "No single cause is worth naming"
    best = answer["causes"][0]
    name = spoken(best["effect"])
    if best["not_separable_from"]:
        alike = ", ".join(map(spoken, best["not_separable_from"]))
        return f"This log cannot tell {name} from {alike}"
    yet = "" if answer["verdict"] == "explained" else ", but more than healthy cycles have"
    return f"{name.capitalize()} leaves least of all causes{yet}"


def _tables(answer: dict[str, Any]) -> Iterator[str]:
    if answer["causes"]:
        yield _cause_table(answer)
    yield _gain_table(answer)
    if answer["runners_up"]:
        rows = [
            (spoken(r["effect"]), EFFECTS[r["effect"]].sentence, _number(r["leftover_sigma"]))
            for r in answer["runners_up"]
        ]
        yield _table("Runners-up", ("effect", "meaning", "leftover (sigma)"), rows, numbers=(2,))
    yield _pairs(_cycles(answer["cycles"]))


def _cause_table(answer: dict[str, Any]) -> str:
    explained = answer["verdict"] == "explained"
    caption = "; ".join(map(_sure, answer["causes"])) if explained else "explains only a part"
    head = ("cause", "since", "parameter", "value", "95 % from", "to", "unit")
    return _table(f"Cause: {caption}", head, _parameters(answer["causes"]), numbers=(3, 4, 5))


def _gain_table(answer: dict[str, Any]) -> str:
    """The figures on the held-out cycles, with and without the cause if there is one."""
    columns, caption = {"baseline": "twin as it stands"}, "Held-out cycles"
    if answer["causes"]:
        columns["extended"] = "with the cause"
        caption = f"Held-out cycles: {_gain(answer['gain'])}"
    rows = [
        (name, *(_number(answer[column][key]) for column in columns), unit)
        for key, name, unit in FIGURES
    ]
    return _table(caption, ("", *columns.values(), "unit"), rows, range(1, 1 + len(columns)))


def _parameters(causes: list[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    for cause in causes:
        for name, p in cause["parameters"].items():
            numbers = (_number(p[key]) for key in ("value", "low95", "high95"))
            yield spoken(cause["effect"]), _since(cause), spoken(name), *numbers, p["unit"]


def _cycles(cycles: dict[str, Any]) -> list[tuple[str, str]]:
    return [
        ("cycles complete in the log", str(cycles["total"])),
        ("fitted on", _some(cycles["fitted"])),
        ("held out, to judge by", _some(cycles["held_out"])),
    ]


def _footer(diagnosis: Diagnosis) -> str:
    answer = diagnosis.json
    rows = [
        ("asset", f"{answer['asset']['type']} {answer['asset']['id']}"),
        ("log", answer["log"]),
        ("data set", f"{diagnosis.data_set}: {_data_set(diagnosis.evidence.theta)}"),
        ("program", f"ejector-twin {version('ejector-twin')}"),
    ]
    return _pairs(rows)


def _data_set(theta: Theta) -> str:
    """What the twin was calibrated to, as far as one can compare it with a nameplate."""
    volume = theta[[c.PORT_VOLUME, c.LINE_VOLUME, c.VOLUME]].sum()
    numbers = (
        ("suction capacity", theta[c.SUCTION] / SL_MIN, "sl/min"),
        ("volume", volume / ML, "ml"),
        ("supply", theta[c.SUPPLY] / BAR, "bar"),
        ("ambient", theta[c.AMBIENT] / MBAR, "mbar"),
        ("H1", theta[c.H1] / MBAR, "mbar"),
    )
    return ", ".join(f"{name} {value:.4g} {unit}" for name, value, unit in numbers)


def _section(title: str, body: str) -> str:
    return f"<section><h2>{html.escape(title)}</h2>\n{body}\n</section>"


def _figure(title: str, svg: str, caption: str) -> str:
    caption = f"<figcaption>{html.escape(caption)}</figcaption>"
    return _section(title, f"<figure>{svg}{caption}</figure>")


def _pairs(rows: Iterable[tuple[str, str]]) -> str:
    said = (f"<dt>{html.escape(what)}</dt><dd>{html.escape(which)}</dd>" for what, which in rows)
    return f"<dl>{''.join(said)}</dl>"


def _table(
    caption: str,
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    numbers: Iterable[int] = (),
) -> str:
    """Return a table; the columns ``numbers`` are set to the right."""
    style = ['class="number"' if i in set(numbers) else "" for i in range(len(head))]
    top = "".join(
        f'<th scope="col" {s}>{html.escape(h)}</th>' for h, s in zip(head, style, strict=True)
    )
    body = "".join(f"<tr>{_row(row, style)}</tr>\n" for row in rows)
    return (
        f"<table><caption>{html.escape(caption)}</caption>\n"
        f"<thead><tr>{top}</tr></thead>\n<tbody>{body}</tbody></table>"
    )


def _row(cells: Sequence[str], style: Sequence[str]) -> str:
    first, *rest = map(html.escape, cells)
    others = "".join(f"<td {s}>{one}</td>" for one, s in zip(rest, style[1:], strict=True))
    return f'<th scope="row">{first}</th>{others}'
