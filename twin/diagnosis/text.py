"""The answer in words: what people read on the terminal, beside an alarm and on the page.

All of it is read from the answer as the contract has it, which may come from another process.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from twin.figures.money import Interval, interval_text, significant
from twin.instants import SECOND_NS, dated, instant
from twin.language import tr
from twin.model.courses import Course
from twin.model.effects import effect_of

Answer = Mapping[str, Any]
MOST_LISTED = 12  # cycles named one by one
MOST_FINER = 3  # digits more than usual, to tell the ends of an interval apart
LONG_S = 120.0  # from here on times are said in minutes
COUNTED = ("No", "One", "Two", "Three")

# Key in the answer, what it is, in few words, unit.
FIGURES = (
    ("rms_mbar", "rms deviation", "rms", "mbar"),
    ("max_mbar", "largest deviation", "max", "mbar"),
    ("evacuation_time_error_pct", "error of the time to 600 mbar", "time to 600 mbar off by", "%"),
    ("h2_time_error_pct", "error of the time to H2", "time to H2 off by", "%"),
    ("level_rms_mbar", "rms error of the switching levels", "switching levels off by", "mbar"),
    ("leftover_sigma", "leftover (healthy: about 1)", "leftover", "sigma"),
)
# What of a course no cycle shows but the one that has it.
_READ_FROM_ALL = {Course.STEP: "when it began", Course.INTERMITTENT: "in which it acts"}


@dataclass(frozen=True)
class Times:
    """What the onsets of an answer are, as people read them at ``now_ns`` (UTC).

    ``log_begin_ns`` is by the clock here; None where no clock gave the times of the log. Text that
    is kept, to be read at any time, has the date in place of an age: its ``now_ns`` is None.
    """

    begin_s: float  # of the log, before what was looked at
    log_begin_ns: int | None
    now_ns: int | None

    @classmethod
    def of(cls, answer: Answer, now_ns: int | None) -> "Times":
        """Those of an answer."""
        cycles = answer["cycles"]
        return cls(cycles.get("begin_s", 0.0), cycles.get("log_begin_ns"), now_ns)

    def at(self, seconds: float) -> str:
        """A time in the log: its clock time and age, and how far into the log."""
        into = f"{clock(seconds)} into the log"
        if self.log_begin_ns is None:
            return into
        ns = self.log_begin_ns + round(seconds * SECOND_NS)
        at = dated(ns) if self.now_ns is None else instant(ns, self.now_ns)
        return f"{at}, {into}"


def lines(answer: Answer, now_ns: int) -> str:
    """The answer in a few lines of plain text."""
    said = [f"{answer['verdict']}: {headline(answer, now_ns)}"]
    said += [f"  {label:<14} {text}" for label, text in _facts(answer, now_ns)]
    said += [f"  {one['signal']:<14} {one['what']}: {one['do']}" for one in signals(answer)]
    return "\n".join(said)


def signals(answer: Answer) -> Sequence[Answer]:
    """What is reported and contradicts the pressure; nearly always nothing."""
    found: Sequence[Answer] = answer.get("signals", ())
    return found


def headline(answer: Answer, now_ns: int) -> str:
    """One sentence for the technician."""
    causes, times = answer["causes"], Times.of(answer, now_ns)
    match answer["verdict"]:
        case "consistent":
            left = number(answer["baseline"]["rms_mbar"])
            return f"The ejector does what its twin expects; {left} mbar rms left over are healthy."
        case "explained" if len(causes) == 1:
            (cause,) = causes
            return f"{effect_of(cause['effect']).sentence} – {size(cause)}, {when(cause, times)}."
        case "explained":
            each = (f"{size(cause)}, {when(cause, times)}" for cause in causes)
            names = (spoken(cause["effect"]) for cause in causes)
            named = listed([f"{name} ({one})" for name, one in zip(names, each, strict=True)])
            return f"{COUNTED[len(causes)]} causes together: {named}."
        case "unlisted" if mechanism := mechanism_of(answer):
            known = f"{_known(causes)} {spoken(answer['unlisted']['where'])}"
            return f"{known}. What suits best: {_small(mechanism['sentence'])}."
        case "unlisted":
            return f"{_known(causes)} {left_over(answer)}."
    return f"The log cannot answer: {answer['next_experiment']}."


def _known(causes: Sequence[Answer]) -> str:
    if not causes:
        return "No listed cause explains the deviation in"
    verb = "explains" if len(causes) == 1 else "explain"
    named = listed([sized(cause) for cause in causes])
    return f"{_capital(named)} {verb} a part; no listed cause explains what is left in"


def mechanism_of(answer: Answer) -> Answer | None:
    """What nobody listed, as physics; None where it is a curve or nothing is left."""
    unlisted: Answer = answer["unlisted"] or {}
    found: Answer | None = unlisted.get("mechanism")
    return found


def _mechanism(found: Answer) -> Iterator[tuple[str, str]]:
    """What is known of a mechanism."""
    yield "mechanism", found["sentence"]
    yield "in the model", found["formula"]
    yield "sizes", "; ".join(_sizes(found))
    for other in found["not_separable_from"]:
        yield "or it may be", other


def left_over(answer: Answer) -> str:
    """Where something unknown remains, and of what shape."""
    unlisted = answer["unlisted"]
    return f"{spoken(unlisted['where'])}: {unlisted['shape']}"


def _facts(answer: Answer, now_ns: int) -> Iterator[tuple[str, str]]:
    """Labelled lines for the terminal."""
    for cause in answer["causes"]:
        yield from about(cause, Times.of(answer, now_ns), sure=answer["verdict"] == "explained")
    yield from to_do(answer)
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
    """How much is gained on the log of ``judged_on``; else why there is ``nothing`` to judge."""
    judged = answer["judged_on"]
    if judged is None:
        return f"  {'another log':<14} nothing is judged on it: {nothing}"
    before, after, cycles = judged["baseline"], judged["extended"], judged["cycles"]
    figures = ", ".join(
        f"{short} {number(before[key])} → {number(after[key])} {unit}"
        for key, _, short, unit in FIGURES
    )
    less = f"{number(judged['gain']['rms_reduction_pct'])} % less rms deviation"
    return (
        f"  {'another log':<14} {judged['log']}, {cycles} cycles on which nothing was chosen:"
        f" {figures}\n  {'gain there':<14} {less} ({gain_interval(judged['gain'], cycles)})"
    )


def held_out_cycles(answer: Answer) -> str:
    """The held-out cycles, and what of the causes was read from them as well."""
    courses = {cause["course"] for cause in answer["causes"]}
    read = [what for course, what in _READ_FROM_ALL.items() if str(course) in courses]
    exception = f", but for {listed(read)}, read from all" if read else ""
    return some(answer["cycles"]["held_out"]) + exception


def about(cause: Answer, times: Times, *, sure: bool) -> Iterator[tuple[str, str]]:
    """What is known of one cause, and where to look for it."""
    yield "cause" if sure else "a part of it", spoken(cause["effect"])
    yield "size", "; ".join(_sizes(cause))
    yield "when", when(cause, times, interval=True)
    if sure:
        yield "how sure", certainty(cause)
    if "cost" in cause:
        yield "cost", cost(cause)
    yield "look at", effect_of(cause["effect"]).look_at
    for name in cause["not_separable_from"]:
        yield "or it may be", f"{spoken(name)}; then look at {effect_of(name).look_at}"


def to_do(answer: Answer) -> Iterator[tuple[str, str]]:
    """What to find out and to record next."""
    if found := mechanism_of(answer):
        yield from _mechanism(found)
    if answer["verdict"] == "unlisted":
        where, depends = spoken(answer["unlisted"]["where"]), answer["unlisted"]["depends_on"]
        yield "find out", f"what in {where} differs from when the twin was calibrated"
        if depends:
            yield "it depends on", listed([spoken(one) for one in depends])
    if answer["verdict"] == "insufficient":
        yield "next", "put this right, record again and diagnose the new log"
    elif answer["next_experiment"]:
        yield "next recording", answer["next_experiment"]


# --- one cause ------------------------------------------------------------------------------------


def sized(cause: Answer) -> str:
    """The cause with its size, short."""
    return f"{spoken(cause['effect'])} ({size(cause)})"


def size(cause: Answer) -> str:
    """How big it is, or has become by the end of the log."""
    known = cause["parameters"]
    return ", ".join(
        (f"{spoken(name)} " if len(known) > 1 else "")
        + f"{number(p.get('at_end', p['value']))} {p['unit'].removesuffix('/h')}"
        for name, p in known.items()
    )


def _sizes(cause: Answer) -> Iterator[str]:
    for name, p in cause["parameters"].items():
        grown = ""
        if "at_end" in p:
            grown = f"{number(p['at_end'])} {p['unit'].removesuffix('/h')} by the end, growing by "
        low, high = ends(p["low95"], p["high95"])
        yield f"{spoken(name)} {grown}{number(p['value'])} {p['unit']} (95 %: {low} to {high})"


def when(cause: Answer, times: Times, *, interval: bool = False) -> str:
    """How it runs in time; with the ``interval`` of an onset and the cycles where it is there."""
    match Course(cause["course"]):
        case Course.STEP:
            low, high = _clocks(cause["onset_low95_s"], cause["onset_high95_s"])
            known = f" (95 %: {low} to {high})" if interval else ""
            return f"since {times.at(cause['onset_s'])}{known}"
        case Course.RAMP if cause["onset_s"] > times.begin_s:
            return f"growing since {times.at(cause['onset_s'])}"
        case Course.RAMP:
            return f"growing {_all_of_it(times, 'from the beginning of the log')}"
        case Course.INTERMITTENT:
            which = f": {some(cause['cycles'])}" if interval else ""
            return f"in {number(cause['share_pct'])} % of the cycles{which}"
    return _all_of_it(times, "in all of the log")


def _all_of_it(times: Times, whole: str) -> str:
    """How long what was there all the time has been: by a part of a log at least that long."""
    return f"since {times.at(times.begin_s)}, or longer" if times.begin_s > 0.0 else whole


def certainty(cause: Answer) -> str:
    """How sure it is, beside other listed causes and what nobody listed."""
    alike = listed([tr(spoken(name)) for name in cause["not_separable_from"]], tr("or"))
    percent = f"{100.0 * cause['probability']:.0f} %"
    if not alike:
        return tr("{percent}; no other listed cause fits as well", percent=percent)
    return tr("{percent}; this log cannot tell it from {alike}", percent=percent, alike=alike)


def cost(cause: Answer) -> str:
    """What a cause costs a year, or that the log cannot tell; only where a price is configured."""
    told, name = cause["cost"], spoken(cause["effect"])
    money = Interval(**told["money_per_year"])
    basis = f"{told['operating_hours']:g} h of operation"
    if not told["differs_from_zero"]:
        text = interval_text(money, told["currency"])
        return f"what this {name} costs cannot be told from zero: {text}, {basis}"
    if money.value > 0.0:
        return f"this {name} costs about {interval_text(money, told['currency'])}, {basis}"
    less = Interval(-money.value, -money.high95, -money.low95)
    return f"this {name} takes less air: about {interval_text(less, told['currency'])}, {basis}"


# --- numbers and lists ----------------------------------------------------------------------------


def change(answer: Answer, key: str) -> str:
    """A figure of the twin as it stands, and with the causes if there are any."""
    before, after = (number(answer[part][key]) for part in ("baseline", "extended"))
    return f"{before} → {after}" if extended(answer) else before


def extended(answer: Answer) -> bool:
    """Whether there is a model that is not just the twin as it stands."""
    return bool(answer["causes"]) or answer["extended"] != answer["baseline"]


def gain(answer: Answer) -> str:
    """How much less deviation there is, and what share of what can be gained at all."""
    known = answer["gain"]
    held_out = len(answer["cycles"]["held_out"])
    interval = gain_interval(known, held_out, "held-out cycle")
    less = f"{number(known['rms_reduction_pct'])} % less rms deviation ({interval})"
    return f"{less}, {number(known['share_of_achievable_pct'])} % of what can be gained"


def gain_interval(known: Answer, cycles: int, cycle: str = "cycle") -> str:
    """The interval of a gain on so many cycles, or why there is none."""
    if known["low95"] is not None:
        low, high = ends(known["low95"], known["high95"])
        return f"95 %: {low} to {high}"
    if known["rms_reduction_pct"] == 0.0:
        return "no cause changes the pressure between switchings"
    return f"{cycles} {cycle}{'s' * (cycles != 1)} cannot tell how sure that is"


def number(value: float | None, digits: int = 3) -> str:
    """Three significant digits, without an exponent."""
    return "–" if value is None else significant(value, digits)


def ends(low: float, high: float) -> tuple[str, str]:
    """Both ends of an interval, with as many digits as tell them apart."""
    return _apart(lambda finer: (number(low, 3 + finer), number(high, 3 + finer)))


def clock(seconds: float, finer: int = 0) -> str:
    """A time in the log; with ``finer`` more decimals."""
    if seconds < LONG_S:
        return f"{seconds:.{1 + finer}f} s"
    minutes, rest = divmod(round(seconds, finer), 60)
    return f"{minutes:.0f} min {rest:.{finer}f} s"


def _clocks(low: float, high: float) -> tuple[str, str]:
    return _apart(lambda finer: (clock(low, finer), clock(high, finer)))


def _apart(spelt: Callable[[int], tuple[str, str]]) -> tuple[str, str]:
    """The first spelling in which two values differ."""
    every = [spelt(finer) for finer in range(MOST_FINER + 1)]
    return next((both for both in every if both[0] != both[1]), every[-1])


def some(cycles: Sequence[int]) -> str:
    """Cycles by number, as many as one reads."""
    if len(cycles) <= MOST_LISTED:
        return ", ".join(map(str, cycles))
    return f"{', '.join(map(str, cycles[:3]))} … {cycles[-1]} ({len(cycles)} cycles)"


def listed(parts: Sequence[str], last: str = "and") -> str:
    """A list as people say it."""
    *first, end = parts or [""]
    return f"{', '.join(first)} {last} {end}" if first else end


def spoken(name: str) -> str:
    """A name as people say it."""
    return name.replace("blow_off", "blow-off").replace("_", " ")


def _small(text: str) -> str:
    return text[:1].lower() + text[1:]


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
