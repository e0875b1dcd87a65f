"""Languages of the page: catalogues are whole, and each browser gets the one it asks for."""

import re
import time
from gettext import c2py
from pathlib import Path

import pytest
from babel.messages.catalog import Catalog

from tools.texts import LOCALE, STATIC, is_translated, texts
from twin.errors import ConfigError
from twin.instants import SECOND_NS, age, clock, dated
from twin.languages.catalogues import Catalogues, read_catalog
from twin.languages.choice import language_of
from twin.languages.texts import Language, notation_within, ntr, numeral, speaking, tr

GERMAN = Catalogues().languages["de"]
NAMES = re.compile(r"\{(\w+)\}")


@pytest.fixture(scope="module")
def said() -> set[str | tuple[str, str]]:
    """Every text that the program says in the language of who reads it, plurals as pairs."""
    return {text for _, text in texts() if text}


def catalogue(code: str) -> Catalog:
    return read_catalog((LOCALE / f"{code}.po").read_bytes(), code)


def test_every_text_is_german_too_and_none_is_stale(said: set[str | tuple[str, str]]) -> None:
    german = {message.id: is_translated(message) for message in catalogue("de") if message.id}
    assert {text for text in said if not german.get(text)} == set()  # python tools/texts.py
    assert set(german) - said == set()
    assert len(said) > 600


def test_no_text_hides_inside_another_string() -> None:
    """The tool that collects texts does not look into f-strings."""
    hidden = re.compile(r"""\{[^{}"\n]*\bn?tr\('""")
    code = {path.name: path.read_text() for path in (LOCALE.parent).rglob("*.py")}
    assert {name: hidden.findall(text) for name, text in code.items() if hidden.search(text)} == {}


@pytest.mark.parametrize("path", sorted(LOCALE.glob("*.po")), ids=lambda path: path.stem)
def test_what_is_filled_in_has_a_place_in_each_translation(path: Path) -> None:
    for message in catalogue(path.stem):
        if message.id and is_translated(message):
            several = isinstance(message.id, tuple)
            for form in message.string if several else [message.string]:
                # A form for one may say it in words.
                english = message.id[-1] if several else message.id
                assert set(NAMES.findall(form)) ^ set(NAMES.findall(english)) <= {"count"} & (
                    {"count"} if several else set()
                ), message.id
                assert "$" not in form
            assert not message.fuzzy


@pytest.mark.parametrize("path", sorted(STATIC.glob("*.html")), ids=lambda path: path.name)
def test_no_page_says_anything_that_is_not_marked(path: Path) -> None:
    text = re.sub(r"\{\{.+?\}\}", "", path.read_text())
    text = re.sub(r"<(title|option|button)[^>]*>(\d+ (s|min)|\$\w+)</\1>", "", text)
    between = re.findall(r">([^<>]+)<", text)
    attributes = re.findall(r'(?:aria-label|title|placeholder|alt)="([^"]*)"', text)
    words = [text for text in (*between, *attributes) if re.search(r"[A-Za-z]", text)]
    assert [word for word in words if not word.strip().startswith("$")] == []


@pytest.mark.parametrize("path", sorted(STATIC.glob("*.js")), ids=lambda path: path.name)
def test_no_script_says_anything_that_is_not_marked(path: Path) -> None:
    """A text has a capital letter or a space; what a program reads has neither, or is in a list."""
    script = re.sub(r"(?m)(^|\s)//.*$|/\*.*?\*/", " ", path.read_text(), flags=re.S)
    script = re.sub(r'\bt\(\s*"[^"]+"|\btn\(\s*"[^"]+",\s*"[^"]+"', "", script)
    quoted = re.findall(r'"([^"\n]*)"', script)
    assert [
        text
        for text in quoted
        if re.match(r"[A-Z][a-z]+( |$)|[a-z]+ [a-z]+", text) and text not in CODE
    ] == []


CODE = {"use strict", "Content-Type"}


@pytest.mark.parametrize(
    ("chosen", "accepted", "code"),
    [
        ("", "de-DE,de;q=0.9,en;q=0.8", "de"),
        ("", "DE", "de"),
        ("", "fr-FR, de;q=0.3, en;q=0.7", "en"),
        ("", "fr", "en"),
        ("", "", "en"),
        ("", "de;q=0", "en"),
        ("", "de;q=much, en;q=0.1", "en"),
        ("de", "en", "de"),
        ("en", "de", "en"),
        ("../../etc", "de", "de"),
    ],
)
def test_what_a_browser_accepts_is_chosen(chosen: str, accepted: str, code: str) -> None:
    assert Catalogues().choose(chosen, accepted) == code


def test_languages_call_themselves_by_their_own_names() -> None:
    names = {language["code"]: language["name"] for language in Catalogues().names}
    assert names["en"] == "English"
    assert names["de"] == "Deutsch"


@pytest.mark.parametrize(
    ("value", "spec", "english", "german"),
    [
        (1.25, ".2f", "1.25", "1,25"),
        (-0.5, "+.1f", "-0.5", "-0,5"),
        (1440.0, ".10g", "1440", "1440"),
        (12345.0, ".10g", "12345", "12\u202f345"),
        (-1234567.5, ".1f", "-1234567.5", "-1\u202f234\u202f567,5"),
        (1e-7, ".2g", "1e-07", "1e-07"),
    ],
)
def test_a_number_is_in_the_notation_of_its_language(
    value: float, spec: str, english: str, german: str
) -> None:
    assert numeral(value, spec) == english
    with speaking(GERMAN):
        assert numeral(value, spec) == german


def test_numbers_within_a_text_are_found() -> None:
    with speaking(GERMAN):
        told = notation_within("v1.2.3: rms 1.25 mbar, -0.5 %, 3.4.2026, at 12345 ms.")
    assert told == "v1.2.3: rms 1,25 mbar, -0,5 %, 3.4.2026, at 12\u202f345 ms."


def test_an_instant_of_another_day_has_the_date_of_its_language() -> None:
    instant_ns = 1_000_000_005 * SECOND_NS
    local = time.localtime(1_000_000_005)
    assert dated(instant_ns) == time.strftime("%Y-%m-%d %H:%M:%S", local)
    with speaking(GERMAN):
        assert dated(instant_ns) == time.strftime("%d.%m.%Y %H:%M:%S", local)
        assert clock(instant_ns, 2 * instant_ns) == dated(instant_ns)


def test_a_count_has_the_form_of_its_language() -> None:
    def cycles(count: int) -> str:
        return ntr("{count} cycle", "{count} cycles", count)

    assert [cycles(count) for count in (0, 1, 2)] == ["0 cycles", "1 cycle", "2 cycles"]
    with speaking(GERMAN):
        assert [cycles(count) for count in (0, 1, 2)] == ["0 Zyklen", "1 Zyklus", "2 Zyklen"]
    polish = Language(
        "pl",
        {"{count} cycle": ("{count} cykl", "{count} cykle", "{count} cykli")},
        c2py("n==1 ? 0 : n%10>=2 && n%10<=4 && (n%100<10 || n%100>=20) ? 1 : 2"),
    )
    with speaking(polish):
        told = [cycles(count) for count in (1, 3, 5, 22)]
    assert told == ["1 cykl", "3 cykle", "5 cykli", "22 cykle"]


@pytest.mark.parametrize(
    ("code", "hint"), [("gr", "there are no texts"), ("../de", "there are no texts")]
)
def test_a_language_without_texts_is_refused(code: str, hint: str) -> None:
    with pytest.raises(ConfigError, match=f"--language: {hint}"):
        language_of(code, "--language")


def test_a_text_without_translation_stays_english() -> None:
    with speaking(Language("de", {"{time} ago": "vor {time}"})):
        assert age(0, 5 * SECOND_NS) == "vor 5 s"
        assert tr("nobody has translated this") == "nobody has translated this"
    assert age(0, 5 * SECOND_NS) == "5 s ago"


def test_scripts_have_their_own_texts_in_german_and_no_others() -> None:
    scripts = (path.read_text(encoding="utf-8") for path in STATIC.glob("*.js"))
    literal = {text for script in scripts for text in re.findall(r'\bt\("([^"\\]+)"', script)}
    texts = Catalogues().of_scripts("de")
    assert len(literal) > 50
    assert literal <= texts.keys()
    assert len(texts) < len(Catalogues().languages["de"].texts) / 3
    assert Catalogues().of_scripts("en") == {}
