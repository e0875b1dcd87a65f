"""The extended model: what was found becomes a data set that replays, runs and is consistent."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rigs
from command_line import twin

from twin.assets.database import open_assets
from twin.config import Config
from twin.diagnosis.answer import Diagnosis
from twin.diagnosis.evidence import Evidence, collect
from twin.diagnosis.extend import extended, nothing, remarks, shifted_key_figures, store
from twin.errors import ConfigError
from twin.figures.expected import leakage_from_rest
from twin.live import Twin, run
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.model.courses import Cause, Course
from twin.model.dataset import DataSet, coefficients
from twin.model.effects import EFFECTS
from twin.model.term import Term
from twin.model.theta import FILM
from twin.monitor.healthy import Scatter
from twin.signals import MBAR, Phase

LEAK = ("leakage=2.0",)
SECONDS = 25.0
SURE = 0.03  # of a size, one sigma


def logged(path: Path, seed: int) -> Path:
    config = rigs.config("test_rig")
    samples, _ = rigs.recorded("test_rig", SECONDS, LEAK, seed)
    sinks = [Recorder(path, config.log_header())]
    run(rigs.cut(samples, 1000), rigs.twin("test_rig"), rigs.monitor("test_rig"), sinks)
    return path


@dataclass(frozen=True)
class Saved:
    folder: Path
    said: str

    @property
    def assets(self) -> str:
        return str(self.folder / "assets.sqlite")

    @property
    def chosen(self) -> tuple[str, ...]:
        return "--id", "leaky", "--assets", self.assets


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Saved:
    """A leaky rig was diagnosed and what was found kept; ``other.mcap`` is of the same rig."""
    folder = tmp_path_factory.mktemp("saved")
    one, _ = logged(folder / "one.mcap", 5), logged(folder / "other.mcap", 6)
    said: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("builtins.print", lambda *lines, **_: said.append(" ".join(map(str, lines))))
        patch.chdir(folder)  # where the database is made
        assert twin(patch, "diagnose", one, "--save-as", "leaky") == 0
    return Saved(folder, "\n".join(said))


# What healthy cycles are like with a finding.


def test_key_figures_of_the_commissioning_move_with_what_was_found() -> None:
    """A leak that is part of the data set now is no reason for a warning; the rest stays."""
    before = rigs.config("test_rig").data
    (size,) = EFFECTS["leakage"].parameters

    def leaking(flow: float) -> DataSet:
        effects = {**before.effects, "leakage": {size.name: flow}}
        return DataSet.model_validate(before.model_dump() | {"effects": effects})

    means = {"t1": 400.0, "leakage": 4.0, "highest_supply": 4.7, "supply": 4.6}
    seen = {name: Scatter(mean=mean, sigma=0.1) for name, mean in means.items()}
    after, doubted = leaking(2.0), coefficients(leaking(2.5))
    shifted = shifted_key_figures(seen, before, after, [doubted])
    found = leakage_from_rest(after) - leakage_from_rest(before)
    assert found > 20.0
    assert shifted["leakage"].mean == pytest.approx(4.0 + found)
    uncertain = leakage_from_rest(leaking(2.5)) - leakage_from_rest(after)
    assert shifted["leakage"].sigma == pytest.approx(np.hypot(0.1, uncertain))
    assert shifted["t1"].mean > 400.0
    assert all(shifted[name] == seen[name] for name in ("highest_supply", "supply"))
    assert "leakage" not in shifted_key_figures(seen, before, leaking(50.0), [])


def test_a_supply_that_was_found_low_is_what_its_gauge_reads() -> None:
    before = rigs.config("test_rig").data
    effects = {"supply_pressure_drop": {"drop": 0.5}}
    seen = {"supply": Scatter(mean=4.6, sigma=0.1)}
    shifted = shifted_key_figures(seen, before, before.model_copy(update={"effects": effects}), [])
    assert shifted["supply"].mean == pytest.approx(4.1)


# From log to log.


@pytest.mark.slow
def test_it_is_stored_as_a_unit_with_where_it_is_from(saved: Saved) -> None:
    with open_assets(saved.assets) as database:
        (record,) = database.records("instance", "leaky")
    assert f"stored as leaky in assets.sqlite, record {record.id[:8]}" in saved.said
    assert record.type == "compact-ejector-35"
    assert record.data["effects"]["leakage"]["sonic_flow"] == pytest.approx(2.0, abs=0.1)
    about = record.provenance
    assert about["log"] == "one.mcap"
    assert about["causes"] == ["leakage"]
    assert about["cycles"] == 7
    assert about["extends"] == f"rig-01, data set {rigs.config('test_rig').data.hash}"
    assert about["program"].startswith("ejector-twin ")
    received = next(open_log(saved.folder / "one.mcap").blocks())[0]["host_ns"]
    assert received[0] < record.valid_from_ns < received[-1]  # the first cycle begins later


@pytest.mark.slow
def test_a_database_that_is_not_there_is_made_and_said(
    saved: Saved,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    new = tmp_path / "new.sqlite"
    log = saved.folder / "one.mcap"
    assert twin(monkeypatch, "diagnose", log, "--assets", new) == 3  # nothing is to be stored
    assert "no such asset database" in capsys.readouterr().err
    assert not new.exists()
    assert twin(monkeypatch, "diagnose", log, "--save-as", "leaky", "--assets", new) == 0
    heard = capsys.readouterr()
    assert f"making a new asset database, {new}" in heard.err
    with open_assets(new) as database, open_assets(saved.assets) as default:
        (record,), (same,) = (store.records("instance", "leaky") for store in (database, default))
    assert record.data == same.data  # with the data set of the log: a new database has no other


def test_its_alarms_are_gone_on_another_log_of_the_same_rig(
    saved: Saved, monkeypatch: pytest.MonkeyPatch
) -> None:
    replay = ("replay", saved.folder / "other.mcap", "--fail-on-alarm")
    assert twin(monkeypatch, *replay) == 1
    assert twin(monkeypatch, *replay, *saved.chosen) == 0


def test_diagnosed_again_it_is_consistent_and_nothing_is_stored(
    saved: Saved, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    again = ("diagnose", saved.folder / "other.mcap", *saved.chosen, "--save-as", "again")
    assert twin(monkeypatch, *again) == 0
    said = capsys.readouterr().out
    assert said.startswith("consistent: ")
    assert "nothing is stored as again: the data set there is fits already" in said
    with open_assets(saved.assets) as database:
        assert database.records("instance", "again") == []


# From what was found to the data set.


@pytest.fixture(scope="module")
def evidence() -> Evidence:
    return collect(rigs.config("test_rig"), [rigs.recorded("test_rig", SECONDS, LEAK, 5)[0]])


def found(
    evidence: Evidence, *causes: Cause, verdict: str = "explained", terms: tuple[Term, ...] = ()
) -> Diagnosis:
    """A diagnosis that found these causes, all of their sizes known."""
    answer = {
        "verdict": verdict,
        "causes": [{"effect": cause.effect, "parameters": _known(cause)} for cause in causes],
    }
    return Diagnosis(evidence, "hash", None, causes, terms, None, None, [], answer)


def _known(cause: Cause) -> dict[str, Any]:
    unit = EFFECTS[cause.effect].parameters[0].unit
    return {
        name: {
            "value": value,
            "unit": f"{unit}/h",
            "low95": value - 1.96 * SURE * value,
            "high95": value + 1.96 * SURE * value,
        }
        for name, value in cause.values.items()
        if name not in cause.law()  # which no answer has
    }


def effects_of(diagnosis: Diagnosis, config: Config | None = None) -> dict[str, dict[str, float]]:
    known = extended(diagnosis, config or rigs.config("test_rig"))
    assert known is not None
    return {name: dict(sizes) for name, sizes in known.data.effects.items()}


def with_effects(**effects: dict[str, float]) -> Config:
    config = rigs.config("test_rig")
    data = config.data.model_copy(update={"effects": effects})
    return Config(config.document, config.asset, data, config.monitor, config.log)


def test_the_model_expects_what_the_hypothesis_did(evidence: Evidence) -> None:
    causes = (Cause("leakage", {"sonic_flow": 2.0}),)
    known = extended(found(evidence, *causes), rigs.config("test_rig"))
    assert known is not None
    _, ticks = rigs.expectation(Twin.of(known.data), [evidence.samples])
    last = slice(evidence.starts[-2], evidence.starts[-1])
    expected = evidence.expected(causes)[last]
    assert np.abs(ticks["expected"][last] - expected).max() < 0.02 * MBAR


def test_it_acts_by_the_law_that_was_found(evidence: Evidence) -> None:
    cause = Cause("slow_ramp_up", {"time_constant": 40.0, "jet_full_at": 0.2})
    known = extended(found(evidence, cause), rigs.config("test_rig"))
    assert known is not None
    assert known.data.ejector.jet_full_at == 0.2
    assert known.data.effects == {"slow_ramp_up": {"time_constant": 40.0}}
    np.testing.assert_array_equal(coefficients(known.data), evidence.course((cause,))[0][1])


def test_a_step_has_its_size_and_holds_since_its_onset(evidence: Evidence, tmp_path: Path) -> None:
    diagnosis = found(evidence, Cause("leakage", {"sonic_flow": 1.5}, Course.STEP, 11.0))
    config = rigs.config("test_rig")
    known = extended(diagnosis, config)
    assert known is not None
    assert known.data.effects == {"leakage": {"sonic_flow": 1.5}}
    log = tmp_path / "log.mcap"
    log.write_bytes(b"")
    record, _ = store(known, diagnosis, config, "stepped", str(tmp_path / "a.sqlite"), log)
    row = int(np.searchsorted(evidence.seconds, 11.0))
    assert record.valid_from_ns == evidence.samples["host_ns"][row]


def test_a_ramp_is_stored_as_it_was_at_the_end_and_said_to_go_on(evidence: Evidence) -> None:
    onset, rate = 5.0, 720.0
    diagnosis = found(evidence, Cause("leakage", {"sonic_flow": rate}, Course.RAMP, onset))
    at_end = rate * (evidence.seconds[-1] - onset) / 3600.0
    assert effects_of(diagnosis) == {"leakage": {"sonic_flow": pytest.approx(at_end)}}
    (line,) = remarks(diagnosis)
    assert line == "leakage goes on growing (720 sl/min/h): it is stored as it was at the end"


def test_what_is_there_now_and_then_is_not_stored_and_that_is_said(evidence: Evidence) -> None:
    now_and_then = Cause("leakage", {"sonic_flow": 3.0}, Course.INTERMITTENT, cycles=frozenset({2}))
    alone = found(evidence, now_and_then)
    assert extended(alone, rigs.config("test_rig")) is None
    assert list(remarks(alone)) == ["leakage is not always there: it is not stored"]
    assert nothing(alone) == "nothing that was found is always there"
    beside = found(evidence, now_and_then, Cause("sensor_gain", {"error": 3.0}))
    assert effects_of(beside) == {"sensor_gain": {"error": 3.0}}


def test_a_size_that_the_log_does_not_determine_is_not_stored(evidence: Evidence) -> None:
    diagnosis = found(evidence, Cause("threshold_drift", {"h1_shift": 12.0, "h2_shift": 20.0}))
    del diagnosis.json["causes"][0]["parameters"]["h2_shift"]
    assert effects_of(diagnosis) == {"threshold_drift": {"h1_shift": 12.0}}


@pytest.mark.parametrize(
    ("effect", "name", "before", "more", "together"),
    [
        ("leakage", "sonic_flow", 1.0, 0.5, 1.5),
        ("suction_loss", "loss", 10.0, 10.0, 19.0),
        ("sensor_gain", "error", 2.0, -1.0, 1.0),
        ("heat_exchange", "film_coefficient", 20.0, 30.0, 30.0),
        ("threshold_drift", "h1_shift", 5.0, 7.0, 12.0),
    ],
)
def test_what_the_data_set_has_already_grows(
    evidence: Evidence, effect: str, name: str, before: float, more: float, together: float
) -> None:
    config = with_effects(**{effect: {name: before}, "added_volume": {"volume": 30.0}})
    diagnosis = found(evidence, Cause(effect, {name: more}))
    assert effects_of(diagnosis, config) == {
        effect: {name: pytest.approx(together, rel=1e-5)},
        "added_volume": {"volume": 30.0},
    }


def test_what_is_beyond_the_model_together_is_refused(evidence: Evidence) -> None:
    config = with_effects(leakage={"sonic_flow": 40.0})
    diagnosis = found(evidence, Cause("leakage", {"sonic_flow": 30.0}))
    with pytest.raises(ConfigError, match=r"leakage: .* together beyond 0 to 60 sl/min"):
        extended(diagnosis, config)


def figures_with(evidence: Evidence, *causes: Cause) -> Mapping[str, Scatter]:
    known = extended(found(evidence, *causes), rigs.config("test_rig"))
    assert known is not None
    before = rigs.config("test_rig").monitor.healthy
    assert known.healthy == before.model_copy(update={"figures": known.healthy.figures})
    return known.healthy.figures


def test_the_switching_levels_move_and_nothing_else_does(evidence: Evidence) -> None:
    before = rigs.config("test_rig").monitor.healthy.figures
    after = figures_with(evidence, Cause("threshold_drift", {"h1_shift": 15.0}))
    assert after["h1_level"].mean == pytest.approx(before["h1_level"].mean + 15.0, abs=0.5)
    unsure = np.hypot(before["h1_level"].sigma, SURE * 15.0)
    assert after["h1_level"].sigma == pytest.approx(unsure, abs=0.1)  # a row is 0.2 mbar
    assert {name: figure for name, figure in after.items() if name != "h1_level"} == {
        name: figure for name, figure in before.items() if name != "h1_level"
    }


def test_figures_are_as_uncertain_as_the_size_is(evidence: Evidence) -> None:
    """Measured at the model: what a sigma of the size moves the pressure by in each phase."""
    before = rigs.config("test_rig").monitor.healthy.figures
    after = figures_with(evidence, Cause("leakage", {"sonic_flow": 4.0}))
    expected, other = (
        evidence.expected((Cause("leakage", {"sonic_flow": size}),))
        for size in (4.0, 4.0 * (1 + SURE))
    )
    rows = (evidence.ticks["phase"] == Phase.SUCTION) & (evidence.bins.number >= 0)
    moved = np.sqrt(np.mean((other - expected)[rows] ** 2)) / MBAR
    for name in ("suction_mean", "suction_rms"):
        assert after[name].mean == before[name].mean
        wider = np.sqrt(after[name].sigma ** 2 - before[name].sigma ** 2)
        assert wider == pytest.approx(moved, rel=0.1)


def test_where_the_supply_is_low_its_scatter_counts_for_more(evidence: Evidence) -> None:
    before = rigs.config("test_rig").monitor.healthy.figures
    drop = Cause("supply_pressure_drop", {"drop": 1.0})
    after = figures_with(evidence, drop)
    scatter = rigs.config("test_rig").monitor.healthy.scatter["supply_pressure_drop"]
    more = replace(drop, values={"drop": 1.0 + scatter})
    rows = (evidence.ticks["phase"] == Phase.SUCTION) & (evidence.bins.number >= 0)
    moved = (evidence.expected((more,)) - evidence.expected((drop,)))[rows] / MBAR
    least = np.hypot(before["suction_rms"].sigma, 0.9 * np.sqrt(np.mean(moved**2)))
    assert after["suction_rms"].sigma > least


def test_a_level_that_is_never_reached_is_no_figure(evidence: Evidence) -> None:
    config = rigs.config("test_rig")
    known = extended(found(evidence, Cause("leakage", {"sonic_flow": 20.0})), config)
    assert known is not None
    assert "h1_level" not in known.healthy.figures
    assert "suction_rms" in known.healthy.figures


def test_key_figures_move_or_go_with_what_is_stored(evidence: Evidence) -> None:
    """A gauge's mean stays with learned terms; the limited figures that they move do not."""
    seen = {"leakage": Scatter(mean=4.0, sigma=0.1), "supply": Scatter(mean=4.6, sigma=0.1)}
    healthy = evidence.healthy.model_copy(update={"key_figures": seen})
    commissioned = replace(evidence, healthy=healthy)
    config = rigs.config("test_rig")
    leaky = extended(found(commissioned, Cause("leakage", {"sonic_flow": 2.0})), config)
    assert leaky is not None
    assert leaky.healthy.key_figures["leakage"].mean > 24.0
    assert leaky.healthy.key_figures["leakage"].sigma > 0.5  # its size is known to 3 %
    assert leaky.healthy.key_figures["supply"] == seen["supply"]
    term = Term(where="suction", over="vacuum", at=(0.0, 700.0), mbar=(0.0, 9.0))
    learned = extended(found(commissioned, verdict="unlisted", terms=(term,)), config)
    assert learned is not None
    assert learned.healthy.key_figures == {"supply": seen["supply"]}


def test_terms_that_data_gave_are_in_it(evidence: Evidence) -> None:
    term = Term(where="suction", over="vacuum", at=(0.0, 700.0), mbar=(0.0, 9.0))
    unlisted = found(evidence, verdict="unlisted", terms=(term,))
    known = extended(unlisted, rigs.config("test_rig"))
    assert known is not None
    assert known.data.terms == (term,)
    levels = [figures["h1_level"] for figures in evidence.figures if "h1_level" in figures]
    assert known.healthy.figures["h1_level"].mean == pytest.approx(np.mean(levels), abs=0.3)
    before = rigs.config("test_rig").monitor.healthy.figures["suction_mean"]
    assert abs(known.healthy.figures["suction_mean"].mean - before.mean) > 10.0  # no such term is
    (remark,) = remarks(unlisted)
    assert remark.startswith("the curve from data holds for this program of commands only")
    assert "where the program changes, go back to the data set without it" in remark


def test_without_a_term_what_nobody_listed_is_said_to_be_missing(evidence: Evidence) -> None:
    partly = found(evidence, Cause("leakage", {"sonic_flow": 2.0}), verdict="unlisted")
    assert effects_of(partly) == {"leakage": {"sonic_flow": 2.0}}
    assert list(remarks(partly)) == ["what no listed effect explains is not in it"]
    nameless = found(evidence, verdict="unlisted")
    assert extended(nameless, rigs.config("test_rig")) is None
    assert nothing(nameless) == "what is off has no name"


def test_the_wall_goes_on_exchanging_heat_as_found(evidence: Evidence) -> None:
    config = rigs.config("test_rig")
    known = extended(found(evidence, Cause("heat_exchange", {"film_coefficient": 25.0})), config)
    assert known is not None
    assert coefficients(known.data)[FILM] == 25.0


def test_too_short_a_log_stores_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config, log = rigs.config("test_rig"), tmp_path / "short.mcap"
    samples = rigs.recorded("test_rig", SECONDS, LEAK, 5)[0][:7000]
    sinks = [Recorder(log, config.log_header())]
    run([samples], rigs.twin("test_rig"), rigs.monitor("test_rig"), sinks)
    monkeypatch.chdir(tmp_path)
    assert twin(monkeypatch, "diagnose", log, "--save-as", "leaky") == 0
    said = capsys.readouterr().out
    assert said.startswith("insufficient: ")
    assert "nothing is stored as leaky: the log cannot answer" in said
    assert [path.name for path in tmp_path.iterdir()] == ["short.mcap"]
