"""The audit trail: it grows, survives a crash and a full disk, and strangers push nothing out."""

import fcntl
import io
import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import twin

from twin import audit as module
from twin.audit import DONE, REFUSED, Act, Audit, in_words, records

NOW_NS = 1_700_000_000_123_456_789


class Trail:
    """A trail with a clock of its own, and what it complained of."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.now_ns, self.said = folder, NOW_NS, list[str]()
        self.audit = Audit(folder, "page", self.said.append, lambda: self.now_ns)

    def record(self, what: str = Act.LOGGED_IN, who: str = "ann", **details: str) -> None:
        self.audit.record(what, who, "192.0.2.7", **details)
        self.now_ns += 1_000_000

    def whos(self) -> list[str]:
        return [entry["who"] for entry in records(self.folder)[0]]


@pytest.fixture
def trail(tmp_path: Path) -> Trail:
    return Trail(tmp_path)


def test_a_record_says_who_did_what_from_where_and_when(trail: Trail) -> None:
    trail.record("acknowledged", "Schlüssel", unit="cell 7", alarm="plc_stale", comment="Schläuche")
    told, broken = records(trail.folder)
    assert broken == 0
    assert told == [
        {
            "time": "2023-11-14T22:13:20.123456Z",
            "what": "acknowledged",
            "who": "Schlüssel",
            "through": "page",
            "from": "192.0.2.7",
            "unit": "cell 7",
            "alarm": "plc_stale",
            "comment": "Schläuche",
        }
    ]
    assert "Schlüssel" in (trail.folder / DONE).read_text(encoding="utf-8")
    assert stat.S_IMODE((trail.folder / DONE).stat().st_mode) == 0o600


def test_records_of_both_files_come_by_time(trail: Trail) -> None:
    for what in (Act.WRONG_PASSWORD, Act.LOGGED_IN, Act.DENIED, "shelved", Act.THROTTLED):
        trail.record(what)
    assert [entry["what"] for entry in records(trail.folder)[0]] == [
        *("wrong_password", "logged_in", "denied", "shelved", "throttled")
    ]
    assert len((trail.folder / REFUSED).read_text().splitlines()) == 3


def test_it_is_bounded_and_the_oldest_goes(trail: Trail, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LARGEST", 300)
    monkeypatch.setattr(module, "KEPT", 3)
    for number in range(20):
        trail.record(who=str(number))
    files = sorted(trail.folder.iterdir())
    assert [file.name for file in files] == ["audit.1.jsonl", "audit.2.jsonl", "audit.jsonl"]
    assert all(file.stat().st_size <= 300 for file in files)
    kept = [int(name) for name in trail.whos()]
    assert kept == list(range(kept[0], 20))
    assert len(kept) > 4


def test_who_guesses_pushes_out_nothing_that_users_did(
    trail: Trail, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LARGEST", 300)
    trail.record("acknowledged", "ann")
    for _ in range(50):
        trail.record(Act.WRONG_PASSWORD, "mallory")
    assert "ann" in trail.whos()


def test_after_a_crash_within_a_line_the_next_one_is_whole(trail: Trail) -> None:
    trail.record(who="ann")
    with (trail.folder / DONE).open("ab") as file:
        file.write(b'{"time": "2023-11-1')
    trail.record(who="bob")
    assert trail.whos() == ["ann", "bob"]
    assert records(trail.folder)[1] == 1


def test_a_record_is_on_the_disk_at_once(tmp_path: Path) -> None:
    program = (
        "import os, pathlib, sys; from twin.audit import Audit;"
        "Audit(pathlib.Path(sys.argv[1]), 'page', print).record('logged_in', 'ann'); os._exit(9)"
    )
    process = subprocess.run([sys.executable, "-c", program, tmp_path], check=False)
    assert process.returncode == 9
    assert [entry["who"] for entry in records(tmp_path)[0]] == ["ann"]


def test_a_disk_that_fails_is_told_once_and_nobody_waits(
    trail: Trail, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = os.write

    def full(handle: int, line: bytes) -> int:
        return plain(handle, line[:20])

    monkeypatch.setattr(os, "write", full)
    trail.record()
    trail.record()
    (said,) = trail.said
    assert "audit.jsonl: the audit trail cannot be written: No space left" in said
    monkeypatch.setattr(os, "write", plain)
    trail.record(who="bob")
    assert trail.whos() == ["bob"]
    monkeypatch.setattr(os, "write", full)
    trail.record()
    assert len(trail.said) == 2


def test_a_folder_that_is_away_is_told(tmp_path: Path) -> None:
    gone = Trail(tmp_path / "gone")
    gone.record()
    assert "cannot be written: No such file" in gone.said[0]


def test_a_process_that_hangs_while_it_writes_is_not_waited_for(
    trail: Trail, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LOCK_S", 0.02)
    monkeypatch.setattr(module, "LARGEST", 150)
    trail.record()
    handle = os.open(trail.folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        trail.record(who="bob")
    finally:
        os.close(handle)
    assert trail.whos() == ["ann", "bob"]
    assert [file.name for file in trail.folder.iterdir()] == [DONE]  # not moved by two at once


def test_what_a_terminal_would_act_on_is_not_printed(trail: Trail) -> None:
    trail.record(Act.WRONG_PASSWORD, "\x1b[2J\nann\u202e\ud800")
    (told,) = records(trail.folder)[0]
    line = in_words(told)
    assert line.isprintable()
    assert "wrong password" in line
    assert "ann" in line


def test_it_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("LOGNAME", "admin")
    kept = tmp_path / "users.toml"
    word = io.StringIO("correct horse\n")
    monkeypatch.setattr(sys, "stdin", word)
    assert twin(monkeypatch, "users", "add", "Jörg", "--users", kept) == 0
    assert twin(monkeypatch, "users", "role", "Jörg", "configure", "--users", kept) == 0
    word.seek(0)
    assert twin(monkeypatch, "users", "password", "Jörg", "--users", kept) == 0
    assert twin(monkeypatch, "users", "remove", "Jörg", "--users", kept) == 0
    assert twin(monkeypatch, "users", "remove", "Jörg", "--users", kept) == 2
    with (tmp_path / DONE).open("a") as file:
        file.write("nothing\n[]\n")
    capsys.readouterr()
    asked = ("users", "audit", "--users", kept, "--json", tmp_path / "a.json")
    assert twin(monkeypatch, *asked) == 0
    shown, said = capsys.readouterr()
    assert [line.split("  ", 1)[1] for line in shown.splitlines()] == [
        "user added        admin  command  user=Jörg  role=look",
        "role changed      admin  command  user=Jörg  role=configure",
        "password changed  admin  command  user=Jörg",
        "user removed      admin  command  user=Jörg",
    ]
    assert said == "twin: 2 lines of the audit trail cannot be read\n"
    assert len(json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))) == 4
    assert "correct horse" not in (tmp_path / DONE).read_text(encoding="utf-8")
