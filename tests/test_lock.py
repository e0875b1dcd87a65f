"""One run at a time for a unit, and the second one is told who the first is."""

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import rigs
from command_line import twin

from twin import lock
from twin.errors import SourceError
from twin.lock import lock_file, only_run

NOW_NS = 1_800_000_000 * 10**9
HOLDER = """
import sys, time
from pathlib import Path
from twin.lock import only_run
with only_run(Path(sys.argv[1]), sys.argv[2], time.time_ns(), print):
    print("held", flush=True)
    sys.stdin.read()
"""


def held(folder: Path, unit: str = "compact-ejector-35 gripper-01") -> None:
    """Take the lock and let go of it; nothing may be complained of."""
    with only_run(folder, unit, NOW_NS, pytest.fail):
        pass


@contextmanager
def holding(folder: Path, unit: str) -> Iterator["subprocess.Popen[str]"]:
    """Another process that holds it."""
    command = [sys.executable, "-c", HOLDER, str(folder), unit]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, cwd=rigs.ROOT) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "held\n"
            yield process
        finally:
            process.kill()


def test_a_second_run_is_told_which_process_is_there_already(tmp_path: Path) -> None:
    with holding(tmp_path, "kind rig-01") as other:
        with pytest.raises(SourceError) as refused:
            held(tmp_path, "kind rig-01")
        said = str(refused.value)
        assert said.startswith(f"kind rig-01 is watched already: process {other.pid} since 2")
        assert said.endswith(f"writes into {tmp_path}")
        held(tmp_path, "kind rig-02")
        (tmp_path / "elsewhere").mkdir()
        held(tmp_path / "elsewhere", "kind rig-01")


def test_a_process_that_is_killed_holds_nothing(tmp_path: Path) -> None:
    with holding(tmp_path, "kind rig-01") as other:
        other.kill()
        other.wait()
        held(tmp_path, "kind rig-01")


def wait_until(what: Callable[[], bool]) -> None:
    """Until that is so; fails if it is not within some seconds."""
    end = time.monotonic() + 10.0
    while not what():
        assert time.monotonic() < end
        time.sleep(0.01)


def is_held(folder: Path) -> bool:
    try:
        held(folder)
    except SourceError:
        return True
    return False


def is_written(path: Path) -> bool:
    """By who has locked it."""
    return path.exists() and path.read_bytes().startswith(b"process ")


def test_a_lock_is_held_after_its_folder_was_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "LOOK_S", 0.01)
    folder, unit = tmp_path / "logs", "compact-ejector-35 gripper-01"
    folder.mkdir()
    with only_run(folder, unit, NOW_NS, pytest.fail):
        for _ in range(2):
            shutil.rmtree(folder)
            folder.mkdir()
            wait_until(lambda: is_written(lock_file(folder, unit)))
            assert is_held(folder)
        lock_file(folder, unit).unlink()
        wait_until(lambda: is_written(lock_file(folder, unit)))
        assert is_held(folder)
    held(folder, unit)


def test_a_run_whose_lock_somebody_else_has_taken_says_so_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "LOOK_S", 0.01)
    folder, unit, said, looks = tmp_path / "logs", "kind rig-01", list[str](), list[object]()
    folder.mkdir()
    hold = lock._Lock.hold

    def seen(one: "lock._Lock") -> None:
        looks.append(one)
        hold(one)

    monkeypatch.setattr(lock._Lock, "hold", seen)
    with only_run(folder, unit, NOW_NS, said.append):
        folder.rename(tmp_path / "aside")
        (tmp_path / "new").mkdir()
        with only_run(tmp_path / "new", unit, NOW_NS, pytest.fail):
            (tmp_path / "new").rename(folder)  # with a file that is locked
            wait_until(lambda: bool(said))
            looks.clear()
            wait_until(lambda: len(looks) > 5)  # and says it once
        folder.rename(tmp_path / "gone")  # at once, while the lock is looked at
    (only,) = said
    assert only.startswith("kind rig-01 is watched already: process ")
    assert only.endswith("; this run goes on")


def test_names_of_units_are_no_paths(tmp_path: Path) -> None:
    assert lock_file(tmp_path, "../kind robot 7, left").parent == tmp_path
    held(tmp_path, "../kind robot 7, left")


def test_where_nothing_can_be_locked_the_run_goes_on_and_says_so(tmp_path: Path) -> None:
    said: list[str] = []
    with only_run(tmp_path / "missing", "kind rig-01", NOW_NS, said.append):
        pass
    assert len(said) == 1
    assert "a second run of this unit would not be noticed" in said[0]


@pytest.mark.parametrize(
    ("table", "options"),
    [
        ("[figures]\nkeep = true\n", ()),
        ("[alarms]\nkeep = true\n", ()),
        ('[figures]\nkeep = true\nurl = "postgresql://nobody@nowhere/figures"\n', ()),
        ("", ("--log", "a.mcap")),
    ],
)
def test_two_runs_of_one_configuration_do_not_write_each_cycle_twice(
    table: str,
    options: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = tmp_path / "cell.toml"
    config.write_text(rigs.path_of("gripper").read_text() + table)
    monkeypatch.chdir(tmp_path)
    with holding(tmp_path, "compact-ejector-35 gripper-01") as other:
        assert twin(monkeypatch, "run", config, "--address", "127.0.0.1:1", "--once", *options) == 3
    assert f"process {other.pid}" in capsys.readouterr().err
    assert not (tmp_path / "a.mcap").exists()


def test_a_run_that_writes_nothing_asks_for_no_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "cell.toml"
    config.write_text(rigs.path_of("gripper").read_text())
    with holding(tmp_path, "compact-ejector-35 gripper-01"):
        assert twin(monkeypatch, "run", config, "--address", "127.0.0.1:1", "--once") == 3
    assert "watched already" not in capsys.readouterr().err  # it got as far as the PLC
    assert [file.name for file in tmp_path.iterdir() if file.suffix == ".lock"] != []
