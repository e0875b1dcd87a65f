"""Stored sentences in the reader's language.

Answers and alarms are stored and exchanged in English, whoever reads them. A sentence with numbers
in it is matched with the template that it was written from; the template's translation then takes
its values. A sentence without a template stays English.
"""

import re
from collections.abc import Callable, Sequence
from functools import cache

from twin.figures.warnings import CAUTIONS
from twin.languages.texts import ENGLISH, language_code, notation_within, tr
from twin.model.mechanism import PLACES, WHENS, Place
from twin.monitor.healthy import NOT_COMMISSIONED

_BECAUSE = (  # why a log cannot answer
    "the log has no complete cycle: record suction, blow-off and the idle after it",
    "the pressure input is saturated in {share}% of the samples: check the sensor's range and"
    " wiring, then record again",
    "only {count} cycle can be judged: record at least {least} complete ones in a row",
    "only {count} cycles can be judged: record at least {least} complete ones in a row",
    "no row can be compared: the twin never found a state to start from",
    f"{NOT_COMMISSIONED}; fit the twin first to a log of healthy cycles: {{command}}",
    "{commands} derived from the pressure: {suctions}; {releases}; valve delays and the timing of"
    " commands cannot be told: record the commands as well",
    "releases go above the level of idle, so they are called blow-off",
    "no release goes above the level of idle: whether a blow-off or a vent ends the vacuum cannot"
    " be told, so it is called idle",
    "{count} suction",
    "{count} suctions",
)
_EXPERIMENTS = (  # what to record next
    "record {test}: {causes} and {rivals} are predicted to part by {sigmas} sigma",
    "no recording of this sensor is predicted to part {causes} from {rivals} (at most {sigmas}"
    " sigma): measure one of them by other means",
    "what else it may be",
    "record {what} as well: {size} mbar of the deviation (rms) look like another weather, and a"
    " fault of that size could hide behind it",
    "ambient pressure",
    "temperature",
    "record {test}: what is left is largest in {phase}, and how it goes on there tells what it may"
    " be",
    "cycles with three times as long an idle",
    "cycles with suction to the end vacuum, the air saving switched off",
    "cycles with three times as long a hold",
    "cycles with three times as long a blow-off",
    "cycle {cycle} alone deviates, by {size} mbar (rms): so few cannot show a cause; record more"
    " cycles if it comes again",
    "cycles {cycles} alone deviate, by {size} mbar (rms): so few cannot show a cause; record more"
    " cycles if it comes again",
)
_UNLISTED = (  # the shape of something unlisted
    "another one in each cycle: no term of the model can take it away",
    "up to {size} mbar of pressure, at {time} ms after it begins",
    "up to {size} mbar of pressure, at {vacuum} mbar vacuum",
    "no listed effect explains what is left in {phase}: {shape}",
)
_MECHANISMS = (
    "{begin} ({sizes}), {when}",
    "{what} changes by {size} times the share; {share}",
    "{what} changes by {size} times the share; {what_2} changes by {size_2} times the share;"
    " {share}",
)
_SIGNALS = (  # reported signals that contradict the pressure, and what to do
    "the ejector reports its nozzle on while nothing is commanded",
    "the pressure shows that the nozzle goes off at {level} of vacuum, and the ejector reports it"
    " on",
    "the ejector reports its nozzle off, and the vacuum goes on rising by {rise}",
    "the ejector reports no part, though the vacuum passes H2, {level}",
    "part present comes at {level} of vacuum; H2 is {h2}",
    "at rest {sensor} reads {difference} more than the pressure",
    "at rest {sensor} reads {difference} less than the pressure",
    "the barometer",
    "the second pressure",
    "by the flow {metered} standard litres are drawn off until {level} of vacuum; the pressure"
    " shows {shown}",
    "check whether the bit of the tag means off, or saving air",
    "check that the tag reads this ejector, and the right bit",
    "check whether the nozzle's valve sticks, then what the tag reads",
    "check which bit the tag part_present reads",
    "set [data.ejector] h2_mbar = {value}, or H2 of the ejector",
    "compare both with a third, then check the scale of the tag {tag}",
    "check unit, scale and direction of the tag flow, then volumes in [data.system.parts]",
    "the supply reads {measured} bar, and the ejector evacuates",
    "the supply reads {measured} bar; the data set has {usual}, and the pressure is as with that",
    "check unit and scale of the tag supply: ejectors need {least} to {most} bar",
    "check the gauge, then unit and scale of the tag supply",
)
_ALARMS = (  # evidence of alarms
    "no fresh sample for {time} ms: check PLC and network",
    "pressure signal: {quality}",
    "out of range",
    "overflow",
    "stale",
    "bad",
    "{warning}; expected {value}",
    "set in [figures]",
    "from the unit's data set",
    "from its commissioning",
    "changed by a person",
)
_COMMISSIONING = (  # what a record corrects in the configuration, and the lines to write instead
    "the opened system stands at {measured} mbar; the configuration says {configured}",
    "the closed system follows an ambient pressure of {fitted} mbar; the configuration says"
    " {configured}",
    "1 suction met no part and was left out",
    "{empty} suctions met no part and were left out",
    '[[data.system.parts]] kind = "vessel", if no part is picked up',
    "in no suction the nozzle goes off by itself; the configuration has air saving on",
    "no row of the record has blow-off; where the unit has one, its command is missing",
    "the vacuum is {highest} mbar at most, where ejectors make 300 and more",
    "the supply reads {measured} bar; the configuration says {configured}",
    "by the flow meter {metered} ml are evacuated; the configuration says {configured}",
    "the pressure is read nearer to {place}; the configuration has the sensor nearer to"
    " {configured}",
    "the vessel",
    "the port",
    "the nozzle goes off at {measured} mbar; the configuration says {configured}",
    "the nozzle goes on again {measured} mbar below that; the configuration says {configured}",
    "part present comes at {measured} mbar; the configuration says {configured}",
    "[driver.tags.blow_off], or the column blow_off",
    "[driver.tags.pressure] unit, if it is in kPa, mmHg or psi",
    '[[data.system.parts]] kind = "sensor", after the tubes',
    '[[data.system.parts]] kind = "sensor", before the tubes',
)
_DOUBTS = (  # that a record is of a healthy unit, and what to do
    "what counts as healthy from now on leaks {leakage} mbar/s in hold; {limit} mbar/s is the usual"
    " limit",
    "repair first and record again, or leave it if it is as built",
    "what counts as healthy from now on never reaches H1, {h1} mbar: the vacuum is {highest} mbar"
    " at most",
    "look for leaks and a low supply, or let suction last longer, and record again",
    "what counts as healthy from now on may leak {leak} sl/min: with an end pressure of {end} mbar"
    " the record fits as well",
    "leave half a second with both off after suction and record again, if a leak matters",
    "{name} is {value} {unit}, where {low} to {high} is healthy for its type",
    "suction capacity",
    "end pressure",
    "response of the nozzle",
    "blow-off flow",
    "response of blow-off",
    "leak",
)
_REFUSALS = (  # why a record cannot be commissioned, and what to do
    "{log}: {derived}. A twin needs to know when valves were told",
    "{commands} derived from the pressure: {suctions}; {releases}; valve delays and the timing of"
    " commands cannot be told",
    "record suction and blow-off beside the pressure, a row each 2 ms or faster; what needs no"
    " twin: twin figures show LOG, twin compare A B",
    "the record has no suction",
    "check which tag or column is suction",
    "the record has a row each {period} ms: the nozzle's switching and the valves' delays are not"
    " seen in it",
    "record again with a row each {slowest} ms or faster; what needs no twin: twin figures show"
    " LOG, twin compare A B",
    "{share}% of the record's rows are missing",
    'record again in block mode (mode = "block"), which loses none',
    "the fit ends at values that no ejector has: this is no record of the parts that [data.system]"
    " lists, or of more than one unit",
    "check volumes, tubes and the sensor's place; use a record of one unit",
    "the pressure falls to {deepest} mbar absolute, and none is below zero: it is gauge pressure,"
    " taken for absolute",
    'set reference = "gauge" of [driver.tags.pressure], or of the column',
    "the pressure goes from {deepest} to {highest} mbar absolute, and ambient pressure is"
    " {ambient}: no vacuum does so",
    "check the unit of [driver.tags.pressure], or of the column: is it read in bar, psi or kPa, and"
    " measured in mbar?",
    "the pressure is never above {highest} mbar absolute: too little, as ambient pressure is"
    " {ambient}",
    "check the unit of [driver.tags.pressure], or of the column: is it in kPa or psi?",
    "the pressure idles at {idle} mbar absolute, and ambient pressure is {ambient}: it is absolute"
    " pressure, taken for gauge",
    'set reference = "absolute" of [driver.tags.pressure], or of the column',
    "the pressure moves by {before} mbar in each cycle, and by {after} mbar from cycle {cycle} on:"
    " its unit of measurement changes within the record",
    "give both parts the same unit, or use one part alone; check [driver.tags.pressure], or of the"
    " column",
    "the pressure moves by {size} mbar only in the whole record: no vacuum is made",
    "check the unit and the range of [driver.tags.pressure], or of the column",
    "the pressure rises from about zero to {highest} mbar under suction: it is vacuum, taken for"
    " absolute pressure",
    'set reference = "vacuum" of [driver.tags.pressure], or of the column',
    "the pressure rises to {highest} mbar absolute while suction is commanded: its sign is wrong",
    'set reference = "gauge" (falls in suction) or "vacuum" (rises) of [driver.tags.pressure], or'
    " of the column",
    "the pressure rises while suction is commanded and falls while blow-off is: the two commands"
    " are swapped",
    "swap [driver.tags.suction] and [driver.tags.blow_off], or the two columns",
    "after suction the pressure holds, then rises by {rise} mbar at once, and no row has blow-off"
    " commanded: something lets air in that the record does not have",
    "connect [driver.tags.blow_off], or the column blow_off, and record again",
    "from cycle {cycle} on the record is another, by {step} mbar rms, and other cycles differ by"
    " {usual}: it is of two units, or something was changed during it",
    "use a record of one healthy unit in one state",
    "the cycles are not alike: with cycle {cycle} something changes that looks like {name}, by"
    " {size}",
    "record healthy cycles of one state; twin diagnose says more",
    "this log is not that of a healthy unit: {key} would be {value}, where {low} to {high} is"
    " healthy for its type",
    "repair first (twin diagnose names the cause), or set the value in [data] if it is as built",
    "the pressure is saturated, stale or bad in {share}% of the samples",
    "check the sensor's range and wiring, then record again",
    "the log has {breaks} gaps and {cycles} cycles without one",
    "record again in block mode",
    "the log has {cycles} complete cycles that count; commissioning needs {least}",
    "the log has {cycles} complete cycles that count; calibration needs {least}",
    "record suction, blow-off and idle again and again without a gap",
)
_FLEETS = (  # why a unit of a fleet could not be judged
    "no cycle of its newest log can be compared",
    "{count} unit to compare, {needed} are needed; its newest log is not diagnosed yet",
    "{count} units to compare, {needed} are needed; its newest log is not diagnosed yet",
    "no diagnosis: {reason}",
)
_AS_WRITTEN = {"tag", "command", "log", "key"}  # values that a person types
_SIZE = re.compile(r"([a-z][a-z0-9 ]*?) ([-+]?\d\S* \S+)")  # a name with its size


def capitalised(place: Place) -> str:
    """The sentence of a place as a mechanism's sentence begins with it."""
    return place.sentence[:1].upper() + place.sentence[1:]


def templates() -> list[str]:
    """All templates of stored sentences; the catalogue has each of them."""
    caution_words = [
        re.sub(r"\{([^:}]+)[^}]*\}", lambda match: f"{{{_name_of(match[1])}}}", caution.words)
        for caution in CAUTIONS.values()
    ]
    return [
        *_BECAUSE,
        *_EXPERIMENTS,
        *_UNLISTED,
        *_SIGNALS,
        *_ALARMS,
        *_COMMISSIONING,
        *_DOUBTS,
        *_REFUSALS,
        *_FLEETS,
        *caution_words,
        *(text for when in WHENS.values() for text in (when.sentence, when.formula)),
        *map(capitalised, PLACES.values()),
        *(word for place in PLACES.values() for word in place.words),
        *_MECHANISMS,
    ]


def _name_of(field: str) -> str:
    """The name of a value in a template, from that of a field such as ``limits.supply[0]``."""
    return "_".join(re.findall(r"\w+", field))


def retold(sentence: str) -> str:
    """A stored English sentence in the chosen language; unchanged if it has no template."""
    is_english = language_code() == ENGLISH.code
    return sentence if is_english else _by_template(sentence) or sentence


def _by_template(text: str) -> str:
    """A text in the chosen language; empty if it has no template there."""
    if (translated := tr(text)) != text:
        return translated
    for template, pattern in _patterns():
        if match := pattern.fullmatch(text):
            values = {
                name: value if name in _AS_WRITTEN else _value(value)
                for name, value in match.groupdict().items()
            }
            return tr(template, **values)
    finding, _, action = text.partition(": ")
    parts = [_by_template(part) for part in (finding, action) if part != text]
    return ": ".join(parts) if len(parts) == 2 and all(parts) else ""


def _value(text: str) -> str:
    """A value of a template in the chosen language: a text, sizes, names or a number."""
    return _by_template(text) or _each(text, _size) or _each(text, _name) or notation_within(text)


@cache
def _patterns() -> list[tuple[str, re.Pattern[str]]]:
    """The templates that have values, the longest first, each with a pattern for these values."""
    patterns = []
    for template in sorted(templates(), key=len, reverse=True):
        pieces = re.split(r"\{(\w+)\}", template)
        if len(pieces) > 1:
            pattern = "".join(
                _group(piece, pieces[:position]) if position % 2 else re.escape(piece)
                for position, piece in enumerate(pieces)
            )
            patterns.append((template, re.compile(pattern)))
    return patterns


def _group(name: str, before: Sequence[str]) -> str:
    """A pattern for a value of a template, which may stand in it several times."""
    if name in before[1::2]:
        return f"(?P={name})"
    texts = "|".join(re.escape(capitalised(place)) for place in PLACES.values())
    return f"(?P<{name}>{texts})" if name == "begin" else f"(?P<{name}>.+?)"


def _each(text: str, part: Callable[[str], str]) -> str:
    """A list with each of its parts in the chosen language; empty unless all are known."""
    pieces = re.split(r"(, | and )", text)
    translated = [part(piece) for piece in pieces[::2]]
    if not all(translated):
        return ""
    conjunction = tr("and")
    between = [", " if piece == ", " else f" {conjunction} " for piece in pieces[1::2]]
    return "".join(word + gap for word, gap in zip(translated, [*between, ""], strict=True))


def _size(text: str) -> str:
    """A name with its size; empty if the text is none."""
    match = _SIZE.fullmatch(text)
    return f"{tr(match[1])} {notation_within(match[2])}" if match else ""


def _name(text: str) -> str:
    """A name in the chosen language; empty if it is unknown."""
    words = text.replace("blow_off", "blow-off").replace("_", " ")
    translated = tr(words)
    return translated if translated != words else ""
