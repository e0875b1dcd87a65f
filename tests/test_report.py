"""The report: what people read about a diagnosis, on the terminal and on one page."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rigs

from twin.diagnosis.answer import Diagnosis, diagnose
from twin.diagnosis.evidence import Evidence, collect
from twin.diagnosis.pictures import (
    Comparison,
    by_phase,
    draw_cycle,
    draw_phases,
    draw_ranking,
    worst_cycle,
    worst_phase,
)
from twin.diagnosis.report import in_words, write_report
from twin.diagnosis.search import Finding
from twin.errors import SourceError
from twin.model.effects import EFFECTS
from twin.signals import NS, Phase

ONSET_S = 10.0
FITTED, HELD_OUT = [1, 2, 3, 5], [4, 6]
VERDICTS = ("consistent", "explained", "unlisted", "insufficient")
BEFORE = {
    "rms_mbar": 21.34,
    "max_mbar": 34.8,
    "evacuation_time_error_pct": 9.37,
    "leftover_sigma": 2.99,
}
AFTER = {
    "rms_mbar": 1.131,
    "max_mbar": 9.038,
    "evacuation_time_error_pct": 0.1574,
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
}


@cache
def evidence() -> Evidence:
    samples, _ = rigs.recorded("test_rig", 25.0, ("leakage=2@10",))
    return collect(rigs.config("test_rig"), rigs.cut(samples, 10_000))


def ranking() -> list[Finding]:
    here = evidence()
    seconds = (here.samples["time_ns"] - here.begin_ns) * NS
    onset = int(np.searchsorted(seconds, ONSET_S))
    sizes = (("leakage", "sonic_flow", 2.0, 1.0), ("porous_leakage", "flow_at_600mbar", 2.1, 1.02))
    others = (("sensor_gain", "error", -3.0, 1.8),)
    return [
        Finding(effect, onset, {p: x}, {p: x - 0.1}, {p: x + 0.1}, 100.0 * left, left)
        for effect, p, x, left in (*sizes, *others)
    ]


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
        "gain": {"rms_reduction_pct": 95.3, "low95": 94.74, "high95": 95.97},
        "next_experiment": "hold for 10 s with the nozzle off",
    }
    return found | changed


def explained(**changed: Any) -> Diagnosis:
    ranked = ranking()
    return Diagnosis(evidence(), "0123456789abcdef", ranked, ranked[0], HELD_OUT, answer(**changed))


def unexplained(verdict: str, **changed: Any) -> Diagnosis:
    """Nothing is worth naming."""
    nothing = {"causes": [], "runners_up": [], "extended": BEFORE, "next_experiment": None}
    text = answer(verdict=verdict, **(nothing | changed))
    return Diagnosis(evidence(), "0123456789abcdef", ranking(), None, HELD_OUT, text)


def insufficient() -> Diagnosis:
    samples, _ = rigs.recorded("test_rig", 7.0)
    return diagnose(rigs.config("test_rig"), [samples], "short.mcap", lambda _what: None)


def made(verdict: str) -> Diagnosis:
    match verdict:
        case "explained":
            return explained()
        case "insufficient":
            return insufficient()
        case "unlisted":
            left = {"where": "blow_off", "depends_on": [], "shape": "+22.5 mbar in the mean"}
            return unexplained(verdict, unlisted=left)
    return unexplained(verdict)


@cache
def compared(verdict: str) -> Comparison:
    return Comparison.of(made(verdict))


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
        if self.open and self.open[-1] in ("h1", "h2"):
            self.headings.append(data)

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.seen if name == tag]


# --- the page -------------------------------------------------------------------------------------


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
    assert Outline(pages["explained"]).headings == [
        "Air leaks in through an opening on the vacuum side (sonic flow 1.98 sl/min).",
        "What to do",
        "Leakage (1.98 sl/min) explains the deviation: 21.3 → 1.13 mbar rms",
        "The deviation is largest in suction, since 10.0 s into the log",
        "This log cannot tell leakage from porous leakage",
        "Numbers",
    ]


def test_without_a_cause_no_cause_is_claimed(pages: dict[str, str]) -> None:
    consistent = Outline(pages["consistent"]).headings
    assert consistent[2:5] == [
        "The twin as it stands fits: 21.3 mbar rms",
        "Every phase is as in healthy cycles",
        "No single cause is worth naming",
    ]
    unlisted = Outline(pages["unlisted"]).headings
    assert (
        unlisted[0] == "No listed cause explains what is left in blow-off: +22.5 mbar in the mean."
    )
    assert unlisted[2] == "The twin as it stands does not fit: 21.3 mbar rms"


def test_a_cause_that_leaves_much_is_called_a_part(tmp_path: Path) -> None:
    left = {"where": "hold", "depends_on": [], "shape": "-6.1 mbar in the mean"}
    part = LEAK | {"not_separable_from": []}
    page = page_of(explained(verdict="unlisted", causes=[part], unlisted=left), tmp_path)
    assert "Leakage (1.98 sl/min) explains only part of the deviation" in page
    assert "Leakage leaves least of all causes, but more than healthy cycles have" in page
    assert "83 %" not in page  # a share among causes that do not explain it is no certainty


def test_insufficient_shows_the_reason_and_no_pictures(pages: dict[str, str]) -> None:
    page = pages["insufficient"]
    assert "record at least 4 complete ones" in page
    assert "<svg" not in page
    assert "<table" not in page


def test_tables_carry_the_numbers(pages: dict[str, str]) -> None:
    page = pages["explained"]
    cells = re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", page)
    for row in (
        ["leakage", "since 10.0 s into the log", "sonic flow", "1.98", "1.93", "2.04", "sl/min"],
        ["rms deviation", "21.3", "1.13", "mbar"],
        ["evacuation time error", "9.37", "0.157", "%"],
        ["sensor gain", EFFECTS["sensor_gain"].sentence, "1.78"],
    ):
        assert " | ".join(row) in " | ".join(cells)
    assert "<dt>fitted on</dt><dd>1, 2, 3, 5</dd>" in page
    assert "<dt>held out, to judge by</dt><dd>4, 6</dd>" in page
    assert "<dt>log</dt><dd>night.mcap</dd>" in page
    assert "volume 755.7 ml" in page  # tank, 165 mm of 6 mm tube, and what is in the ejector
    assert "ejector-twin 0." in page


def test_all_text_is_escaped(tmp_path: Path) -> None:
    evil = "<script>alert('&')</script>"
    cause = LEAK | {"why": evil, "not_separable_from": []}
    asset = {"type": evil, "id": '"' + evil}
    page = page_of(explained(asset=asset, log=evil, next_experiment=evil, causes=[cause]), tmp_path)
    assert "<script" not in page
    assert page.count("&lt;script&gt;alert(&#x27;&amp;&#x27;)") >= 6
    assert "$" not in re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL)


def test_same_diagnosis_gives_the_same_bytes(pages: dict[str, str], tmp_path: Path) -> None:
    assert page_of(explained(), tmp_path) == pages["explained"]


def test_a_report_that_cannot_be_written_is_an_error_for_people(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"missing/report\.html: cannot be written") as caught:
        write_report(insufficient(), tmp_path / "missing" / "report.html")
    assert "directory" in caught.value.hint


# --- the pictures ---------------------------------------------------------------------------------


def test_pictures_are_svg_with_a_text_alternative() -> None:
    found = compared("explained")
    for svg in (
        draw_cycle(found, 4, 'a "cycle"'),
        draw_phases(found, 'a "cycle"'),
        draw_ranking(found, [], 'a "cycle"'),
    ):
        root = ET.fromstring(svg)
        assert root.get("role") == "img"
        assert root.get("aria-label") == 'a "cycle"'
        assert len(svg) < 200_000


def test_cycle_is_drawn_before_and_after_with_a_cause_only() -> None:
    assert "expected with leakage" in draw_cycle(compared("explained"), 4, "")
    healthy = draw_cycle(compared("consistent"), 4, "")
    assert "expected: twin as it stands" in healthy
    assert "expected with" not in healthy


def test_phases_show_the_onset_and_the_signature_of_a_cause_only() -> None:
    marks = ("signature of leakage", ">onset<", "deviation, held out", ">healthy<")
    with_cause, without = (draw_phases(compared(v), "") for v in ("explained", "consistent"))
    assert [mark in with_cause for mark in marks] == [True, True, True, True]
    assert [mark in without for mark in marks] == [False, False, True, True]


def test_ranking_marks_the_cause_and_its_look_alikes() -> None:
    svg = draw_ranking(compared("explained"), ["porous_leakage"], "")
    for text in ("▶ leakage", "≈ porous leakage (look-alike)", ">sensor gain<", "no cause"):
        assert text in svg
    assert "▶" not in draw_ranking(compared("consistent"), [], "")


def test_worst_cycle_and_phase_are_those_of_the_leak() -> None:
    early_and_late = replace(compared("explained"), diagnosis=replace(explained(), held_out=[1, 5]))
    assert worst_cycle(early_and_late) == 5
    assert worst_phase(early_and_late) == Phase.SUCTION


def test_means_by_phase_are_those_of_the_cycles_figures() -> None:
    here = evidence()
    means = by_phase(here, compared("consistent").off_before)
    assert np.isnan(means[0]).all()  # the first cycle is not judged
    figures = [cycle["suction_mean"] for cycle in here.figures]
    np.testing.assert_allclose(means[1:, Phase.SUCTION], figures[1:], atol=0.3)


# --- in words -------------------------------------------------------------------------------------


def test_words_for_a_cause() -> None:
    assert in_words(explained()).splitlines() == [
        f"explained: {LEAK['why']}",
        "  cause          leakage, sonic flow 1.98 sl/min (95 %: 1.93 to 2.04), since 10.0 s into"
        " the log",
        "  how sure       83 %; this log cannot tell it from porous leakage",
        f"  look at        {EFFECTS['leakage'].look_at}",
        f"  or it may be   porous leakage; then look at {EFFECTS['porous_leakage'].look_at}",
        "  next recording hold for 10 s with the nozzle off",
        "  unseen cycles  rms 21.3 → 1.13 mbar, max 34.8 → 9.04 mbar, evacuation time error"
        " 9.37 → 0.157 %, leftover 2.99 → 1.16 sigma",
        "  gain           95.3 % less rms deviation (95 %: 94.7 to 96)",
        "  cycles         7; fitted: 1, 2, 3, 5; held out: 4, 6",
    ]


def test_words_without_a_cause() -> None:
    consistent = in_words(made("consistent"))
    assert consistent.startswith("consistent: The ejector does what its twin expects; 21.3 mbar")
    assert "rms 21.3 mbar, max 34.8 mbar" in consistent
    assert "→" not in consistent
    assert "look at" not in consistent
    unlisted = in_words(made("unlisted"))
    assert unlisted.startswith("unlisted: No listed cause explains what is left in blow-off: +22.5")
    assert "cause  " not in unlisted


def test_words_for_a_log_that_cannot_answer() -> None:
    first, *rest = in_words(insufficient()).splitlines()
    assert first.startswith("insufficient: The log cannot answer: only 1 cycle can be judged")
    assert len(rest) == 1
    assert "record again" in rest[0]


def test_words_stay_short_for_a_long_log() -> None:
    cycles = {"total": 400, "fitted": list(range(1, 400, 2)), "held_out": list(range(2, 400, 2))}
    assert "held out: 2, 4, 6 … 398 (199 cycles)" in in_words(explained(cycles=cycles))
