"""The fuzz tool in short, and that it would find what it looks for."""

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from tools import fuzz
from tools.fuzz_targets import seeds
from twin.errors import TwinError


@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_nothing_is_found_in_short(name: str, tmp_path: Path) -> None:
    assert fuzz.fuzz(name, 200, tmp_path, seed=5) == []


@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_what_was_kept_is_still_no_trouble(name: str, tmp_path: Path) -> None:
    shutil.copytree(fuzz.CORPUS / name, tmp_path / name)
    assert list((tmp_path / name).iterdir())
    assert fuzz.fuzz(name, 0, tmp_path, seed=5) == []


def test_an_input_that_takes_too_long_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuzz, "LONGEST_S", -1.0)
    assert any("took" in line for line in fuzz.fuzz("ring", 0, tmp_path, seed=5))


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
    assert any(what.partition(" (")[0] in line for line in again)


def test_an_input_that_ends_the_process_is_there_afterwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def deadly(data: bytes) -> str:
        if len(data) > 40:
            raise SystemExit
        return "done"

    monkeypatch.setitem(fuzz.TARGETS, "values", deadly)
    with pytest.raises(SystemExit):
        fuzz.fuzz("values", 20_000, tmp_path, seed=5)
    last = tmp_path / "values" / fuzz.UNDER_WAY
    assert len(last.read_bytes()) > 40
    with pytest.raises(SystemExit):  # it is the first of those that are tried again
        fuzz.fuzz("values", 0, tmp_path, seed=6)
    assert f"{last}: this ended the process" in capsys.readouterr().err


def test_a_fast_target_has_more_of_the_inputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0

    def taking(seconds: float) -> Callable[[bytes], str]:
        def target(_data: bytes) -> str:
            nonlocal now
            now += seconds
            return "done"

        return target

    monkeypatch.setattr(fuzz.time, "monotonic", lambda: now)
    monkeypatch.setitem(fuzz.TARGETS, "ring", taking(0.001))
    monkeypatch.setitem(fuzz.TARGETS, "values", taking(0.01))
    fast, slow = (fuzz.Campaign(name, tmp_path) for name in ("ring", "values"))
    fuzz.share([fast, slow], 2000)
    assert fast.inputs + slow.inputs == 2000
    assert fast.inputs / slow.inputs == pytest.approx(10.0, rel=0.1)


def test_each_target_takes_its_examples_for_whole() -> None:
    """Else nothing behind the first look at an input would ever be reached."""
    for name, target in fuzz.TARGETS.items():
        whole = 0
        for data in seeds(name):
            with suppress(TwinError):
                whole += not target(data).startswith("no")
        assert whole, name
