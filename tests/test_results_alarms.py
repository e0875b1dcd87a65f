"""Alarms as OPC UA conditions, as node-opcua sees, refreshes and acknowledges them."""

import json
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import pytest
from independent import PEERS
from opcua_plc import acquainted
from test_alarms_loop import (
    LEAK,
    NONE,
    UNIT,
    Stream,
    cycle,
    deviation,
    diagnosis,
    event,
    kept,
    rows,
)
from test_notifications import NO_TICKS
from test_results import FIGURES, HERE, asked
from user_files import quick_users

from drivers.opcua import certificates
from drivers.outputs.results import ResultsServer
from drivers.outputs.settings import ResultsSettings
from drivers.outputs.state import Results
from twin.alarms import writer as keeper_module
from twin.alarms.loop import Alarms
from twin.alarms.settings import board_rules
from twin.alarms.state import AlarmAction
from twin.audit import records
from twin.cli.alarms import asker_of
from twin.config import Config
from twin.errors import SourceError
from twin.events import Kind
from twin.settings import Document
from twin.users import Role

PATIENCE_S = 30.0
REFRESH_START, REFRESH_END = "ns=0;i=2787", "ns=0;i=2788"
PRESSURE = "ns={0};s=rig.Meas.Pressure", "ns={0};s=rig.Model.Expected"


class Watcher:
    """node-opcua in a process of its own, subscribed to alarms."""

    def __init__(self, url: str, folder: Path, **options: Any) -> None:
        told = {"url": url, "folder": str(folder / "peer"), **options}
        command = ["node", PEERS / "opcua_alarms.js", json.dumps(told)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True
        )
        self.seen: list[dict[str, Any]] = []
        assert self._read() == "ready"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with self._process.stdin, self._process.stdout:
            self._process.stdin.write('{"do": "quit"}\n')
        self._process.wait(PATIENCE_S)

    def do(self, what: str, **options: Any) -> Any:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": what, **options}) + "\n")
        self._process.stdin.flush()
        return json.loads(self._read())

    def until(self, is_it: Callable[[list[dict[str, Any]]], Any]) -> list[dict[str, Any]]:
        """The events since the last time, once they are what is waited for."""
        found: list[dict[str, Any]] = []
        end = time.monotonic() + PATIENCE_S
        while not is_it(found):
            assert time.monotonic() < end, found
            found += self.do("list")
        return found

    def _read(self) -> str:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("> "):
                return line[2:].strip()
        raise RuntimeError("node has ended")


def counted(number: int) -> Callable[[Sequence[Any]], bool]:
    return lambda found: len(found) >= number


@pytest.fixture(scope="module")
def server() -> Iterator[ResultsServer]:
    with ResultsServer(HERE, FIGURES) as running:
        yield running


def told(sink: Results, stream: Stream) -> None:
    sink.write(NONE, NO_TICKS, stream.said)
    stream.said = []


@pytest.mark.slow
@pytest.mark.needs("node-opcua")
def test_an_alarm_comes_with_what_is_compared(server: ResultsServer, tmp_path: Path) -> None:
    sink, stream = server.sink("rig", ""), Stream()
    with Watcher(server.url, tmp_path) as watcher:
        stream.at(5, deviation(5))
        told(sink, stream)
        (raised,) = watcher.until(counted(1))
        stream.desk.ask(LEAK, AlarmAction.ACKNOWLEDGED)
        stream.at(6)
        stream.at(9, event(9, Kind.DEVIATION_CLEARED))
        told(sink, stream)
        acknowledged, cleared = watcher.until(counted(2))
    index = raised["ConditionId"].partition(";")[0].removeprefix("ns=")
    assert raised["EventType"] == "ns=0;i=10368"  # NonExclusiveDeviationAlarmType
    assert raised["ConditionId"] == f"ns={index};s=rig.Alarms.{LEAK}"
    assert (raised["InputNode"], raised["SetpointNode"]) == tuple(
        node.format(index) for node in PRESSURE
    )
    assert (raised["SourceName"], raised["ConditionName"]) == ("rig", LEAK)
    assert raised["Message"].startswith(f"{LEAK} raised (medium priority)")
    assert raised["Severity"] == 600
    assert raised["Time"].startswith("Sun Sep 09 2001 01:46:45")
    assert raised["BranchId"] in (None, "ns=0;i=0")
    assert states(raised) == (True, False, True)
    assert (raised["ActiveState"], raised["AckedState"]) == ("Active", "Unacknowledged")
    assert states(acknowledged) == (True, True, True)
    assert acknowledged["ClientUserId"] == "ann"
    assert states(cleared) == (False, True, False)
    assert {raised["EnabledState.Id"], raised["SuppressedOrShelved"]} == {True, False}
    names = ("ActiveState.Id", "AckedState.Id", "Retain", "SetpointNode", "Severity")
    read = [node.Value.Value for node in asked(server, *(f"rig.Alarms.{LEAK}.{n}" for n in names))]
    assert read[:3] == [False, True, False]
    assert (read[3].Identifier, read[4]) == ("rig.Model.Expected", 600)


def states(one: dict[str, Any]) -> tuple[bool, bool, bool]:
    return one["ActiveState.Id"], one["AckedState.Id"], one["Retain"]


@pytest.mark.slow
@pytest.mark.needs("node-opcua")
def test_figures_and_the_plc_have_their_own_kinds(server: ResultsServer, tmp_path: Path) -> None:
    sink, stream = server.sink("kinds", ""), Stream()
    with Watcher(server.url, tmp_path) as watcher:
        limit = ("leakage_over_limit",)
        for second in (1, 15):
            stream.at(second, cycle(second, *limit, leakage_measured=300.0))
        stream.at(16, event(16, Kind.PLC_STALE))
        told(sink, stream)
        found = {event["ConditionName"]: event for event in watcher.until(counted(3))}
    leak, stale = found["leakage_over_limit"], found["plc_stale"]
    assert leak["InputNode"].endswith("kinds.Cycle.leakage_measured")
    assert leak["SetpointNode"].endswith("kinds.Cycle.leakage_expected")
    assert (leak["Severity"], stale["Severity"]) == (300, 900)
    assert stale["EventType"] == "ns=0;i=10637"  # OffNormalAlarmType
    assert leak["SuppressedOrShelved"]  # while the PLC is stale


@pytest.mark.slow
@pytest.mark.needs("node-opcua")
def test_a_renamed_alarm_goes_on_under_its_new_name(server: ResultsServer, tmp_path: Path) -> None:
    sink, stream = server.sink("named", ""), Stream()
    with Watcher(server.url, tmp_path) as watcher:
        stream.at(5, deviation(5))
        stream.at(9, diagnosis(9, 5, "suction_loss"))
        told(sink, stream)
        _raised, left, now = watcher.until(counted(3))
    assert (left["ConditionName"], states(left)) == (LEAK, (False, True, False))
    assert (now["ConditionName"], states(now)) == ("deviation_suction_loss", (True, False, True))


@pytest.mark.slow
@pytest.mark.needs("node-opcua")
def test_who_comes_later_is_told_what_stands(server: ResultsServer, tmp_path: Path) -> None:
    before = Stream()
    before.at(5, deviation(5))
    before.at(6, event(6, Kind.PLC_STALE))
    before.at(7, event(7, Kind.PLC_BACK))
    before.desk.ask("plc_stale", AlarmAction.ACKNOWLEDGED)
    before.at(8)
    sink = server.sink("later", "")
    sink.resume(Stream(before.desk.before).alarms.standing(), 10**18)

    def own(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return [event for event in found if event["SourceName"] == "later"]

    with Watcher(server.url, tmp_path) as watcher:
        time.sleep(2 * HERE.interval_ms * 1e-3)
        assert watcher.do("refresh") == "Good"
        found = watcher.until(lambda found: found[-1:] and found[-1]["EventType"] == REFRESH_END)
    (stands,) = own(found)
    assert found[0]["EventType"] == REFRESH_START
    assert (stands["ConditionName"], states(stands)) == (LEAK, (True, False, True))
    assert stands["Message"] == f"{LEAK}: unacknowledged"


# --- acknowledging ------------------------------------------------------------------------------


class Beside:
    """Alarms with their database and loop, served by a server; and a configuration of it all."""

    def __init__(self, folder: Path, server: ResultsServer, name: str) -> None:
        text = f'[data]\n[asset]\ntype = "{UNIT.type}"\nid = "{UNIT.id}"\n[alarms]\nkeep = true\n'
        (folder / "cell.toml").write_text(text, encoding="utf-8")
        self.config = Config.of(Document.read(folder / "cell.toml"))
        alarm_writer = kept(folder / "alarms.sqlite")
        self.alarms = Alarms(board_rules(None), lambda: 0, alarm_writer.begin(), alarm_writer)
        self.sink = server.sink(name, UNIT.type, asker_of(self.config))
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._loop)

    def __enter__(self) -> Self:
        self.sink.write(NONE, NO_TICKS, self.alarms.follow(rows(5), [deviation(5)]))
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()
        self.alarms.close()

    def _loop(self) -> None:
        while not self._ending.wait(0.01):
            self.sink.write(NONE, NO_TICKS, self.alarms.follow(NONE, []))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keeper_module, "POLL_S", 0.01)


@pytest.mark.slow
@pytest.mark.needs("node-opcua")
@pytest.mark.usefixtures("quick")
def test_who_is_allowed_to_acknowledges_and_others_are_not(tmp_path: Path) -> None:
    acquainted(tmp_path)
    roles = {"ännchen": Role.ACKNOWLEDGE, "guest": Role.LOOK}
    known = ((name, f"Schlüssel {name}", role) for name, role in roles.items())
    users = quick_users(tmp_path / "users.toml", *known)
    table = {"opcua": True, "port": 0, "policies": ["Basic256Sha256"]}
    table |= {"certificates": tmp_path / "theirs", "users": users.path}
    own = certificates.own(tmp_path / "ours", datetime.now(UTC))
    ours = {"certificate": str(own.path), "key": str(own.key), "uri": own.uri}
    ours["policy"] = "Basic256Sha256"

    def come(name: str) -> Watcher:
        user = {"userName": name, "password": f"Schlüssel {name}"}
        return Watcher(server.url, tmp_path, user=user, **ours)

    with (
        ResultsServer(ResultsSettings.model_validate(table), FIGURES) as server,
        come("ännchen") as ann,
        come("guest") as guest,
        Beside(tmp_path, server, "rig"),
    ):
        for watcher in (ann, guest):
            (raised,) = watcher.until(counted(1))
            assert states(raised) == (True, False, True)
        assert guest.do("acknowledge", alarm=LEAK) == "BadUserAccessDenied"
        assert ann.do("acknowledge", alarm=LEAK, comment="a hose") == "Good"
        for watcher in (ann, guest):
            (seen,) = watcher.until(counted(1))
            assert states(seen) == (True, True, True)
            assert seen["ClientUserId"] == "ännchen (a hose)"
        assert ann.do("acknowledge", alarm=LEAK) == "BadConditionBranchAlreadyAcked"
        users.set_role("ännchen", Role.LOOK)
        assert ann.do("acknowledge", alarm=LEAK) == "BadUserAccessDenied"
    told, _ = records(tmp_path)
    about = {"unit": "rig", "alarm": LEAK}
    known = ("time", "through", "from")
    assert {(record["through"], record["from"]) for record in told} == {("opcua", "127.0.0.1")}
    assert [{name: record[name] for name in record if name not in known} for record in told] == [
        {"what": "logged_in", "who": "ännchen"},
        {"what": "logged_in", "who": "guest"},
        {"what": "denied", "who": "guest", "wanted": "acknowledged", **about},
        {"what": "acknowledged", "who": "ännchen", **about, "comment": "a hose"},
        {"what": "denied", "who": "ännchen", "wanted": "acknowledged", **about},
    ]


@pytest.mark.needs("node-opcua")
@pytest.mark.usefixtures("quick")
def test_nobody_in_particular_cannot_acknowledge(server: ResultsServer, tmp_path: Path) -> None:
    with Watcher(server.url, tmp_path) as watcher, Beside(tmp_path, server, "open") as beside:
        watcher.until(counted(1))
        assert watcher.do("acknowledge", alarm=LEAK) == "BadUserAccessDenied"
        assert not beside.alarms.board[LEAK].acknowledged


def test_without_alarms_that_are_kept_there_is_nobody_to_ask(tmp_path: Path) -> None:
    assert asker_of(Config.of(Document.parse("[data]", str(tmp_path / "a.toml")))) is None


def test_a_database_that_is_away_is_an_error(tmp_path: Path) -> None:
    text = '[data]\n[alarms]\nkeep = true\nurl = "nowhere/a.sqlite"'
    ask = asker_of(Config.of(Document.parse(text, str(tmp_path / "a.toml"))))
    assert ask is not None
    with pytest.raises(SourceError):
        ask(LEAK, "ann")
