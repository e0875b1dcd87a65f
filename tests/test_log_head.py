"""The head of a log is believed as it was written, or not at all."""

import random
from dataclasses import replace
from pathlib import Path

import pytest
import rigs
from log_rows import course

from twin.config import Config
from twin.errors import SourceError
from twin.log import header as module
from twin.log.check import check
from twin.log.header import UNCHECKED, LogHeader
from twin.log.reader import open_log
from twin.log.recorder import Recorder

SAMPLES, TICKS = course(100)
MUTATIONS = 600


@pytest.fixture(scope="module")
def header() -> LogHeader:
    return rigs.config("gripper").log_header()


def written(path: Path, header: LogHeader) -> bytes:
    """A log; gives its head."""
    with Recorder(path, header) as recorder:
        head = path.stat().st_size
        recorder.write(SAMPLES, TICKS)
    return path.read_bytes()[:head]


def mutated(head: bytes, rng: random.Random) -> bytes:
    """One bit, one byte, a byte that is missing, a byte more, or two places exchanged."""
    raw, at = bytearray(head), rng.randrange(len(head))
    match rng.randrange(6):
        case 0 | 1:
            raw[at] ^= 1 << rng.randrange(8)
        case 2:
            raw[at] = rng.randrange(256)
        case 3:
            del raw[at]
        case 4:
            raw.insert(at, rng.randrange(256))
        case 5:
            other = rng.randrange(len(head))
            raw[at], raw[other] = raw[other], raw[at]
    return bytes(raw)


@pytest.mark.parametrize("seed", range(4))
def test_no_damaged_head_is_believed_with_another_meaning(
    tmp_path: Path, header: LogHeader, seed: int
) -> None:
    path, rng = tmp_path / "a.mcap", random.Random(seed)
    head = written(path, header)
    rest, refused = path.read_bytes()[len(head) :], 0
    for _ in range(MUTATIONS // 4):
        path.write_bytes(mutated(head, rng) + rest)
        try:
            log = open_log(path)
            config = Config.of_recorded(log.header, str(path))
        except SourceError:
            refused += 1
            continue
        assert log.header == header
        assert log.checked
        assert config.data.hash == header.metadata["data_set"]
    assert refused > MUTATIONS // 4 * 0.8  # a few meet what has no meaning


def test_a_digit_of_the_data_set_is_not_taken(tmp_path: Path, header: LogHeader) -> None:
    path = tmp_path / "a.mcap"
    written(path, header)
    raw = path.read_bytes()
    assert raw.count(b'"volume_ml":') > 0
    at = raw.index(b'"volume_ml":') + len(b'"volume_ml":')
    path.write_bytes(raw[:at] + (b"1" if raw[at : at + 1] != b"1" else b"2") + raw[at + 1 :])
    with pytest.raises(SourceError, match="its checksum is wrong"):
        check(path)


def older(monkeypatch: pytest.MonkeyPatch, path: Path, header: LogHeader) -> None:
    """A log as it was written before heads had a checksum."""
    to_metadata = module.to_metadata

    def without(header: LogHeader, identity: module.Identity) -> dict[str, str]:
        stored = to_metadata(header, identity)
        del stored[module.CHECKSUM]
        return stored | {"format": UNCHECKED}

    monkeypatch.setattr("twin.log.part.to_metadata", without)
    written(path, header)
    monkeypatch.undo()


def test_an_older_log_is_read_and_said_to_be_unchecked(
    tmp_path: Path, header: LogHeader, monkeypatch: pytest.MonkeyPatch
) -> None:
    older(monkeypatch, tmp_path / "old.mcap", header)
    written(tmp_path / "new.mcap", header)
    old, new = open_log(tmp_path / "old.mcap"), open_log(tmp_path / "new.mcap")
    assert old.header == new.header == header
    assert (old.checked, new.checked) == (False, True)
    assert "unchecked" in str(check(old.path))
    assert "unchecked" not in str(check(new.path))


def test_of_an_older_log_the_hash_of_its_data_set_is_compared(
    tmp_path: Path, header: LogHeader, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed = header.metadata["data"].replace('"temperature_c":2', '"temperature_c":1')
    assert changed != header.metadata["data"]
    wrong = replace(header, metadata=header.metadata | {"data": changed})
    older(monkeypatch, tmp_path / "old.mcap", wrong)
    log = open_log(tmp_path / "old.mcap")
    with pytest.raises(SourceError, match="its hash is another one"):
        Config.of_recorded(log.header, "old.mcap")
