"""Languages of the page: catalogues are whole, and each browser gets the one it asks for."""

import re
from pathlib import Path

import pytest
from babel.messages.catalog import Catalog
from babel.messages.pofile import read_po

from tools.texts import LOCALE, STATIC, texts
from twin.instants import SECOND_NS, age
from twin.language import speaking, tr
from twin.page.catalogues import Catalogues

NAMES = re.compile(r"\{(\w+)\}")


@pytest.fixture(scope="module")
def said() -> set[str]:
    """Every text that the program says in the language of who reads it."""
    return {text for _, text in texts() if text}


def catalogue(code: str) -> Catalog:
    return read_po((LOCALE / f"{code}.po").read_bytes().splitlines(keepends=True))


def test_every_text_is_german_too_and_none_is_stale(said: set[str]) -> None:
    german = {one.id: one.string for one in catalogue("de") if one.id}
    assert {text for text in said if not german.get(text)} == set()  # python tools/texts.py
    assert set(german) - said == set()
    assert len(said) > 300


@pytest.mark.parametrize("path", sorted(LOCALE.glob("*.po")), ids=lambda path: path.stem)
def test_what_is_filled_in_has_a_place_in_each_translation(path: Path) -> None:
    for one in catalogue(path.stem):
        if one.id and one.string:
            assert set(NAMES.findall(str(one.string))) == set(NAMES.findall(str(one.id))), one.id
            assert "$" not in str(one.string)
            assert not one.fuzzy


@pytest.mark.parametrize("path", sorted(STATIC.glob("*.html")), ids=lambda path: path.name)
def test_no_page_says_anything_that_is_not_marked(path: Path) -> None:
    text = re.sub(r"\{\{.+?\}\}", "", path.read_text())
    text = re.sub(r"<(title|option|button)[^>]*>(\d+ (s|min)|\$\w+)</\1>", "", text)
    between = re.findall(r">([^<>]+)<", text)
    attributes = re.findall(r'(?:aria-label|title|placeholder|alt)="([^"]*)"', text)
    words = [one for one in (*between, *attributes) if re.search(r"[A-Za-z]", one)]
    assert [one for one in words if not one.strip().startswith("$")] == []


@pytest.mark.parametrize("path", sorted(STATIC.glob("*.js")), ids=lambda path: path.name)
def test_no_script_says_anything_that_is_not_marked(path: Path) -> None:
    """A text has a capital letter or a space; what a program reads has neither, or is in a list."""
    script = re.sub(r"(?m)(^|\s)//.*$|/\*.*?\*/", " ", path.read_text(), flags=re.S)
    script = re.sub(r'\bt\(\s*"[^"]+"', "", script)
    quoted = re.findall(r'"([^"\n]*)"', script)
    assert [
        one
        for one in quoted
        if re.match(r"[A-Z][a-z]+( |$)|[a-z]+ [a-z]+", one) and one not in CODE
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
    names = {one["code"]: one["name"] for one in Catalogues().names}
    assert names["en"] == "English"
    assert names["de"] == "Deutsch"


def test_a_text_without_translation_stays_english() -> None:
    with speaking({"{time} ago": "vor {time}"}):
        assert age(0, 5 * SECOND_NS) == "vor 5 s"
        assert tr("nobody has translated this") == "nobody has translated this"
    assert age(0, 5 * SECOND_NS) == "5 s ago"
