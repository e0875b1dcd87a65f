"""What systemd is told, over a real socket; and what stands in the files that set a service up."""

import configparser
import os
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import rigs
from plc_process import PlcProcess

from twin.cli.stopping import INTERRUPTED
from twin.errors import ConfigError
from twin.service import FEEDS, Service

PATIENCE_S = 60.0  # s; only a busy machine takes so long
DEPLOY = rigs.ROOT / "deploy"


class Clock:
    """Time as the test wants it."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


class Manager:
    """The socket of a service manager."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + address[1:] if address.startswith("@") else address)

    def next(self) -> str:
        """The next that is told."""
        self._socket.settimeout(PATIENCE_S)
        return self._socket.recv(1000).decode()

    def told(self) -> list[str]:
        """All that was told and not yet read."""
        self._socket.setblocking(False)
        found = []
        while True:
            try:
                found.append(self._socket.recv(1000).decode())
            except BlockingIOError:
                return found

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["file", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    address = str(tmp_path / "notify") if request.param == "file" else f"@twin-test-{os.getpid()}"
    found = Manager(address)
    yield found
    found.close()


def environment(manager: Manager, **more: str) -> dict[str, str]:
    return {"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "8000000", "HOME": "/", **more}


def test_ready_and_stopping_are_told_once(manager: Manager) -> None:
    with Service(environment(manager), Clock()):
        assert manager.told() == ["READY=1"]
    assert manager.told() == ["STOPPING=1"]


def test_children_do_not_speak_for_the_process(manager: Manager) -> None:
    environ = environment(manager, WATCHDOG_PID=str(os.getpid()))
    Service(environ)
    assert environ == {"HOME": "/"}


def test_the_watchdog_is_fed_while_a_loop_asks_whether_to_stop(manager: Manager) -> None:
    clock = Clock()
    service = Service(environment(manager), clock)
    with service.loop("rig-01", lambda *, begun=True: f"asked {begun}") as stopped:
        told = manager.told()
        for _ in range(64):
            clock.now += 0.5
            assert stopped(begun=False) == "asked False"
            told += manager.told()
        assert told == ["WATCHDOG=1"] * (1 + 64 * FEEDS // 16)  # 16 times in 8 s


def test_one_loop_that_hangs_keeps_it_unfed_and_one_that_has_ended_does_not(
    manager: Manager,
) -> None:
    clock = Clock()
    service = Service(environment(manager), clock)

    def ask(stopped: object) -> list[str]:
        manager.told()
        for _ in range(20):
            clock.now += 1.0
            stopped()  # type: ignore[operator]
        return manager.told()[-5:]

    with service.loop("rig-01", str) as stopped:
        assert len(ask(stopped)) == 5
        with service.loop("rig-02", str) as other:
            other()
            ask(stopped)
            assert ask(stopped) == []  # it was heard of for the last time 20 s ago
            other()
            stopped()
            assert manager.told() == ["WATCHDOG=1"]
        assert len(ask(stopped)) == 5


@pytest.mark.parametrize(
    "changed", [{"WATCHDOG_USEC": ""}, {"WATCHDOG_USEC": "x"}, {"WATCHDOG_PID": "1"}]
)
def test_who_asks_for_no_watchdog_hears_of_none(manager: Manager, changed: dict[str, str]) -> None:
    clock = Clock()
    told = Service(environment(manager, **changed), clock)
    with told as service, service.loop("rig-01", str) as stopped:
        clock.now += 100.0
        stopped()
    assert manager.told() == ["READY=1", "STOPPING=1"]


def test_without_a_manager_or_with_one_that_is_gone_nothing_is_different(tmp_path: Path) -> None:
    for environ in ({}, {"NOTIFY_SOCKET": str(tmp_path / "gone"), "WATCHDOG_USEC": "8000000"}):
        with Service(environ) as service, service.loop("rig-01", str) as stopped:
            assert stopped("go on") == "go on"


def test_a_manager_that_does_not_read_is_not_waited_for(manager: Manager) -> None:
    service = Service(environment(manager))
    for _ in range(2000):  # more than a socket holds
        service._tell("WATCHDOG=1")


@contextmanager
def running(manager: Manager, *arguments: str | Path) -> Iterator["subprocess.Popen[str]"]:
    environ = os.environ | environment(manager, WATCHDOG_USEC="400000")
    environ["HOME"] = os.environ["HOME"]
    command = [sys.executable, "-m", "twin.cli", "run", *map(str, arguments)]
    with subprocess.Popen(command, cwd=rigs.ROOT, env=environ, stdout=-1, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.slow
def test_a_run_tells_it_beside_a_plc_and_while_it_waits_for_one(
    manager: Manager, plc: PlcProcess, tmp_path: Path
) -> None:
    gripper = rigs.path_of("gripper")
    for port in (plc.port, 1):
        with running(manager, gripper, "--address", f"127.0.0.1:{port}") as process:
            assert manager.next() == "READY=1"
            assert {manager.next() for _ in range(8)} == {"WATCHDOG=1"}
            process.send_signal(signal.SIGTERM)
            while (told := manager.next()) == "WATCHDOG=1":
                pass
            assert told == "STOPPING=1"
            process.communicate(timeout=PATIENCE_S)
            assert process.returncode == INTERRUPTED


# The files.


@pytest.fixture(scope="module")
def unit() -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(DEPLOY / "ejector-twin@.service")
    return parser


def test_the_unit_starts_what_there_is_and_knows_its_exit_codes(
    unit: configparser.ConfigParser,
) -> None:
    service = unit["Service"]
    assert (service["Type"], service["NotifyAccess"]) == ("notify", "main")
    assert int(service["WatchdogSec"]) >= 30
    assert service["Restart"] == "always"
    assert int(service["SuccessExitStatus"]) == INTERRUPTED
    assert int(service["RestartPreventExitStatus"]) == ConfigError.exit_code
    program, *arguments = shlex.split(service["ExecStart"])
    assert program.endswith("/bin/twin")
    assert arguments == [
        "run", "/var/lib/ejector-twin/%i/cell.toml", "--log", "/var/lib/ejector-twin/%i/logs"
    ]  # fmt: skip
    assert service["StateDirectory"].split() == ["ejector-twin/%i", "ejector-twin/%i/logs"]


def test_the_container_runs_as_nobody_and_on_a_root_that_cannot_be_written_to() -> None:
    lines = (DEPLOY / "Containerfile").read_text().splitlines()
    (user,) = (line.split()[1] for line in lines if line.startswith("USER "))
    assert int(user.split(":")[0]) >= 1000
    copied = {name for line in lines if line.startswith("COPY ") for name in line.split()}
    assert {"pyproject.toml", "hatch_build.py", "twin", "drivers"} <= copied  # what a build reads
    compose = (DEPLOY / "compose.yaml").read_text()
    for wanted in ("read_only: true", "restart: always", "- ALL", "no-new-privileges:true"):
        assert wanted in compose
