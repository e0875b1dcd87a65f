"""Which files a request for logs means, and how they come into a folder: without a broker."""

import errno
import os
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_rows import START_NS, course

from twin.assets.unit import Unit
from twin.log.header import LogHeader
from twin.log.recorder import Recorder
from twin.notifications import logs
from twin.notifications.sender import LostError
from twin.notifications.upload_destinations import Share, StoppedError, described
from twin.notifications.upload_requests import REQUEST_FORMAT, RefusedError, UploadRequest

UNIT = Unit("kind", "rig-01")
S = 1_000_000_000


def written(path: Path, unit: Unit = UNIT, *, rotate_bytes: int | None = None) -> Path:
    """A finished log of twenty seconds, received from START_NS on."""
    samples, ticks = course(20_000)
    samples["host_ns"] = START_NS + np.arange(len(samples)) * 1_000_000
    now = 0.0
    with Recorder(path, LogHeader(*unit, "a.toml", ""), rotate_bytes, lambda: now) as log:
        for begin in range(0, len(samples), 500):
            now += 0.5
            log.write(samples[begin : begin + 500], ticks[begin : begin + 500])
    return path


def asked(log: str = "", begin_s: float | None = None, end_s: float = 0.0) -> UploadRequest:
    table: dict[str, Any] = {"format": REQUEST_FORMAT, "id": "a", "log": log}
    if begin_s is not None:
        table |= {"from": _moment(begin_s), "to": _moment(end_s)}
    return UploadRequest.model_validate(table)


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(START_NS / S + seconds, UTC)


def names(folder: Path, request: UploadRequest) -> list[str]:
    return [path.name for path in logs.find(folder, UNIT, request).parts]


def test_a_name_means_all_parts_of_that_log(tmp_path: Path) -> None:
    written(tmp_path / "a.mcap", rotate_bytes=30_000)
    written(tmp_path / "b.mcap")
    parts = sorted(path.name for path in tmp_path.glob("a*"))
    assert len(parts) > 2
    assert sorted(names(tmp_path, asked("a.mcap"))) == parts


def test_a_time_means_what_was_received_then(tmp_path: Path) -> None:
    written(tmp_path / "a.mcap", rotate_bytes=30_000)
    everything = names(tmp_path, asked(begin_s=-1.0, end_s=30.0))
    first = names(tmp_path, asked(begin_s=0.0, end_s=0.5))
    assert first == ["a.mcap"]
    assert len(everything) > 2
    with pytest.raises(RefusedError, match="no finished file of a log is like that"):
        names(tmp_path, asked(begin_s=30.0, end_s=40.0))


@pytest.mark.parametrize("name", ["../a.mcap", "/etc/passwd", "b/a.mcap", ".", "missing.mcap"])
def test_a_name_is_no_path(tmp_path: Path, name: str) -> None:
    written(tmp_path / "a.mcap")
    (tmp_path / "logs" / "b").mkdir(parents=True)
    written(tmp_path / "logs" / "b" / "a.mcap")
    with pytest.raises(RefusedError, match="there is no log of that name"):
        logs.find(tmp_path / "logs", UNIT, asked(name))


def test_a_log_of_another_unit_is_not_given_away(tmp_path: Path) -> None:
    written(tmp_path / "a.mcap", Unit("kind", "rig-02"))
    with pytest.raises(RefusedError, match="that is the log of another asset"):
        logs.find(tmp_path, UNIT, asked("a.mcap"))
    with pytest.raises(RefusedError, match="no finished file"):
        logs.find(tmp_path, UNIT, asked(begin_s=-1.0, end_s=30.0))


def test_what_is_no_log_and_what_a_link_leads_to_is_not_given_away(tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "noise.mcap").write_bytes(b"x" * 100)
    (folder / "link.mcap").symlink_to(written(tmp_path / "a.mcap"))
    with pytest.raises(RefusedError, match="cannot be read as a log"):
        logs.find(folder, UNIT, asked("noise.mcap"))
    with pytest.raises(RefusedError, match="there is no log of that name"):
        logs.find(folder, UNIT, asked("link.mcap"))
    with pytest.raises(RefusedError, match="no finished file"):
        logs.find(folder, UNIT, asked(begin_s=-1.0, end_s=30.0))


def test_what_is_still_written_is_named_and_left_out(tmp_path: Path) -> None:
    whole = written(tmp_path / "a.mcap")
    torn = tmp_path / "b.mcap"
    torn.write_bytes(whole.read_bytes()[:-5000])
    found = logs.find(tmp_path, UNIT, asked(begin_s=-1.0, end_s=30.0))
    assert ([path.name for path in found.parts], found.unfinished) == (["a.mcap"], ("b.mcap",))
    with pytest.raises(RefusedError, match=r"not finished: b\.mcap"):
        logs.find(tmp_path, UNIT, asked("b.mcap"))


def test_a_request_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(tmp_path / "a.mcap", rotate_bytes=30_000)
    monkeypatch.setattr(logs, "MOST_PARTS", 2)
    with pytest.raises(RefusedError, match="more than 2: ask for less"):
        logs.find(tmp_path, UNIT, asked("a.mcap"))


@pytest.fixture
def share(tmp_path: Path) -> Share:
    (tmp_path / "share").mkdir()
    return Share(tmp_path / "share", Unit("kind", ".."), threading.Event())


def test_a_copy_is_there_whole_and_nothing_is_replaced(tmp_path: Path, share: Share) -> None:
    log, ending = written(tmp_path / "a.mcap"), threading.Event()
    file = described(log, ending)
    for _ in range(2):  # what has arrived already is well
        share.put(log, file)
    (copy,) = (path for path in (tmp_path / "share").rglob("*") if path.is_file())
    assert copy.read_bytes() == log.read_bytes()
    assert copy.parent == tmp_path / "share" / "kind" / "%2E%2E"
    copy.write_bytes(b"another")
    with pytest.raises(RefusedError, match=r"another file called a\.mcap is already there"):
        share.put(log, file)
    assert copy.read_bytes() == b"another"


def test_a_share_that_is_away_or_full_is_waited_for(
    tmp_path: Path, share: Share, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, ending = written(tmp_path / "a.mcap"), threading.Event()
    file = described(log, ending)
    away = Share(tmp_path / "nowhere", UNIT, ending)
    with pytest.raises(LostError, match="no such folder"):
        away.put(log, file)

    def full(_handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(LostError, match="cannot be written: No space left"):
        share.put(log, file)
    assert not list((tmp_path / "share").rglob("*.mcap"))  # only a part of it


def test_a_file_that_became_a_link_is_not_read(tmp_path: Path, share: Share) -> None:
    log, ending = written(tmp_path / "a.mcap"), threading.Event()
    file = described(log, ending)
    log.rename(tmp_path / "elsewhere")
    log.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RefusedError, match=r"a\.mcap cannot be read"):
        share.put(log, file)


def test_a_copy_ends_with_the_program(tmp_path: Path, share: Share) -> None:
    log, ending = written(tmp_path / "a.mcap"), threading.Event()
    file = described(log, ending)
    share._ending.set()
    with pytest.raises(StoppedError):
        share.put(log, file)
