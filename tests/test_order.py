"""The files that take longest go first, so that no process is alone with one at the end."""

import re
from types import SimpleNamespace

import conftest
import rigs

TESTS = rigs.ROOT / "tests"
LONG_S = 600.0  # twice what a test may take that says nothing


def timeouts(text: str) -> list[float]:
    """How long (s) tests of a file may take that say so."""
    return [float(seconds) for seconds in re.findall(r"mark\.timeout\((\d+)\)", text)]


def test_what_may_take_long_goes_first() -> None:
    files = [SimpleNamespace(path=path) for path in sorted(TESTS.rglob("test_*.py"))]
    conftest.pytest_collection_modifyitems(files)  # type: ignore[arg-type]
    ordered = [file.path for file in files]
    first = ordered[: len(conftest.FIRST)]
    assert [path.stem for path in first] == [f"test_{name}" for name in conftest.FIRST]
    long = {path for path in ordered if max(timeouts(path.read_text()), default=0.0) >= LONG_S}
    assert len(long) > 5
    assert long <= set(first)
