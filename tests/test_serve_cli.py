"""``twin serve`` on the command line: who it lets in, and what a run leaves for it."""

import io
import json
import os
import pickle
import socket
import ssl
import subprocess
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import rigs
from command_line import twin
from independent import pem
from page_site import Run, config, flat, write_config
from plc_process import ROOT
from test_alarms_loop import Stream as Alarming
from test_alarms_loop import deviation, diagnosis
from test_live_diagnosis import ANSWER, Stream, answering, quiet

from drivers.opcua import certificates
from twin.cli.serve import live_rows_of, reports_of
from twin.diagnosis import __main__ as diagnosing
from twin.diagnosis import process, report
from twin.diagnosis.process import LiveDiagnosis
from twin.extras import install_hint
from twin.page.ejector import REPORT
from twin.page.ring import read
from twin.page.settings import RING, folder_of


@pytest.mark.slow
@pytest.mark.needs("uplot")
def test_it_serves_until_it_is_told_to_end(tmp_path: Path) -> None:
    path = write_config(tmp_path)
    Run(config(path)).close()
    command = [sys.executable, "-m", "twin.cli", "serve", "--port", "0", "--config", str(path)]
    server = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    try:
        url = server.stdout.readline().removeprefix("the page is at ").strip()
        with urllib.request.urlopen(f"{url}api/me") as answer:
            assert json.load(answer)["ejectors"][0]["name"] == "gripper-01"
    finally:
        server.terminate()
        assert server.wait(10) in (0, -15)
        server.stdout.close()


@pytest.mark.slow
@pytest.mark.needs("uplot")
def test_it_serves_over_tls(tmp_path: Path) -> None:
    path = write_config(tmp_path)
    Run(config(path)).close()
    own = certificates.make(tmp_path / "tls")
    options = ("--port", "0", "--config", path, "--certificate", pem(tmp_path / "tls"))
    command = [sys.executable, "-m", "twin.cli", "serve", *options, "--key", own.key]
    server = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    try:
        url = server.stdout.readline().removeprefix("the page is at ").strip()
        assert url.startswith("https://127.0.0.1:")
        trusting = ssl.create_default_context(cafile=str(tmp_path / "tls" / "certificate.pem"))
        trusting.check_hostname = False
        with urllib.request.urlopen(f"{url}login", context=trusting) as answer:
            assert "Log in" in answer.read().decode()
    finally:
        server.terminate()
        server.wait(10)
        server.stdout.close()


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "::", "hall-7"])
def test_others_reach_no_page_without_users(
    tmp_path: Path, host: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_config(tmp_path)
    assert twin(monkeypatch, "serve", "--config", path, "--host", host) == 2
    said = capsys.readouterr().err
    assert "it has no users" in said
    assert "twin users add NAME" in said


@pytest.mark.needs("uplot")
def test_what_cannot_be_served_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_config(tmp_path)
    pem = tmp_path / "page.pem"
    pem.write_text("none")
    for options, why in (
        ([], "no ejector to show"),
        (["--config", path, "--certificate", pem], "belong together"),
        (["--config", path, "--certificate", pem, "--key", pem], "cannot be used"),
        (
            ["--config", rigs.path_of("gripper")],
            "put keep = true under [alarms] and [page] and start twin run again",
        ),
    ):
        assert twin(monkeypatch, "serve", "--port", "0", *options) == 2
        assert why in capsys.readouterr().err
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert twin(monkeypatch, "serve", "--config", path, "--port", str(port)) == 3
    assert "nobody can listen there" in capsys.readouterr().err


# --- what a run leaves ----------------------------------------------------------------------------


def test_a_run_leaves_rows_and_reports_only_where_it_is_asked_to(tmp_path: Path) -> None:
    silent = rigs.config("gripper")
    assert live_rows_of(silent, pytest.fail) is None
    assert reports_of(silent, pytest.fail) is None
    settings = config(write_config(tmp_path))
    opened = live_rows_of(settings, pytest.fail)
    assert opened is not None
    live = opened()
    live.write(*flat(60), [])
    live.close()
    folder = folder_of(settings.document, settings.asset)
    assert folder == tmp_path / "page" / "compact-ejector-35.gripper-01"
    assert read(folder / RING) is not None
    assert reports_of(settings, pytest.fail) == folder / "reports"


def test_without_matplotlib_a_run_says_that_it_leaves_no_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    said: list[str] = []
    assert reports_of(config(write_config(tmp_path)), said.append) is None
    (remark,) = said
    assert "the extra [reports]" in remark
    assert remark.endswith(install_hint("reports"))


def test_an_answer_says_where_it_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, ANSWER)
    questions = []
    asked = process.Asked
    monkeypatch.setattr(process, "Asked", lambda *how: (questions.append(how[0]), asked(*how))[1])
    stream = Stream()
    stream.to = LiveDiagnosis(
        rigs.config("gripper"), "a.mcap", lambda: False, quiet, reports=tmp_path / "reports"
    )
    stream.cycles(5)
    stream.cycle(alarm=True)
    stream.cycles(2)
    stream.answered()
    (event,), (question,) = stream.told, questions
    assert question[3] == tmp_path / "reports" / f"{event.data['report']}.html"
    assert REPORT.fullmatch(event.data["report"])


def test_the_alarm_knows_the_report_of_its_diagnosis() -> None:
    stream = Alarming()
    stream.at(5, deviation(5))
    told = diagnosis(9, 5, "leakage")
    told = replace(told, data={**told.data, "report": "f" * 32})
    stream.at(9, told)
    (episode,) = stream.desk.news.episodes.values()
    assert episode.evidence["report"] == "f" * 32


@pytest.mark.parametrize("verdict", ["explained", "unlisted", "consistent", "insufficient"])
def test_the_process_that_diagnoses_draws_what_it_found(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    verdict: str,
) -> None:
    path = tmp_path / "new" / "a.html"
    _diagnosed(monkeypatch, path, verdict)
    assert json.loads(capsys.readouterr().out) == {"verdict": verdict}
    kept = {"a.html": "in en", "a.de.html": "in de"}
    assert {file.name: file.read_text() for file in tmp_path.rglob("*.*")} == (
        kept if verdict in ("explained", "unlisted") else {}
    )


def test_a_report_that_cannot_be_drawn_costs_no_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    _diagnosed(monkeypatch, tmp_path / "file" / "a.html", "explained")
    assert json.loads(capsys.readouterr().out) == {"verdict": "explained"}


def test_the_oldest_reports_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosing, "MOST_REPORTS", 3)
    for number in range(5):
        path = tmp_path / f"{number}.html"
        _diagnosed(monkeypatch, path, "explained")
        os.utime(path, (number, number))
    names = [f"{number}{code}.html" for number in (2, 3, 4) for code in (".de", "")]
    assert sorted(file.name for file in tmp_path.iterdir()) == names


def _diagnosed(monkeypatch: pytest.MonkeyPatch, path: Path, verdict: str) -> None:
    """The process, with an answer in place of the search."""
    found = SimpleNamespace(json={"verdict": verdict})
    question = io.BytesIO(pickle.dumps((None, None, "a.mcap", path, 0.0)))
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=question))
    monkeypatch.setattr(diagnosing, "diagnose", lambda *_: found)
    monkeypatch.setattr(
        report, "write_report", lambda _, file, language: file.write_text(f"in {language.code}")
    )
    diagnosing.main()
