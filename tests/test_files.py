"""Files that answers are written to."""

import json
from pathlib import Path

import numpy as np
import pytest

from twin import files
from twin.errors import SourceError
from twin.files import write_json


def test_an_answer_with_a_number_that_is_none_is_written(tmp_path: Path) -> None:
    """Nothing is worse at the end of an hour's work than an error for one figure."""
    write_json(tmp_path / "a.json", {"a": np.nan, "b": [np.float64(1.5), np.inf], "c": (1, "x")})
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "a": None,
        "b": [1.5, None],
        "c": [1, "x"],
    }


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
