"""What people read about a diagnosis, on the terminal and on one page."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rigs
from matplotlib.text import Annotation
from written_pages import ENGLISH_WORDS, visible

from twin.diagnosis import drawing
from twin.diagnosis.answer import INDEPENDENT, Diagnosis, _close_runners_up, diagnose
from twin.diagnosis.drawing import as_narrow_svg, as_svg
from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis, collect
from twin.diagnosis.fit import Fitted
from twin.diagnosis.held_out import Judged, judge
from twin.diagnosis.log_picture import (
    cycle_rms,
    draw_log,
    size_over_log,
)
from twin.diagnosis.phase_pictures import (
    Laid,
    acting,
    draw_left,
    draw_phases,
    healthy_sigma,
    laid_over,
    off_in,
    signatures,
    unseen,
    worst_kind,
)
from twin.diagnosis.pictures import (
    Found,
    draw_cycle,
    draw_ranking,
    worst_cycle,
)
from twin.diagnosis.report import in_words, write_report
from twin.diagnosis.residual_covariance import covariance
from twin.diagnosis.search import Search
from twin.diagnosis.text import Times, certainty, when
from twin.errors import SourceError
from twin.inference.unmodelled import Odds
from twin.languages.choice import language_of
from twin.languages.texts import speaking
from twin.model.courses import Cause, Course
from twin.model.effects import EFFECTS
from twin.model.mechanism import MECHANISMS
from twin.model.term import KINDS, Term
from twin.monitor.bins import Floats
from twin.monitor.healthy import ModelError
from twin.signals import MBAR

ONSET_S = 10.0
FITTED, HELD_OUT = [1, 3, 5], [2, 4, 6]
VERDICTS = ("consistent", "explained", "two", "unlisted", "insufficient")
BEFORE = {
    "rms_mbar": 21.34,
    "max_mbar": 34.8,
    "evacuation_time_error_pct": 9.37,
    "h2_time_error_pct": 8.18,
    "level_rms_mbar": 0.4321,
    "leftover_sigma": 2.99,
}
AFTER = {
    "rms_mbar": 1.131,
    "max_mbar": 9.038,
    "evacuation_time_error_pct": 0.1574,
    "h2_time_error_pct": 0.1312,
    "level_rms_mbar": 0.4009,
    "leftover_sigma": 1.161,
}
LEAK = {
    "effect": "leakage",
    "course": "step",
    "onset_s": ONSET_S,
    "parameters": {
        "sonic_flow": {"value": 1.982, "unit": "sl/min", "low95": 1.925, "high95": 2.038}
    },
    "probability": 0.83,
    "not_separable_from": ["porous_leakage"],
    "why": "Air leaks in through an opening on the vacuum side (sonic flow 1.98 sl/min).",
    "onset_low95_s": 9.91,
    "onset_high95_s": 10.07,
}
BLOW_OFF = {
    "effect": "weak_blow_off",
    "course": "ramp",
    "onset_s": 0.0,
    "parameters": {
        "loss": {"value": 1440.0, "unit": "%/h", "low95": 1300.0, "high95": 1580.0, "at_end": 10.0}
    },
    "probability": 0.97,
    "not_separable_from": [],
    "why": "The blow-off flow is too small (loss 10 % by now, and growing).",
}
DELAY = {
    "effect": "response_delay",
    "course": "intermittent",
    "onset_s": None,
    "parameters": {"delay": {"value": 8.0, "unit": "ms", "low95": 7.0, "high95": 9.0}},
    "probability": 0.7,
    "not_separable_from": [],
    "why": "The suction valve acts later (delay 8 ms, in 2 cycles only).",
    "cycles": [3, 4],
    "share_pct": 33.33,
}
STEP = Cause("leakage", {"sonic_flow": 1.982}, Course.STEP, ONSET_S)
RAMP = Cause("weak_blow_off", {"loss": 1440.0}, Course.RAMP)
SOME = Cause("response_delay", {"delay": 8.0}, Course.INTERMITTENT, cycles=frozenset({3, 4}))
HYPOTHESES: dict[str, Hypothesis] = {
    "healthy": HEALTHY,
    "leak": (STEP,),
    "two": (STEP, RAMP),
    "some": (SOME,),
}
LEFT = {"where": "blow_off", "depends_on": ["time"], "shape": "+22.5 mbar in the mean"}


@cache
def evidence() -> Evidence:
    samples, _ = rigs.recorded("test_rig", 25.0, ("leakage=2@10",))
    here = collect(rigs.config("test_rig"), rigs.cut(samples, 10_000))
    assert here.judged == sorted(FITTED + HELD_OUT)
    return here


@cache
def judged(name: str) -> Judged:
    hypothesis = HYPOTHESES[name]
    return judge(evidence(), covariance(evidence(), hypothesis).of(HELD_OUT), hypothesis)


def fitted(*causes: Cause, left: float) -> Fitted:
    size = len(causes)
    return Fitted(causes, np.ones(size), np.eye(size), 100.0 * left**2, 100.0 * left**2, 100)


@cache
def searched(name: str) -> Search:
    """What a search could have found, with a look-alike of the first cause."""
    hypothesis = HYPOTHESES[name]
    known = covariance(evidence(), hypothesis)
    alike = fitted(Cause("porous_leakage", {}), *hypothesis[1:], left=1.02)
    ends = np.full(len(hypothesis), 0.9), np.full(len(hypothesis), 1.1)
    singles = [("leakage", 1.0), ("porous_leakage", 1.02), ("sensor_gain", 1.8)]
    ranking = [fitted(Cause(name, {}), left=left) for name, left in singles]
    if not hypothesis:
        return Search(known, 100.0, None, ranking, [], ends, [])
    found = fitted(*hypothesis, left=0.97)
    rivals = [[alike], *[[] for _ in hypothesis[1:]]]
    return Search(known, 900.0, found, ranking, rivals, ends, [(9.9, 10.1)] * len(hypothesis))


def answer(**changed: Any) -> dict[str, Any]:
    """An answer as the contract has it, of a leak that was found."""
    found = {
        "format": "ejector-twin-diagnosis/1",
        "log": "night.mcap",
        "asset": {"type": "compact-ejector-35", "id": "rig-01"},
        "verdict": "explained",
        "causes": [LEAK],
        "runners_up": [
            {"effect": "porous_leakage", "course": "step", "leftover_sigma": 1.02},
            {"effect": "sensor_gain", "course": "step", "leftover_sigma": 1.779},
        ],
        "unlisted": None,
        "cycles": {"total": evidence().cycles, "fitted": FITTED, "held_out": HELD_OUT},
        "baseline": BEFORE,
        "extended": AFTER,
        "gain": {
            "rms_reduction_pct": 95.3,
            "low95": 94.74,
            "high95": 95.97,
            "share_of_achievable_pct": 98.1,
        },
        "next_experiment": "hold for 10 s with the nozzle off",
    }
    return found | changed


def diagnosis(name: str, text: dict[str, Any]) -> Diagnosis:
    return Diagnosis(
        evidence=evidence(),
        data_set="0123456789abcdef",
        search=searched(name),
        hypothesis=HYPOTHESES[name],
        terms=(),
        before=judged("healthy"),
        after=judged(name),
        held_out=HELD_OUT,
        json=text,
    )


def explained(**changed: Any) -> Diagnosis:
    return diagnosis("leak", answer(**changed))


def two() -> Diagnosis:
    return diagnosis("two", answer(causes=[LEAK, BLOW_OFF]))


def unexplained(verdict: str, **changed: Any) -> Diagnosis:
    """Nothing is worth naming."""
    nothing = {"causes": [], "runners_up": [], "extended": BEFORE, "next_experiment": None}
    return diagnosis("healthy", answer(verdict=verdict, **(nothing | changed)))


def part(**changed: Any) -> Diagnosis:
    """A cause that leaves much."""
    return explained(verdict="unlisted", unlisted=LEFT, **changed)


def insufficient() -> Diagnosis:
    samples, _ = rigs.recorded("test_rig", 7.0)
    return diagnose(rigs.config("test_rig"), [samples], "short.mcap", lambda _what: None)


def made(verdict: str) -> Diagnosis:
    match verdict:
        case "explained":
            return explained()
        case "two":
            return two()
        case "insufficient":
            return insufficient()
        case "unlisted":
            return unexplained(verdict, unlisted=LEFT)
    return unexplained(verdict)


@cache
def found(verdict: str) -> Found:
    return Found.of(made(verdict))


def laid(verdict: str) -> Laid:
    return laid_over(evidence(), acting(found(verdict)))


def page_of(diagnosis: Diagnosis, folder: Path) -> str:
    path = folder / "report.html"
    write_report(diagnosis, path)
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The page of each verdict; drawing takes its time."""
    folder = tmp_path_factory.mktemp("pages")
    return {verdict: page_of(made(verdict), folder) for verdict in VERDICTS}


class Outline(HTMLParser):
    """Checks that every element is closed, and collects what stands where."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str | None]]] = []
        self.headings: list[str] = []
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))
        if tag != "meta":
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("h1", "h2", "h3"):
            self.headings.append(data)

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.seen if name == tag]


# --- the page -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("verdict", VERDICTS)
def test_page_needs_nothing_from_outside(verdict: str, pages: dict[str, str]) -> None:
    page = pages[verdict]
    outside = re.sub(r'xmlns(:\w+)?="[^"]*"', "", page)
    assert "://" not in outside
    assert not re.search(r"<(script|link|iframe|img|object)\b|@import|url\((?!#)", outside)
    assert len(page.encode()) < 2_000_000


@pytest.mark.parametrize("verdict", VERDICTS)
def test_page_is_whole(verdict: str, pages: dict[str, str]) -> None:
    outline = Outline(pages[verdict])
    ids = [attributes["id"] for _, attributes in outline.seen if "id" in attributes]
    assert len(ids) == len(set(ids))  # pictures share the page, and refer to their parts by id
    assert len(outline.all("h1")) == 1
    assert outline.seen[0] == ("html", {"lang": "en"})


@pytest.mark.parametrize(
    ("verdict", "colour", "words"),
    [
        ("consistent", "#1b6e2e", "Nothing wrong"),
        ("explained", "#a31515", "Cause found"),
        ("unlisted", "#a31515", "Something unknown"),
        ("insufficient", "#555555", "No answer from this log"),
    ],
)
def test_banner_says_the_verdict_in_colour_and_words(
    verdict: str, colour: str, words: str, pages: dict[str, str]
) -> None:
    page = pages[verdict]
    assert f".banner {{ background: {colour};" in page
    assert f"{words} – compact-ejector-35 rig-01</p>" in page


def test_order_is_sentence_then_steps_then_pictures_then_numbers(pages: dict[str, str]) -> None:
    headings = Outline(pages["explained"]).headings
    deviation = headings.pop(6)
    assert headings == [
        "Air leaks in through an opening on the vacuum side – 1.98 sl/min, since 10.0 s into the"
        " log.",
        "What to do",
        "Leakage",
        "Next recording",
        "Leakage (1.98 sl/min) explains the deviation: 21.3 → 1.13 mbar rms",
        "Over time: leakage since 10.0 s into the log",
        "This log cannot tell leakage from porous leakage",
        "Numbers",
    ]
    assert re.fullmatch(
        r"The deviation is largest in suction: [\d.]+ → [\d.]+ mbar rms in the mean", deviation
    )


def test_two_causes_have_a_card_a_course_and_a_row_each(pages: dict[str, str]) -> None:
    headings = Outline(pages["two"]).headings
    assert headings[0] == (
        "2 causes together: leakage (1.98 sl/min, since 10.0 s into the log) and weak blow-off"
        " (10 %, growing from the beginning of the log)."
    )
    assert headings[2:4] == ["Leakage", "Weak blow-off"]
    cells = " | ".join(re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", pages["two"]))
    assert "weak blow-off | growing from the beginning of the log | loss | 1440 | 1300" in cells
    assert "loss at the end | 10 |  |  | %" in cells


def test_without_a_cause_no_cause_is_claimed(pages: dict[str, str]) -> None:
    consistent = Outline(pages["consistent"]).headings
    assert consistent[1:] == [
        "What to do",
        "The unchanged twin fits: 21.3 mbar rms",
        "Over time: no cause comes or goes",
        "Every phase is as in healthy cycles",
        "Numbers",
    ]
    unlisted = Outline(pages["unlisted"]).headings
    assert unlisted[0] == (
        "No listed cause explains the deviation in blow-off: +22.5 mbar in the mean."
    )
    assert unlisted[2:4] == [
        "Something that no listed cause explains",
        "The unchanged twin does not fit: 21.3 mbar rms",
    ]
    assert "What no listed cause explains: blow-off: +22.5 mbar in the mean" in unlisted
    assert "<dt>it depends on</dt><dd>time</dd>" in pages["unlisted"]


def test_a_cause_that_leaves_much_is_called_a_part(tmp_path: Path) -> None:
    page = page_of(part(causes=[LEAK | {"not_separable_from": []}]), tmp_path)
    assert "<h1>Leakage (1.98 sl/min) explains a part; no listed cause explains what" in page
    assert "Leakage (1.98 sl/min) explains only a part of the deviation" in page
    assert "Leakage leaves least, but more than healthy cycles have" in page
    assert "83 %" not in page  # a share among causes that do not explain it is no certainty


def test_insufficient_shows_the_reason_and_no_pictures(pages: dict[str, str]) -> None:
    page = pages["insufficient"]
    assert "record at least 4 complete ones" in page
    assert "<dt>cycles complete in the log</dt><dd>2</dd>" in page
    assert "<svg" not in page
    assert "<table" not in page


def test_tables_carry_the_numbers(pages: dict[str, str]) -> None:
    page = pages["explained"]
    cells = re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", page)
    course = "since 10.0 s into the log (95 %: 9.9 s to 10.1 s)"
    for row in (
        ["leakage", course, "sonic flow", "1.98", "1.93", "2.04", "sl/min"],
        ["rms deviation", "21.3", "1.13", "mbar"],
        ["error of the time to 600 mbar", "9.37", "0.157", "%"],
        ["error of the time to H2", "8.18", "0.131", "%"],
        ["how sure", "", "95 %: 94.7 to 96", "%"],
        ["share of what can be gained", "", "98.1", "%"],
        ["sensor gain", "step", "1.78"],
    ):
        assert " | ".join(row) in " | ".join(cells)
    assert "<dt>fitted on</dt><dd>1, 3, 5</dd>" in page
    assert (
        "<dt>held out, to judge by</dt><dd>2, 4, 6, but for when it began, read from all</dd>"
        in page
    )
    assert "<dt>log</dt><dd>night.mcap</dd>" in page
    assert "volume 755.7 ml" in page  # tank, 165 mm of 6 mm tube, and what is in the ejector
    assert "ejector-twin 0." in page


def test_without_a_cause_the_table_has_no_gain(pages: dict[str, str]) -> None:
    page = pages["consistent"]
    assert "unchanged twin</th>" in page
    assert '<td class="number">95.3' not in page
    assert "what can be gained" not in page


@pytest.mark.slow
def test_all_text_is_escaped(tmp_path: Path) -> None:
    evil = "<script>alert('&')</script>"
    asset = {"type": evil, "id": '"' + evil}
    left = {"where": "hold", "depends_on": [evil], "shape": evil}
    page = page_of(
        explained(asset=asset, log=evil, next_experiment=evil, verdict="unlisted", unlisted=left),
        tmp_path,
    )
    assert "<script" not in page
    assert page.count("&lt;script&gt;alert(&#x27;&amp;&#x27;)") >= 9
    assert "$" not in re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL)


def test_same_diagnosis_gives_the_same_bytes(pages: dict[str, str], tmp_path: Path) -> None:
    assert page_of(explained(), tmp_path) == pages["explained"]


def test_a_report_that_cannot_be_written_is_an_error_for_people(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"missing/report\.html: cannot be written") as caught:
        write_report(insufficient(), tmp_path / "missing" / "report.html")
    assert "folder" in caught.value.hint


# --- in another language --------------------------------------------------------------------------

RECORD = (
    "record cycles with a blow-off of 1 s: leakage and porous_leakage are predicted to part by"
    " 12 sigma"
)
SHAPE = {"where": "hold", "depends_on": ["vacuum"]} | {
    "shape": "up to +22.5 mbar of pressure, at 31 ms after it begins"
}


@pytest.fixture(scope="module")
def german(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """German pages; all of their visible texts, pictures and alternatives included."""
    folder = tmp_path_factory.mktemp("german")
    values = {"loss": 43.5, "sets_in": 3.25, "fades": 10.5}
    found = MECHANISMS["suction_nozzle_on_slowly"]
    mechanism = {
        "name": found.name,
        "sentence": found.sentence(values),
        "formula": found.formula(values),
        "parameters": {"loss": {"value": 43.5, "unit": "%", "low95": 36.3, "high95": 51.9}},
        "not_separable_from": [MECHANISMS["suction_always"].sentence({"loss": 40.5})]
        if "suction_always" in MECHANISMS
        else [],
    }
    diagnoses = {
        "explained": explained(next_experiment=RECORD),
        "two": diagnosis("two", answer(causes=[LEAK, BLOW_OFF], next_experiment=RECORD)),
        "some": diagnosis("some", answer(causes=[DELAY], next_experiment=None)),
        "part": explained(verdict="unlisted", unlisted=SHAPE, next_experiment=RECORD),
        "unlisted": unexplained("unlisted", unlisted=SHAPE | {"mechanism": mechanism}),
        "consistent": unexplained("consistent"),
        "insufficient": insufficient(),
    }
    pages = {}
    for verdict, answered in diagnoses.items():
        write_report(answered, folder / "a.html", language_of("de", "language"))
        pages[verdict] = (folder / "a.html").read_text(encoding="utf-8")
    return pages


@pytest.mark.slow
@pytest.mark.parametrize("name", ["explained", "two", "some", "part", "unlisted", "consistent"])
def test_a_german_page_is_german_in_each_word_and_number(name: str, german: dict[str, str]) -> None:
    text = visible(german[name])
    assert '<html lang="de">' in german[name]
    assert ENGLISH_WORDS.findall(text) == []
    assert re.findall(r"\d\.\d", text) == []
    assert len(re.findall(r"\d,\d", text)) > 10


def test_why_there_is_no_answer_is_german(german: dict[str, str]) -> None:
    text = visible(german["insufficient"])
    assert "mindestens 4 vollständige nacheinander aufzeichnen" in text
    assert ENGLISH_WORDS.findall(text) == []


def test_a_german_sentence_has_the_form_for_its_count(german: dict[str, str]) -> None:
    assert "Leckage (1,98 sl/min) erklärt die Abweichung" in german["explained"]
    assert "schwaches Abblasen (10 %) erklären die Abweichung" in german["two"]
    assert "2 Ursachen zusammen: Leckage" in german["two"]


# --- the pictures ---------------------------------------------------------------------------------


def test_a_picture_for_a_phone_leaves_the_other_as_it_is() -> None:
    picture = draw_cycle(found("explained"), 4, "")
    wide = as_svg(picture)
    narrow = as_narrow_svg(picture)
    assert as_svg(picture) == wide
    sizes = [float(ET.fromstring(svg).attrib["width"].removesuffix("pt")) for svg in (wide, narrow)]
    assert sizes == pytest.approx([72.0 * drawing.WIDTH, 72.0 * drawing.NARROW])
    ids = [set(re.findall(r'\bid="([^"]+)"', svg)) for svg in (wide, narrow)]
    assert ids[0]
    assert not ids[0] & ids[1]  # both stand in one page


def test_names_of_short_phases_do_not_touch_on_a_phone() -> None:
    """Of four phases the third is short: its name stands above that of the second."""
    with drawing.empty("names", 2.0, "") as picture:
        axes = picture.subplots()
        axes.set_xlim(0.0, 100.0)
        for x, name in ((30.0, "suction"), (68.0, "hold"), (75.0, "blow-off"), (92.0, "idle")):
            picture.name_above(axes, x, name)

    def raised() -> list[bool]:
        heights = [text.xyann[1] for text in axes.texts if isinstance(text, Annotation)]
        return [height > drawing.ABOVE for height in heights]

    picture.resize(drawing.NARROW, 2.0)
    assert raised() == [False, False, True, False]
    picture.resize(drawing.WIDTH, 2.0)
    assert raised() == [False] * 4


def test_pictures_are_svg_with_a_text_alternative() -> None:
    one = found("explained")
    for svg in (
        as_svg(draw_cycle(one, 4, 'a "cycle"')),
        as_svg(draw_log(one, 'a "cycle"')),
        as_svg(draw_phases(one, laid("explained"), 'a "cycle"')),
        as_svg(draw_left(found("unlisted"), laid("unlisted"), 'a "cycle"')),
        as_svg(draw_ranking(one, 'a "cycle"')),
    ):
        root = ET.fromstring(svg)
        assert root.get("role") == "img"
        assert root.get("aria-label") == 'a "cycle"'
        assert len(svg) < 200_000


@pytest.mark.parametrize(
    ("names", "columns"), [(["measured"] * 4, 4), (["measured"] * 5, 3), (["m" * 40] * 4, 2)]
)
def test_a_legend_has_as_many_columns_as_fit(names: list[str], columns: int) -> None:
    assert drawing.legend_columns(names, drawing.WIDTH) == columns


def test_a_long_name_beside_a_low_panel_has_several_lines() -> None:
    with speaking(language_of("de", "language")):
        picture = draw_log(found("two"), "")
    assert picture.axes[2].get_ylabel() == "schwaches\nAbblasen\n(%)"


def test_cycle_is_drawn_before_and_after_with_a_cause_only() -> None:
    assert "expected with leakage" in as_svg(draw_cycle(found("explained"), 4, ""))
    healthy = as_svg(draw_cycle(found("consistent"), 4, ""))
    assert "expected: unchanged twin" in healthy
    assert "expected with" not in healthy


def test_worst_cycle_is_a_held_out_one_of_the_leak() -> None:
    assert worst_cycle(found("explained")) in (4, 6)


def test_rms_of_a_cycle_is_that_of_its_rows() -> None:
    here, before = evidence(), judged("healthy")
    rms = cycle_rms(here, before)
    assert np.isnan(rms[0])  # the first cycle is not judged
    rows = np.arange(here.starts[5], here.starts[6])
    off = (here.samples["pressure"][rows] - before.expected[rows]) / MBAR
    assert rms[5] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-6)
    assert max(rms[1:3]) < 3.0
    assert min(rms[4:]) > 15.0  # the leak opens in cycle 3
    assert max(cycle_rms(here, judged("leak"))[1:]) < 3.0


def test_log_shows_fitted_and_held_out_and_how_each_cause_runs() -> None:
    svg = as_svg(draw_log(found("two"), ""))
    for text in (
        "unchanged twin, fitted",
        "unchanged twin, held out",
        "with all causes, held out",
        "leakage begins",
        ">(sl/min)<",
        ">weak blow-off<",
        "time in the log (s)",
    ):
        assert text in svg
    healthy = as_svg(draw_log(found("consistent"), ""))
    assert "with " not in healthy
    assert "begins" not in healthy


def test_log_leaves_the_marks_of_held_out_cycles_empty() -> None:
    svg = as_svg(draw_log(replace(found("explained"), held_out=[2, 4]), ""))
    empty = [
        len(re.findall(f"fill: #ffffff; stroke: {colour}", svg))
        for colour in (drawing.BEFORE, drawing.AFTER)
    ]
    assert empty == [3, 3]  # one of each in the legend


def test_log_marks_the_cycles_of_an_intermittent_cause() -> None:
    some = Found.of(diagnosis("some", answer(causes=[DELAY])))
    assert "response delay is there" in as_svg(draw_log(some, ""))


def test_a_long_log_is_drawn_over_minutes() -> None:
    here = evidence()
    slow = here.samples.copy()
    slow["time_ns"] = here.begin_ns + (slow["time_ns"] - here.begin_ns) * 10
    late = replace(found("explained"), evidence=replace(here, samples=slow))
    assert "time in the log (min)" in as_svg(draw_log(late, ""))


def size_of(cause: Cause, known: dict[str, Any]) -> tuple[Floats, Floats]:
    (parameter,) = EFFECTS[cause.effect].parameters
    return size_over_log(evidence(), cause, parameter, known["parameters"][parameter.name])


def test_size_over_the_log_is_that_of_its_course() -> None:
    seconds, (step, low, high) = size_of(STEP, LEAK)
    assert set(step[seconds < ONSET_S]) == {0.0}
    assert seconds[step > 0.0][0] == ONSET_S
    assert (low[-1], step[-1], high[-1]) == pytest.approx((1.925, 1.982, 2.038))
    seconds, (ramp, low, _) = size_of(RAMP, BLOW_OFF)
    np.testing.assert_allclose(ramp, 1440.0 / 3600.0 * seconds)
    np.testing.assert_allclose(low, 1300.0 / 3600.0 * seconds)
    seconds, (some, *_) = size_of(SOME, DELAY)
    starts = evidence().seconds[evidence().starts[:-1]]
    assert seconds[some > 0.0][0] == starts[3]
    np.testing.assert_array_equal(some > 0.0, (seconds >= starts[3]) & (seconds < starts[5]))


def test_size_of_what_replaces_a_coefficient_begins_at_the_data_sets_own() -> None:
    film = EFFECTS["heat_exchange"].parameters[0].neutral(evidence().theta)
    known = {"value": film + 4.0, "unit": "W/(m²·K)", "low95": film + 3.0, "high95": film + 6.0}
    cause = Cause("heat_exchange", {"film_coefficient": film + 4.0}, Course.STEP, ONSET_S)
    _, sizes = size_of(cause, {"parameters": {"film_coefficient": known}})
    np.testing.assert_allclose(sizes[:, 0], film)
    np.testing.assert_allclose(sizes[:, -1] - film, [4.0, 3.0, 6.0])


def test_cycles_laid_over_each_other_are_those_with_the_cause_at_work() -> None:
    assert acting(found("explained")).tolist() == [4, 6]
    assert acting(found("consistent")).tolist() == HELD_OUT
    assert unseen(found("explained")).tolist() == HELD_OUT
    only = replace(found("explained"), held_out=[1, 2])
    assert acting(only).tolist() == [3, 4, 5, 6]  # nothing of it was held out


def test_means_over_cycles_are_of_the_same_time_since_switching() -> None:
    here, one = evidence(), laid("explained")
    means = one.mean(here.bins.time[one.bins])
    np.testing.assert_allclose(means, here.bins.time[one.bins][_first(one.place)], atol=1e-9)
    assert (np.diff(one.ms[one.kind == KINDS.index("suction")]) > 0.0).all()
    first = one.ms[one.kind == KINDS.index("suction")][0]
    last = one.ms[one.kind == KINDS.index("suction")][-1]
    assert first <= 1.0
    assert 1000.0 < last < 2500.0
    # In suction the leak leaves more and more of the deviation, and the step takes it away.
    suction = (one.kind == KINDS.index("suction")) & one.enough
    off = one.mean(judged("healthy").off[one.bins])[suction]
    assert abs(off[0]) < 2.0
    assert off[-1] > 20.0
    assert np.abs(one.mean(judged("leak").off[one.bins])[suction]).max() < 5.0
    assert worst_kind(found("explained"), one)[0] == "suction"


def _first(place: Sequence[int]) -> Any:
    return np.unique(place, return_index=True)[1]


def test_healthy_band_is_of_a_mean_and_grows_with_what_healthy_cycles_have() -> None:
    here = replace(evidence(), another_day=False)  # what the day leaves open is common to all
    both, one = laid_over(here, np.array([4, 6])), laid_over(here, np.array([4]))
    several, single = healthy_sigma(here, both), healthy_sigma(here, one)
    assert several.mean() < 0.95 * single.mean()
    rough, rougher = (healthy_sigma(with_error(mbar), both) for mbar in (100.0, 200.0))
    np.testing.assert_allclose(rougher / rough, 2.0, rtol=0.05)


def with_error(mbar: float) -> Evidence:
    error = ModelError(after_ms=(0.0,), common_mbar=(mbar,), alone_mbar=(mbar,))
    healthy = evidence().healthy.model_copy(update={"error": dict.fromkeys(KINDS, error)})
    return replace(evidence(), healthy=healthy)


def test_phases_show_the_signature_and_what_is_left_with_a_cause_only() -> None:
    marks = ("healthy (95 %)", "mean of 2 cycles", "signature of leakage", ">left over<")
    svg = as_svg(draw_phases(found("explained"), laid("explained"), ""))
    assert [mark in svg for mark in marks] == [True, True, True, True]
    svg = as_svg(draw_phases(found("consistent"), laid("consistent"), ""))
    assert [mark in svg for mark in marks] == [True, False, False, False]


def test_two_causes_have_a_signature_each_beside_the_common_one() -> None:
    (total, *_), *alone = signatures(found("two"), laid("two"))
    assert [label for *_, label in alone] == ["of leakage", "of weak blow-off"]
    added = sum(made for made, *_ in alone)
    assert np.sqrt(np.mean((added - total) ** 2)) < 0.1 * np.sqrt(np.mean(total**2))
    assert len(signatures(found("explained"), laid("explained"))) == 1
    assert signatures(found("consistent"), laid("consistent")) == []


def test_running_only_the_cycles_drawn_tells_the_same() -> None:
    one = laid_over(evidence(), np.array([2, 5]))
    before, after = off_in(evidence(), one, [HEALTHY, (STEP,)]).T
    in_full = [judged(name).off[one.bins] for name in ("healthy", "leak")]
    np.testing.assert_allclose(before, in_full[0], atol=1.0)  # the vessel's warmth swings in slowly
    np.testing.assert_allclose(before - after, in_full[0] - in_full[1], atol=0.1)


def test_what_is_left_is_drawn_over_time_and_vacuum_with_its_term() -> None:
    term = Term(where="blow_off", over="vacuum", at=(0.0, 700.0), mbar=(1.0, 20.0))
    other = Term(where="idle", over="vacuum", at=(0.0,), mbar=(1.0,))
    plain = as_svg(draw_left(found("unlisted"), laid("unlisted"), ""))
    assert "left in blow-off" in plain
    assert "(mbar below ambient)" in plain
    assert "term in" not in plain
    with_term = replace(found("unlisted"), terms=[term, other])
    svg = as_svg(draw_left(with_term, laid("unlisted"), ""))
    assert "term in blow-off" in svg
    assert "term in idle" not in svg


def test_a_term_is_part_of_the_extended_model(tmp_path: Path) -> None:
    term = Term(where="blow_off", over="time", at=(0.0, 300.0), mbar=(1.0, 20.0))
    one = unexplained("unlisted", unlisted=LEFT, extended=AFTER)
    page = page_of(replace(one, terms=(term,), after=judged("leak")), tmp_path)
    assert "does not fit: 21.3 → 1.13 mbar rms with a term from data" in page
    assert "expected with a term from data" in page
    assert "Dashed: the term that takes it away" in page
    assert "less rms deviation" in page
    assert "  gain           95.3 % less" in in_words(one)


def test_a_mechanism_is_told_with_its_formula_and_all_that_it_may_be_as_well(
    tmp_path: Path,
) -> None:
    size = {"value": 43.4, "unit": "%", "low95": 36.3, "high95": 51.9}
    mechanism = {
        "name": "suction_nozzle_on",
        "sentence": "The ejector moves less air (loss 43.4 %), while the nozzle runs",
        "formula": "suction capacity changes by loss 43.4 % times the share; share = jet",
        "parameters": {"loss": size},
        "not_separable_from": ["First another one", "Then one more"],
    }
    unlisted = LEFT | {"mechanism": mechanism}
    one = unexplained("unlisted", unlisted=unlisted, extended=AFTER, next_experiment="record it")
    page, words = page_of(one, tmp_path), in_words(one)
    assert "with the mechanism" in page
    for text in (mechanism["formula"], "First another one", "Then one more", "36.3 to 51.9"):
        assert text in page
        assert text in words
    assert "What suits best: The ejector moves less air" in words
    assert page.count("Record it.") == 1


def test_people_are_told_the_cycles_numbers_in_the_log(tmp_path: Path) -> None:
    late = replace(evidence(), numbers=evidence().numbers + 100)
    page = page_of(replace(explained(), evidence=late), tmp_path)
    assert "Cycle 106 of" in page or "Cycle 104 of" in page
    assert "Mean over the cycles 104, 106" in page


def test_ranking_marks_the_cause_and_its_look_alikes() -> None:
    svg = as_svg(draw_ranking(found("explained"), ""))
    for text in ("▶ leakage", "≈ porous leakage (look-alike)", ">sensor gain<", "no cause"):
        assert text in svg
    assert svg.count("porous leakage") == 1  # not once more among the others
    assert "3.00" in svg  # of no cause: 900 over 100 residuals
    assert "▶" not in as_svg(draw_ranking(found("consistent"), ""))
    assert "▶ leakage + weak blow-off" in as_svg(draw_ranking(found("two"), ""))


# --- in words -------------------------------------------------------------------------------------

NO_CLOCK = Times(begin_s=0.0, log_begin_ns=None, now_ns=0)


def test_words_for_a_cause() -> None:
    assert in_words(explained()).splitlines() == [
        "explained: Air leaks in through an opening on the vacuum side – 1.98 sl/min, since 10.0 s"
        " into the log.",
        "  cause          leakage",
        "  size           sonic flow 1.98 sl/min (95 %: 1.93 to 2.04)",
        "  when           since 10.0 s into the log (95 %: 9.9 s to 10.1 s)",
        "  how sure       83 %; this log cannot tell it from porous leakage",
        f"  look at        {EFFECTS['leakage'].look_at}",
        f"  or it may be   porous leakage; then look at {EFFECTS['porous_leakage'].look_at}",
        "  next recording hold for 10 s with the nozzle off",
        "  unseen cycles  rms 21.3 → 1.13 mbar, max 34.8 → 9.04 mbar, time to 600 mbar off by"
        " 9.37 → 0.157 %, time to H2 off by 8.18 → 0.131 %, switching levels off by"
        " 0.432 → 0.401 mbar, leftover 2.99 → 1.16 sigma",
        "  gain           95.3 % less rms deviation (95 %: 94.7 to 96), 98.1 % of what can be"
        " gained",
        "  cycles         7; fitted: 1, 3, 5; held out: 2, 4, 6, but for when it began,"
        " read from all",
    ]


@pytest.mark.parametrize(
    ("cause", "short", "long"),
    [
        (
            LEAK | {"onset_s": 754.2, "onset_low95_s": 90.0, "onset_high95_s": 3600.0},
            "since 12 min 34 s into the log",
            "since 12 min 34 s into the log (95 %: 90.0 s to 60 min 0 s)",
        ),
        (LEAK | {"course": "constant"}, "in all of the log", "in all of the log"),
        (
            BLOW_OFF,
            "growing from the beginning of the log",
            "growing from the beginning of the log",
        ),
        (
            BLOW_OFF | {"onset_s": 4.04},
            "growing since 4.0 s into the log",
            "growing since 4.0 s into the log",
        ),
        (DELAY, "in 33.3 % of the cycles", "in 33.3 % of the cycles: 3, 4"),
    ],
)
def test_when_says_the_course(cause: dict[str, Any], short: str, long: str) -> None:
    assert when(cause, NO_CLOCK) == short
    assert when(cause, NO_CLOCK, interval=True) == long


@pytest.mark.parametrize(
    ("cause", "said"),
    [
        (LEAK, "since 14:13:30, 8 min ago, 10.0 s into the log (95 %: 9.9 s to 10.1 s)"),
        (LEAK | {"course": "constant"}, "since 14:13:25, 8 min ago, 5.0 s into the log, or longer"),
        (
            BLOW_OFF | {"onset_s": 5.0},
            "growing since 14:13:25, 8 min ago, 5.0 s into the log, or longer",
        ),
        (BLOW_OFF | {"onset_s": 7.0}, "growing since 14:13:27, 8 min ago, 7.0 s into the log"),
    ],
)
def test_since_is_clock_time_and_age_and_counts_from_the_logs_begin(
    cause: dict[str, Any], said: str
) -> None:
    begin_ns = 1_790_000_000 * 10**9
    times = Times(begin_s=5.0, log_begin_ns=begin_ns, now_ns=begin_ns + 490 * 10**9)
    assert when(cause, times, interval=True) == said


def test_words_for_a_ramp_say_the_rate_and_what_it_has_come_to() -> None:
    said = in_words(two())
    assert "and weak blow-off (10 %, growing from the beginning of the log)." in said
    assert "loss 10 % by the end, growing by 1440 %/h (95 %: 1300 to 1580)" in said
    assert "  how sure       97 %; no other listed cause fits as well" in said


def test_words_of_two_parameters_name_them() -> None:
    shifts = {
        name: {"value": value, "unit": "mbar", "low95": value - 1.0, "high95": value + 1.0}
        for name, value in (("h1_shift", -12.0), ("h2_shift", 8.0))
    }
    drift = LEAK | {"effect": "threshold_drift", "course": "constant", "parameters": shifts}
    first = in_words(explained(causes=[drift])).splitlines()[0]
    assert first.endswith("moved – h1 shift -12 mbar, h2 shift 8 mbar, in all of the log.")


def test_words_without_a_cause() -> None:
    consistent = in_words(made("consistent"))
    assert consistent.startswith("consistent: The ejector does what its twin expects; 21.3 mbar")
    assert "rms 21.3 mbar, max 34.8 mbar" in consistent
    assert "→" not in consistent
    assert "look at" not in consistent
    unlisted = in_words(made("unlisted"))
    assert unlisted.startswith(
        "unlisted: No listed cause explains the deviation in blow-off: +22.5"
    )
    assert "cause  " not in unlisted
    assert "  it depends on  time" in unlisted


def test_words_for_what_is_explained_in_part_only() -> None:
    said = in_words(part())
    assert said.startswith("unlisted: Leakage (1.98 sl/min) explains a part; no listed cause")
    assert "  a part of it   leakage" in said
    assert "how sure" not in said


def test_words_for_a_log_that_cannot_answer() -> None:
    first, *rest = in_words(insufficient()).splitlines()
    assert first.startswith("insufficient: The log cannot answer: only 1 cycle can be judged")
    assert len(rest) == 1
    assert "record again" in rest[0]


def test_a_figure_that_no_cycle_shows_is_a_dash() -> None:
    nothing = {"evacuation_time_error_pct": None}
    said = in_words(explained(baseline=BEFORE | nothing, extended=AFTER | nothing))
    assert "time to 600 mbar off by – → – %" in said


def test_ends_of_an_interval_are_told_apart() -> None:
    narrow = {"low95": 94.96, "high95": 95.04}
    size = {"sonic_flow": {"value": 95.0, "unit": "sl/min"} | narrow}
    onset = {"onset_s": 9.5, "onset_low95_s": 9.49, "onset_high95_s": 9.51}
    one = explained(causes=[LEAK | onset | {"parameters": size}], gain=answer()["gain"] | narrow)
    said = in_words(one)
    assert "sonic flow 95 sl/min (95 %: 94.96 to 95.04)" in said
    assert "since 9.5 s into the log (95 %: 9.49 s to 9.51 s)" in said
    assert "less rms deviation (95 %: 94.96 to 95.04)" in said
    late = LEAK | {"onset_s": 754.2, "onset_low95_s": 754.1, "onset_high95_s": 754.3}
    assert when(late, NO_CLOCK, interval=True).endswith("(95 %: 12 min 34.1 s to 12 min 34.3 s)")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("held_out", "reduction", "why"),
    [
        ([2], 95.3, "1 held-out cycle cannot tell how sure that is"),
        ([2, 4, 6, 8], 95.3, "4 held-out cycles cannot tell how sure that is"),
        ([2, 4, 6], 0.0, "no cause changes the pressure between switchings"),
    ],
)
def test_a_gain_without_an_interval_says_why(
    held_out: list[int], reduction: float, why: str, tmp_path: Path
) -> None:
    gain = answer()["gain"] | {"rms_reduction_pct": reduction, "low95": None, "high95": None}
    one = explained(gain=gain, cycles=answer()["cycles"] | {"held_out": held_out})
    assert f"% less rms deviation ({why})" in in_words(one)
    assert why in page_of(one, tmp_path)


def test_the_only_cause_left_is_no_certainty() -> None:
    """It may be one that nobody listed: the probability counts that."""
    alone = certainty(LEAK | {"probability": 0.96, "not_separable_from": []})
    assert alone == "96 %; no other listed cause fits as well"
    unsure = certainty(LEAK | {"probability": 0.58, "not_separable_from": []})
    assert unsure == "58 %; other causes, listed or not, are not ruled out"


def test_words_stay_short_for_a_long_log() -> None:
    cycles = {"total": 400, "fitted": list(range(1, 400, 2)), "held_out": list(range(2, 400, 2))}
    assert "held out: 2, 4, 6 … 398 (199 cycles)" in in_words(explained(cycles=cycles))


@pytest.mark.parametrize(
    ("left", "least", "most"), [(0.98, 0.55, 0.65), (1.05, 0.95, 0.97), (1.8, 0.99, 1.0)]
)
def test_a_runner_up_that_leaves_hardly_more_makes_a_cause_unsure(
    left: float, least: float, most: float
) -> None:
    known = searched("leak")
    ranking = [fitted(Cause("leakage", {}), left=0.97), fitted(Cause("sensor_gain", {}), left=left)]
    alone = replace(known, ranking=ranking, rivals=[[]])
    close = _close_runners_up(alone, 0.97)
    assert least <= Odds(0.0).of_cause(1, close) <= most
    # Where both leave much, it is their ratio that counts.
    large = replace(alone, ranking=[fitted(Cause("sensor_gain", {}), left=2.0 * left)])
    in_sigmas = np.exp(-0.5 * INDEPENDENT * max(4.0 * left**2 - 4.0, 0.0) / 4.0)
    assert _close_runners_up(large, 2.0) == pytest.approx(in_sigmas)
    rival = replace(alone, rivals=[[ranking[1]]])  # its weight is that of the log
    assert _close_runners_up(rival, 0.97) == 0.0
    several = replace(alone, found=searched("two").found)
    assert _close_runners_up(several, 0.97) == 0.0
