"""What people read is plain: no riddles that once stood here, and sentences that read easily.

Reading ease is Flesch's: 206.835 less 1.015 times the words of a sentence and 84.6 times the
syllables of a word (Flesch, "A new readability yardstick", 1948). From 60 on a text is plain
English. A page of short, odd sentences scores well too: hence the phrases.
"""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pyphen
import pytest
import typer
from babel.messages.pofile import read_po

from twin.cli.main import app

ROOT = Path(__file__).parents[1]
EASIEST = 60.0  # Flesch's limit of plain English
LONGEST = 45  # words of a sentence, lists in it included
FEWEST = 80  # words, below which a page has no reading ease
FEWEST_SHORT = 20  # the same of a help text or message: it is one or two sentences
# Riddles, and word orders of another language. Each stood in a text here, and a reader stopped.
BANNED = {
    r"\bnothing to tell\b": "say what is missing: incomplete, not evaluated",
    r"\bhas it from\b": "name its source",
    r"\bwants (one|to be)\b": "requires",
    r"\bis said once\b": "is reported once",
    r"\band that is said\b": "with a warning",
    r"\bwhat cannot be is\b": "invalid values are",
    r"\bwhat else goes\b": "other data",
    r"\bhow they go together\b": "how they fit together",
    r"\bgoes as one before\b": "is like an earlier one",
    r"\bsp(eaks|oke) for\b": "evidence",
    r"\blet it speak\b": "unshelve",
    r"\bnothing waits\b": "the queue is empty",
    r"\bnobody took\b": "say what is lost, and why",
    r"\bke(eps?|pt)\b[^.]{0,20}\bquiet\b": "shelved, suppressed, out of service or not announced",
    r"\bas wide as needed\b": "say how wide, and why",
    r"\bnot told of\b": "unknown or missing, and in how many",
    r"\bso many of them\b": "say how many",
    r"\bbeen told yet\b": "been reported yet",
    r"\bsays? none\b": "name what is missing: without a zone",
    r"\bwithout a word\b": "without notice, an event or a key, or by default",
    r"\btwin as it stands\b": "the unchanged twin",
    r"\bthe less of what\b": "two quantities and how one follows the other",
}
# A key of a configuration is described by a noun phrase: these words refer to one that is missing.
WITHOUT_NOUN = re.compile(r"(of|that|the same|than|so)\b", flags=re.I)
OF_TYPER = {"install_completion", "show_completion"}  # options with texts of that library
WORDS = re.compile(r"[A-Za-z][A-Za-z'’-]*")


def pages() -> list[Path]:
    """Every page that somebody wrote, and not a program."""
    made = {"commands.md", "configuration.md"}
    docs = [page for page in (ROOT / "docs").rglob("*.md") if page.name not in made]
    return sorted([*docs, ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md"])


def prose(markdown: str) -> str:
    """Paragraphs and list items without code, tables, headings, comments and link targets."""
    text = re.sub(r"^ *```.*?^ *```", "", markdown, flags=re.S | re.M)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.S)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    lines = [
        ""
        if re.match(r"\s*(#|\||>|:|\+--|=+$)", line)
        else re.sub(r"^\s*([-*]|\d+\.) ", "\n", line)
        for line in text.splitlines()
    ]
    return "\n".join(lines)


def sentences(text: str) -> Iterator[str]:
    """Sentences; a paragraph or list item ends one. Code in backticks counts as one word."""
    plain = re.sub(r"`[^`]*`", "code", text).replace("**", "")
    for paragraph in re.split(r"\n\s*\n", plain):
        for sentence in re.split(r"(?<=[.!?:;])\s+", " ".join(paragraph.split())):
            if WORDS.search(sentence):
                yield sentence


@cache
def syllables(word: str) -> int:
    """Syllables of an English word, by where it may be divided."""
    return str(pyphen.Pyphen(lang="en_US").inserted(word.lower())).count("-") + 1


def reading_ease(text: str) -> float:
    """Flesch's reading ease."""
    counted = [WORDS.findall(sentence) for sentence in sentences(text)]
    words = [word for some in counted for word in some]
    each = sum(syllables(word) for word in words) / len(words)
    return 206.835 - 1.015 * len(words) / len(counted) - 84.6 * each


def helps() -> Iterator[tuple[str, str]]:
    """Name and help text of every command, and of its options."""

    def below(command: Any, name: str) -> Iterator[tuple[str, str]]:
        options = [
            str(getattr(option, "help", "") or "")
            for option in command.params
            if option.name not in OF_TYPER
        ]
        yield name, " ".join([command.help or "", *options])
        for child, subcommand in getattr(command, "commands", {}).items():
            yield from below(subcommand, f"{name} {child}")

    yield from below(typer.main.get_command(app), "twin")


def messages() -> Iterator[str]:
    """Texts of page, alarms and advice, as their catalogue has them; a plural is one of two."""
    with (ROOT / "twin" / "locale" / "de.po").open("rb") as file:
        for message in read_po(file):
            yield from message.id if isinstance(message.id, tuple) else (str(message.id),)


def said() -> Iterator[tuple[str, str]]:
    """Place and text of every string in the programs, docstrings and comments left out.

    Docstrings of commands are their help, and checked there.
    """
    for path in sorted([*(ROOT / "twin").rglob("*.py"), *(ROOT / "drivers").rglob("*.py")]):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        described = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        for node in nodes:
            if isinstance(node, ast.Constant) and id(node) not in described:
                yield f"{path.relative_to(ROOT)}:{node.lineno}", str(node.value)


def banned(text: str) -> list[str]:
    """What a text says that nobody understands at once, with what to write."""
    plain = " ".join(text.split())
    return [
        f"{found[0]!r}: {instead}"
        for phrase, instead in BANNED.items()
        for found in [re.search(phrase, plain, flags=re.I)]
        if found
    ]


def remarks(source: str) -> Iterator[str]:
    """Docstrings, and comments; those on successive lines are one text."""
    comments: list[str] = []
    last = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            is_alone = not token.line[: token.start[1]].strip()
            if not is_alone or token.start[0] > last + 1:
                yield " ".join(comments)
                comments = []
            comments.append(token.string.lstrip("# "))
            last = token.start[0]
    yield " ".join(comments)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""


def keys() -> list[tuple[str, str]]:
    """Each key on the page of all keys, with its description."""
    page = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    return re.findall(r"^\| `(\w+)` \|.* \| (.*) \|$", page, flags=re.M)


def hard(text: str, fewest: int) -> list[str]:
    """What makes a text hard to read; its reading ease counts from ``fewest`` words on."""
    found = banned(text)
    found += [
        f"{count} words: {sentence}"
        for sentence in sentences(text)
        if (count := len(WORDS.findall(sentence))) > LONGEST
    ]
    if len(WORDS.findall(text)) >= fewest and (ease := reading_ease(text)) < EASIEST:
        found.append(f"reading ease {ease:.0f}: {text[:300]}")
    return found


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_reads_easily(page: Path) -> None:
    assert not hard(prose(page.read_text(encoding="utf-8")), FEWEST)


@pytest.mark.parametrize(("name", "text"), list(helps()), ids=lambda text: text[:30])
def test_a_help_text_reads_easily(name: str, text: str) -> None:
    assert not hard(text, FEWEST_SHORT), name


def test_every_message_reads_easily() -> None:
    texts = list(messages())
    assert len(texts) > 900  # it looks at them
    assert not [found for text in texts for found in hard(text, FEWEST_SHORT)]


def test_no_string_of_the_programs_is_a_riddle() -> None:
    strings = list(said())
    assert len(strings) > 10_000  # it looks at them
    assert not [(place, found) for place, text in strings for found in banned(text)]


@pytest.mark.parametrize("folder", ["twin", "drivers", "tools", "tests"])
def test_no_docstring_and_no_comment_is_a_riddle(folder: str) -> None:
    found = [
        f"{path.relative_to(ROOT)}: {riddle}"
        for path in sorted((ROOT / folder).rglob("*.py"))
        for remark in remarks(path.read_text(encoding="utf-8"))
        for riddle in banned(remark)
    ]
    assert not found


def test_a_key_is_described_by_a_noun() -> None:
    assert len(keys()) > 100
    assert not [(key, text) for key, text in keys() if WITHOUT_NOUN.match(text)]


def test_the_check_finds_what_it_is_for() -> None:
    assert hard("word " * (LONGEST + 1), FEWEST) == [f"46 words: {'word ' * 45}word"]
    assert hard("Instrumentation " * FEWEST_SHORT, FEWEST_SHORT)
    assert not hard("Instrumentation " * (FEWEST_SHORT - 1), FEWEST_SHORT)
    assert banned("Where it\nhas it from is told.") == ["'has it from': name its source"]
    source = '"""A module."""\n# It has\n# it from there.\nx = 1  # mbar\n'
    assert [text for text in remarks(source) if text] == [
        "It has it from there.",
        "mbar",
        "A module.",
    ]
    easy, heavy = (
        "The tank leaks. Close the valve. ",
        "Instrumentation heterogeneity necessitates. ",
    )
    assert reading_ease(50 * easy) > 90.0
    assert reading_ease(50 * heavy) < 0.0
    assert list(sentences("One is here. `a.b.c` is two:\n\n- three")) == [
        "One is here.",
        "code is two:",
        "- three",
    ]
