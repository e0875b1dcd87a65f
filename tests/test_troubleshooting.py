"""What the page on troubleshooting quotes, the program says; and no refusal is left out."""

import ast
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from test_retelling import written

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
OTHERS = {  # quoted without being a message: of commands, of this page, and of the system
    "twin probe",
    "twin log check",
    "…",
    "No space left on device",
}
REFUSALS = ("record_checks", "market_fit", "wiring", "stationarity", "calibrate")


def rows() -> Iterator[list[str]]:
    """The cells of each row of the page's tables, without heads."""
    for line in PAGE.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if line.startswith("| ") and not line.startswith(("| you see", "| ---")):
            yield cells


def quotes() -> list[str]:
    """The messages of the first columns."""
    found = [quote for row in rows() for quote in re.findall(r"`([^`]+)`", row[0])]
    return [quote for quote in found if quote not in OTHERS]


@cache
def texts() -> str:
    """Every text of the program, one on a line, with {} for each value; no docstring."""
    lines: list[str] = []
    for folder in ("twin", "drivers"):
        for file in (ROOT / folder).rglob("*.py"):
            lines += spoken(ast.parse(file.read_text(encoding="utf-8")))
    for file in (ROOT / "twin" / "page" / "static").glob("*.js"):
        lines += re.findall(r'"([^"\n]+)"', file.read_text(encoding="utf-8"))
    alarms = tomllib.loads((ROOT / "twin" / "alarms" / "default_rules.toml").read_text())
    lines += [rule["name"] for rule in alarms["alarm"]]
    return "\n".join(line.replace("\n", " ") for line in lines)


def spoken(tree: ast.Module) -> Iterator[str]:
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if id(node) not in docstrings and (text := written(node)):
            yield text


def pattern(quote: str) -> str:
    return r"[^\n]*?".join(re.escape(part) for part in quote.split("…"))


@pytest.mark.slow
@pytest.mark.parametrize("quote", quotes())
def test_the_program_says_what_is_quoted(quote: str) -> None:
    assert re.search(pattern(quote), texts()), quote


def test_a_message_that_nobody_says_is_noticed() -> None:
    assert not re.search(pattern("the pressure is … green"), texts())


def test_each_row_has_a_reason_and_a_remedy() -> None:
    assert len(list(rows())) > 55
    for row in rows():
        assert len(row) == 3, row
        assert all(len(cell) > 3 for cell in row), row


def refusals() -> Iterator[str]:
    """The messages with which a commissioning or a calibration is refused."""
    for name in REFUSALS:
        file = ROOT / "twin" / "calibration" / f"{name}.py"
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "ConfigError":
                yield written(node.args[0])


@pytest.mark.parametrize("refusal", sorted({*refusals()} - {""}))
def test_each_refusal_of_a_commissioning_is_on_the_page(refusal: str) -> None:
    assert any(re.search(pattern(quote), refusal) for quote in quotes()), refusal
