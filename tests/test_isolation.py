"""Causes named while the loop runs: from a rig with a small fault that begins, and is mended."""

import gc
import math
import weakref
from collections.abc import Sequence

import numpy as np
import pytest
import rigs
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from twin.alarms import watch
from twin.events import Event, Kind
from twin.model.catalogue import CatalogueEffect
from twin.model.effects import EFFECTS, UNKNOWN
from twin.monitor import isolation, score_prediction
from twin.monitor.bins import Floats
from twin.monitor.cycles import Cycle, CycleView, cut, figures
from twin.monitor.healthy import Healthy
from twin.monitor.isolation import Isolation, Verdict
from twin.monitor.likeness import Likeness
from twin.monitor.model_bank import SUSPECTS, ModelBank, hypotheses
from twin.monitor.monitor import Monitor
from twin.monitor.settings import MonitorSettings
from twin.signals import SAMPLE, TICK, Samples, Ticks

BEGINS, CYCLES = 30, 42
SECONDS = {"test_rig": 3.2, "gripper": 2.3}  # of a cycle, at most


def events(
    name: str, faults: Sequence[str], cycles: int = CYCLES, seed: int = 11, size: int = 1000
) -> list[Event]:
    samples, _ = rigs.recorded(name, cycles * SECONDS[name], tuple(faults), seed)
    twin, watched, told = rigs.twin(name), rigs.isolating(name), []
    for block in rigs.cut(samples, size):
        told += watched.update(*twin.advance(block))
    return told + watched.update(*twin.flush()) + watched.close()


def piece(rows: Samples, ticks: Ticks) -> Cycle:
    """Rows that are no whole cycle."""
    return Cycle(0, rows, ticks, complete=False)


def raised(told: Sequence[Event]) -> list[Event]:
    return [event for event in told if event.kind is Kind.DEVIATION]


def named(told: Sequence[Event]) -> list[Event]:
    return [event for event in raised(told) if event.data["effect"] != UNKNOWN]


def probabilities(told: Sequence[Event]) -> dict[int, dict[str, float]]:
    """By cycle."""
    return {
        event.data["cycle"]: event.data["probabilities"]
        for event in told
        if event.kind is Kind.CYCLE and "probabilities" in event.data
    }


# All are far below what a single cycle's figures show (six sigma).
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "effect", "size"),
    [
        ("test_rig", "suction_loss", 1.2),
        ("test_rig", "leakage", 0.25),
        ("test_rig", "threshold_drift", 4.0),
        ("gripper", "check_valve_leak", 0.3),
        ("gripper", "response_delay", 4.0),
        ("gripper", "sensor_offset", 2.0),
    ],
)
def test_a_small_fault_is_found_within_cycles_and_named(
    name: str, effect: str, size: float
) -> None:
    told = events(name, [f"{effect}={size}@c{BEGINS}"])
    assert 0 <= raised(told)[0].data["cycle"] - BEGINS <= 5
    first = named(told)[0]
    assert 0 <= first.data["cycle"] - BEGINS <= 5
    assert first.data["effect"] == effect
    assert first.data["size"] == pytest.approx(size, rel=0.5)
    last = probabilities(told)[max(probabilities(told))]
    assert last["none"] < 0.01
    # A sensor drifts a tenth as often as things wear, and weather moves much alike.
    assert last[effect] > (0.9 if EFFECTS[effect].often == 1.0 else 0.85)


@pytest.mark.slow
@pytest.mark.parametrize("name", rigs.NAMES)
@pytest.mark.parametrize("seed", [21, 22])
def test_healthy_cycles_are_probably_nothing(name: str, seed: int) -> None:
    told = events(name, [], 60, seed)
    assert raised(told) == []
    assert len(probabilities(told)) > 40
    assert min(chance["none"] for chance in probabilities(told).values()) > 0.5


def test_probabilities_are_of_one_cause_or_none() -> None:
    for chances in probabilities(events("test_rig", [f"leakage=0.25@c{BEGINS}"])).values():
        assert sum(chances.values()) == pytest.approx(1.0, abs=0.05)
        assert set(chances) <= {"none", UNKNOWN, *(suspect.effect for suspect in SUSPECTS)}


@pytest.mark.parametrize("name", rigs.NAMES)
def test_what_is_not_known_of_a_low_supply_is_nothing_unlisted(name: str) -> None:
    told = probabilities(events(name, [f"supply_pressure_drop=0.4@c{BEGINS}"]))
    assert told[max(told)].get(UNKNOWN, 0.0) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "listed", "unlisted"),
    [
        ("gripper", "leakage=2", "lip_lift=4"),
        ("test_rig", "leakage=0.25", "condensate=6"),
    ],
)
def test_what_nobody_listed_is_an_alternative_to_the_name(
    name: str, listed: str, unlisted: str
) -> None:
    said = []
    for fault in (listed, unlisted):
        told = probabilities(events(name, [f"{fault}@c{BEGINS}"]))
        said.append(told[max(told)].get(UNKNOWN, 0.0))
    assert said[0] < 0.05
    assert said[1] > 0.25


def test_an_effect_that_was_taken_in_is_named_like_any_other() -> None:
    """And those of the table keep their names beside it."""
    lip = CatalogueEffect.model_validate(
        {
            "mechanism": "opening_above",
            "sentence": "A lip lifts off",
            "look_at": "the lips of the cups",
            "parameters": {
                "sonic_flow": {"low": 0.0, "high": 60.0, "found": 1.7},
                "begins": {"low": 180.0, "high": 900.0, "found": 554.0},
                "ends_below": {"low": 10.0, "high": 400.0, "found": 147.0},
            },
        }
    )
    config = rigs.config("gripper")
    data = config.data.model_copy(update={"catalogue": {"lifting_lip": lip}})
    for fault, effect, size in (
        ("lip_lift=1.5", "lifting_lip", 1.5),
        ("leakage=0.5", "leakage", 0.5),
    ):
        watched = rigs.isolating("gripper")
        watched.isolation = Isolation.of(data, config.monitor.healthy, 30.0)
        samples, _ = rigs.recorded("gripper", CYCLES * 2.3, (f"{fault}@c{BEGINS}",), 11)
        twin, told = rigs.twin("gripper"), list[Event]()
        for block in rigs.cut(samples, 1000):
            told += watched.update(*twin.advance(block))
        first = named(told)[0]
        assert first.data["effect"] == effect
        assert first.data["size"] == pytest.approx(size, rel=0.3)
        evidence = watch.evidence(first)
        (found,) = evidence.values()
        words = {"name": effect, "sentence": "A lip lifts off", "look_at": "the lips of the cups"}
        assert found.get("taken_in") == (words if effect == "lifting_lip" else None)


def test_what_is_told_does_not_depend_on_blocks() -> None:
    assert events("gripper", [f"leakage=0.5@c{BEGINS}"], size=47) == events(
        "gripper", [f"leakage=0.5@c{BEGINS}"], size=60_000
    )


def test_a_fault_that_goes_is_cleared() -> None:
    samples, _ = rigs.recorded("gripper", 90 * 2.3, (f"suction_loss=2@c{BEGINS}",), 5)
    healthy, _ = rigs.recorded("gripper", 90 * 2.3, (), 5)
    # The same cycles, without the fault from a suction edge on.
    edge = _edge(samples, 45)
    whole = np.concatenate([samples[:edge], healthy[_edge(healthy, 45) :]])
    whole["sequence"] = np.arange(len(whole))
    whole["time_ns"] = samples["time_ns"][0] + np.arange(len(whole)) * 1_000_000
    whole["host_ns"] = whole["time_ns"]
    twin, watched, told = rigs.twin("gripper"), rigs.isolating("gripper"), []
    for block in rigs.cut(whole, 1000):
        told += watched.update(*twin.advance(block))
    (alarm,) = named(told)
    assert alarm.data["effect"] == "suction_loss"
    (cleared,) = [event for event in told if event.kind is Kind.DEVIATION_CLEARED]
    assert cleared.time_ns > int(whole["time_ns"][edge])
    assert watched.active == ""


def _edge(samples: Samples, cycle: int) -> int:
    """The row at which a cycle's suction begins."""
    edges = np.flatnonzero(np.diff((samples["commands"] == 1).astype(int)) == 1) + 1
    return int(edges[cycle])


def test_only_what_is_fit_to_be_judged_says_something() -> None:
    samples, _ = rigs.recorded("gripper", 12.0)
    cycles = list(cut([rigs.expectation(rigs.twin("gripper"), [samples])]))
    theta = rigs.theta("gripper")
    looks = [
        CycleView(cycle, None, figures(cycle, theta), fit=cycle.index != 2, theta=theta)
        for cycle in cycles
    ]
    isolation = rigs.isolating("gripper").isolation
    assert isolation
    heard = isolation.extract(looks)
    saying = {one.index: said for one, said in zip(cycles, heard, strict=True) if said}
    assert list(saying) == [cycle.index for cycle in cycles if cycle.complete and cycle.index != 2]
    for cycle in cycles:
        if cycle.index in saying:
            lasted = np.ptp(cycle.samples["time_ns"]) * 1e-9
            assert saying[cycle.index].seconds == pytest.approx(lasted)


def test_what_is_far_out_is_not_learned_as_usual() -> None:
    told = events("gripper", ["leakage=10@c3"], 40)
    assert raised(told)  # by a single cycle's figures
    assert probabilities(told) == {}  # nobody knows what is usual


def test_a_gross_fault_on_top_of_a_small_one_that_stands_is_told() -> None:
    told = events("gripper", [f"sensor_offset=2@c{BEGINS}", "leakage=10@c60"], 66)
    first, second = named(told)[:2]
    assert first.data["effect"] == "sensor_offset"
    assert second.data["effect"] in ("leakage", "porous_leakage")  # much alike when gross
    assert second.data["cycle"] == 61
    (begun,) = [event for event in raised(told) if event.data["cycle"] == 60]
    assert begun.data["effect"] == UNKNOWN


def test_without_anything_known_of_healthy_cycles_sums_alarm_still() -> None:
    samples, _ = rigs.recorded("gripper", CYCLES * 2.3, (f"leakage=8@c{BEGINS}",), 11)
    watched = Monitor(MonitorSettings(), rigs.theta("gripper"))
    watched.isolation = Isolation.of(rigs.config("gripper").data, Healthy(), 30.0)
    twin = rigs.twin("gripper")
    told = [
        event for block in rigs.cut(samples, 1000) for event in watched.update(*twin.advance(block))
    ]
    (alarm,) = raised(told)
    assert alarm.data["figure"] == "cycles"
    assert alarm.data["effect"] == UNKNOWN  # nobody knows how far off its twin is


def test_sizes_are_possible_ones() -> None:
    told = events("test_rig", [f"supply_pressure_drop=3@c{BEGINS}"])
    for event in named(told):
        ends = [suspect.parameter for suspect in SUSPECTS if suspect.effect == event.data["effect"]]
        assert any(end.low < event.data.get("size", end.typical) < end.high for end in ends)


def test_the_bank_expects_what_the_twin_expects_where_it_is_drawn() -> None:
    samples, _ = rigs.recorded("gripper", 6.0)
    rows, ticks = rigs.expectation(rigs.twin("gripper"), [samples])
    bank = ModelBank(rigs.theta("gripper"))
    for end in range(700, len(rows), 700):
        bank.run_ahead(rows[:end], ticks[:end], at_edge=False)
    drawn, together = bank.take(piece(rows, ticks))
    assert together.shape == (len(drawn), len(hypotheses(rigs.theta("gripper"))))
    assert 0.1 < len(drawn) / len(rows) < 0.35
    known = np.isfinite(ticks["expected"][drawn])
    assert known.sum() > 500
    # Between drawn rows the line between them is enough; it is stepped more roughly.
    line = np.interp(np.arange(len(rows)), drawn[known], together[known, 0])
    inside = np.arange(drawn[known][0], drawn[known][-1])
    assert np.abs(line[inside] - ticks["expected"][inside]).max() < 60.0  # Pa
    assert np.abs(together[known, 0] - ticks["expected"][drawn[known]]).max() < 30.0


@pytest.mark.parametrize("size", [1, 13, 400])
def test_what_the_bank_draws_does_not_depend_on_blocks(size: int) -> None:
    samples, _ = rigs.recorded("gripper", 3.0)
    rows, ticks = rigs.expectation(rigs.twin("gripper"), [samples])
    whole, cut = ModelBank(rigs.theta("gripper")), ModelBank(rigs.theta("gripper"))
    for end in range(size, len(rows), size):
        cut.run_ahead(rows[:end], ticks[:end], at_edge=False)
    all_of_it = piece(rows, ticks)
    for one, other in zip(whole.take(all_of_it), cut.take(all_of_it), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_plc_that_is_silent_for_days_fills_no_memory() -> None:
    watched = rigs.isolating("gripper")
    nothing, none = np.empty(0, SAMPLE), np.empty(0, TICK)
    gone = weakref.ref(nothing)
    watched.update(nothing, none)
    del nothing
    gc.collect()
    assert gone() is None


def test_rows_and_ticks_of_the_bank_go_with_cycles_through_a_gap() -> None:
    samples = rigs.recorded("test_rig", 40.0)[0].copy()
    samples["quality"][20_000] |= 1
    twin, watched = rigs.twin("test_rig"), rigs.isolating("test_rig")
    parts: list[tuple[Samples, Ticks]] = [twin.advance(samples), twin.flush()]
    for rows, ticks in parts:
        watched.update(rows, ticks)
    watched.close()
    assert watched.isolation is not None
    bank = watched.isolation._bank
    assert len(bank._expected) == bank._stepped == 0
    assert bank._last_ns == int(samples["time_ns"][-1])


def test_a_change_that_begins_is_not_learned_as_usual() -> None:
    # Some sigmas a cycle: were the first such cycles learned, the next would look less strange.
    first = named(events("gripper", ["weak_blow_off=1.5@c20"], 30))[0]
    assert first.data["effect"] == "weak_blow_off"
    assert 20 <= first.data["cycle"] <= 25


@pytest.mark.parametrize("wanders", [score_prediction.WANDERS, 0.0])
def test_scores_of_a_zero_that_wanders_are_independent(
    wanders: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(score_prediction, "WANDERS", wanders)
    samples = rigs.recorded("gripper", 160 * SECONDS["gripper"], (), 5)[0].copy()
    rng, wander = np.random.default_rng(1), np.zeros(len(samples) // 100 + 1)
    keeps = math.exp(-0.1 / 60.0)
    for step in range(1, len(wander)):  # 0.4 mbar, with a time constant of a minute
        kick = rng.normal(0.0, 40.0 * math.sqrt(1.0 - keeps**2))
        wander[step] = keeps * wander[step - 1] + kick
    samples["pressure"] += np.interp(np.arange(len(samples)) / 100, np.arange(len(wander)), wander)
    watched, twin, config = rigs.monitor("gripper"), rigs.twin("gripper"), rigs.config("gripper")
    watched.isolation = Isolation.of(config.data, config.monitor.healthy, 1e9)  # raises nothing
    for block in rigs.cut(samples, 5000):
        watched.update(*twin.advance(block))
    zero = [suspect.effect for suspect in SUSPECTS].index("sensor_offset")
    values = np.array(watched.isolation._scored)[20:, zero]
    next_to = float(np.mean(values[1:] * values[:-1]) / np.mean(values**2))
    assert next_to < 0.25 if wanders else next_to > 0.5


@pytest.mark.parametrize(("worth", "is_told"), [(isolation.WORTH, False), (0.0, True)])
def test_a_steady_change_too_small_for_an_alarm_is_not_told(
    worth: float, is_told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(isolation, "WORTH", worth)
    told = events("test_rig", [f"check_valve_leak=0.018@c{BEGINS}"], 80, 12)  # of 1 sl/min
    assert bool(raised(told)) is is_told


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "effect", "size"), [("test_rig", "leakage", 0.8), ("gripper", "suction_loss", 4.0)]
)
def test_a_slow_drift_is_found_while_it_is_small(name: str, effect: str, size: float) -> None:
    begin_s = SECONDS[name] * BEGINS
    told = events(name, [f"{effect}={size}@{begin_s}/ramp:300"], 80)
    first = named(told)[0]
    assert BEGINS - 3 <= first.data["cycle"] <= BEGINS + 20
    last = probabilities(told)[max(probabilities(told))]
    assert last[effect] > 0.9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fault", "seed"),
    [
        ("test_rig", "threshold_drift=-150@59.4392", 24),
        ("gripper", "check_valve_leak=14.286@41.5007", 43),
    ],
)
def test_the_name_of_a_gross_fault_stays(name: str, fault: str, seed: int) -> None:
    """It begins within a cycle. What small signatures say of it later is another cause."""
    told = events(name, [fault], 31, seed)
    assert raised(told)[0].data["effect"] == UNKNOWN
    assert [event.data["effect"] for event in named(told)] == [fault.split("=", maxsplit=1)[0]]


def test_where_it_is_known_that_something_differs_the_causes_share_all_of_it() -> None:
    """A cycle that is far out by itself has changed, whatever the sums over cycles hold of it."""
    leak, other = Likeness("leakage", 1.0, "sl/min", 0.03), Likeness(UNKNOWN, None, "", 0.01)
    found = Verdict(0.96, [leak, other]).where_changed()
    assert found.none == 0.0
    assert [cause.share for cause in found.causes] == pytest.approx([0.75, 0.25])
    assert Verdict(1.0, ()).where_changed().causes == []


@given(hnp.arrays(np.float64, 6, elements=st.floats(-1e6, 1e6)), st.integers(0, 100))
def test_no_size_is_beyond_its_bounds(off: Floats, seed: int) -> None:
    signatures = np.random.default_rng(seed).normal(size=(6, 3))
    bounds = np.array([[-1.0, 1.0], [0.0, 2.0], [0.0, math.inf]])
    sizes, _ = isolation._fitted(off[:, None], signatures, bounds)
    assert (sizes >= bounds[:, 0]).all()
    assert (sizes <= bounds[:, 1]).all()
