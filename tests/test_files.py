"""Files that answers are written to."""

import json
from pathlib import Path

import numpy as np

from twin.files import write_json


def test_an_answer_with_a_number_that_is_none_is_written(tmp_path: Path) -> None:
    """Nothing is worse at the end of an hour's work than an error for one figure."""
    write_json(tmp_path / "a.json", {"a": np.nan, "b": [np.float64(1.5), np.inf], "c": (1, "x")})
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "a": None,
        "b": [1.5, None],
        "c": [1, "x"],
    }
