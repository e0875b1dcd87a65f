"""The trial of mechanisms: what it changes on a rig, how it scores, and that it resumes."""

from pathlib import Path

import pytest
import rigs

from tools import battery_first, battery_second, mechanism_trial
from tools.battery_cases import Case, CaseFile, Hidden
from tools.mechanism_trial import CONDENSATE, RIGHT, cases, is_right, is_worse, share, table
from tools.mechanism_worlds import CHANGES, Change, changed_config, changed_rig
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
