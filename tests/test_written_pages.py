"""Pages of a commissioning and of a fleet: German throughout, and fit for keyboard and phone."""

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import rigs
from accessible import SCHEMES, violations_light_and_dark
from calibrations import log_of
from command_line import twin
from PIL import Image
from playwright.sync_api import Browser
from test_fleet_report import some_of_all
from test_report import explained
from test_retelling import shape_of, written_in
from written_pages import ENGLISH_WORDS, UNIT, commissioned, visible

from twin.calibration.page import write_page as write_commissioning
from twin.diagnosis import drawing
from twin.diagnosis.page import PAGE
from twin.diagnosis.report import write_report
from twin.diagnosis.retelling import templates
from twin.fleet.report_page import write_page as write_fleet
from twin.languages.choice import language_of
from twin.log.header import DERIVED
from twin.log.recorder import Recorder
from twin.signals import TICK

PAGES = ("good", "usable", "refused", "fleet", "report")
WIDTHS = (390, 820, 1400)
GROUND = {"light": "rgb(255, 255, 255)", "dark": "rgb(18, 18, 18)"}


def page_of(name: str, code: str, folder: Path) -> Path:
    path, language = folder / f"{name}.{code}.html", language_of(code, "language")
    if name == "fleet":
        write_fleet(some_of_all(), path, language)
    elif name == "report":
        write_report(explained(), path, language)
    else:
        write_commissioning(commissioned(name), UNIT, path, language)
    return path


def without_lines(text: str) -> str:
    """A text without what a person types: lines of a configuration, commands, keys."""
    text = re.sub(r"\[+[a-z.]+\]+( \w+ = [\w\".]+)?", "", text)
    return re.sub(r"\b(ejector|system|sensor)\.\w+", "", text)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["good", "usable", "refused", "fleet"])
def test_a_german_page_is_german_in_each_word_and_number(name: str, tmp_path: Path) -> None:
    page = page_of(name, "de", tmp_path).read_text(encoding="utf-8")
    english = page_of(name, "en", tmp_path).read_text(encoding="utf-8")
    assert '<html lang="de">' in page
    text = without_lines(visible(page))
    assert ENGLISH_WORDS.findall(text) == []
    assert re.findall(r"\d\.\d", re.sub(r"\d\d\.\d\d\.\d{4}", "", text)) == []
    assert len(re.findall(r"\d,\d", text)) > 10
    lines = {line.strip() for line in text.splitlines() if re.search(r"[a-z]{3}", line)}
    same = lines & {line.strip() for line in without_lines(visible(english)).splitlines()}
    assert {line for line in same if line not in SAME} == set()


SAME = {"mbar", "sl/min", "few", "why", "cut", "two", "empty", "other"}  # units, and what is given
SAME |= {f"gripper-{number:02d}" for number in range(10)}


def test_a_commissioning_writes_its_page_in_the_language_that_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "twin.calibration.commission.commission", lambda *_arguments: commissioned("refused")
    )
    log, page = tmp_path / "log.mcap", tmp_path / "a.html"
    recorder = Recorder(log, rigs.config("test_rig").log_header())
    samples = log_of("test_rig")[:1000]
    recorder.write(samples, np.zeros(len(samples), TICK), [])
    recorder.close()
    command = ("commission", log, "--id", "gripper-7", "-o", page)
    assert twin(monkeypatch, *command, "--language", "ed") == 2
    assert 'there are no texts in "ed"' in capsys.readouterr().err
    assert not page.exists()
    assert twin(monkeypatch, *command, "--language", "de") == 2  # as it is refused
    assert "refused: the twin is off by more" in capsys.readouterr().out  # the terminal is English
    assert "Abgelehnt – compact-ejector-35 gripper-7" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("derived", [False, True])
def test_a_record_that_is_refused_before_its_fit_leaves_its_answer_and_its_page(
    derived: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    log, page, answer = (Path(f"a.{ending}") for ending in ("mcap", "html", "json"))
    metadata = {DERIVED: derived_commands()} if derived else None
    recorder = Recorder(log, rigs.config("test_rig").log_header(metadata))
    samples = log_of("test_rig")[:1000].copy()
    samples["commands"] = 0
    recorder.write(samples, np.zeros(len(samples), TICK), [])
    recorder.close()
    command = ("commission", log, "--id", "rig-7", "-o", page, "--json", answer)
    assert twin(monkeypatch, *command, "--language", "de") == 2
    stored = json.loads(answer.read_text(encoding="utf-8"))
    assert (stored["verdict"], stored["record"]) == ("refused", None)
    assert stored["asset"]["id"] == "rig-7"
    said = capsys.readouterr().err
    assert stored["reason"] in said
    assert stored["do"] in said
    written = page.read_text(encoding="utf-8")
    assert "Abgelehnt – compact-ejector-35 rig-7" in written
    assert "Nichts wird gespeichert." in written
    assert ENGLISH_WORDS.findall(visible(written)) == []
    why = "aus dem Druck abgeleitet: 8-mal Saugen" if derived else "wird nie gesaugt. Prüfen"
    assert why in written


def derived_commands() -> str:
    return (
        "suction and blow-off derived from the pressure: 8 suctions; releases go above the level of"
        " idle, so they are called blow-off; valve delays and the timing of commands cannot be told"
    )


def test_the_verdict_says_what_follows_in_german(tmp_path: Path) -> None:
    page = page_of("refused", "de", tmp_path).read_text(encoding="utf-8")
    assert "<h1>Abweichung in den Phasen Halten und Abblasen.</h1>" in page
    assert "gemessen höchstens 31,2 mbar über erwartet, 12 ms nach ihrem Beginn" in page
    assert "Die Düse schaltet bei 752,5 mbar ab; in der Konfiguration stehen 700" in page
    assert "[data.ejector] h1_mbar = 752.5" in page  # as it is typed
    assert "kind = &quot;sensor&quot;, nach den Schläuchen" in page


@pytest.mark.parametrize(
    ("file", "pattern", "count"),
    [
        (
            "calibration/commission.py",
            r"the configuration (says|has)|where ejectors make|its command is missing",
            8,
        ),
        (
            "calibration/record_checks.py",
            r"the configuration (says|has)|where ejectors make|its command is missing",
            3,
        ),
        ("calibration/commission.py", r"^\[+[a-z._]+\]+.*,( or| if|.* the tubes)", 2),
        ("calibration/record_checks.py", r"^\[+[a-z._]+\]+.*,( or| if|.* the tubes)", 3),
        ("fleet/report.py", r"newest log (can|is)|no diagnosis:", 3),
    ],
)
def test_stored_sentences_of_these_pages_have_templates(
    file: str, pattern: str, count: int
) -> None:
    texts = {text for text in written_in(file) if re.search(pattern, text)}
    texts = {text for text in texts if not any(text in other and text != other for other in texts)}
    shapes = {shape_of(template).replace("{} units", "{} {}") for template in templates()}
    assert texts - shapes == set()
    assert len(texts) == count


@pytest.mark.slow
@pytest.mark.needs("axe")
@pytest.mark.parametrize("code", ["en", "de"])
def test_axe_finds_no_violation_and_no_width_is_too_small(
    code: str, tmp_path: Path, browser: Browser
) -> None:
    for name in PAGES:
        page = browser.new_page()
        page.goto(page_of(name, code, tmp_path).as_uri())
        for width in WIDTHS:
            at = name, width
            page.set_viewport_size({"width": width, "height": 800})
            assert page.evaluate("document.documentElement.scrollWidth") <= width, at
            scrolled = page.evaluate(
                "[...document.querySelectorAll('.wide, figure')]"
                ".some(e => e.scrollWidth > e.clientWidth)"
            )
            assert not scrolled, at
            assert violations_light_and_dark(page) == [], at
        for scheme in SCHEMES:
            page.emulate_media(color_scheme=scheme)
            ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
            assert ground == GROUND[scheme], (name, scheme)
        page.close()


@pytest.mark.needs("axe")
def test_what_is_faint_in_the_dark_alone_is_found(browser: Browser) -> None:
    page = browser.new_page()
    colours = "body {background: #111} h1 {color: #fff} p {color: #333}"
    dark = f"@media (prefers-color-scheme: dark) {{{colours}}}"
    page.set_content(
        f"<html lang=en><title>a</title><style>{dark}</style><main><h1>a</h1><p>words</p></main>"
    )
    found = violations_light_and_dark(page)
    page.close()
    assert [violation.split(": ")[:2] for violation in found] == [["dark", "color-contrast"]]


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
def test_each_picture_is_shown_once_with_letters_that_can_be_read(
    width: int, tmp_path: Path, browser: Browser
) -> None:
    page = browser.new_page(viewport={"width": width, "height": 800})
    page.goto(page_of("report", "en", tmp_path).as_uri())
    shown = page.evaluate(
        """[...document.querySelectorAll("figure")].map((figure) =>
          [...figure.querySelectorAll("svg")].map((svg) =>
            svg.getBoundingClientRect().width / svg.viewBox.baseVal.width).filter(Boolean))"""
    )
    page.close()
    assert [len(scales) for scales in shown] == [1, 1, 1, 1]
    letters = [drawing.STYLE["font.size"] * scale for (scale,) in shown]
    assert 10.0 <= min(letters) <= max(letters) <= 16.0  # pixels


def contrast(one: tuple[int, ...], other: tuple[int, ...]) -> float:
    """The contrast of two colours (WCAG 2.2), from 1 to 21."""

    def luminance(colour: tuple[int, ...]) -> float:
        shares = [value / 255.0 for value in colour[:3]]
        linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares]
        return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))

    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


def test_lines_and_letters_of_pictures_stand_out_in_both_schemes(browser: Browser) -> None:
    """WCAG asks for 3 of lines and marks, 4.5 of letters; white becomes the page's ground."""
    lines = [drawing.MEASURED, drawing.BEFORE, drawing.AFTER, drawing.QUIET, *drawing.EACH]
    letters, blank = "#000000", "#ffffff"
    colours = [*lines, letters, blank]
    squares = "".join(
        f'<rect x="{10 * number}" width="10" height="10" fill="{colour}"/>'
        for number, colour in enumerate(colours)
    )
    svg = f'<svg viewBox="0 0 {10 * len(colours)} 10">{squares}</svg>'
    empty = dict.fromkeys(("title", "colour", "mark", "verdict", "headline", "footer"), "")
    html = PAGE.substitute(empty, language="en", body=svg)
    for scheme in SCHEMES:
        page = browser.new_page(viewport={"width": 600, "height": 400}, color_scheme=scheme)
        page.set_content(html)
        box = page.locator("svg").bounding_box()
        image = Image.open(io.BytesIO(page.screenshot()))
        page.close()
        assert box is not None
        ground = image.getpixel((300, 399))
        assert isinstance(ground, tuple)
        middle, step = box["y"] + box["height"] / 2.0, box["width"] / len(colours)
        for number, colour in enumerate(colours):
            pixel = image.getpixel((round(box["x"] + (number + 0.5) * step), round(middle)))
            assert isinstance(pixel, tuple)
            least = 4.5 if colour == letters else 3.0
            if colour == blank:
                assert pixel == ground, scheme
            else:
                assert contrast(pixel, ground) >= least, (colour, scheme)


@pytest.mark.slow
def test_paper_is_white_and_wide(tmp_path: Path, browser: Browser) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 800}, color_scheme="dark")
    page.goto(page_of("report", "en", tmp_path).as_uri())
    page.emulate_media(media="print", color_scheme="dark")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == GROUND["light"]
    assert page.locator(".on-screen").first.is_visible()
    assert not page.locator(".on-phone").first.is_visible()
    page.close()
