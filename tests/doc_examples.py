"""Examples of the documentation: its code blocks, and what they say when they are run."""

import doctest
import re
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).parents[1] / "docs"
_NUMBER = re.compile(r"(-?\d+\.?\d*)")
_CLOSE = {"rel": 0.02, "abs": 0.02}  # another processor, other last digits


class _Roughly(doctest.OutputChecker):
    """The same words, and about the same numbers."""

    def check_output(self, want: str, got: str, optionflags: int) -> bool:
        want = want.replace(doctest.BLANKLINE_MARKER, "")
        pairs = zip_longest(*(_NUMBER.split(" ".join(text.split())) for text in (want, got)))
        alike = (
            one == other or (None not in (one, other) and place % 2 and _alike(one, other))
            for place, (one, other) in enumerate(pairs)
        )
        return all(alike) or super().check_output(want, got, optionflags)


def _alike(want: str, got: str) -> bool:
    return bool(float(got) == pytest.approx(float(want), **_CLOSE))


def blocks(page: str, language: str) -> list[str]:
    """The code blocks of a page that are in a language."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def run(page: str) -> tuple[dict[str, Any], str]:
    """Run the examples of a page; gives their names, and what was not as the page says."""
    text = "\n".join(blocks(page, "pycon"))
    test = doctest.DocTestParser().get_doctest(text, {}, page, page, 0)
    said: list[str] = []
    flags = doctest.ELLIPSIS | doctest.REPORT_NDIFF
    runner = doctest.DocTestRunner(_Roughly(), optionflags=flags)
    runner.run(test, out=said.append, clear_globs=False)
    return test.globs, "".join(said)
