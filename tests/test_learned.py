"""The learned classifier beside the battery: what it sees, what it learns, how both are counted."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.plc.faults import parse_fault
from tools import learned_features, learned_models
from tools.battery import SEEDS
from tools.battery_cases import Case, Hidden
from tools.battery_first import Unit
from tools.battery_page import ASKED, marked
from tools.calibration_coverage import recorded, rig_of, shipped
from tools.learned import MARK, TRAINING, answered, compared, summary, written
from tools.learned_features import (
    FIRST_SEED,
    FIRST_UNIT,
    PLACES,
    Record,
    RecordFile,
    features,
    mean_at,
    of_record,
    training_keys,
)
from tools.learned_models import CLASSIFIERS, Learned, half_width, label, named, unlisted_unseen
from twin.config import Config

PAGE = (Path(__file__).parent.parent / "docs" / "battery.md").read_text(encoding="utf-8")
# In made records each effect moves a feature of its own, by its size.
MOVES = {"leakage": 0, "suction_loss": 1, "strange": 2}
LEAK = Hidden("leakage", "constant", 2.0)


def made(effect: str | None, size: float, seed: int, course: str = "constant") -> Record:
    """A record of six features: one for each effect, one that drifts with a ramp, and noise."""
    rng = np.random.default_rng(seed)
    values = rng.normal(0.0, 0.05, 6)
    if effect is not None:
        values[MOVES[effect]] += size
        values[3] += size * (course == "ramp")
    hidden = [] if effect is None else [Hidden(effect, course, size)]
    kind = "unlisted" if effect == "strange" else "single" if effect else "healthy"
    return Record(kind, FIRST_SEED + seed, 4, hidden, float(seed % 5), values, 0.5)


def training() -> list[Record]:
    """Records of every kind, sizes evenly drawn."""
    rng = np.random.default_rng(7)
    drawn = [(name, course) for name in MOVES for course in ("constant", "ramp")] * 20
    records = [
        made(name, float(rng.uniform(1.0, 8.0)), seed, course)
        for seed, (name, course) in enumerate(drawn)
    ]
    return records + [made(None, 0.0, 1000 + seed) for seed in range(40)]


@pytest.fixture(scope="module")
def learned() -> Learned:
    quick = ("logistic regression", "randomised trees, tempered")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learned_models, "CLASSIFIERS", {name: CLASSIFIERS[name] for name in quick})
        return Learned.fit(training())


# --- what it learns from --------------------------------------------------------------------------


def test_no_training_seed_is_one_of_the_battery() -> None:
    keys = training_keys(TRAINING)
    assert len(keys) == len(set(keys)) == sum(TRAINING.values())
    assert min(seed for _, seed in keys) >= FIRST_SEED >= 2 * SEEDS


def test_the_first_training_cases_are_of_every_kind_in_proportion() -> None:
    first = [kind for kind, _ in training_keys(TRAINING)[:200]]
    for kind, many in TRAINING.items():
        assert first.count(kind) == pytest.approx(200 * many / sum(TRAINING.values()), abs=2)


def test_training_rigs_are_none_that_are_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[tuple[Any, ...]]()

    def drawn_case(*of: Any) -> None:
        asked.append(of)
        raise LookupError

    monkeypatch.setattr(learned_features, "drawn_case", drawn_case)
    for seed in (SEEDS - 1, FIRST_SEED):
        with pytest.raises(LookupError):
            RecordFile(None).get("single", seed, 10)
    assert asked == [("single", SEEDS - 1, 10, 0), ("single", FIRST_SEED, 10, FIRST_UNIT)]
    assert FIRST_UNIT >= 1000  # a run of the battery has tens


def test_records_that_are_judged_are_not_learned_from() -> None:
    with pytest.raises(ValueError, match="845000"):
        Learned.fit([*training(), replace(made("leakage", 2.0, 1), seed=845000)])


def test_a_file_keeps_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, one = tmp_path / "records.npz", made("leakage", 2.0, 1)
    ejector = SimpleNamespace(suction_capacity_sl_min=one.rig)
    unit = SimpleNamespace(config=SimpleNamespace(data=SimpleNamespace(ejector=ejector)))
    monkeypatch.setattr(learned_features, "drawn_case", lambda *_: (unit, one.hidden, None))
    monkeypatch.setattr(learned_features, "features", lambda *_: one.features)
    records = RecordFile(path)
    drawn = records.get(one.kind, one.seed, one.units)
    records.write()
    monkeypatch.undo()
    kept = RecordFile(path).get(one.kind, one.seed, one.units)
    assert np.array_equal(kept.features, one.features)
    assert replace(kept, features=drawn.features) == drawn


# --- features -------------------------------------------------------------------------------------


def test_a_place_has_the_mean_of_its_bins_and_nan_where_none_is() -> None:
    means = mean_at(np.array([3, 3, 5]), np.array([1.0, 3.0, -1.0]))
    assert means[3] == 2.0
    assert means[5] == -1.0
    assert np.isnan(means).sum() == PLACES - 2


def test_mean_spread_drift_and_the_cycle_that_is_off_most() -> None:
    ramp, some = np.arange(6.0), np.array([0.0, 0.0, 9.0, 0.0, 0.0, 0.0])
    nothing = np.full(6, np.nan)
    values = of_record(np.column_stack([ramp, some, nothing])).reshape(4, 3)
    assert values[:, :2] == pytest.approx(
        np.array([[2.5, 1.5], [ramp.std(), some.std()], [4.0, 0.0], [2.0, 9.0]])
    )
    assert np.isnan(values[:, 2]).all()


@pytest.fixture(scope="module")
def unit() -> Unit:
    document = shipped("test_rig")
    return Unit("test_rig", rig_of(document), Config.of(document))


def by_statistic(unit: Unit, *faults: str) -> Any:
    """Features of a record of four cycles, (statistics, columns of a cycle)."""
    samples = recorded(unit.plc, 4, 5, [parse_fault(fault) for fault in faults])
    values = features(unit, samples)
    assert values[-1] == 0.0  # the first system
    return values[:-1].reshape(4, 2 * PLACES + 3)


def test_healthy_cycles_stay_within_their_sigmas_and_a_leak_stands_out(unit: Unit) -> None:
    healthy, leaking = by_statistic(unit), by_statistic(unit, "leakage=3")
    white = slice(PLACES, 2 * PLACES)
    assert np.sqrt(np.nanmean(healthy[0, white] ** 2)) < 1.5
    assert np.nanmax(np.abs(leaking[0, white])) > 3.0 * np.nanmax(np.abs(healthy[0, white]))


def test_switching_levels_are_held_against_healthy_ones(unit: Unit) -> None:
    levels = slice(2 * PLACES, 2 * PLACES + 1)  # H1 alone: a tight rig switches off once
    healthy, drifted = by_statistic(unit), by_statistic(unit, "threshold_drift=10")
    assert np.abs(healthy[0, levels]) < 3.0
    assert drifted[0, levels] - healthy[0, levels] > 5.0


# --- answers --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_leak_in_clean_features_is_recognised(learned: Learned) -> None:
    answer = learned.answer(made("leakage", 4.0, 9001).features)
    (cause,) = answer["causes"]
    size = cause["parameters"]["size"]
    assert answer["verdict"] == "explained"
    assert (cause["effect"], cause["course"]) == ("leakage", "constant")
    assert cause["probability"] > 0.8
    assert size["low95"] < 4.0 < size["high95"]
    assert size["value"] == pytest.approx(4.0, rel=0.2)


def test_a_ramp_says_what_it_comes_to(learned: Learned) -> None:
    record = made("suction_loss", 5.0, 9002, "ramp")
    answer = learned.answer(record.features)
    told = Case("single", 1, "gripper", record.hidden, answer).answer_outcomes
    assert told["named"]
    assert told["course"]
    assert told["covered"]
    assert answer["causes"][0]["parameters"]["size"]["at_end"] == pytest.approx(5.0, rel=0.2)


def test_healthy_and_unlisted_records_have_no_cause(learned: Learned) -> None:
    healthy, strange = made(None, 0.0, 9003).features, made("strange", 4.0, 9004).features
    assert learned.answer(healthy) == {"verdict": "consistent", "causes": []}
    assert learned.answer(strange) == {"verdict": "unlisted", "causes": []}


class Sure:
    """A classifier that gives these probabilities, whatever it sees."""

    def __init__(self, **probability: float) -> None:
        self.classes_ = np.array(list(probability))
        self._probability = np.array([list(probability.values())])

    def predict_proba(self, _features: Any) -> Any:
        return self._probability


@pytest.mark.parametrize(
    ("probability", "verdict", "effects"),
    [
        (
            {"leakage": 0.3, "porous_leakage": 0.28, "added_volume": 0.02, "none": 0.4},
            "explained",
            2,
        ),
        ({"leakage": 0.3, "porous_leakage": 0.1, "none": 0.1, "unlisted": 0.5}, "unlisted", 0),
        ({"leakage": 0.2, "none": 0.5, "unlisted": 0.3}, "consistent", 0),
        ({"leakage": 0.9, "porous_leakage": 0.02, "none": 0.08}, "explained", 1),
    ],
)
def test_look_alikes_are_told_as_far_as_the_probability_goes(
    probability: dict[str, float], verdict: str, effects: int
) -> None:
    told, found = named(Sure(**probability), np.zeros(1))
    assert told == verdict
    assert list(found) == list(probability)[:effects]


def test_an_interval_is_as_wide_as_what_is_missed() -> None:
    misses = np.arange(1.0, 101.0)
    assert half_width(misses) == 96.0  # of 101, the new one with them, 96 are no wider
    assert half_width(misses[:5]) == 5.0


def test_unseen_mechanisms_are_judged_without_a_record_of_theirs(learned: Learned) -> None:
    records = training()
    found = unlisted_unseen(learned, records)
    assert len(found) == sum(label(record) == "unlisted" for record in records) == 40
    assert not any(found)  # nothing else is unlisted here, so nobody can have learned the word


# --- the table ------------------------------------------------------------------------------------


def case(kind: str, seed: int, answer: dict[str, Any]) -> Case:
    return Case(kind, seed, "gripper", [LEAK] if kind == "single" else [], answer)


def cause(effect: str, high: float = 2.2, alike: Sequence[str] = ()) -> dict[str, Any]:
    """An answer with one cause of size 1.8 to ``high``."""
    size = {"value": 2.0, "low95": 1.8, "high95": high}
    one = {"effect": effect, "course": "constant", "probability": 0.97}
    one |= {"parameters": {"sonic_flow": size}, "not_separable_from": list(alike)}
    return {
        "verdict": "explained",
        "causes": [one],
        "extended": {"leftover_sigma": 1.0},
        "gain": {"share_of_achievable_pct": 99.0},
    }


def without(answer: dict[str, Any]) -> dict[str, Any]:
    """As the learned one answers: of what is left it says nothing."""
    return {name: answer[name] for name in ("verdict", "causes")}


def test_the_table_counts_both_alike() -> None:
    alike = cause("porous_leakage", alike=["leakage"])
    twin = [case("single", seed, cause("leakage")) for seed in range(8)]
    other = [case("single", seed, without(alike)) for seed in range(6)]
    other += [case("single", seed, without(cause("leakage", 2.6))) for seed in (6, 7)]
    twin.append(case("healthy", 0, {"verdict": "consistent", "causes": []}))
    other.append(case("healthy", 0, without(cause("leakage"))))
    page = compared(twin, other)
    rows = dict(line.strip("| ").split(" | ", 1) for line in page.splitlines() if "|" in line)
    both = "single effects named first or in a set of at most three"
    assert rows[both] == "8 of 8 (100%) | 8 of 8 (100%) | 0 : 0"
    assert rows["single effects named first"] == "8 of 8 (100%) | 2 of 8 (25%) | 6 : 0"
    assert rows[ASKED["wrong"].words] == "0 of 8 (0%) | 1 of 9 (11%) | –"
    assert rows["healthy records called consistent"] == "1 of 1 (100%) | 0 of 1 (0%) | 1 : 0"
    assert rows["95 % interval covers the size"] == "8 of 8 (100%) | 2 of 2 (100%) | –"
    assert rows["half of that interval over the size, median"] == "±10% | ±20% | –"
    assert rows["expected calibration error"] == "0.030 | 0.748 | –"  # 2 of 9 act of 97 %
    assert "`twin diagnose` wins in: single effects named first, named alone" in page
    assert "wins in: single effects named first or" not in page
    assert "the learned one wins" not in page


def test_the_learned_one_may_win() -> None:
    right = [case("single", seed, cause("leakage")) for seed in range(6)]
    wrong = [case("single", seed, cause("added_volume")) for seed in range(6)]
    page = compared(wrong, right)
    assert page.count("`twin diagnose` wins") == 0
    assert "the learned one wins in: single effects named first or in a set" in page


class Kept(RecordFile):
    """Holds one record, whatever is asked for."""

    def __init__(self, record: Record) -> None:
        super().__init__(None)
        self._record = record

    def get(self, *_: Any) -> Record:
        return self._record


def test_a_record_is_answered_as_the_case_that_it_is(learned: Learned) -> None:
    record = replace(made("leakage", 2.0, 1), seed=1)
    hidden = Case("single", 1, "gripper", record.hidden, error="refused")
    found = answered(learned, Kept(record), hidden, 4)
    assert (found.first, found.error, found.key) == ("leakage", "", hidden.key)
    with pytest.raises(ValueError, match="single 1 hides something else"):
        answered(learned, Kept(record), replace(hidden, hidden=[replace(LEAK, size=3.0)]), 4)


def test_what_may_have_been_learned_from_is_not_judged(learned: Learned) -> None:
    record = made("leakage", 2.0, 1)
    hidden = Case("single", record.seed, "gripper", record.hidden)
    with pytest.raises(ValueError, match="take a lower seed"):
        answered(learned, Kept(record), hidden, 4)


def test_the_line_above_the_table_says_what_is_compared() -> None:
    cases = [case("single", 7, cause("leakage")), case("single", 9, cause("leakage"))]
    line = summary("abc1234", [*cases, case("healthy", 7, {"verdict": "consistent"})])
    assert line.endswith("commit abc1234, seeds 7 to 9: 2 single, 1 healthy.**")


def test_the_page_has_a_place_for_it() -> None:
    page = written(PAGE, "new table")
    assert marked(MARK, page)[2] == "new table\n"
    assert page.replace("new table\n", marked(MARK, PAGE)[2]) == PAGE
