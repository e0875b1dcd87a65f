"""A fleet's report: who stands out, who drifts, and what the units say of their type."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twin.assets.record import Record
from twin.calibration.parameters import FREE
from twin.errors import SourceError
from twin.fleet.peers import DAY_NS, FEWEST_PEERS, standings
from twin.fleet.report import Refused, Report, State, report
from twin.fleet.report_page import headline, in_words, write_page
from twin.fleet.results_database import Key, Result
from twin.fleet.type_statistics import estimates
from twin.languages.choice import language_of

EFFECTS = {"leakage": "sl/min", "suction_loss": "%", "sensor_offset": "mbar"}
STEP = 0.1  # of size, in a sigma


def watched(unit: str, sigmas: Mapping[str, float], day: float = 0.0, kind: str = "T") -> Result:
    effects = {
        name: {
            "sigmas": at,
            "scatter": 1.0,
            "cycles": 100,
            "size": STEP * at,
            "unit": EFFECTS[name],
        }
        for name, at in sigmas.items()
    }
    return result("replay", unit, {"effects": effects}, day, kind)


def result(work: str, unit: str, answer: Any, day: float = 0.0, kind: str = "T") -> Result:
    key = Key(work, f"{unit} {day}", "code", "basis")
    return Result(key, kind, unit, "b1", f"{unit}.mcap", int(day * DAY_NS), 0, answer)


def fleet(rng: np.random.Generator, units: int, scatter: float = 2.0) -> list[dict[str, float]]:
    """Sigmas of units that differ from their type, by more than their logs are uncertain."""
    return [{name: float(rng.normal(1.0, scatter)) for name in EFFECTS} for _ in range(units)]


def diagnosis(verdict: str, *effects: str, rms: float = 1.0) -> dict[str, Any]:
    return {
        "verdict": verdict,
        "causes": [{"effect": effect} for effect in effects],
        "baseline": {"rms_mbar": rms},
    }


def test_one_that_is_far_from_the_others_is_first() -> None:
    units = fleet(np.random.default_rng(1), 200)
    units[17]["leakage"] = 21.0
    first, second, *_ = standings([watched(f"U{n}", effects) for n, effects in enumerate(units)])
    assert (first.id, first.effect) == ("U17", "leakage")
    assert first.beyond == pytest.approx(10.0, rel=0.2)  # of the others' two sigmas
    assert first.size == pytest.approx(2.0, rel=0.15)
    assert second.beyond < 4.5


def test_what_can_only_grow_does_not_stand_out_by_less() -> None:
    units = fleet(np.random.default_rng(2), 50)
    units[3]["leakage"] = -30.0
    assert standings([watched(f"U{n}", effects) for n, effects in enumerate(units)])[0].id != "U3"


def test_a_unit_is_compared_with_what_it_was() -> None:
    rng = np.random.default_rng(3)
    results = []
    for number, effects in enumerate(fleet(rng, 60, scatter=20.0)):
        changed = {name: at + rng.normal(0.5, 0.3) for name, at in effects.items()}
        if number == 5:
            changed["sensor_offset"] += 6.0
        results += [watched(f"U{number}", effects), watched(f"U{number}", changed, day=90.0)]
    first, second, *_ = standings(results)
    assert (first.id, first.effect) == ("U5", "sensor_offset")
    assert first.size == pytest.approx(0.6, rel=0.25)
    assert first.beyond > 10.0
    assert second.beyond < 4.5


def test_of_few_units_the_diagnosis_counts() -> None:
    few = [watched(f"U{n}", {"leakage": 9.0}) for n in range(FEWEST_PEERS - 1)]
    found = report([*few, result("diagnose", "U2", diagnosis("explained", "leakage"))], [], 0)
    assert [row.id for row in found.of(State.STANDS_OUT)] == ["U2"]
    assert found.rows[0].id == "U2"


def test_without_watching_the_worst_diagnosis_is_first() -> None:
    found = report(
        [
            result("diagnose", "U1", diagnosis("consistent")),
            result("diagnose", "U2", diagnosis("explained", "leakage", rms=3.0)),
            result("diagnose", "U3", diagnosis("unlisted", rms=8.0)),
        ],
        [],
        0,
    )
    assert [row.id for row in found.rows] == ["U3", "U2", "U1"]
    assert [row.stands_out for row in found.rows] == [True, True, False]
    assert found.groups() == [
        {
            "type": "T",
            "batch": "b1",
            "units": 3,
            "stands_out": 2,
            "does_not": 1,
            "not_judged": 0,
            "log_cut": 0,
            "causes": {"unlisted": 1, "leakage": 1},
        }
    ]


def test_the_newest_diagnosis_holds() -> None:
    mended = [
        result("diagnose", "U1", diagnosis("explained", "leakage"), day=1.0),
        result("diagnose", "U1", diagnosis("consistent"), day=2.0),
    ]
    assert report(mended, [], 0).rows[0].state is State.DOES_NOT


def few(*diagnosed: Result) -> Report:
    """Four units far from the twin, too few to compare, of which some are diagnosed."""
    watched_ones = [watched(f"U{n}", {"leakage": 9.0}) for n in range(4)]
    return report([*watched_ones, *diagnosed], [], 0, [Refused("bad.mcap", "bad.mcap: is empty")])


def test_of_few_units_nobody_is_judged_before_a_diagnosis() -> None:
    found = few()
    assert [row.state for row in found.rows] == [State.NOT_JUDGED] * 4
    assert found.rows[0].reason == (
        "4 units to compare, 8 are needed; its newest log is not diagnosed yet"
    )
    assert headline(found) == (
        "4 units: none stands out, 4 could not be judged; 1 log could not be used"
    )
    said = in_words(found)
    assert "run twin fleet diagnose LOGS, then this report again" in said
    assert "bad.mcap  is empty" in said
    assert "sigma" not in said  # of nobody: there are too few others


def test_a_diagnosis_without_an_answer_judges_nobody_and_stops_no_report() -> None:
    unanswered = {
        "verdict": "insufficient",
        "causes": [],
        "baseline": {"rms_mbar": None},
        "next_experiment": "record more cycles",
    }
    found = few(
        result("diagnose", "U0", unanswered), result("diagnose", "U1", diagnosis("consistent"))
    )
    states = {row.id: (row.state, row.reason) for row in found.rows}
    assert states["U0"] == (State.NOT_JUDGED, "no diagnosis: record more cycles")
    assert states["U1"] == (State.DOES_NOT, "")
    assert "1 does not, 3 could not be judged" in headline(found)


def test_what_was_well_in_an_older_log_says_nothing_of_the_newest() -> None:
    results = [
        result("diagnose", "U1", diagnosis("consistent"), day=1.0),
        watched("U1", {"leakage": 9.0}, day=2.0),
    ]
    assert report(results, [], 0).rows[0].state is State.NOT_JUDGED


def test_a_log_without_a_cycle_judges_nobody() -> None:
    (row,) = report([result("replay", "U1", {"effects": {}})], [], 0).rows
    assert (row.state, row.reason) == (
        State.NOT_JUDGED,
        "no cycle of its newest log can be compared",
    )


@pytest.mark.parametrize(
    ("states", "says"),
    [
        ("ddd", "3 units: none stands out"),
        ("dsd", "3 units: 1 stands out, 2 do not"),
        ("s", "1 unit: 1 stands out"),
        ("ssn", "3 units: 2 stand out, 1 could not be judged"),
        ("dn", "2 units: none stands out, 1 does not, 1 could not be judged"),
    ],
)
def test_the_count_is_one_sentence(states: str, says: str, tmp_path: Path) -> None:
    verdicts = {"d": "consistent", "s": "explained"}
    results = [
        result("diagnose", f"U{n}", diagnosis(verdicts[one]))
        if one in verdicts
        else watched(f"U{n}", {"leakage": 9.0})
        for n, one in enumerate(states)
    ]
    found, page = report(results, [], 0), tmp_path / "fleet.html"
    assert headline(found) == says
    write_page(found, page)
    text = page.read_text(encoding="utf-8")
    assert f"<h1>{says}</h1>" in text
    assert ("✓" in text) == (set(states) == {"d"})  # green only where all are known to be well


def test_a_log_that_was_cut_off_never_looks_well(tmp_path: Path) -> None:
    """Its unit is judged by what is there, and everything that tells of it says so."""
    well = [result("diagnose", f"U{n}", diagnosis("consistent")) for n in range(2)]
    well[1] = replace(well[1], complete=False)
    found, page = report(well, [], 0), tmp_path / "fleet.html"
    said = in_words(found)
    assert "2 units: none stands out; 1 log cut off: judged by what is there" in said
    assert re.search(r"U1 +b1 +U1\.mcap +does not stand out", said)
    write_page(found, page)
    text = page.read_text(encoding="utf-8")
    assert "✓" not in text
    assert "Log cut off" in text
    units = {unit["id"]: unit for unit in found.plain()["units"]}
    assert {name: unit["log_complete"] for name, unit in units.items()} == {"U0": True, "U1": False}
    assert found.plain()["groups"][0]["log_cut"] == 1


def test_an_older_log_that_was_cut_off_is_no_matter_of_the_newest() -> None:
    cut = replace(result("diagnose", "U1", diagnosis("consistent"), day=1.0), complete=False)
    whole = result("diagnose", "U1", diagnosis("consistent"), day=2.0)
    assert "cut off" not in headline(report([cut, whole], [], 0))


def test_one_that_drifts_is_told_with_its_rate() -> None:
    rng = np.random.default_rng(4)
    results = []
    for unit in range(20):
        for day in range(0, 100, 10):
            grows = 0.3 * day if unit == 7 else 0.0
            sigmas = {name: float(rng.normal(0.0, 1.0)) for name in EFFECTS}
            sigmas["leakage"] += grows
            results.append(watched(f"U{unit}", sigmas, float(day)))
    found = report(sorted(results, key=lambda result_of_log: result_of_log.begin_ns), [], 0)
    assert found.rows[0].id == "U7"
    drift = found.rows[0].drifts[0]
    assert drift.effect == "leakage"
    assert drift.per_day == pytest.approx(0.03, rel=0.2)
    assert sum(bool(row.drifts) for row in found.rows) <= 2


@pytest.mark.parametrize(
    ("hours", "steps", "says"),
    [
        (240.0, False, r"leakage \+0\.0\S+ sl/min/day over 190 days"),
        (240.0, True, r"leakage stepped \+3\S* sl/min by 1970-04-11 00:00:00"),
        (0.1, False, ""),
    ],
)
def test_a_step_is_no_drift_and_minutes_have_no_rate(hours: float, steps: bool, says: str) -> None:
    rng = np.random.default_rng(20)
    results = []
    for number in range(20):
        sigmas = {name: float(rng.normal(0.0, 1.0)) for name in EFFECTS}
        sigmas["leakage"] += 30.0 * (number >= 10) if steps else 3.0 * number
        results.append(watched("U1", sigmas, number * hours / 24.0))
    (row,) = report(results, [], 0).rows
    if not says:
        assert row.drifts == ()
        return
    assert row.drifts[0].effect == "leakage"
    assert (row.drifts[0].per_day is None) == steps
    assert re.search(says, in_words(report(results, [], 0)))


def calibrated(unit: str, value: float, sigma: float, known: bool = True) -> Record:
    number = next(i for i, free in enumerate(FREE) if free.key == "suction_capacity_sl_min")
    covariance = np.zeros((len(FREE), len(FREE)))
    covariance[number, number] = sigma**2
    return Record(
        "instance",
        unit,
        "T",
        {"ejector": {"suction_capacity_sl_min": value}},
        arrays={"covariance": covariance},
        provenance={
            "parameters": [free.name for free in FREE],
            "determined": ["ejector.suction_capacity_sl_min"] if known else [],
        },
    )


def test_a_types_data_come_from_its_units_with_their_spread() -> None:
    rng = np.random.default_rng(5)
    sigmas = rng.uniform(0.1, 1.0, 400)
    values = rng.normal(35.0, 0.7, 400) + sigmas * rng.normal(size=400)
    units = [calibrated(f"U{n}", v, s) for n, (v, s) in enumerate(zip(values, sigmas, strict=True))]
    base = Record("type", "T", "T", {"ejector": {"suction_capacity_sl_min": 34.0}})
    (one,) = estimates([base, *units, calibrated("left out", 90.0, 0.1, known=False)], 0)["T"]
    assert (one.parameter, one.units, one.type_has) == (
        "ejector.suction_capacity_sl_min",
        400,
        34.0,
    )
    assert one.mean == pytest.approx(35.0, abs=3.0 * one.sigma)
    assert one.spread == pytest.approx(0.7, rel=0.15)
    assert one.sigma == pytest.approx(np.std(values) / 20.0, rel=0.2)


def test_units_that_differ_by_no_more_than_is_known_have_no_spread() -> None:
    units = [calibrated("U1", 35.0, 1.0), calibrated("U2", 35.5, 1.0)]
    (one,) = estimates(units, 0)["T"]
    assert (one.mean, one.spread, one.type_has) == (35.25, 0.0, None)


@pytest.fixture
def some() -> Report:
    units = fleet(np.random.default_rng(6), 30)
    units[4]["leakage"] = 40.0
    results = [watched(f"<U{n}>", effects) for n, effects in enumerate(units)]
    return report(results, [calibrated("U1", 35.0, 0.1), calibrated("U2", 35.5, 0.1)], 0)


def test_words_say_who_first(some: Report) -> None:
    assert headline(some) == "30 units: 1 stands out, 29 do not"
    said = in_words(some)
    assert said.splitlines()[3].split()[:2] == ["1", "<U4>"]
    assert "leakage +" in said
    assert "twin fleet diagnose" in said
    assert "ejector.suction_capacity_sl_min" in said


def test_the_page_is_whole_and_escaped(some: Report, tmp_path: Path) -> None:
    page = tmp_path / "fleet.html"
    write_page(some, page)
    text = page.read_text(encoding="utf-8")
    assert "&lt;U4&gt;" in text
    assert "<U4>" not in text
    assert "<svg" in text
    assert "units stand out" not in text  # the headline has the only count
    assert "http://" not in text.replace("http://www.w3.org", "")
    with pytest.raises(SourceError, match="cannot be written"):
        write_page(some, tmp_path / "absent" / "fleet.html")


def some_of_all() -> Report:
    """Units in each state, one that drifts, one that stepped, and a log that is none."""
    rng = np.random.default_rng(6)
    units = fleet(rng, 30)
    units[4]["leakage"] = 40.0
    results = [watched(f"<U{n}>", effects) for n, effects in enumerate(units)]
    for day in range(0, 200, 10):
        for number in range(FEWEST_PEERS):
            sigmas = {name: float(rng.normal(0.0, 1.0)) for name in EFFECTS}
            sigmas["leakage"] += 0.3 * day if number == 7 else 0.0
            sigmas["suction_loss"] += 30.0 * (number == 6 and day >= 100)
            results.append(watched(f"gripper-{number:02d}", sigmas, float(day)))
    unanswered = {"verdict": "insufficient", "causes": [], "baseline": {"rms_mbar": None}}
    reason = "only 3 cycles can be judged: record at least 4 complete ones in a row"
    results += [
        watched("few", {"leakage": 9.0}, kind="other"),
        replace(result("diagnose", "cut", diagnosis("unlisted"), kind="other"), complete=False),
        result("diagnose", "two", diagnosis("explained", "leakage", "weak_blow_off"), kind="other"),
        result("diagnose", "why", unanswered | {"next_experiment": reason}, kind="other"),
        result("replay", "empty", {"effects": {}}, kind="other"),
    ]
    records = [calibrated("U1", 35.0, 0.1), calibrated("U2", 35.5, 0.1)]
    refused = [Refused("bad.mcap", "bad.mcap: this is not the log of an ejector")]
    return report(
        sorted(results, key=lambda result_of_log: result_of_log.begin_ns), records, 0, refused
    )


def test_a_german_page_counts_and_says_why_in_german(tmp_path: Path) -> None:
    write_page(some_of_all(), tmp_path / "a.html", language_of("de", "language"))
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "43 Geräte: 5 fallen auf, 35 fallen nicht auf, 3 nicht beurteilbar" in page
    assert "Leckage +0,03" in page
    assert "sl/min/Tag über 190 Tage" in page
    assert re.search(r"Saugleistungsverlust: Sprung um \+\S+ %, spätestens \d\d\.\d\d\.1970", page)
    assert "keine Diagnose: nur 3 Zyklen sind auswertbar" in page
    assert '<p lang="en">this is not the log of an ejector</p>' in page
