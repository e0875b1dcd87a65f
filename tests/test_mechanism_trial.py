"""The trial of mechanisms: what it changes on a rig, how it scores, and that it resumes."""

from dataclasses import replace
from pathlib import Path

import pytest
import rigs

from tools import battery_first, battery_second, mechanism_trial
from tools.battery_cases import Case, CaseFile, Hidden
from tools.mechanism_trial import (
    CONDENSATE,
    OF_VOLUME,
    RIGHT,
    SIZES,
    cases,
    holds_size,
    is_right,
    is_worse,
    recounted,
    reduces,
    share,
    summary,
    table,
    wrongly_sure,
)
from tools.mechanism_worlds import CHANGES, Change, changed_config, changed_rig
from twin.model.effects import effect_of
from twin.model.mechanism import PLACES, WHENS
from twin.signals import BAR

RMS = {name: [10.0, 2.0, 1.0] for name in CHANGES}


def case(effect: str, *mechanisms: str, world: str = "first") -> Case:
    more = {"mechanisms": list(mechanisms), "judged": RMS, "world": world}
    hidden = [Hidden(effect, "constant", 1.0)]
    answer = {"verdict": "unlisted", "causes": [], "unlisted": None}
    return Case("unlisted", 1, "gripper", hidden, answer, more=more)


def test_both_worlds_hide_twelve_or_more_and_each_has_a_place_and_a_way_of_acting() -> None:
    for hidden in (battery_first.OUTSIDE, battery_second.OUTSIDE):
        assert len(hidden) >= 12
        assert set(hidden) <= {*RIGHT, "condensate"}
    for places, whens in (*RIGHT.values(), *CONDENSATE.values()):
        assert set(places) <= set(PLACES)
        assert set(whens) <= set(WHENS)


def test_place_and_dependence_are_right_among_at_most_three() -> None:
    assert is_right(case("supply_swing", "supply_swinging"))
    assert is_right(case("supply_swing", "inflow_swinging", "supply_swinging"))
    assert not is_right(case("supply_swing", "supply_nozzle_on_slowly"))
    assert not is_right(case("supply_swing"))
    assert not is_right(case("lip_lift", "opening_above", *["seepage_above"] * 3))
    assert is_right(case("condensate", "line_gathered", world="second"))
    assert not is_right(case("condensate", "line_gathered"))


def told(effect: str, size: float, name: str, world: str = "first", **sizes: list[float]) -> Case:
    """A case whose mechanism is told with intervals."""
    shown = {key: {"low95": low, "high95": high} for key, (low, high) in sizes.items()}
    named = case(effect, name, world=world)
    mechanism = {"name": name, "sentence": "It acts", "parameters": shown}
    answer = {**(named.answer or {}), "unlisted": {"mechanism": mechanism}}
    return replace(named, hidden=[Hidden(effect, "constant", size)], answer=answer)


def test_a_size_counts_where_it_means_what_was_hidden() -> None:
    assert holds_size(told("lip_lift", 3.9, "inflow_above", flow=[3.2, 4.5])) is True
    assert holds_size(told("lip_lift", 5.0, "inflow_above", flow=[3.2, 4.5])) is False
    assert holds_size(told("supply_swing", 1.3, "supply_swinging", drop=[-1.5, -1.1])) is True
    assert holds_size(told("lip_lift", 3.9, "seepage_above", flow_at_600mbar=[3.2, 4.5])) is None
    gathered = told("sensor_thermal_drift", 18.7, "sensor_gathered", offset=[10.0, 20.0])
    assert holds_size(gathered) is None  # another way of acting
    leak = ("blow_off_valve_leak", 2.0, "inflow_always")
    assert holds_size(told(*leak, flow=[1.0, 3.0])) is True
    assert holds_size(told(*leak, world="second", flow=[1.0, 3.0])) is None
    for effect, places in SIZES.items():
        for place, parameter in places.items():
            known = PLACES[place].parameters if place in PLACES else effect_of(place).parameters
            assert parameter in {p.name for p in known}
            assert effect == "sticking_valve" or place in RIGHT[effect][0]
    assert set(SIZES) >= OF_VOLUME


def test_a_sticking_valve_has_the_size_of_its_delay_and_no_other_cause_is_right() -> None:
    delay = {"delay": {"low95": 20.0, "high95": 50.0}}
    cause = {"effect": "response_delay", "course": "intermittent", "not_separable_from": []}
    stuck = told("sticking_valve", 30.0, "")
    stuck = replace(stuck, answer={"verdict": "explained", "unlisted": None})
    sure = {"causes": [cause | {"parameters": delay, "probability": 0.96}]}
    named = replace(stuck, answer={**(stuck.answer or {}), **sure})
    assert holds_size(named) is True
    assert wrongly_sure(named) == []
    mimicked = replace(named, hidden=[Hidden("lip_lift", "constant", 30.0)])
    assert wrongly_sure(mimicked) == ["response_delay"]
    doubted = {"causes": [cause | {"parameters": delay, "probability": 0.9}]}
    assert wrongly_sure(replace(mimicked, answer={**(stuck.answer or {}), **doubted})) == []


def test_a_case_counts_if_it_holds_under_all_other_conditions() -> None:
    judged = {"same": [10.0, 9.0, 1.0], "suction × 2": [10.0, 2.0, 1.0]}
    held = replace(case("lip_lift"), more={"judged": judged, "world": "first"})
    assert reduces(held) is True
    judged = judged | {"volume − 30 %": [10.0, 5.0, 1.0], "supply + 1 bar": [1.0, 1.0, 1.0]}
    assert reduces(replace(held, more={"judged": judged, "world": "first"})) is False
    assert reduces(replace(held, more={"world": "first"})) is None
    text = summary([told("lip_lift", 3.9, "inflow_above", flow=[3.2, 4.5])])
    assert "In 1 of 1 cases it has that share" in text
    assert "holds the true one in 1 of 1 cases" in text
    assert "with 95% or more in 0 of 1 cases" in text


def test_a_stored_run_is_scored_anew(tmp_path: Path) -> None:
    file = CaseFile(tmp_path / "cases.jsonl", {"first": 1, "commit": "abc"})
    file.add("second", Case("commissioning", 1, "gripper"))
    stored = file.add("second", case("lip_lift", world="second"))
    assert recounted(tmp_path / "cases.jsonl") == {"first": [], "second": [stored]}


def test_shares_are_of_what_can_be_reached() -> None:
    assert share([10.0, 2.0, 0.0]) == pytest.approx(0.8)
    assert share([10.0, 1.0, 1.0]) == pytest.approx(1.0)
    assert share([1.1, 1.0, 1.0]) is None
    assert is_worse([10.0, 11.0, 1.0])
    assert not is_worse([10.0, 10.1, 1.0])


def test_the_data_set_is_changed_as_the_rig_is() -> None:
    config = rigs.config("test_rig")
    changed = changed_config(config, Change(supply_bar=-1.0, volume=1.3)).data
    before, after = config.data.system.parts[-1], changed.system.parts[-1]
    assert after.volume_ml == pytest.approx(1.3 * before.volume_ml)  # type: ignore[union-attr]
    assert changed.supply.pressure_bar == pytest.approx(config.data.supply.pressure_bar - 1.0)
    rig = battery_second.draw_rig(3)
    other = changed_rig(rig, Change(suction=2.0, supply_bar=1.0))
    assert other.program.suction_s == 2.0 * rig.program.suction_s
    assert other.supply.supply_gauge - rig.supply.supply_gauge == pytest.approx(BAR)


def test_a_run_goes_on_where_it_was_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[int] = []

    def trial(_world: str, seed: int, _subject: object) -> Case:
        tried.append(seed)
        return Case("unlisted", seed, "gripper", [Hidden("lip_lift", "constant", 2.0)], error="no")

    monkeypatch.setattr(mechanism_trial, "first", lambda _seed: object())
    monkeypatch.setattr(mechanism_trial, "trial", trial)
    path = tmp_path / "cases.jsonl"
    list(cases("first", 5, 1, CaseFile(path, {"first": 5})))
    results = list(cases("first", 5, 2, CaseFile(path, {"first": 5})))
    assert tried == [5, 6]
    assert table(results).count("| gripper | lip_lift 2 | no |") == 2
