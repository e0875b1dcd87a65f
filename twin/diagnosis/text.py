"""The answer in words: for the terminal, beside an alarm and on the page.

The text comes from the stored form of the answer only, which may come from another process.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from twin.diagnosis.retelling import retold
from twin.figures.money import Interval, interval_text, significant
from twin.instants import SECOND_NS, dated, instant
from twin.languages.texts import ntr, numeral, tr
from twin.model.courses import Course
from twin.model.effects import effect_of

Answer = Mapping[str, Any]
PLAIN = 0.9  # probability, from which runners-up and what is unlisted need no word
MOST_LISTED = 12  # cycles listed by number
MOST_FINER = 3  # extra digits at most, to tell the ends of an interval apart
LONG_S = 120.0  # from here on times are in minutes

# Key in the answer, name, short name, unit.
FIGURES = (
    ("rms_mbar", "rms deviation", "rms", "mbar"),
    ("max_mbar", "largest deviation", "max", "mbar"),
    ("evacuation_time_error_pct", "error of the time to 600 mbar", "time to 600 mbar off by", "%"),
    ("h2_time_error_pct", "error of the time to H2", "time to H2 off by", "%"),
    ("level_rms_mbar", "rms error of the switching levels", "switching levels off by", "mbar"),
    ("leftover_sigma", "leftover (healthy: about 1)", "leftover", "sigma"),
)
# Properties of a course that are read from held-out cycles as well, since no other cycle has them.
READ_FROM_ALL = {Course.STEP: "when it began", Course.INTERMITTENT: "in which it acts"}


@dataclass(frozen=True)
class Times:
    """Turns onsets of an answer into text for a reader at ``now_ns`` (UTC).

    ``log_begin_ns`` is host time; None if no clock gave the times of the log. With ``now_ns`` None
    the text has a date instead of an age, for text that is stored and read at any time.
    """

    begin_s: float  # where in the log the diagnosed part begins
    log_begin_ns: int | None
    now_ns: int | None

    @classmethod
    def of(cls, answer: Answer, now_ns: int | None) -> "Times":
        """The times of an answer."""
        cycles = answer["cycles"]
        return cls(cycles.get("begin_s", 0.0), cycles.get("log_begin_ns"), now_ns)

    def at(self, seconds: float) -> str:
        """A time in the log: its clock time and age, and how far into the log."""
        into = tr("{time} into the log", time=clock(seconds))
        if self.log_begin_ns is None:
            return into
        ns = self.log_begin_ns + round(seconds * SECOND_NS)
        at = dated(ns) if self.now_ns is None else instant(ns, self.now_ns)
        return f"{at}, {into}"


def lines(answer: Answer, now_ns: int) -> str:
    """The answer in a few lines of plain text."""
    rows = [f"{answer['verdict']}: {headline(answer, now_ns)}"]
    rows += [f"  {label:<14} {text}" for label, text in _facts(answer, now_ns)]
    rows += [
        f"  {contradiction['signal']:<14} {contradiction['what']}: {contradiction['do']}"
        for contradiction in signals(answer)
    ]
    return "\n".join(rows)


def signals(answer: Answer) -> Sequence[Answer]:
    """Reported signals that contradict the pressure; nearly always none."""
    contradictions: Sequence[Answer] = answer.get("signals", ())
    return contradictions


def weakness_of(answer: Answer) -> str:
    """In which phases the twin of an answer is weak; empty if it is good."""
    return weakness(answer.get("twin", {}).get("weak", {}))


def weakness(weak: Mapping[str, float]) -> str:
    """How far a twin is off, by times the floor of its ``weak`` phases; empty without any."""
    if not weak:
        return ""
    phases = [
        tr("{times} times its floor in {phase}", times=numeral(times, ".1f"), phase=spoken(phase))
        for phase, times in weak.items()
    ]
    return tr("this twin is usable: off {phases}", phases=listed(phases))


def headline(answer: Answer, now_ns: int | None) -> str:
    """One sentence for the technician."""
    causes, times = answer["causes"], Times.of(answer, now_ns)
    match answer["verdict"]:
        case "consistent":
            rms = number(answer["baseline"]["rms_mbar"])
            return tr(
                "The ejector does what its twin expects; {rms} mbar rms left over are healthy.",
                rms=rms,
            )
        case "explained" if len(causes) == 1:
            (cause,) = causes
            sentence = tr(effect_of(cause["effect"]).sentence)
            return f"{sentence} – {size(cause)}, {when(cause, times)}."
        case "explained":
            sizes = (f"{size(cause)}, {when(cause, times)}" for cause in causes)
            names = (spoken(cause["effect"]) for cause in causes)
            named = listed(
                [
                    f"{name} ({size_and_time})"
                    for name, size_and_time in zip(names, sizes, strict=True)
                ]
            )
            return ntr(
                "{count} cause: {named}.",
                "{count} causes together: {named}.",
                len(causes),
                named=named,
            )
        case "unlisted" if mechanism := mechanism_of(answer):
            opening = _unexplained(causes, spoken(answer["unlisted"]["where"]))
            best = tr("What suits best: {sentence}.", sentence=retold(mechanism["sentence"]))
            return f"{opening} {best}"
        case "unlisted":
            return _unexplained(causes, left_over(answer))
    return tr("The log cannot answer: {reason}.", reason=retold(answer["next_experiment"]))


def _unexplained(causes: Sequence[Answer], location: str) -> str:
    if not causes:
        return tr("No listed cause explains the deviation in {where}.", where=location)
    return ntr(
        "{causes} explains a part; no listed cause explains what is left in {where}.",
        "{causes} explain a part; no listed cause explains what is left in {where}.",
        len(causes),
        causes=capital(listed([sized(cause) for cause in causes])),
        where=location,
    )


def mechanism_of(answer: Answer) -> Answer | None:
    """The mechanism of something unlisted; None if it is a curve or nothing is left."""
    unlisted: Answer = answer["unlisted"] or {}
    mechanism: Answer | None = unlisted.get("mechanism")
    return mechanism


def mechanism_lines(mechanism: Answer) -> Iterator[tuple[str, str]]:
    """Labelled lines on a mechanism."""
    yield tr("mechanism"), retold(mechanism["sentence"])
    yield tr("in the model"), retold(mechanism["formula"])
    yield tr("sizes"), "; ".join(_sizes(mechanism))
    for rival in mechanism["not_separable_from"]:
        yield tr("or it may be"), retold(rival)


def left_over(answer: Answer) -> str:
    """Where something unlisted acts, and its shape."""
    unlisted = answer["unlisted"]
    return f"{spoken(unlisted['where'])}: {retold(unlisted['shape'])}"


def _facts(answer: Answer, now_ns: int) -> Iterator[tuple[str, str]]:
    """Labelled lines for the terminal."""
    for cause in answer["causes"]:
        yield from about(cause, Times.of(answer, now_ns), sure=answer["verdict"] == "explained")
    yield from to_do(answer)
    if weakness := weakness_of(answer):
        yield "the twin", weakness
    if "without_part" in answer["cycles"]:
        yield "not judged", f"cycles that met no part: {some(answer['cycles']['without_part'])}"
    if answer["verdict"] == "insufficient":
        return
    yield (
        "unseen cycles",
        ", ".join(f"{short} {change(answer, key)} {unit}" for key, _, short, unit in FIGURES),
    )
    if extended(answer):
        yield "gain", gain(answer)
    cycles = answer["cycles"]
    fitted = some(cycles["fitted"])
    yield "cycles", f"{cycles['total']}; fitted: {fitted}; held out: {held_out_cycles(answer)}"


def on_another_log(answer: Answer, nothing: str) -> str:
    """The gain on the log of ``judged_on``; without one, ``nothing`` says why."""
    judged = answer["judged_on"]
    if judged is None:
        return f"  {'another log':<14} nothing is judged on it: {nothing}"
    before, after, cycles = judged["baseline"], judged["extended"], judged["cycles"]
    figures = ", ".join(
        f"{short} {number(before[key])} → {number(after[key])} {unit}"
        for key, _, short, unit in FIGURES
    )
    reduction = f"{number(judged['gain']['rms_reduction_pct'])} % less rms deviation"
    left_out = f"\n  {'left out':<14} {judged['left_out']}" if judged["left_out"] else ""
    return (
        f"  {'another log':<14} {judged['log']}, {cycles} cycles on which nothing was chosen:"
        f" {figures}\n  {'gain there':<14} {reduction} ({gain_interval(judged['gain'], cycles)})"
        f"{left_out}"
    )


def held_out_cycles(answer: Answer) -> str:
    """The held-out cycles, and which properties of causes were read from them as well."""
    courses = {cause["course"] for cause in answer["causes"]}
    read = [reading for course, reading in READ_FROM_ALL.items() if str(course) in courses]
    cycles = some(answer["cycles"]["held_out"])
    if not read:
        return cycles
    exceptions = listed([tr(reading) for reading in read])
    return tr("{cycles}, but for {what}, read from all", cycles=cycles, what=exceptions)


def about(cause: Answer, times: Times, *, sure: bool) -> Iterator[tuple[str, str]]:
    """Labelled lines on one cause: size, course, certainty, cost and where to look."""
    yield tr("cause") if sure else tr("a part of it"), spoken(cause["effect"])
    yield tr("size"), "; ".join(_sizes(cause))
    yield tr("when"), when(cause, times, interval=True)
    if sure:
        yield tr("how sure"), certainty(cause)
    if "cost" in cause:
        yield tr("cost"), cost(cause)
    yield tr("look at"), tr(effect_of(cause["effect"]).look_at)
    for name in cause["not_separable_from"]:
        look_at = tr(effect_of(name).look_at)
        yield (
            tr("or it may be"),
            tr("{cause}; then look at {where}", cause=spoken(name), where=look_at),
        )


def to_do(answer: Answer) -> Iterator[tuple[str, str]]:
    """What to find out and to record next."""
    if mechanism := mechanism_of(answer):
        yield from mechanism_lines(mechanism)
    yield from to_find_out(answer)
    yield from to_record(answer)


def to_find_out(answer: Answer) -> Iterator[tuple[str, str]]:
    """What to find out about something unlisted."""
    if answer["verdict"] != "unlisted":
        return
    where, depends = spoken(answer["unlisted"]["where"]), answer["unlisted"]["depends_on"]
    what = tr("what in {where} differs from when the twin was calibrated", where=where)
    yield tr("find out"), what
    if depends:
        yield tr("it depends on"), listed([spoken(quantity) for quantity in depends])


def to_record(answer: Answer) -> Iterator[tuple[str, str]]:
    """What to record next."""
    if answer["verdict"] == "insufficient":
        yield tr("next"), tr("put this right, record again and diagnose the new log")
    elif answer["next_experiment"]:
        yield tr("next recording"), retold(answer["next_experiment"])


# --- one cause ------------------------------------------------------------------------------------


def sized(cause: Answer) -> str:
    """Name and size of a cause."""
    return f"{spoken(cause['effect'])} ({size(cause)})"


def size(cause: Answer) -> str:
    """Size of a cause; of a ramp at the end of the log."""
    parameters = cause["parameters"]
    return ", ".join(
        (f"{spoken(name)} " if len(parameters) > 1 else "")
        + f"{number(p.get('at_end', p['value']))} {p['unit'].removesuffix('/h')}"
        for name, p in parameters.items()
    )


def _sizes(cause: Answer) -> Iterator[str]:
    for name, p in cause["parameters"].items():
        low, high = ends(p["low95"], p["high95"])
        value = f"{number(p['value'])} {p['unit']}"
        text = tr("{value} (95 %: {low} to {high})", value=value, low=low, high=high)
        if "at_end" in p:
            at_end = f"{number(p['at_end'])} {p['unit'].removesuffix('/h')}"
            text = tr("{value} by the end, growing by {rate}", value=at_end, rate=text)
        yield f"{spoken(name)} {text}"


def when(cause: Answer, times: Times, *, interval: bool = False) -> str:
    """When a cause acts; with ``interval`` also that of its onset, and its cycles."""
    match Course(cause["course"]):
        case Course.STEP:
            text = tr("since {time}", time=times.at(cause["onset_s"]))
            if interval:
                low, high = _clocks(cause["onset_low95_s"], cause["onset_high95_s"])
                text = tr("{value} (95 %: {low} to {high})", value=text, low=low, high=high)
        case Course.RAMP if cause["onset_s"] > times.begin_s:
            text = tr("growing since {time}", time=times.at(cause["onset_s"]))
        case Course.RAMP if times.begin_s > 0.0:
            text = tr("growing since {time}, or longer", time=times.at(times.begin_s))
        case Course.RAMP:
            text = tr("growing from the beginning of the log")
        case Course.INTERMITTENT:
            text = tr("in {share} % of the cycles", share=number(cause["share_pct"]))
            text += f": {some(cause['cycles'])}" if interval else ""
        case _ if times.begin_s > 0.0:  # throughout, and only a part of the log is diagnosed
            text = tr("since {time}, or longer", time=times.at(times.begin_s))
        case _:
            text = tr("in all of the log")
    return text


def certainty(cause: Answer) -> str:
    """Probability of a cause, compared with its look-alikes and something unlisted."""
    alike = listed([spoken(name) for name in cause["not_separable_from"]], tr("or"))
    percent = f"{100.0 * cause['probability']:.0f} %"
    if not alike and cause["probability"] < PLAIN:
        return tr("{percent}; other causes, listed or not, are not ruled out", percent=percent)
    if not alike:
        return tr("{percent}; no other listed cause fits as well", percent=percent)
    return tr("{percent}; this log cannot tell it from {alike}", percent=percent, alike=alike)


def cost(cause: Answer) -> str:
    """Cost of a cause a year, or that it cannot be told from zero; needs a configured price."""
    entry, name = cause["cost"], spoken(cause["effect"])
    money = Interval(**entry["money_per_year"])
    hours = tr("{hours} h of operation", hours=numeral(entry["operating_hours"], "g"))
    if not entry["differs_from_zero"]:
        text = interval_text(money, entry["currency"])
        text = tr(
            "what this {cause} costs cannot be told from zero: {amount}", cause=name, amount=text
        )
    elif money.value > 0.0:
        text = interval_text(money, entry["currency"])
        text = tr("this {cause} costs about {amount}", cause=name, amount=text)
    else:
        saving = Interval(-money.value, -money.high95, -money.low95)
        text = interval_text(saving, entry["currency"])
        text = tr("this {cause} takes less air: about {amount}", cause=name, amount=text)
    return f"{text}, {hours}"


# --- numbers and lists ----------------------------------------------------------------------------


def change(answer: Answer, key: str) -> str:
    """A figure of the unchanged twin, and of the extended model if there is one."""
    before, after = (number(answer[part][key]) for part in ("baseline", "extended"))
    return f"{before} → {after}" if extended(answer) else before


def extended(answer: Answer) -> bool:
    """Whether there is an extended model."""
    return bool(answer["causes"]) or answer["extended"] != answer["baseline"]


def gain(answer: Answer) -> str:
    """Reduction of the deviation with its interval, and its share of the achievable gain."""
    figures = answer["gain"]
    return tr(
        "{reduction} % less rms deviation ({interval}), {share} % of what can be gained",
        reduction=number(figures["rms_reduction_pct"]),
        interval=gain_interval(figures, len(answer["cycles"]["held_out"])),
        share=number(figures["share_of_achievable_pct"]),
    )


def gain_interval(figures: Answer, cycles: int) -> str:
    """The 95 % interval of a gain on ``cycles`` cycles, or why there is none."""
    if figures["low95"] is not None:
        low, high = ends(figures["low95"], figures["high95"])
        return tr("95 %: {low} to {high}", low=low, high=high)
    if figures["rms_reduction_pct"] == 0.0:
        return tr("no cause changes the pressure between switchings")
    return ntr(
        "{count} held-out cycle cannot tell how sure that is",
        "{count} held-out cycles cannot tell how sure that is",
        cycles,
    )


def number(value: float | None, digits: int = 3) -> str:
    """Three significant digits, without an exponent."""
    return "–" if value is None else significant(value, digits)


def ends(low: float, high: float) -> tuple[str, str]:
    """Both ends of an interval, with enough digits to tell them apart."""
    return _apart(lambda finer: (number(low, 3 + finer), number(high, 3 + finer)))


def clock(seconds: float, finer: int = 0) -> str:
    """A time in the log, with ``finer`` extra decimals."""
    if seconds < LONG_S:
        return f"{numeral(seconds, f'.{1 + finer}f')} s"
    minutes, rest = divmod(round(seconds, finer), 60)
    return f"{minutes:.0f} min {numeral(rest, f'.{finer}f')} s"


def _clocks(low: float, high: float) -> tuple[str, str]:
    return _apart(lambda finer: (clock(low, finer), clock(high, finer)))


def _apart(spell: Callable[[int], tuple[str, str]]) -> tuple[str, str]:
    """The first pair of texts that differ, with as few extra digits as possible."""
    spellings = [spell(finer) for finer in range(MOST_FINER + 1)]
    return next((pair for pair in spellings if pair[0] != pair[1]), spellings[-1])


def some(cycles: Sequence[int]) -> str:
    """Numbers of cycles; shortened if they are more than MOST_LISTED."""
    if len(cycles) <= MOST_LISTED:
        return ", ".join(map(str, cycles))
    counted = ntr("{count} cycle", "{count} cycles", len(cycles))
    return f"{', '.join(map(str, cycles[:3]))} … {cycles[-1]} ({counted})"


def listed(parts: Sequence[str], last: str = "") -> str:
    """A list in words, with ``last`` (by default "and") before its last part."""
    *first, end = parts or [""]
    word = last or tr("and")
    return f"{', '.join(first)} {word} {end}" if first else end


def spoken(name: str) -> str:
    """A name in words of the chosen language."""
    return tr(plain_words(name))


def plain_words(name: str) -> str:
    """A name in English words."""
    return name.replace("blow_off", "blow-off").replace("_", " ")


def capital(text: str) -> str:
    """A text that begins with a capital letter."""
    return text[:1].upper() + text[1:]
