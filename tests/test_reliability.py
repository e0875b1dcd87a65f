"""docs/reliability.md says what docs/reliability.json holds, and its tables count rightly."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from tools import reliability
from tools.battery_cases import Case, CaseFile, Hidden
from tools.naming_trial import Watched
from tools.reliability import PAGE, Run, known, live, offline, tables, together, written

RUN = Run(
    "live", "first", "abc", 7, [(0.99, True)] * 9 + [(0.99, False), (0.6, True), (0.6, False)]
)


def test_the_page_is_that_of_the_statements_that_are_kept() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert written(page, known()) == page


def test_statements_are_counted_by_kind_world_and_probability() -> None:
    other = replace(RUN, kind="offline", world="second", stated=[(0.97, True)])
    text = tables([RUN, other])
    assert "| first name of an alarm, first world | 12 | 83.3% | 10 | 90.0% | 0.092 |" in text
    assert "| causes of a diagnosis, second world | 1 | 100.0% | 1 | 100.0% | 0.030 |" in text
    unlisted = replace(RUN, kind="unlisted", stated=[(0.6, True), (0.6, False)])
    with_unlisted = tables([RUN, other, unlisted])
    assert all("| all causes | 13 |" in page for page in (text, with_unlisted))
    line = "| something unlisted in a diagnosis, first world | 2 | 50.0% | 0 | – | 0.100 |"
    assert line in with_unlisted
    assert "| probability stated | diagnoses | mean | are right | by chance |" in with_unlisted
    assert "| 50% to 80% | 2 | 60.0% | 50.0% |" in text


def test_a_run_that_is_there_already_is_replaced() -> None:
    newer = replace(RUN, stated=[(0.5, True)])
    assert together([RUN, replace(RUN, first=8), newer]) == [newer, replace(RUN, first=8)]


def test_an_alarm_states_its_first_name_and_none_where_nothing_is_named(tmp_path: Path) -> None:
    named = Watched("first", "gripper", 7, "leakage=2", "leakage", 3, ["a", "leakage"], [0.6, 0.9])
    silent = replace(named, seed=5, alarms=0, names=[], probabilities=[])
    path = tmp_path / "live.jsonl"
    lines = [json.dumps({"commit": "abc", **asdict(case)}) for case in (named, silent)]
    path.write_text("\n".join(lines), encoding="utf-8")
    assert list(live(path)) == [Run("live", "first", "abc", 5, [(0.6, False)])]


def test_a_diagnosis_states_its_causes_and_that_something_is_unlisted(tmp_path: Path) -> None:
    cause = {"effect": "leakage", "course": "constant", "not_separable_from": []}
    answer = {"verdict": "explained", "causes": [cause | {"probability": 0.9}]}
    answer["unmodelled_probability"] = 0.05
    leak = [Hidden("leakage", "constant", 1.0)]
    ice = [Hidden("nozzle_icing", "constant", 1.0)]
    cases = CaseFile(tmp_path / "cases.jsonl", {"first": 7, "commit": "abc"})
    cases.add("first", Case("single", 7, "gripper", leak, answer))
    cases.add("first", Case("unlisted", 7, "gripper", ice, answer))
    cases.add("first", Case("unlisted", 8, "gripper", ice, error="no suction phase"))
    assert list(offline(tmp_path / "cases.jsonl")) == [
        Run("offline", "first", "abc", 7, [(0.9, True), (0.9, False)]),
        Run("unlisted", "first", "abc", 7, [(0.05, False), (0.05, True)]),
    ]


def test_what_is_kept_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "reliability.json"
    monkeypatch.setattr(reliability, "DATA", data)
    assert known() == []
    data.write_text(json.dumps([asdict(RUN)]), encoding="utf-8")
    assert known() == [replace(RUN, stated=[[p, acts] for p, acts in RUN.stated])]
