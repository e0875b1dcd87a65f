"""docs/battery.md holds the tables of one run, which the battery writes; older ones are lines."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from tools import battery
from tools.battery_page import ASKED, FOUND, Case, Hidden, Tally, summary, tables, with_run
from twin.errors import TwinError

PAGE = (Path(__file__).parent.parent / "docs" / "battery.md").read_text(encoding="utf-8")
HEAD = "| what | reached | asked for | kept |"
LEAK = Hidden("leakage", "constant", 1.0)


def test_the_page_has_the_table_of_one_run() -> None:
    assert PAGE.count(HEAD) == 1
    assert PAGE.count("<!-- newest run: python tools/battery.py --write docs/battery.md -->") == 1


def test_a_run_replaces_the_tables_and_leaves_a_line_of_the_one_before() -> None:
    page = with_run(with_run(PAGE, "first line", f"{HEAD}\n1"), "second line", f"{HEAD}\n2")
    assert page.count(HEAD) == 1
    assert f"**second line**\n\n{HEAD}\n2\n<!-- end -->" in page
    older = page.partition("<!-- older runs")[2].splitlines()
    assert older[1] == "- first line"
    assert older[2].startswith("- 20")  # the run that stood in the page
    assert page.partition("<!--")[0] == PAGE.partition("<!--")[0]


def test_a_page_without_a_place_for_the_run_is_refused() -> None:
    with pytest.raises(ValueError, match="newest run"):
        with_run("# Another page", "line", "tables")


def test_tables_say_what_was_reached_and_what_was_not_found() -> None:
    cause = {"effect": "porous_leakage", "course": "constant", "not_separable_from": []}
    answer = {
        "verdict": "explained",
        "causes": [cause | {"parameters": {"flow": {"value": 0.9}}}],
        "extended": {"leftover_sigma": 1.31},
    }
    tally = Tally()
    battery.judge_single(answer, [LEAK], tally)
    tally.cases.append(Case("single", 7, "gripper", [LEAK], answer, found=False))
    text = tables(tally)
    assert "| confidently wrong | 1 of 1 (100%) | at most 2% | **no** |" in text
    assert "| `leakage` | 1 | 0 | 0 | porous_leakage 1 | 1 | 1.31 |" in text
    row = "| single | 7 | gripper | leakage constant 1 | explained | porous_leakage constant 0.9 |"
    assert row in text
    line = summary(tally, "2026-01-02", "abc")
    assert line == "2026-01-02, commit abc, seeds 7 to 7: found 0 of 1 single."
    assert not tally.all_kept


@pytest.mark.parametrize("kind", FOUND)
def test_a_case_that_ends_in_an_error_is_not_found(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> Iterator[object]:
        raise TwinError("no suction phase", "record more")

    one = SimpleNamespace(name="gripper", config=None)
    monkeypatch.setattr(battery, "case", lambda *_: (one, [LEAK], None))
    monkeypatch.setattr(battery, "diagnose", refused)
    tally = Tally()
    (line,) = battery.run(kind, range(3, 4), 1, tally)
    assert line.startswith("FAILED")
    assert tally.outcomes == {FOUND[kind]: [False]}
    assert set(tally.outcomes) <= set(ASKED)
    assert f"| {kind} | 3 | gripper | leakage constant 1 | error | – | – |" in tables(tally)
