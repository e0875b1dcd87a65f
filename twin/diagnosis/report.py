"""The answer as text for the terminal, and as a page that can be stored and printed."""

import html
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from twin.diagnosis import page
from twin.diagnosis.answer import Diagnosis
from twin.diagnosis.drawing import Picture, as_svg
from twin.diagnosis.log_picture import draw_log
from twin.diagnosis.phase_pictures import (
    Laid,
    acting,
    draw_left,
    draw_phases,
    laid_over,
    unseen,
    worst_kind,
)
from twin.diagnosis.pictures import (
    Found,
    draw_cycle,
    draw_ranking,
    worst_cycle,
)
from twin.diagnosis.text import (
    FIGURES,
    Answer,
    Times,
    about,
    change,
    ends,
    extended,
    gain_interval,
    headline,
    held_out_cycles,
    left_over,
    lines,
    listed,
    mechanism_of,
    number,
    signals,
    sized,
    some,
    spoken,
    to_do,
    when,
)
from twin.errors import ConfigError, known_names
from twin.files import write_text
from twin.instants import dated
from twin.model import theta as c
from twin.model.courses import Course
from twin.model.effects import effect_of
from twin.model.theta import Theta
from twin.signals import BAR, MBAR, ML, SL_MIN

Clock = Callable[[], int]  # UTC, ns

RECORD = ("next", "next recording")  # steps that get a box each
# Colour, mark and text of each verdict's banner.
BANNER = {
    "consistent": ("#1b6e2e", "✔", "Nothing wrong"),
    "explained": ("#a31515", "✖", "Cause found"),
    "unlisted": ("#a31515", "?", "Something unknown"),
    "insufficient": ("#555555", "…", "No answer from this log"),
}


def in_words(diagnosis: Diagnosis, clock: Clock = time.time_ns) -> str:
    """The answer in a few lines of plain text."""
    return lines(diagnosis.json, clock())


def write_report(diagnosis: Diagnosis, path: Path) -> None:
    """Write the answer with pictures as one HTML file; SourceError if it cannot be written."""
    write_text(path, _page(diagnosis))


def summary(diagnosis: Diagnosis) -> str:
    """The answer as a part of a page: headline, what to do, the gain, and a small picture."""
    answer, now_ns = diagnosis.json, _received_ns(diagnosis)
    colour, mark, verdict = BANNER[answer["verdict"]]
    times, is_sure = Times.of(answer, now_ns), answer["verdict"] == "explained"
    parts = [page.pairs(about(cause, times, sure=is_sure)) for cause in answer["causes"]]
    parts.append(page.pairs(to_do(answer)))
    if answer["verdict"] == "insufficient":
        return page.summary(f"{mark} {headline(answer, now_ns)}", parts, colour=colour)
    parts.append(_gain_table(answer))
    return page.summary(
        f"{mark} {verdict}: {headline(answer, now_ns)}",
        parts,
        draw(diagnosis, "cycle").picture,
        colour,
    )


def _received_ns(diagnosis: Diagnosis) -> int:
    """When the log's last row was received: ages count from it, not from when they are read."""
    received = diagnosis.evidence.samples["host_ns"]
    return int(received[-1]) if len(received) else 0


def _page(diagnosis: Diagnosis) -> str:
    answer, now_ns = diagnosis.json, _received_ns(diagnosis)
    colour, mark, verdict = BANNER[answer["verdict"]]
    asset = f"{answer['asset']['type']} {answer['asset']['id']}"
    times = Times.of(answer, now_ns)
    parts = [page.section("What to do", "\n".join(_steps(answer, times)))]
    if answer["verdict"] == "insufficient":
        parts.append(page.section("The log", page.pairs(_cycles(answer))))
    else:
        diagnosed = Found.of(diagnosis)
        shown = [PICTURES[name](diagnosed, times) for name in _of_verdict(answer)]
        parts += [page.picture(s.title, as_svg(s.picture), s.caption) for s in shown]
        parts.append(page.section("Numbers", "\n".join(_tables(answer, times))))
    return page.PAGE.substitute(
        title=html.escape(f"Diagnosis of {asset}"),
        colour=colour,
        mark=mark,
        verdict=html.escape(f"{verdict} – {asset}"),
        headline=html.escape(headline(answer, now_ns)),
        body="\n".join(parts),
        footer=_footer(diagnosis, times),
    )


def _steps(answer: Answer, times: Times) -> Iterator[str]:
    """A card for each cause and for something unlisted, boxes for signals and recordings."""
    sure = answer["verdict"] == "explained"
    for cause in answer["causes"]:
        title = spoken(cause["effect"]).capitalize()
        rows = [row for row in about(cause, times, sure=sure) if row[1] != spoken(cause["effect"])]
        yield page.card(title, f"{effect_of(cause['effect']).sentence}.", rows)
    steps = [step for step in to_do(answer) if step[0] not in RECORD]
    if answer["verdict"] == "unlisted":
        title, text = "Something that no listed cause explains", f"Left in {left_over(answer)}."
        if mechanism := mechanism_of(answer):
            title, text = "What suits best, though nobody listed it", f"{mechanism['sentence']}."
            steps = [step for step in steps if step[0] != "mechanism"]
        yield page.card(title, text, steps)
    for contradiction in signals(answer):
        yield page.box(
            f"The signal {contradiction['signal']}",
            f"{contradiction['what']}: {contradiction['do']}.",
        )
    for title, text in to_do(answer):
        if title in RECORD:
            yield page.box(title.capitalize(), f"{text[:1].upper()}{text[1:]}.")
    if answer["verdict"] == "consistent":
        yield page.paragraph("Nothing: no cause is worth naming.")


# --- pictures -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shown:
    """A picture with the conclusion to draw from it, and what else there is to know."""

    title: str
    picture: Picture
    caption: str


def draw(diagnosis: Diagnosis, name: str) -> Shown:
    """Draw one of the report's ``PICTURES``.

    ConfigError if there is none of that name, or none of this answer.
    """
    if name not in PICTURES:
        raise ConfigError(f"no picture is called {name!r}", known_names(name, PICTURES))
    pictures = _of_verdict(diagnosis.json)
    if name not in pictures:
        verdict = diagnosis.json["verdict"]
        raise ConfigError(
            f"an answer whose verdict is {verdict} has no picture {name!r}",
            f"it has {listed(pictures)}" if pictures else str(diagnosis.json["next_experiment"]),
        )
    times = Times.of(diagnosis.json, _received_ns(diagnosis))
    return PICTURES[name](Found.of(diagnosis), times)


def _of_verdict(answer: Answer) -> list[str]:
    """Names of the pictures that an answer has."""
    if answer["verdict"] == "insufficient":
        return []
    left = ["left"] if answer["unlisted"] else []
    ranking = ["ranking"] if answer["verdict"] != "consistent" else []
    return ["cycle", "log", "phases", *left, *ranking]


def _cycle_picture(diagnosed: Found, _times: Times) -> Shown:
    answer, worst = diagnosed.answer, worst_cycle(diagnosed)
    (cycle,) = diagnosed.numbers([worst])
    title = _verdict_in_numbers(answer)
    alt = f"{title}. Vacuum in cycle {cycle}, measured and expected, and the deviation, over time."
    caption = (
        f"Cycle {cycle} of {answer['cycles']['total']} (counted from 0): of those held out from the"
        " fit, the one furthest off. The rms is over all held-out cycles. A deviation above zero is"
        " too little vacuum."
    )
    return Shown(title, draw_cycle(diagnosed, worst, alt), caption)


def _log_picture(diagnosed: Found, times: Times) -> Shown:
    answer = diagnosed.answer
    parts = [f"{spoken(cause['effect'])} {when(cause, times)}" for cause in answer["causes"]]
    title = f"Over time: {'; '.join(parts) or 'no cause comes or goes'}"
    alt = f"{title}. Rms deviation of each cycle, before and after, and the size of each cause."
    caption = (
        "A filled mark is a cycle that was fitted, an empty one was held out to judge by. Cycles in"
        " which the model still swings in are left out."
    )
    if answer["causes"]:
        caption += " Below: the size of each cause with its 95 % interval; dotted: as it should be."
    return Shown(title, draw_log(diagnosed, alt), caption)


def _phases_picture(diagnosed: Found, _times: Times) -> Shown:
    laid = laid_over(diagnosed.evidence, acting(diagnosed))
    title = _where(diagnosed, laid)
    alt = f"{title}. Mean deviation over the time since each phase began."
    caption = (
        f"Mean over the cycles {some(diagnosed.numbers(laid.cycles))}: {_which(diagnosed, laid)}. A"
        " deviation above zero is too little vacuum. The band is where 95 % of such means of"
        " healthy cycles lie."
    )
    return Shown(title, draw_phases(diagnosed, laid, alt), caption)


def _left_picture(diagnosed: Found, _times: Times) -> Shown:
    laid = laid_over(diagnosed.evidence, unseen(diagnosed))
    title = f"What no listed cause explains: {left_over(diagnosed.answer)}"
    alt = f"{title}. Mean deviation left over time since the phase began and over vacuum."
    caption = (
        f"The held-out cycles {some(diagnosed.numbers(laid.cycles))} laid over each other. On what"
        " it depends, over that the dots form one curve. A deviation above zero is too little"
        " vacuum."
    )
    if diagnosed.terms:
        caption += " Dashed: the term that takes it away in the extended model."
    return Shown(title, draw_left(diagnosed, laid, alt), caption)


def _ranking_picture(diagnosed: Found, _times: Times) -> Shown:
    title = _ranked(diagnosed.answer)
    alt = f"{title}. Sigmas left by each cause that was fitted, best first."
    caption = (
        "Each cause was fitted with its own size and course. The nearer to the dashed line, the"
        " better it explains the log; a look-alike is one that this log cannot reject."
    )
    return Shown(title, draw_ranking(diagnosed, alt), caption)


PICTURES: Mapping[str, Callable[[Found, Times], Shown]] = {
    "cycle": _cycle_picture,
    "log": _log_picture,
    "phases": _phases_picture,
    "left": _left_picture,
    "ranking": _ranking_picture,
}


def _verdict_in_numbers(answer: Answer) -> str:
    rms = f"{change(answer, 'rms_mbar')} mbar rms"
    if not answer["causes"]:
        fits = answer["verdict"] == "consistent"
        by = "the mechanism" if mechanism_of(answer) else "a term from data"
        term = f" with {by}" if extended(answer) else ""
        return f"The twin as it stands {'fits' if fits else 'does not fit'}: {rms}{term}"
    causes = listed([sized(cause) for cause in answer["causes"]])
    is_single = len(answer["causes"]) == 1
    does = "explains" if is_single else "explain"
    if answer["verdict"] != "explained":
        does += " only a part of"
    return f"{causes[:1].upper()}{causes[1:]} {does} the deviation: {rms}"


def _which(diagnosed: Found, laid: Laid) -> str:
    which = (
        "held out from the fit"
        if set(laid.cycles.tolist()) <= set(diagnosed.held_out)
        else "fitted"
    )
    return f"{which}, with the cause at work" if diagnosed.causes else which


def _where(diagnosed: Found, laid: Laid) -> str:
    if diagnosed.answer["verdict"] == "consistent":
        return "Every phase is as in healthy cycles"
    kind, before, after = worst_kind(diagnosed, laid)
    rms = f"{number(before)} → {number(after)}" if diagnosed.extended else number(before)
    return f"The deviation is largest in {spoken(kind)}: {rms} mbar rms in the mean"


def _ranked(answer: Answer) -> str:
    if not answer["causes"]:
        return "No listed cause is worth naming"
    for cause in answer["causes"]:
        if cause["not_separable_from"]:
            rivals = listed([spoken(name) for name in cause["not_separable_from"]], "or")
            return f"This log cannot tell {spoken(cause['effect'])} from {rivals}"
    name = listed([spoken(cause["effect"]) for cause in answer["causes"]])
    leave = "leaves" if len(answer["causes"]) == 1 else "leave"
    yet = "" if answer["verdict"] == "explained" else ", but more than healthy cycles have"
    return f"{name.capitalize()} {leave} least{yet}"


# --- tables ---------------------------------------------------------------------------------------


def _tables(answer: Answer, times: Times) -> Iterator[str]:
    if answer["causes"]:
        head = ("cause", "course", "parameter", "value", "95 % from", "to", "unit")
        yield page.table("Causes", head, _parameters(answer, times), numbers=(3, 4, 5))
    yield _gain_table(answer)
    if answer["runners_up"]:
        columns = ("effect", "course", "leftover (sigma)")
        yield page.table("Runners-up, each alone", columns, _runners_up(answer), numbers=(2,))
    yield page.pairs(_cycles(answer))


def _runners_up(answer: Answer) -> Iterator[tuple[str, ...]]:
    for runner_up in answer["runners_up"]:
        yield spoken(runner_up["effect"]), runner_up["course"], number(runner_up["leftover_sigma"])


def _parameters(answer: Answer, times: Times) -> Iterator[tuple[str, ...]]:
    for cause in answer["causes"]:
        for name, p in cause["parameters"].items():
            numbers = [number(p["value"]), *ends(p["low95"], p["high95"])]
            course = when(cause, times, interval=True)
            yield spoken(cause["effect"]), course, spoken(name), *numbers, p["unit"]
            if cause["course"] == Course.RAMP:
                numbers = [number(p["at_end"]), "", ""]
                name_at_end = f"{spoken(name)} at the end"
                yield "", "", name_at_end, *numbers, p["unit"].removesuffix("/h")


def _gain_table(answer: Answer) -> str:
    """The figures on held-out cycles, before and, with an extended model, after."""
    columns, caption = {"baseline": "twin as it stands"}, "Held-out cycles"
    if extended(answer):
        columns, caption = {"baseline": "before", "extended": "after"}, "Gain on held-out cycles"
    rows: list[tuple[str, ...]] = [
        (name, *(number(answer[column][key]) for column in columns), unit)
        for key, name, _, unit in FIGURES
    ]
    if extended(answer):
        rows += _gained(answer)
    head = ("", *columns.values(), "unit")
    return page.table(caption, head, rows, range(1, 1 + len(columns)))


def _gained(answer: Answer) -> Iterator[tuple[str, ...]]:
    gain = answer["gain"]
    yield "less rms deviation", "", number(gain["rms_reduction_pct"]), "%"
    interval = gain_interval(gain, len(answer["cycles"]["held_out"]), "held-out cycle")
    yield "how sure", "", interval, "%" if gain["low95"] is not None else ""
    yield "share of what can be gained", "", number(gain["share_of_achievable_pct"]), "%"


def _cycles(answer: Answer) -> list[tuple[str, str]]:
    cycles = answer["cycles"]
    rows = [("cycles complete in the log", str(cycles["total"]))]
    if cycles["fitted"]:
        rows.append(("fitted on", some(cycles["fitted"])))
        rows.append(("held out, to judge by", held_out_cycles(answer)))
    return rows


def _footer(diagnosis: Diagnosis, times: Times) -> str:
    answer = diagnosis.json
    rows = [
        ("asset", f"{answer['asset']['type']} {answer['asset']['id']}"),
        ("log", answer["log"]),
        ("data set", f"{diagnosis.data_set}: {_data_set(diagnosis.evidence.theta)}"),
        ("program", f"ejector-twin {version('ejector-twin')}"),
    ]
    if times.log_begin_ns is not None and times.now_ns is not None:
        between = f"{dated(times.log_begin_ns)} to {dated(times.now_ns)}"
        rows.insert(2, ("recorded", f"{between}; ages count back from its end"))
    return page.pairs(rows)


def _data_set(theta: Theta) -> str:
    """Calibrated values that a nameplate or a setting shows."""
    volume = theta[[c.PORT_VOLUME, c.LINE_VOLUME, c.VOLUME]].sum()
    numbers = (
        ("suction capacity", theta[c.SUCTION] / SL_MIN, "sl/min"),
        ("volume", volume / ML, "ml"),
        ("supply", theta[c.SUPPLY] / BAR, "bar"),
        ("ambient", theta[c.AMBIENT] / MBAR, "mbar"),
        ("H1", theta[c.H1] / MBAR, "mbar"),
    )
    return ", ".join(f"{name} {value:.4g} {unit}" for name, value, unit in numbers)
