"""docs/battery.md holds the tables of one run in each world; older ones are lines."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tools import battery_first
from tools.battery import recounted
from tools.battery_cases import FOUND, Case, CaseFile, Hidden, first_of
from tools.battery_page import ASKED, all_kept, expected, likely, summary, tables, with_run
from tools.calibration_coverage import rig_of, shipped
from twin.errors import TwinError

PAGE = (Path(__file__).parent.parent / "docs" / "battery.md").read_text(encoding="utf-8")
HEAD = "| what | reached | by chance | asked for | kept |"
LEAK = Hidden("leakage", "constant", 1.0)
WORLDS = ("first", "second")


def answer(
    effect: str, verdict: str = "explained", left: float = 1.31, probability: float = 0.97
) -> dict[str, Any]:
    """An answer that names one effect of size 0.9."""
    size = {"value": 0.9, "low95": 0.8, "high95": 1.1}
    cause = {"effect": effect, "course": "constant", "not_separable_from": []}
    cause["probability"] = probability
    return {
        "verdict": verdict,
        "causes": [cause | {"parameters": {"flow": size}}],
        "extended": {"leftover_sigma": left},
        "gain": {"share_of_achievable_pct": 97.0},
    }


def single(effect: str, **more: Any) -> Case:
    return Case("single", 7, "gripper", [LEAK], answer(effect), more=more)


def test_what_is_stated_is_compared_with_how_often_it_is_right() -> None:
    named = [*["leakage"] * 3, "porous_leakage"]
    sure = [Case("single", n, "gripper", [LEAK], answer(causes)) for n, causes in enumerate(named)]
    doubted = Case("unlisted", 9, "gripper", [], answer("leakage", probability=0.6))
    page = tables([*sure, doubted])
    assert "| 95% to 98% | 4 | 97.0% | 75.0% | 19% to 99% |" in page
    assert "| 50% to 80% | 1 | 60.0% | 0.0% | 0% to 98% |" in page
    assert "Expected calibration error: 0.296, over 5 causes." in page  # (4 * 0.22 + 0.6) / 5
    assert "| causes stated with 95% or more that act | 3 of 4 (75%) |" in page


@pytest.mark.parametrize("world", WORLDS)
def test_the_page_has_a_place_for_each_world(world: str) -> None:
    place = f"<!-- newest run of the {world} world: python tools/battery.py --write docs/battery.md"
    assert PAGE.count(place) == 1


@pytest.mark.parametrize("world", WORLDS)
def test_a_run_replaces_the_tables_and_leaves_a_line_of_the_one_before(world: str) -> None:
    page = with_run(PAGE, world, "first line", f"{HEAD}\n1")
    page = with_run(page, world, "second line", f"{HEAD}\n2")
    assert f"**second line**\n\n{HEAD}\n2\n<!-- end -->" in page
    assert f"{HEAD}\n1" not in page
    older = page.partition("<!-- older runs")[2].splitlines()
    assert older[1] == "- first line"
    assert older[2].startswith("- 20")  # the run that stood in the page
    assert page.partition("<!--")[0] == PAGE.partition("<!--")[0]


def test_a_page_without_a_place_for_the_run_is_refused() -> None:
    with pytest.raises(ValueError, match="newest run of the first world"):
        with_run("# Another page", "first", "line", "tables")


def test_tables_say_what_was_reached_and_what_was_not_found() -> None:
    cases = [single("porous_leakage", moved_mbar=3.14, noise_mbar=0.4)]
    text = tables(cases)
    wrong = ASKED["wrong"].words
    assert f"| {wrong} | 1 of 1 (100%) | 3% to 100% | at most 0.5% | **no** |" in text
    assert "| `leakage` | 1 | 0 | 0 | porous_leakage 1 | 1 | 1.31 |" in text
    row = (
        "| single | 7 | gripper | leakage constant 1 | 3.1 mbar | 0.4 mbar | explained |"
        " porous_leakage constant 0.9 |"
    )
    assert row in text
    line = summary("first", cases, "2026-01-02", "abc")
    assert line == "2026-01-02, first world, commit abc, seeds 7 to 7: found 0 of 1 single."
    assert not all_kept(cases)


def test_a_size_counts_where_it_means_the_same_in_both_worlds() -> None:
    assert single("leakage").outcomes["covered"] is True
    assert "covered" not in single("leakage", comparable=False).outcomes
    of_volume = single("leakage", of_volume=True).outcomes
    assert "covered" not in of_volume
    assert of_volume["flows"] is True


STUCK = Hidden("sticking_valve", "constant", 30.0)
HIDDEN = {
    "healthy": [],
    "single": [LEAK],
    "pair": [LEAK, replace(LEAK, effect="sensor_lag")],
    "unlisted": [replace(LEAK, effect="condensate")],
}


@pytest.mark.parametrize("kind", HIDDEN)
def test_explained_and_wrong_is_what_names_no_cause_that_acts(kind: str) -> None:
    wrong = Case(kind, 1, "gripper", HIDDEN[kind], answer("sensor_gain"))
    assert wrong.outcomes["wrong"] is True
    assert wrong.outcomes["spurious"] is True
    unsure = replace(wrong, answer=answer("sensor_gain", "unlisted"))
    assert "wrong" not in unsure.outcomes  # of all that is explained
    assert unsure.outcomes["spurious"] is True  # of all answers
    silent = replace(wrong, answer=answer("", "consistent") | {"causes": []})
    assert silent.outcomes["spurious"] is False


def test_half_a_pair_is_not_wrong_but_spurious() -> None:
    half, other = answer("leakage"), answer("sensor_gain")["causes"]
    case = Case("pair", 1, "gripper", HIDDEN["pair"], half | {"causes": half["causes"] + other})
    assert case.outcomes["wrong"] is False
    assert case.outcomes["spurious"] is True
    assert case.outcomes["pairs"] is False


@pytest.mark.parametrize(("course", "is_right"), [("intermittent", True), ("constant", False)])
def test_a_sticking_valve_may_be_told_as_a_delay_in_some_cycles(
    course: str, is_right: bool
) -> None:
    told = answer("response_delay")
    told["causes"][0]["course"] = course
    case = Case("unlisted", 1, "gripper", [STUCK], told)
    assert case.found is is_right
    assert case.outcomes["wrong"] is not is_right
    assert case.stated == [(0.97, is_right)]
    assert Case("unlisted", 1, "gripper", [STUCK], answer("x", "unlisted")).found


def test_mechanisms_outside_the_table_are_counted_each() -> None:
    ice = [replace(LEAK, effect="nozzle_icing")]
    verdicts = ("unlisted", "unlisted", "explained", "consistent")
    cases = [
        Case("unlisted", seed, "gripper", ice, answer("leakage", verdict))
        for seed, verdict in enumerate(verdicts)
    ]
    assert "| `nozzle_icing` | 4 | 2 | 1 | 1 |" in tables(cases)


def test_what_hides_below_the_noise_counts_apart_too() -> None:
    """Nobody can find an effect that moves the record by less than its rows scatter."""
    ice, told = [replace(LEAK, effect="nozzle_icing")], answer("leakage", "consistent")
    moves = {0.1: False, 2.0: True}
    cases = [
        Case("unlisted", 1, "gripper", ice, told, more={"moved_mbar": moved, "noise_mbar": 0.7})
        for moved in moves
    ]
    assert [("shown" in case.outcomes) for case in cases] == [*moves.values()]
    assert "shown" not in Case("unlisted", 1, "gripper", ice, told).outcomes  # not known
    page = tables(cases)
    assert f"| {ASKED['unlisted'].words} | 0 of 2 " in page
    assert f"| {ASKED['shown'].words} | 0 of 1 " in page


def test_each_mechanism_outside_the_table_takes_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    unit = battery_first.Unit("gripper", rig_of(shipped("gripper")), None)  # type: ignore[arg-type]
    monkeypatch.setattr(battery_first, "unit", lambda *_: unit)
    monkeypatch.setattr(battery_first, "recorded", lambda *_: None)
    drawn = {
        battery_first.drawn_case("unlisted", seed, 1)[1][0].effect
        for seed in range(len(battery_first.OUTSIDE))
    }
    assert drawn == set(battery_first.OUTSIDE)


def test_a_draw_is_compared_with_what_the_page_reached_where_that_is_short() -> None:
    run = (
        f"| {ASKED['named'].words} | 20 of 25 (80%) | |\n"
        f"| {ASKED['pairs'].words} | 10 of 10 (100%) | |\n"
        f"| {ASKED['wrong'].words} | 1 of 10 (10%) | |\n"
    )
    page = with_run(PAGE, "second", "a line", run)
    assert expected("named", "second", page) == 0.8
    assert expected("pairs", "second", page) == ASKED["pairs"].share
    assert expected("wrong", "second", page) == 0.1
    assert expected("spurious", "second", page) == ASKED["spurious"].share  # not in that run


def test_ranks_of_true_sizes_are_uniform_where_intervals_are_right() -> None:
    said = answer("leakage")
    assert Case("single", 1, "gripper", [replace(LEAK, size=0.9)], said).rank == 0.5
    assert Case("single", 1, "gripper", [replace(LEAK, size=0.8)], said).rank == pytest.approx(
        0.025
    )
    assert Case("single", 1, "gripper", [replace(LEAK, size=1.1)], said).rank == pytest.approx(
        0.975
    )
    assert Case("single", 1, "gripper", [replace(LEAK, course="step")], said).rank is None
    assert "Ranks of 1 true sizes" in tables([single("leakage")])


def test_a_spurious_cause_is_one_beside_those_that_act() -> None:
    found, other = answer("leakage"), answer("sensor_gain")["causes"]
    assert single("leakage").outcomes["spurious"] is False
    case = Case("single", 7, "gripper", [LEAK], found | {"causes": found["causes"] + other})
    assert case.outcomes["spurious"] is True


@pytest.mark.parametrize("kind", FOUND)
def test_a_case_that_ends_in_an_error_is_not_found(kind: str) -> None:
    case = Case(kind, 3, "gripper", [LEAK], error="no suction phase")
    assert case.outcomes == {FOUND[kind]: False}
    assert set(case.outcomes) <= set(ASKED)
    text = tables([case])
    if kind == "commissioning":
        assert "| no suction phase | 1 |" in text
    else:
        assert f"| {kind} | 3 | gripper | leakage constant 1 | – | – | error | – | – |" in text


def test_a_refusal_of_the_diagnosis_is_an_error_of_the_case(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refused(*_: object) -> object:
        raise TwinError("no suction phase", "record more")

    one = battery_first.Unit("gripper", None, None)  # type: ignore[arg-type]
    monkeypatch.setattr(battery_first, "drawn_case", lambda *_, **__: (one, [LEAK], None))
    monkeypatch.setattr(battery_first, "diagnose", refused)
    case = battery_first.answered("single", 3, 1)
    assert (case.verdict, case.error) == ("error", "no suction phase")


def commissioning(seed: int, verdict: str, times: float, true: bool | None = None) -> Case:
    if true is not None:
        return Case("commissioning", seed, "micro", error="a row each 10 ms", more={"true": true})
    residual = {"suction": {"times": 1.0}, "blow_off": {"times": times}}
    held = {"true": 10.0, "value": 11.0, "low95": 9.0, "high95": 13.0, "holds": True}
    found = {"verdict": verdict, "residual": residual, "covered": {"ejector.x": held}}
    return Case("commissioning", seed, "micro", answer=found, seconds=float(seed))


def test_commissionings_are_told_by_verdict_phase_parameter_and_reason() -> None:
    cases = [
        commissioning(1, "good", 1.2),
        commissioning(2, "refused", 3.0),
        commissioning(3, "", 0.0, true=True),
    ]
    text = tables(cases)
    assert "| rigs commissioned without editing a number | 1 of 3 (33%) | 1% to 91% |" in text
    assert "| refused for a reason that is true of the record | 1 of 2 (50%) |" in text
    assert "| micro | 3 | 1 | – | 1 | 1 |" in text
    assert "| blow_off | 2 | 2.10 | 2.82 | 3.00 |" in text
    assert "| the worst phase | 2 | 2.10 | 2.82 | 3.00 |" in text
    assert "| `ejector.x` | 1 | 1 | 10% | ±18% |" in text  # of those that are stored
    assert "| a row each … ms | 1 | yes | 3 |" in text
    assert "most in blow_off | 1 | **no** | 2 |" in text
    assert "| commissioning | 3 | 1.0 s | 1.9 s | 2.0 s |" in text


def test_chance_says_how_likely_so_few_are() -> None:
    cases = [Case("healthy", seed, "gripper", (), answer("x")) for seed in range(3)]
    assert likely(cases, "consistent") == pytest.approx(0.02**3)
    right = Case("healthy", 9, "gripper", (), answer("x", "consistent"))
    assert likely([*cases, right], "consistent") > likely(cases, "consistent")


# The file of cases.

RUN = {"first": 12, "commit": "abc"}


def test_a_run_that_was_cut_goes_on_where_it_ended(tmp_path: Path) -> None:
    path, case = tmp_path / "cases.jsonl", single("leakage")
    CaseFile(path, RUN).add("second", case)
    with path.open("a") as file:
        file.write('{"world": "second", "kind": "sin')  # cut
    assert first_of(path) == 12
    again = CaseFile(path, RUN)
    assert again.get("second", ("single", 7, 0)) == case
    assert again.get("first", ("single", 7, 0)) is None
    again.add("first", replace(case, seed=8))
    assert [json.loads(line).get("seed") for line in path.read_text().splitlines()] == [None, 7, 8]


def test_a_stored_run_is_counted_anew_under_its_own_commit(tmp_path: Path) -> None:
    path, page = tmp_path / "cases.jsonl", tmp_path / "page.md"
    page.write_text(PAGE, encoding="utf-8")
    CaseFile(path, RUN).add("second", single("leakage"))
    for _ in range(2):
        recounted(path, page)
    text = page.read_text(encoding="utf-8")
    assert "second world, commit abc, seeds 7 to 7: found 1 of 1 single.**" in text
    assert "commit abc" not in text.partition("<!-- older runs")[2]  # no run of its own twice


def test_cases_of_another_run_are_not_mixed(tmp_path: Path) -> None:
    path = tmp_path / "cases.jsonl"
    CaseFile(path, RUN)
    with pytest.raises(ValueError, match=re.escape(str(path))):
        CaseFile(path, RUN | {"commit": "abd"})
