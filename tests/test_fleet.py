"""Fleets of logs: each worked on once, whatever happens to the others, here or on a cluster."""

import json
import os
import signal
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import replace
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

import fleets
import pytest
import rigs
from command_line import twin

from tools.dask_cluster import cluster
from twin.assets.database import open_assets
from twin.fleet import runner as going
from twin.fleet.tasks import Done, Job, code, run

UNITS = ("A1", "A2", "A3")
DIES = "dies"  # in the name of a log


@pytest.fixture(scope="module", autouse=True)
def tracker() -> Iterator[None]:
    """What processes leave to the next ones outlives a test; it ends with the module."""
    resource_tracker.ensure_running()
    yield
    resource_tracker._resource_tracker._stop()


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three units, the last one with a leak."""
    folder = tmp_path_factory.mktemp("logs")
    for seed, unit in enumerate(UNITS):
        fleets.write(folder, unit, seed, ("leakage=2.0",) if unit == "A3" else ())
    return folder


def answers(path: Path) -> dict[str, Any]:
    """By log's name."""
    return {Path(log["log"]).name: log for log in json.loads(path.read_text())["logs"]}


@pytest.mark.slow
def test_each_log_is_worked_on_once(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    database, first, second = (tmp_path / name for name in ("f.sqlite", "1.json", "2.json"))
    asked = ("fleet", "diagnose", logs, "--assets", database, "--workers", "2", "--json")
    fleets.commission(database, *UNITS)
    assert twin(monkeypatch, *asked, first) == 0
    assert "3 of 3 logs done, 0 were known" in capsys.readouterr().out
    assert twin(monkeypatch, *asked, second) == 0
    assert "0 of 3 logs done, 3 were known" in capsys.readouterr().out
    before, after = answers(first), answers(second)
    assert {result["state"] for result in after.values()} == {"known"}
    assert [result["answer"] for result in before.values()] == [
        result["answer"] for result in after.values()
    ]
    verdicts = {name: result["answer"]["verdict"] for name, result in before.items()}
    assert verdicts == {
        "A1-0.mcap": "consistent",
        "A2-1.mcap": "consistent",
        "A3-2.mcap": "explained",
    }
    # The same as one log alone.
    alone = tmp_path / "alone.json"
    one = ("diagnose", logs / "A3-2.mcap", "--assets", database, "--id", "A3")
    assert twin(monkeypatch, *one, "--json", alone) == 0
    found = json.loads(alone.read_text())
    assert found["causes"][0]["effect"] == before["A3-2.mcap"]["answer"]["causes"][0]["effect"]
    assert found["extended"] == before["A3-2.mcap"]["answer"]["extended"]


@pytest.mark.slow
def test_other_code_answers_anew(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("fleet", "replay", logs / "A1-0.mcap", "--assets", tmp_path / "f.sqlite")
    assert twin(monkeypatch, *asked) == 0
    for module in ("results_database", "runner", "tasks"):
        monkeypatch.setattr(f"twin.fleet.{module}.code", lambda: "another")
    monkeypatch.setattr(going, "run", here)
    capsys.readouterr()
    assert twin(monkeypatch, *asked) == 0
    assert "1 of 1 logs done, 0 were known" in capsys.readouterr().out


def test_a_broken_log_costs_only_itself(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (logs / "A1-0.mcap").read_bytes()
    damaged, foreign, good = (tmp_path / f"{name}.mcap" for name in ("damaged", "foreign", "good"))
    at = len(whole) // 2
    damaged.write_bytes(
        whole[:at] + bytes(255 - byte for byte in whole[at : at + 4000]) + whole[at + 4000 :]
    )
    foreign.write_text("time,pressure\n")
    good.write_bytes(whole)
    found, page = tmp_path / "f.json", tmp_path / "f.html"
    asked = ("fleet", "report", tmp_path, "--assets", tmp_path / "f.sqlite", "--workers", "1")
    assert twin(monkeypatch, *asked, "--json", found, "--report", page) == 3  # as for one log alone
    said = capsys.readouterr()
    assert "1 unit: none stands out, 1 could not be judged; 2 logs could not be used" in said.out
    assert [refused["log"] for refused in json.loads(found.read_text())["refused"]] == [
        str(damaged),
        str(foreign),
    ]
    assert "not an MCAP file" in page.read_text(encoding="utf-8")
    assert "1 of 3 logs done, 0 were known, 2 could not be" in said.out
    german = ("fleet", "report", "--assets", tmp_path / "f.sqlite", "--language", "de")
    assert twin(monkeypatch, *german, "--html", page) == 0  # the former name of --report
    assert "<h1>1 Gerät: keines fällt auf, 1 nicht beurteilbar</h1>" in page.read_text()
    assert str(damaged) in said.err
    assert str(foreign) in said.err
    assert "Traceback" not in said.err


@pytest.mark.slow
def test_a_log_that_was_cut_off_is_said_to_be(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log, found = tmp_path / "cut.mcap", tmp_path / "f.json"
    whole = (logs / "A1-0.mcap").read_bytes()
    log.write_bytes(whole[:-100])
    database = ("--assets", tmp_path / "f.sqlite")
    fleets.commission(tmp_path / "f.sqlite", "A1")
    for state in ("done", "known"):
        assert twin(monkeypatch, "fleet", "diagnose", log, *database, "--json", found) == 0
        said = capsys.readouterr()
        assert f"twin: {log} is not complete; what can be read is diagnosed" in said.err
        assert "0 could not be, 1 cut off; in" in said.out
        (one,) = json.loads(found.read_text())["logs"]
        assert (one["state"], one["log_complete"]) == (state, False)
    assert twin(monkeypatch, "fleet", "report", *database, "--json", found) == 0  # of the database
    assert "1 log cut off: judged by what is there" in capsys.readouterr().out
    (unit,) = json.loads(found.read_text())["units"]
    assert (unit["verdict"], unit["log_complete"]) == ("consistent", False)


def test_commissioning_says_that_its_record_was_cut_off(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "cut.mcap"
    log.write_bytes((logs / "A1-0.mcap").read_bytes()[:-100])
    absent = tmp_path / "absent.toml"
    assert twin(monkeypatch, "commission", log, "--config", absent, "--id", "A1") == 3
    assert f"twin: {log} is not complete; what can be read is used" in capsys.readouterr().err


@pytest.mark.slow
def test_units_are_calibrated_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log, database = fleets.write(tmp_path, "A1", 3, cycles=8), tmp_path / "f.sqlite"
    short = fleets.write(tmp_path, "A2", 4, cycles=1)
    asked = ("fleet", "calibrate", tmp_path, "--assets", database, "--workers", "1")
    assert twin(monkeypatch, *asked) == 3
    said = capsys.readouterr()
    assert "1 of 2 logs done, 0 were known, 1 could not be" in said.out
    assert f"{short}: the log has 1 complete cycles" in said.err
    assert twin(monkeypatch, *asked) == 3
    assert "0 of 2 logs done, 1 were known" in capsys.readouterr().out
    with open_assets(database) as assets:
        (record,) = assets.records("instance", "A1")
    assert record.provenance["log"] == log.name
    assert "ejector.suction_capacity_sl_min" in record.provenance["determined"]


def here(job: Job) -> Done:
    """As ``run``, by the code that asks."""
    return run(replace(job, code=code()))


def test_a_worker_with_other_code_is_refused(logs: Path) -> None:
    log = logs / "A1-0.mcap"
    done = run(Job("replay", log, rigs.config("test_rig"), "another"))
    assert done.answer is None
    assert str(log) in done.error
    assert "another version" in done.error


@pytest.mark.slow
def test_a_worker_does_each_work_and_tells_what_stopped_it(logs: Path, tmp_path: Path) -> None:
    """In this process, whatever pools and clusters do with it."""
    replayed = here(Job("replay", logs / "A1-0.mcap", rigs.config("test_rig"), ""))
    assert (replayed.error, replayed.record) == ("", None)
    assert replayed.answer
    diagnosed = here(Job("diagnose", logs / "A3-2.mcap", rigs.config("test_rig"), ""))
    assert diagnosed.answer
    assert diagnosed.answer["log"].endswith("A3-2.mcap")
    missing = here(Job("calibrate", tmp_path / "nothing.mcap", rigs.config("test_rig"), ""))
    assert missing.answer is None
    assert "nothing.mcap" in missing.error
    strange = here(Job("dance", logs / "A1-0.mcap", rigs.config("test_rig"), ""))
    assert "a mistake of this program, please report it: KeyError('dance')" in strange.error


def at_a_loss(job: Job) -> Done:
    """As ``run``; but at one log its process dies."""
    if DIES in job.log.name:
        os.kill(os.getpid(), signal.SIGKILL)
    return run(job)


@pytest.mark.slow
def test_a_killed_process_costs_only_its_log(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(3):
        (tmp_path / f"{number}.mcap").write_bytes(
            (logs / f"A{number + 1}-{number}.mcap").read_bytes()
        )
    fleets.write(tmp_path, DIES, 9)
    monkeypatch.setattr(going, "run", at_a_loss)
    asked = ("fleet", "replay", tmp_path, "--assets", tmp_path / "f.sqlite", "--workers", "2")
    assert twin(monkeypatch, *asked) == 3
    said = capsys.readouterr()
    assert "3 of 4 logs done, 0 were known, 1 could not be" in said.out
    assert f"{DIES}-9.mcap: the process that worked on it was killed" in said.err


@pytest.mark.slow
def test_a_cluster_gives_the_same_though_a_worker_is_killed(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    here, there = tmp_path / "here.json", tmp_path / "there.json"
    asked = ("fleet", "replay", logs, "--assets")
    assert twin(monkeypatch, *asked, tmp_path / "1.sqlite", "--workers", "1", "--json", here) == 0
    with cluster(2) as started:
        keep = going._store_outcome

        def killing(future: "Future[Done]", *rest: Any) -> going.Outcome:
            started.workers[0].kill()  # with what it is at, and what it has done
            return keep(future, *rest)

        monkeypatch.setattr(going, "_store_outcome", killing)
        on = ("--engine", "dask", "--scheduler", started.address, "--json", there)
        assert twin(monkeypatch, *asked, tmp_path / "2.sqlite", *on) == 0
        assert started.workers[0].wait(10) == -signal.SIGKILL
    alike = [{n: result["answer"] for n, result in answers(path).items()} for path in (here, there)]
    assert list(alike[0].items()) == list(alike[1].items())  # in the order they were named in
    assert len(alike[0]) == len(UNITS)
    assert "3 of 3 logs done" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "code", "says"),
    [
        (("--engine", "dask"), 2, "no scheduler is named"),
        (("--engine", "dask", "--scheduler", "tcp://127.0.0.1:1"), 3, "no Dask scheduler answers"),
        (("--scheduler", "tcp://127.0.0.1:1"), 2, "a scheduler is Dask's"),
    ],
)
def test_engines_are_refused_in_words(
    logs: Path,
    tmp_path: Path,
    options: tuple[str, ...],
    code: int,
    says: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("twin.fleet.engines.CONNECT_S", 0.5)
    asked = ("fleet", "replay", logs, "--assets", tmp_path / "f.sqlite", *options)
    assert twin(monkeypatch, *asked) == code
    assert says in capsys.readouterr().err
