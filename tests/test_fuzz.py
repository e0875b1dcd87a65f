"""The fuzz tool in short, and that it would find what it looks for."""

import shutil
from pathlib import Path

import pytest

from tools import fuzz


@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_nothing_is_found_in_short(name: str, tmp_path: Path) -> None:
    assert fuzz.fuzz(name, 200, tmp_path, seed=5) == []


@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_what_was_kept_is_still_no_trouble(name: str, tmp_path: Path) -> None:
    shutil.copytree(fuzz.CORPUS / name, tmp_path / name)
    assert len(list((tmp_path / name).iterdir())) > 2
    assert fuzz.fuzz(name, 0, tmp_path, seed=5) == []


def test_an_input_that_takes_too_long_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuzz, "LONGEST_S", -1.0)
    assert any("took" in one for one in fuzz.fuzz("ring", 0, tmp_path, seed=5))


def test_what_is_found_is_kept_with_its_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fragile(data: bytes) -> str:
        return str(len(data) // data[0])

    monkeypatch.setitem(fuzz.TARGETS, "values", fragile)
    (found,) = fuzz.fuzz("values", 2000, tmp_path, seed=5)[:1]
    path, _, what = found.partition(": ")
    assert "Error" in what
    with pytest.raises((ZeroDivisionError, IndexError)):
        fragile(Path(path).read_bytes())
    again = fuzz.fuzz("values", 0, tmp_path, seed=6)  # what was kept is tried first
    assert any(what in one for one in again)
