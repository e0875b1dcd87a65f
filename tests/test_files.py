"""Files that answers are written to."""

import json
from pathlib import Path

import numpy as np
import pytest

from twin import files
from twin.errors import SourceError
from twin.files import MOST_DEEP, json_text, write_json


def test_an_answer_with_a_number_that_is_none_is_written(tmp_path: Path) -> None:
    """Nothing is worse at the end of an hour's work than an error for one figure."""
    write_json(tmp_path / "a.json", {"a": np.nan, "b": [np.float64(1.5), np.inf], "c": (1, "x")})
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "a": None,
        "b": [1.5, None],
        "c": [1, "x"],
    }


class _Rude:
    def __repr__(self) -> str:
        raise ZeroDivisionError


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (b"\x00\xff", "not JSON (bytes): b'\\x00\\xff'"),
        (1 + 2j, "not JSON (complex): (1+2j)"),
        (1 << 20_000, "not JSON (int)"),
        (_Rude(), "not JSON (_Rude): "),
        (np.datetime64("2026-01-01", "s"), "not JSON (datetime): "),
        (np.bool_(True), True),
        (np.arange(3), [0, 1, 2]),
        (np.array([1.0, np.nan]), [1.0, None]),
        ({1: {(2, 3): {4}}}, {"1": {"(2, 3)": [4]}}),
        ("half \ud800 character", "half \\ud800 character"),
        (2**63, 2**63),
    ],
    ids=lambda _: "",
)
def test_json_never_fails_and_says_what_it_cannot_hold(value: object, written: object) -> None:
    read = json.loads(json_text({"a": value, "b": 1}).encode())
    assert read["b"] == 1
    if isinstance(written, str):
        assert read["a"].startswith(written)
    else:
        assert read["a"] == written


def test_json_of_what_has_no_end_is_cut() -> None:
    endless: list[object] = [1]
    endless.append(endless)
    read = json.loads(json_text(endless))
    for _ in range(MOST_DEEP - 1):
        one, read = read
        assert one == 1
    assert read[1].startswith("not JSON (list): [1, [1,")


def test_what_is_there_is_written_over_though_its_folder_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As /dev/stdout is to everybody but root, whom nothing is closed to."""
    open_file, closed_file = tmp_path / "open", tmp_path / "closed"
    open_file.touch()
    closed_file.touch()
    monkeypatch.setattr(files.os, "access", lambda path, _mode: path == open_file)
    files.require_writable(open_file)
    with pytest.raises(SourceError, match=r"closed: cannot be written: Permission denied"):
        files.require_writable(closed_file)
    with pytest.raises(SourceError, match=r"new: cannot be written: no folder to write to"):
        files.require_writable(tmp_path / "new")
