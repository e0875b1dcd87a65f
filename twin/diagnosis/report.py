"""The answer as text for the terminal, and as a page that can be stored and printed."""

import html
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from twin.diagnosis import page
from twin.diagnosis.answer import Diagnosis
from twin.diagnosis.drawing import Picture
from twin.diagnosis.log_picture import draw_log
from twin.diagnosis.mechanism_picture import Inferred, draw_mechanism, inferred
from twin.diagnosis.phase_pictures import (
    Laid,
    acting,
    draw_left,
    draw_phases,
    laid_over,
    unseen,
    worst_kind,
)
from twin.diagnosis.pictures import Found, draw_cycle, draw_ranking, worst_cycle
from twin.diagnosis.retelling import retold
from twin.diagnosis.text import (
    FIGURES,
    Answer,
    Times,
    about,
    capital,
    change,
    ends,
    extended,
    gain_interval,
    headline,
    held_out_cycles,
    left_over,
    lines,
    listed,
    mechanism_lines,
    mechanism_of,
    number,
    signals,
    sized,
    some,
    spoken,
    to_do,
    to_find_out,
    to_record,
    weakness_of,
    when,
)
from twin.errors import ConfigError, known_names
from twin.files import write_text
from twin.instants import dated
from twin.languages.texts import ENGLISH, Language, language_code, ntr, numeral, speaking, tr
from twin.model import theta as c
from twin.model.courses import Course
from twin.model.effects import effect_of
from twin.model.theta import Theta
from twin.signals import BAR, MBAR, ML, SL_MIN

Clock = Callable[[], int]  # UTC, ns

HOLDS = 0.75  # share of the dots within 95 % of a law that holds; fewer where the twin is coarse

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


def write_report(diagnosis: Diagnosis, path: Path, language: Language = ENGLISH) -> None:
    """Write the answer with pictures as one HTML file; SourceError if it cannot be written."""
    with speaking(language):
        write_text(path, _page(diagnosis))


def summary(diagnosis: Diagnosis) -> str:
    """The answer as a part of a page: headline, what to do, the gain, and a small picture."""
    answer = diagnosis.json
    colour, mark, verdict = BANNER[answer["verdict"]]
    times, is_sure = Times.of(answer, None), answer["verdict"] == "explained"
    parts = [page.pairs(about(cause, times, sure=is_sure)) for cause in answer["causes"]]
    parts.append(page.pairs(to_do(answer)))
    if weakness := weakness_of(answer):
        parts.append(page.paragraph(f"{capital(weakness)}."))
    if answer["verdict"] == "insufficient":
        return page.summary(f"{mark} {headline(answer, None)}", parts, colour=colour)
    parts.append(_gain_table(answer))
    return page.summary(
        f"{mark} {tr(verdict)}: {headline(answer, None)}",
        parts,
        draw(diagnosis, "cycle").picture,
        colour,
    )


def _received_ns(diagnosis: Diagnosis) -> int:
    """When the log's last row was received (UTC, ns)."""
    received = diagnosis.evidence.samples["host_ns"]
    return int(received[-1]) if len(received) else 0


def _page(diagnosis: Diagnosis) -> str:
    answer = diagnosis.json
    colour, mark, verdict = BANNER[answer["verdict"]]
    asset = f"{answer['asset']['type']} {answer['asset']['id']}"
    times = Times.of(answer, None)
    parts = [page.section(tr("What to do"), "\n".join(_steps(answer, times)))]
    if answer["verdict"] == "insufficient":
        parts.append(page.section(tr("The log"), page.pairs(_cycles(answer))))
    else:
        diagnosed = Found.of(diagnosis)
        shown = [PICTURES[name](diagnosed, times) for name in _names(diagnosis)]
        parts += [page.picture(s.title, s.picture, s.caption) for s in shown]
        parts.append(page.section(tr("Numbers"), "\n".join(_tables(answer, times))))
    return page.PAGE.substitute(
        language=language_code(),
        title=html.escape(tr("Diagnosis of {asset}", asset=asset)),
        colour=colour,
        mark=mark,
        verdict=html.escape(f"{tr(verdict)} – {asset}"),
        headline=html.escape(headline(answer, None)),
        body="\n".join(parts),
        footer=_footer(diagnosis, times),
    )


def _steps(answer: Answer, times: Times) -> Iterator[str]:
    """A card for each cause and for something unlisted, boxes for signals and recordings."""
    sure = answer["verdict"] == "explained"
    for cause in answer["causes"]:
        name = spoken(cause["effect"])
        rows = [row for row in about(cause, times, sure=sure) if row[1] != name]
        yield page.card(capital(name), f"{tr(effect_of(cause['effect']).sentence)}.", rows)
    if answer["verdict"] == "unlisted":
        yield _unlisted_card(answer)
    for contradiction in signals(answer):
        yield page.box(
            tr("The signal {signal}", signal=contradiction["signal"]),
            f"{retold(contradiction['what'])}: {retold(contradiction['do'])}.",
        )
    for title, text in to_record(answer):
        yield page.box(capital(title), f"{capital(text)}.")
    if answer["verdict"] == "consistent":
        yield page.paragraph(tr("Nothing: no cause is worth naming."))
    if weakness := weakness_of(answer):
        yield page.paragraph(f"{capital(weakness)}.")


def _unlisted_card(answer: Answer) -> str:
    """A card for something unlisted: its mechanism, or where it is."""
    if mechanism := mechanism_of(answer):
        title = tr("What suits best, though nobody listed it")
        text = f"{retold(mechanism['sentence'])}."
        rows = [row for row in mechanism_lines(mechanism) if row[0] != tr("mechanism")]
    else:
        title = tr("Something that no listed cause explains")
        text = tr("Left in {where}.", where=left_over(answer))
        rows = []
    return page.card(title, text, [*rows, *to_find_out(answer)])


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
    pictures = _names(diagnosis)
    if name not in pictures:
        verdict = diagnosis.json["verdict"]
        raise ConfigError(
            f"an answer whose verdict is {verdict} has no picture {name!r}",
            f"it has {listed(pictures)}" if pictures else str(diagnosis.json["next_experiment"]),
        )
    times = Times.of(diagnosis.json, None)
    return PICTURES[name](Found.of(diagnosis), times)


def _names(diagnosis: Diagnosis) -> list[str]:
    """Names of the pictures that an answer has."""
    answer = diagnosis.json
    if answer["verdict"] == "insufficient":
        return []
    left = ["left"] if answer["unlisted"] else []
    left += ["mechanism"] if diagnosis.mechanism else []
    ranking = ["ranking"] if answer["verdict"] != "consistent" else []
    return ["cycle", "log", "phases", *left, *ranking]


def _cycle_picture(diagnosed: Found, _times: Times) -> Shown:
    answer, worst = diagnosed.answer, worst_cycle(diagnosed)
    (cycle,) = diagnosed.numbers([worst])
    title = _verdict_in_numbers(answer)
    alt = tr(
        "Vacuum in cycle {cycle}, measured and expected, and the deviation, over time.", cycle=cycle
    )
    caption = tr(
        "Cycle {cycle} of {total} (counted from 0): of those held out from the fit, the one"
        " furthest off. The rms is over all held-out cycles. A deviation above zero is too little"
        " vacuum.",
        cycle=cycle,
        total=answer["cycles"]["total"],
    )
    return Shown(title, draw_cycle(diagnosed, worst, f"{title}. {alt}"), caption)


def _log_picture(diagnosed: Found, times: Times) -> Shown:
    answer = diagnosed.answer
    parts = [f"{spoken(cause['effect'])} {when(cause, times)}" for cause in answer["causes"]]
    course = "; ".join(parts) or tr("no cause comes or goes")
    title = tr("Over time: {course}", course=course)
    alt = tr("Rms deviation of each cycle, before and after, and the size of each cause.")
    caption = tr(
        "A filled mark is a cycle that was fitted, an empty one was held out to judge by. Cycles in"
        " which the model still swings in are left out."
    )
    if answer["causes"]:
        sizes = tr("Below: the size of each cause with its 95 % interval; dotted: as it should be.")
        caption = f"{caption} {sizes}"
    return Shown(title, draw_log(diagnosed, f"{title}. {alt}"), caption)


def _phases_picture(diagnosed: Found, _times: Times) -> Shown:
    laid = laid_over(diagnosed.evidence, acting(diagnosed))
    title = _where(diagnosed, laid)
    alt = tr("Mean deviation over the time since each phase began.")
    caption = tr(
        "Mean over the cycles {cycles}: {which}. A deviation above zero is too little vacuum. The"
        " band is where 95 % of such means of healthy cycles lie.",
        cycles=some(diagnosed.numbers(laid.cycles)),
        which=_which(diagnosed, laid),
    )
    return Shown(title, draw_phases(diagnosed, laid, f"{title}. {alt}"), caption)


def _left_picture(diagnosed: Found, _times: Times) -> Shown:
    laid = laid_over(diagnosed.evidence, unseen(diagnosed))
    title = tr("What no listed cause explains: {where}", where=left_over(diagnosed.answer))
    alt = tr("Mean deviation left over time since the phase began and over vacuum.")
    caption = tr(
        "The held-out cycles {cycles} laid over each other. On what it depends, over that the dots"
        " form one curve. A deviation above zero is too little vacuum.",
        cycles=some(diagnosed.numbers(laid.cycles)),
    )
    if diagnosed.terms:
        term = tr("Dashed: the term that takes it away in the extended model.")
        caption = f"{caption} {term}"
    return Shown(title, draw_left(diagnosed, laid, f"{title}. {alt}"), caption)


def _mechanism_picture(diagnosed: Found, _times: Times) -> Shown:
    found = inferred(diagnosed)
    title = _law_holds(found)
    words = listed([tr(size.word) for size in found.sizes])
    alt = tr("{sizes} over {driver}, by the law and refitted.", sizes=words, driver=found.driver)
    caption = tr(
        "Line: the fitted law. Dots: what the held-out cycles {cycles} show. In each range of"
        " the axis the size may differ from the law, in all of them at once. Where the pressure"
        " hardly shows the size there is no dot.",
        cycles=some(diagnosed.numbers(diagnosed.held_out)),
    )
    if found.levels is not None:
        ways = tr("Upwards it begins at the higher vacuum, downwards it ends at the lower one.")
        caption = f"{caption} {ways}"
    if len(found.sizes) > 1:
        each = tr("Each size is refitted with the other as in the law.")
        caption = f"{caption} {each}"
    return Shown(title, draw_mechanism(found, f"{title}. {alt}"), caption)


def _law_holds(found: Inferred) -> str:
    within, count = found.agreeing
    if not count:
        return tr("Held-out cycles do not show whether the law holds everywhere")
    if within < HOLDS * count:
        return tr(
            "Held-out cycles show another law: only {within} of {count} dots are within 95 %",
            within=within,
            count=count,
        )
    return tr(
        "The law holds on held-out cycles: {within} of {count} dots are within 95 %",
        within=within,
        count=count,
    )


def _ranking_picture(diagnosed: Found, _times: Times) -> Shown:
    title = _ranked(diagnosed.answer)
    alt = tr("Sigmas left by each cause that was fitted, best first.")
    caption = tr(
        "Each cause was fitted with its own size and course. The nearer to the dashed line, the"
        " better it explains the log; a look-alike is one that this log cannot reject."
    )
    return Shown(title, draw_ranking(diagnosed, f"{title}. {alt}"), caption)


PICTURES: Mapping[str, Callable[[Found, Times], Shown]] = {
    "cycle": _cycle_picture,
    "log": _log_picture,
    "phases": _phases_picture,
    "left": _left_picture,
    "mechanism": _mechanism_picture,
    "ranking": _ranking_picture,
}


def _verdict_in_numbers(answer: Answer) -> str:
    rms = tr("{value} mbar rms", value=change(answer, "rms_mbar"))
    if not answer["causes"]:
        if extended(answer):
            term = tr("the mechanism") if mechanism_of(answer) else tr("a term from data")
            rms = tr("{rms} with {term}", rms=rms, term=term)
        if answer["verdict"] == "consistent":
            return tr("The unchanged twin fits: {rms}", rms=rms)
        return tr("The unchanged twin does not fit: {rms}", rms=rms)
    count = len(answer["causes"])
    causes = capital(listed([sized(cause) for cause in answer["causes"]]))
    if answer["verdict"] == "explained":
        return ntr(
            "{causes} explains the deviation: {rms}",
            "{causes} explain the deviation: {rms}",
            count,
            causes=causes,
            rms=rms,
        )
    return ntr(
        "{causes} explains only a part of the deviation: {rms}",
        "{causes} explain only a part of the deviation: {rms}",
        count,
        causes=causes,
        rms=rms,
    )


def _which(diagnosed: Found, laid: Laid) -> str:
    if set(laid.cycles.tolist()) <= set(diagnosed.held_out):
        which = tr("held out from the fit")
    else:
        which = tr("fitted")
    return tr("{cycles}, with the cause at work", cycles=which) if diagnosed.causes else which


def _where(diagnosed: Found, laid: Laid) -> str:
    if diagnosed.answer["verdict"] == "consistent":
        return tr("Every phase is as in healthy cycles")
    kind, before, after = worst_kind(diagnosed, laid)
    rms = f"{number(before)} → {number(after)}" if diagnosed.extended else number(before)
    return tr(
        "The deviation is largest in {phase}: {rms} mbar rms in the mean",
        phase=spoken(kind),
        rms=rms,
    )


def _ranked(answer: Answer) -> str:
    if not answer["causes"]:
        return tr("No listed cause is worth naming")
    for cause in answer["causes"]:
        if cause["not_separable_from"]:
            rivals = listed([spoken(name) for name in cause["not_separable_from"]], tr("or"))
            name = spoken(cause["effect"])
            return tr("This log cannot tell {cause} from {rivals}", cause=name, rivals=rivals)
    causes = capital(listed([spoken(cause["effect"]) for cause in answer["causes"]]))
    count = len(answer["causes"])
    if answer["verdict"] == "explained":
        return ntr("{causes} leaves least", "{causes} leave least", count, causes=causes)
    return ntr(
        "{causes} leaves least, but more than healthy cycles have",
        "{causes} leave least, but more than healthy cycles have",
        count,
        causes=causes,
    )


# --- tables ---------------------------------------------------------------------------------------


def _tables(answer: Answer, times: Times) -> Iterator[str]:
    if answer["causes"]:
        head = [tr("cause"), tr("course"), tr("parameter"), tr("value")]
        head += [tr("95 % from"), tr("to"), tr("unit")]
        yield page.table(tr("Causes"), head, _parameters(answer, times), numbers=(3, 4, 5))
    yield _gain_table(answer)
    if answer["runners_up"]:
        caption = tr("Runners-up, each alone")
        columns = (tr("effect"), tr("course"), tr("leftover (sigma)"))
        yield page.table(caption, columns, _runners_up(answer), numbers=(2,))
    yield page.pairs(_cycles(answer))


def _runners_up(answer: Answer) -> Iterator[tuple[str, ...]]:
    for runner_up in answer["runners_up"]:
        course = spoken(runner_up["course"])
        yield spoken(runner_up["effect"]), course, number(runner_up["leftover_sigma"])


def _parameters(answer: Answer, times: Times) -> Iterator[tuple[str, ...]]:
    for cause in answer["causes"]:
        for name, p in cause["parameters"].items():
            numbers = [number(p["value"]), *ends(p["low95"], p["high95"])]
            course = when(cause, times, interval=True)
            yield spoken(cause["effect"]), course, spoken(name), *numbers, p["unit"]
            if cause["course"] == Course.RAMP:
                numbers = [number(p["at_end"]), "", ""]
                name_at_end = tr("{parameter} at the end", parameter=spoken(name))
                yield "", "", name_at_end, *numbers, p["unit"].removesuffix("/h")


def _gain_table(answer: Answer) -> str:
    """The figures on held-out cycles, before and, with an extended model, after."""
    columns, caption = {"baseline": tr("unchanged twin")}, tr("Held-out cycles")
    if extended(answer):
        columns = {"baseline": tr("before"), "extended": tr("after")}
        caption = tr("Gain on held-out cycles")
    rows: list[tuple[str, ...]] = [
        (tr(name), *(number(answer[column][key]) for column in columns), tr(unit))
        for key, name, _, unit in FIGURES
    ]
    if extended(answer):
        rows += _gained(answer)
    head = ("", *columns.values(), tr("unit"))
    return page.table(caption, head, rows, range(1, 1 + len(columns)))


def _gained(answer: Answer) -> Iterator[tuple[str, ...]]:
    gain = answer["gain"]
    yield tr("less rms deviation"), "", number(gain["rms_reduction_pct"]), "%"
    interval = gain_interval(gain, len(answer["cycles"]["held_out"]))
    yield tr("how sure"), "", interval, "%" if gain["low95"] is not None else ""
    yield tr("share of what can be gained"), "", number(gain["share_of_achievable_pct"]), "%"


def _cycles(answer: Answer) -> list[tuple[str, str]]:
    cycles = answer["cycles"]
    rows = [(tr("cycles complete in the log"), str(cycles["total"]))]
    if cycles["fitted"]:
        rows.append((tr("fitted on"), some(cycles["fitted"])))
        rows.append((tr("held out, to judge by"), held_out_cycles(answer)))
    if "without_part" in cycles:
        rows.append((tr("not judged, as they met no part"), some(cycles["without_part"])))
    return rows


def _footer(diagnosis: Diagnosis, times: Times) -> str:
    answer = diagnosis.json
    rows = [
        (tr("asset"), f"{answer['asset']['type']} {answer['asset']['id']}"),
        (tr("log"), answer["log"]),
        (tr("data set"), f"{diagnosis.data_set}: {_data_set(diagnosis.evidence.theta)}"),
        (tr("program"), f"ejector-twin {version('ejector-twin')}"),
    ]
    if times.log_begin_ns is not None:
        begin, end = dated(times.log_begin_ns), dated(_received_ns(diagnosis))
        between = tr("{begin} to {end}", begin=begin, end=end)
        rows.insert(2, (tr("recorded"), between))
    return page.pairs(rows)


def _data_set(theta: Theta) -> str:
    """Calibrated values that a nameplate or a setting shows."""
    volume = theta[[c.PORT_VOLUME, c.LINE_VOLUME, c.VOLUME]].sum()
    numbers = (
        (tr("suction capacity"), theta[c.SUCTION] / SL_MIN, "sl/min"),
        (tr("volume"), volume / ML, "ml"),
        (tr("supply"), theta[c.SUPPLY] / BAR, "bar"),
        (tr("ambient"), theta[c.AMBIENT] / MBAR, "mbar"),
        ("H1", theta[c.H1] / MBAR, "mbar"),
    )
    return ", ".join(f"{name} {numeral(value, '.4g')} {unit}" for name, value, unit in numbers)
