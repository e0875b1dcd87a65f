"""The glossary has each word once, and those that the program says of an answer."""

import re
from pathlib import Path

import pytest

from twin.model.courses import Course
from twin.signals import Phase

DOCS = Path(__file__).parent.parent / "docs"
TERMS = [
    term.strip()
    for row in re.findall(r"^\| ([^|]+) \|", (DOCS / "glossary.md").read_text("utf-8"), re.M)
    for term in row.split(",")
    if row not in ("word", "---")
]


def test_each_word_has_one_meaning() -> None:
    assert len(TERMS) == len(set(TERMS)) > 50


@pytest.mark.parametrize(
    "word",
    [
        *(phase.name.lower().replace("_", "-") for phase in Phase),
        *("consistent", "explained", "unlisted", "insufficient"),
        *("good", "usable", "refused"),
    ],
)
def test_what_the_program_says_of_an_answer_is_explained(word: str) -> None:
    assert word in TERMS


def test_courses_are_named() -> None:
    text = (DOCS / "glossary.md").read_text("utf-8")
    assert all(f"`{course}`" in text for course in Course)
