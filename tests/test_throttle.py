"""How often one may try a password: in one process, in several, and where nothing can be kept."""

import sqlite3
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import rigs
from user_files import Clock

from twin.throttle import FREE_TRIES, LoginThrottle, Wait

LONGEST_S = {"name": 60.0}
ANN, BOB = {"name": "ann"}, {"name": "bob"}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "logins.sqlite"


def throttle(path: Path, clock: Clock | None = None) -> LoginThrottle:
    return LoginThrottle(path, LONGEST_S, clock or Clock())


def waits(tries: LoginThrottle, clock: Clock, count: int) -> list[float]:
    """What each try that is taken is followed by."""
    found = []
    for _ in range(count):
        assert tries.take(ANN).seconds == 0.0
        wait_s = tries.take(ANN).seconds if len(found) >= FREE_TRIES - 1 else 0.0
        clock.now += wait_s
        found.append(wait_s)
    return found


def test_after_some_wrong_tries_each_takes_longer(path: Path) -> None:
    tries = throttle(path, clock := Clock())
    expected = [0.0] * (FREE_TRIES - 1) + [1, 2, 4, 8, 16, 32, 60, 60, 60]
    assert waits(tries, clock, FREE_TRIES + 8) == expected
    assert tries.take(BOB) == Wait()
    tries.right(ANN)
    assert waits(tries, clock, FREE_TRIES)[:-1] == [0.0] * (FREE_TRIES - 1)


def test_it_is_counted_once_for_all_and_for_their_owner_alone(path: Path) -> None:
    clock = Clock()
    for number in range(FREE_TRIES):
        assert throttle(path, clock).take(ANN) == Wait(), number
    assert throttle(path, clock).take(ANN) == Wait(1.0, is_news=True)
    assert throttle(path, clock).take(ANN) == Wait(1.0, is_news=False)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_tries_at_one_time_are_not_taken_by_each_of_several_processes(path: Path) -> None:
    """Each counts before its hash: else all would take one whenever a wait is over."""
    code = (
        "import sys; from pathlib import Path; from twin.throttle import LoginThrottle\n"
        "tries = LoginThrottle(Path(sys.argv[1]), {'name': 60.0}); input()\n"
        "print([tries.take({'name': 'ann'}).seconds > 0 for _ in range(20)].count(False))"
    )
    command = [sys.executable, "-c", code, str(path)]
    pipe = subprocess.PIPE
    running = [
        subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, cwd=rigs.ROOT)
        for _ in range(3)
    ]
    taken = [int(process.communicate("\n", timeout=60)[0]) for process in running]
    assert sum(taken) <= FREE_TRIES + 1  # and one where a second passed


@pytest.fixture(params=["folder", "garbage", "locked"])
def useless(path: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """A file that cannot be counted in."""
    if request.param == "folder":
        path.mkdir()
    elif request.param == "garbage":
        path.write_bytes(b"x" * 5000)
    if request.param != "locked":
        yield path
        return
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        yield path


def test_where_nothing_can_be_kept_each_counts_for_itself(
    useless: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.throttle.BUSY_S", 0.01)
    tries = throttle(useless, clock := Clock())
    assert waits(tries, clock, FREE_TRIES + 2)[-3:] == [1.0, 2.0, 4.0]
    assert tries._own is not None
    tries._own.close()


def test_a_machine_that_began_anew_holds_nobody_for_ever(path: Path) -> None:
    clock = Clock()
    clock.now = 1e6
    for _ in range(FREE_TRIES):
        throttle(path, clock).take(ANN)
    clock.now = 5.0  # since the machine began
    assert throttle(path, clock).take(ANN).seconds == 1.0
    clock.now = 6.0
    assert throttle(path, clock).take(ANN) == Wait()


def test_who_has_tried_is_not_remembered_without_bound(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.throttle.MOST", 10)
    tries = throttle(path)
    for number in range(50):
        tries.take({"name": str(number)})
    with closing(sqlite3.connect(path)) as known:
        found = known.execute("SELECT who FROM wrong").fetchall()
    assert sorted(int(who) for (who,) in found) == list(range(40, 50))
