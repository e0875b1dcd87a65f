"""Pages of a commissioning and of a fleet: German throughout, and fit for keyboard and phone."""

import re
from pathlib import Path

import numpy as np
import pytest
import rigs
from accessible import violations
from calibrations import log_of
from command_line import twin
from playwright.sync_api import Browser
from test_fleet_report import some_of_all
from test_report import explained
from test_retelling import shape_of, written_in
from written_pages import ENGLISH_WORDS, UNIT, commissioned, visible

from twin.calibration.page import write_page as write_commissioning
from twin.diagnosis.report import write_report
from twin.diagnosis.retelling import templates
from twin.fleet.report_page import write_page as write_fleet
from twin.languages.choice import language_of
from twin.log.recorder import Recorder
from twin.signals import TICK

PAGES = ("good", "usable", "refused", "fleet", "report")
WIDTHS = (390, 820, 1400)


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
            10,
        ),
        ("calibration/commission.py", r"^\[+[a-z._]+\]+.*,( or| if|.* the tubes)", 4),
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


@pytest.mark.needs("axe")
@pytest.mark.parametrize("code", ["en", "de"])
def test_axe_finds_no_violation_and_no_width_is_too_small(
    code: str, tmp_path: Path, browser: Browser
) -> None:
    for name in PAGES:
        url = page_of(name, code, tmp_path).as_uri()
        for width in WIDTHS:
            page = browser.new_page(viewport={"width": width, "height": 800})
            page.goto(url)
            assert page.evaluate("document.documentElement.scrollWidth") <= width, (name, width)
            scrolled = page.evaluate(
                "[...document.querySelectorAll('.wide')].some(e => e.scrollWidth > e.clientWidth)"
            )
            assert not scrolled, (name, width)
            assert violations(page) == [], (name, width)
            page.close()
