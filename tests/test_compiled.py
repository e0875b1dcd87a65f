"""What is compiled once is loaded by those that come later, and nothing else with it."""

import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rigs

from twin import files
from twin.errors import SourceError
from twin.files import private_folder
from twin.model import compiled, kernel

LOADING = """
import sys
import numpy as np
from twin.monitor.clock import line
x = np.arange(5.0)
assert line(x, 2.0 * x) == (2.0, 8.0)
print(sorted({"numba.typed.typeddict", "numba.np.polynomial"} & sys.modules.keys()))
"""


def start(cache: Path | None = None) -> "subprocess.CompletedProcess[str]":
    env = dict(os.environ) if cache is None else {**os.environ, "XDG_CACHE_HOME": str(cache)}
    command = [sys.executable, "-c", LOADING]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=100, env=env)


class Planted:
    """Runs as it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.mark,)


@pytest.mark.slow
def test_a_start_with_all_compiled_gets_no_compiler_ready() -> None:
    for _ in range(2):  # the first one may have to compile it
        said = start()
    assert said.stdout.strip() == "[]"


@pytest.mark.slow
def test_a_cache_that_others_may_write_to_is_not_unpickled(tmp_path: Path) -> None:
    cache, mark = tmp_path / "cache", tmp_path / "mark"
    assert "then kept" in start(cache).stderr
    indexes = list(cache.rglob("*.nbi"))
    assert indexes
    for index in indexes:
        index.write_bytes(pickle.dumps(Planted(mark)))
    (cache / "ejector-twin").chmod(0o777)
    said = start(cache).stderr
    assert not mark.exists()
    assert "and not kept" in said
    assert f"{cache / 'ejector-twin'}: others may use it" in said


def test_what_is_compiled_is_for_its_user_alone(tmp_path: Path) -> None:
    start(tmp_path)
    folders = [tmp_path / "ejector-twin", *(tmp_path / "ejector-twin").iterdir()]
    assert [folder.stat().st_mode & 0o777 for folder in folders] == [0o700, 0o700]


def test_a_folder_of_somebody_else_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = private_folder(tmp_path / "mine")
    monkeypatch.setattr(files.os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(SourceError, match="belongs to another user"):
        private_folder(mine)


def test_a_link_is_refused(tmp_path: Path) -> None:
    private_folder(tmp_path / "elsewhere")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(SourceError, match="is a link"):
        private_folder(tmp_path / "link")


def test_a_folder_in_one_that_all_may_write_to_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o1777)  # as temporary files have it
    with pytest.raises(SourceError, match="others may use it"):
        private_folder(tmp_path / "guessable")


@pytest.mark.slow
def test_a_step_is_taken_for_several_hypotheses_at_a_time() -> None:
    """One at a time they take three times as long, which nothing else would tell."""
    theta = np.stack([rigs.theta("test_rig")] * kernel.LANES, axis=1)
    rows = np.zeros(2)
    expected = np.empty((2, kernel.LANES))
    kernel.advance(kernel.at_rest(theta), theta, rows, rows.astype(np.uint8), rows, expected)
    again = compiled._with_arrays(kernel._advance.py_func)  # what is cached cannot be looked at
    again.compile(kernel._advance.signatures[0])
    (assembly,) = again.inspect_asm().values()
    divisions = re.findall(r"\bv?divpd\b|\bfdiv\s+v\d+\.2d", assembly)
    assert len(divisions) > 100
