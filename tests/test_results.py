"""What the twin finds, as a SCADA reads it over OPC UA: by clients of other make than ours."""

import asyncio
import json
import math
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from contextlib import closing, suppress
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rigs
import tomli_w
from asyncua import Client, ua
from independent import PEERS, free_port
from opcua_plc import acquainted
from plc_process import start_plc
from pydantic import ValidationError
from user_files import quick_users

from drivers.opcua import certificates
from drivers.outputs.open import open_results
from drivers.outputs.results import ResultsServer
from drivers.outputs.settings import ResultsSettings
from drivers.outputs.state import MEANS, Results, Standing, Status
from drivers.sources import open_source
from twin.errors import ConfigError, SourceError
from twin.events import Event, Kind
from twin.live import run
from twin.quality import Quality
from twin.settings import Document
from twin.signals import SAMPLE, TICK, Phase, Samples, Ticks
from twin.users import Role

NAMESPACE = "urn:ejector-twin:results"
FIGURES = {"t0": "ms", "max_vacuum": "mbar", "leakage": "mbar/s"}
HERE = ResultsSettings(opcua=True, port=0)
SECOND = 1_000_000_000
FROZEN = timedelta(seconds=0.4)  # for which a client stands still
START_NS = 1_700_000_000 * SECOND


def rows(count: int = 30, begin: int = 0, **columns: float) -> tuple[Samples, Ticks]:
    samples, ticks = np.zeros(count, SAMPLE), np.zeros(count, TICK)
    samples["sequence"] = np.arange(begin, begin + count)
    samples["time_ns"] = START_NS + samples["sequence"] * 1_000_000
    samples["pressure"], samples["supply"] = 40_000.0, 480_000.0
    ticks["expected"], ticks["phase"] = 39_500.0, Phase.SUCTION
    for name, value in columns.items():
        (samples if name in SAMPLE.names else ticks)[name] = value  # type: ignore[operator]
    return samples, ticks


def event(kind: Kind, second: float = 1.0, **data: Any) -> Event:
    return Event(START_NS + round(second * SECOND), kind, f"it is {kind}", data)


CYCLE = event(
    Kind.CYCLE, cycle=7, t0_measured=825.0, t0_expected=710.0, max_vacuum=748.0, suction_mean=1.5
)
DEVIATION = event(Kind.DEVIATION, 2.0, effect="leakage", size=1.9, unit="sl/min")


# --- what is kept, and what it means ------------------------------------------------------------


class Hand:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Hand:
    return Hand()


@pytest.fixture
def results(clock: Hand) -> Results:
    return Results("rig-01", tuple(FIGURES), clock)


def test_before_anything_has_come_no_value_is_good(results: Results) -> None:
    readings = results.readings()
    assert readings["State"].value == Standing.STARTING
    values = [
        "Pressure",
        "Supply",
        "Expected",
        "Deviation",
        "Phase",
        "t0_measured",
        "cycle",
        *MEANS,
    ]
    assert {readings[name].status for name in values} == {Status.NONE_YET}


def test_the_newest_row_is_shown_with_its_time(results: Results) -> None:
    results.write(*rows(), [])
    readings = results.readings()
    assert readings["Pressure"].value == pytest.approx(400.0)
    assert readings["Supply"].value == pytest.approx(4800.0)
    assert readings["Expected"].value == pytest.approx(395.0)
    assert readings["Deviation"].value == pytest.approx(5.0)
    assert readings["Phase"].value == Phase.SUCTION
    values = [readings[name] for name in ("Pressure", "Supply", "Expected", "Deviation", "Phase")]
    assert {value.time_ns for value in values} == {START_NS + 29_000_000}
    assert {value.status for value in values} == {Status.GOOD}
    assert results.health.standing is Standing.OK
    assert results.health.since_ns == START_NS


def test_blocks_without_rows_change_nothing(results: Results) -> None:
    results.write(*rows(), [])
    before = results.readings()
    results.write(*rows(0), [])
    assert results.readings() == before


def test_what_was_kept_does_not_hold_on_to_blocks(results: Results) -> None:
    samples, ticks = rows()
    results.write(samples, ticks, [])
    samples["pressure"] = 0.0
    assert results.readings()["Pressure"].value == pytest.approx(400.0)


@pytest.mark.parametrize(
    ("columns", "statuses"),
    [
        ({"quality": Quality.BAD}, [Status.BAD, Status.GOOD, Status.BAD]),
        ({"quality": Quality.OVERFLOW}, [Status.BEYOND, Status.GOOD, Status.BEYOND]),
        ({"quality": Quality.STALE}, [Status.LAST, Status.GOOD, Status.LAST]),
        ({"quality": Quality.GAP}, [Status.GOOD] * 3),
        ({"expected": math.nan}, [Status.GOOD, Status.NONE_YET, Status.NONE_YET]),
    ],
)
def test_what_is_wrong_with_a_row_is_wrong_with_its_values(
    results: Results, columns: dict[str, Any], statuses: list[Status]
) -> None:
    results.write(*rows(**columns), [])
    readings = results.readings()
    assert [readings[n].status for n in ("Pressure", "Expected", "Deviation")] == statuses


def test_without_fresh_rows_values_are_the_last_ones(results: Results, clock: Hand) -> None:
    results.write(*rows(), [])
    clock.now += 0.9
    assert results.readings()["Pressure"].status is Status.GOOD
    clock.now += 0.2
    readings = results.readings()
    assert readings["Pressure"].status is readings["Phase"].status is Status.LAST
    assert readings["Pressure"].value == pytest.approx(400.0)
    results.write(*rows(begin=30), [])
    assert results.readings()["Pressure"].status is Status.GOOD


def test_while_the_plc_is_stale_so_are_the_values(results: Results) -> None:
    results.write(*rows(), [event(Kind.PLC_STALE)])
    assert results.health.standing is Standing.PLC_STALE
    assert results.readings()["Expected"].status is Status.LAST
    results.write(*rows(begin=30), [event(Kind.PLC_BACK, 3.0)])
    assert results.health == results.health
    assert results.health.standing is Standing.OK
    assert results.health.since_ns == START_NS + 3 * SECOND


def test_health_is_the_gravest_of_what_holds(results: Results) -> None:
    results.write(*rows(), [DEVIATION, event(Kind.SIGNAL_BAD), event(Kind.PLC_STALE)])
    assert results.health.standing is Standing.PLC_STALE
    results.write(*rows(), [event(Kind.PLC_BACK)])
    assert results.health.standing is Standing.SIGNAL_BAD
    results.write(*rows(), [event(Kind.SIGNAL_GOOD)])
    health = results.health
    assert (health.standing, health.cause, health.size, health.unit) == (
        *(Standing.DEVIATION, "leakage", 1.9, "sl/min"),
    )
    assert health.since_ns == DEVIATION.time_ns
    results.write(*rows(), [event(Kind.DEVIATION_CLEARED, 9.0, effect="leakage")])
    assert results.health.standing is Standing.OK


def diagnosis(*causes: dict[str, Any]) -> Event:
    return event(
        Kind.DIAGNOSIS,
        30.0,
        alarm_ns=DEVIATION.time_ns,
        begin_ns=START_NS,
        answer={"causes": causes},
    )


POROUS = {
    "effect": "porous_leakage",
    "parameters": {"flow_at_600mbar": {"value": 2.5, "unit": "sl/min"}},
    "onset_s": 1.25,
}


def test_a_diagnosis_says_it_better(results: Results) -> None:
    results.write(*rows(), [DEVIATION, diagnosis(POROUS)])
    health = results.health
    assert (health.cause, health.size, health.unit) == ("porous_leakage", 2.5, "sl/min")
    assert health.since_ns == START_NS + 1_250_000_000
    assert health.text == "it is diagnosis"


def test_a_diagnosis_without_a_cause_leaves_the_alarms(results: Results) -> None:
    results.write(*rows(), [DEVIATION, diagnosis()])
    assert results.health.cause == "leakage"
    failed = event(Kind.DIAGNOSIS, alarm_ns=0)
    results.write(*rows(), [failed])
    assert results.health.cause == "leakage"


def test_a_diagnosis_of_what_is_over_changes_nothing(results: Results) -> None:
    results.write(*rows(), [DEVIATION, event(Kind.DEVIATION_CLEARED), diagnosis(POROUS)])
    assert results.health.standing is Standing.OK


def test_the_last_cycle_is_shown_and_what_it_does_not_tell_is_missing(results: Results) -> None:
    results.write(*rows(), [CYCLE])
    readings = results.readings()
    assert readings["cycle"].value == 7
    assert readings["t0_measured"].value == 825.0
    assert readings["t0_expected"].value == 710.0
    assert readings["max_vacuum_measured"].value == 748.0  # where no side is said, it is measured
    assert readings["suction_mean"].value == 1.5
    assert readings["max_vacuum_expected"].status is Status.MISSING
    assert readings["leakage_measured"].status is Status.MISSING
    assert readings["t0_measured"].time_ns == CYCLE.time_ns


def test_the_last_events_are_kept_newest_first(results: Results) -> None:
    results.write(*rows(), [event(Kind.GAP, second) for second in range(40)])
    readings = results.readings()
    assert len(readings["Times"].value) == 16
    assert readings["Times"].value[0] == START_NS + 39 * SECOND
    assert readings["Severities"].value[0] == "warning"


def test_when_the_twin_has_stopped_nothing_is_good_any_more(results: Results) -> None:
    results.write(*rows(), [CYCLE])
    results.close()
    readings = results.readings()
    assert readings["State"].value == Standing.STOPPED
    assert readings["Pressure"].status is readings["Deviation"].status is Status.ENDED


# --- settings -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"host": "0.0.0.0"}, "is beyond this machine"),
        ({"host": "192.168.0.5", "policies": ["None", "Basic256Sha256"]}, "certificates"),
        ({"policies": ["Basic256Sha256"]}, "policies need certificates"),
        ({"users": "users.toml"}, "a password is not sent in the clear"),
        ({"policies": []}, "at least 1"),
        ({"interval_ms": 1}, "greater than or equal to 20"),
    ],
)
def test_what_is_not_protected_is_refused(table: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        ResultsSettings.model_validate(table)


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
def test_this_machine_needs_no_protection(host: str) -> None:
    assert ResultsSettings(host=host).policies == ("None",)


def test_beyond_it_may_be_said_that_everybody_may_read() -> None:
    assert ResultsSettings(host="0.0.0.0", unprotected=True)
    protected = {"policies": ["Basic256Sha256"], "certificates": "pki"}
    assert ResultsSettings.model_validate({"host": "0.0.0.0"} | protected)


def test_they_are_off_unless_they_are_switched_on() -> None:
    with open_results([Document.read(rigs.path_of("test_rig"))], lambda: FIGURES) as sink:
        assert sink is None


def test_two_places_for_one_process_are_refused() -> None:
    documents = [
        Document.parse(f"[results]\nopcua = true\nport = {port}", f"{port}.toml")
        for port in (4841, 4842)
    ]
    with (
        pytest.raises(ConfigError, match=r"4841\.toml and 4842\.toml"),
        open_results(documents, dict),
    ):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("text", [None, "", "nonsense"])
def test_users_that_cannot_be_used(tmp_path: Path, text: str | None) -> None:
    acquainted(tmp_path)
    if text is not None:
        (tmp_path / "users.toml").write_text(text, encoding="utf-8")
        (tmp_path / "users.toml").chmod(0o600)
    settings = protected(tmp_path, users=tmp_path / "users.toml")
    with pytest.raises(ConfigError, match=r"users\.toml: no") as refused:
        ResultsServer(settings, {}).__enter__()
    assert "twin users add" in refused.value.hint


@pytest.mark.slow
def test_what_hinders_a_login_is_said_by_the_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    users = quick_users(tmp_path / "users.toml", ("scada", "correct horse", Role.LOOK))

    def said() -> list[str]:
        return [
            record.getMessage()
            for record in caplog.records
            if record.name == "drivers.outputs.results"
        ]

    async def come(url: str) -> None:
        client = Client(url)
        client.set_user("scada")
        client.set_password("correct horse")
        async with client:
            pass

    with ResultsServer(HERE.model_copy(update={"users": users.path}), {}) as server:
        asyncio.run(come(server.url))
        users.path.chmod(0o644)
        with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
            asyncio.run(come(server.url))
        end = time.monotonic() + 10.0
        while not said() and time.monotonic() < end:
            time.sleep(0.01)
    (why,) = said()
    assert "nobody can log in over OPC UA" in why
    assert f"chmod 600 {users.path}" in why


def test_users_stand_beside_the_configuration() -> None:
    settings = ResultsSettings.model_validate(PROTECTED | {"users": "users.toml"})
    assert settings.below(Path("/cell-7")).users == Path("/cell-7/users.toml")
    assert ResultsSettings().below(Path("/cell-7")).users is None


PROTECTED = {"policies": ["Basic256Sha256"], "certificates": "pki"}


def protected(folder: Path, **changes: Any) -> ResultsSettings:
    table = {"opcua": True, "port": 0, "policies": ["Basic256Sha256", "Aes256Sha256RsaPss"]}
    return ResultsSettings.model_validate(table | {"certificates": folder / "theirs"} | changes)


# --- as a client sees it ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def server() -> Iterator[ResultsServer]:
    with ResultsServer(HERE, FIGURES) as running:
        yield running


@pytest.fixture(scope="module")
def rig(server: ResultsServer) -> Results:
    sink = server.sink("rig-01", "compact-ejector-35")
    sink.write(*rows(), [DEVIATION, CYCLE])
    return sink


def asked(server: ResultsServer, *names: str) -> list[ua.DataValue]:
    """What the library's own client reads, once what was written is shown."""

    async def ask() -> list[ua.DataValue]:
        async with Client(server.url) as client:
            index = await client.get_namespace_index(NAMESPACE)
            nodes = [client.get_node(f"ns={index};s={name}") for name in names]
            return [await node.read_data_value(raise_on_bad_status=False) for node in nodes]

    time.sleep(2 * HERE.interval_ms * 1e-3)
    return asyncio.run(ask())


def test_everything_has_its_type_unit_and_time(server: ResultsServer, rig: Results) -> None:
    rig.write(*rows(begin=100), [])
    pressure, unit, span, t0, phase, phases, since, texts, kind = asked(
        server,
        "rig-01.Meas.Pressure",
        "rig-01.Meas.Pressure.EngineeringUnits",
        "rig-01.Meas.Pressure.EURange",
        "rig-01.Cycle.t0_expected",
        "rig-01.Model.Phase",
        "rig-01.Model.Phase.EnumStrings",
        "rig-01.Health.Since",
        "rig-01.Events.Texts",
        "rig-01.Identification.Type",
    )
    assert pressure.Value.Value == pytest.approx(400.0)
    assert ua_ns(pressure.SourceTimestamp) == START_NS + 129_000_000
    assert (unit.Value.Value.UnitId, unit.Value.Value.DisplayName.Text) == (5063250, "mbar")
    assert (span.Value.Value.Low, span.Value.Value.High) == (0.0, 2000.0)
    assert (t0.Value.Value, ua_ns(t0.SourceTimestamp)) == (710.0, CYCLE.time_ns)
    assert phases.Value.Value[phase.Value.Value].Text == "suction"
    assert ua_ns(since.Value.Value) == DEVIATION.time_ns
    assert texts.Value.Value == ["it is cycle", "it is deviation"]
    assert kind.Value.Value == "compact-ejector-35"


def ua_ns(stamp: Any) -> int:
    from drivers.opcua.values import nanoseconds

    return nanoseconds(stamp)


def test_what_is_no_longer_fresh_says_so(server: ResultsServer) -> None:
    sink = server.sink("stale", "")
    sink.write(*rows(), [event(Kind.PLC_STALE)])
    pressure, state, states, missing = asked(
        server,
        "stale.Meas.Pressure",
        "stale.Health.State",
        "stale.Health.State.EnumStrings",
        "stale.Cycle.t0_measured",
    )
    assert pressure.StatusCode.name == "UncertainLastUsableValue"
    assert states.Value.Value[state.Value.Value].Text == "plc stale"
    assert missing.StatusCode.name == "BadWaitingForInitialData"
    sink.close()
    pressure, state = asked(server, "stale.Meas.Pressure", "stale.Health.State")
    assert pressure.StatusCode.name == "BadOutOfService"
    assert states.Value.Value[state.Value.Value].Text == "stopped"


def test_several_twins_share_a_server(server: ResultsServer) -> None:
    first, second = server.sink("one", "a"), server.sink("two", "b")
    first.write(*rows(pressure=10_000.0), [])
    second.write(*rows(pressure=20_000.0), [])
    values = asked(server, "one.Meas.Pressure", "two.Meas.Pressure")
    assert [value.Value.Value for value in values] == pytest.approx([100.0, 200.0])


def test_nobody_can_write_or_change_anything(server: ResultsServer, rig: Results) -> None:
    async def attempt() -> None:
        async with Client(server.url) as client:
            index = await client.get_namespace_index(NAMESPACE)
            for name in ("Meas.Pressure", "Health.State", "Cycle.t0_measured", "Events.Texts"):
                target = client.get_node(f"ns={index};s=rig-01.{name}")
                value = await target.read_data_value(raise_on_bad_status=False)
                with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
                    await target.write_attribute(ua.AttributeIds.Value, ua.DataValue(value.Value))
                with pytest.raises(ua.UaStatusCodeError):
                    await target.delete()
            top = client.get_node(f"ns={index};s=rig-01")
            with pytest.raises(ua.UaStatusCodeError):
                await top.add_variable(index, "mine", 1.0)

    asyncio.run(attempt())


@pytest.mark.slow
def test_a_port_in_use_is_told(server: ResultsServer) -> None:
    port = int(server.url.rpartition(":")[2])
    taken = HERE.model_copy(update={"port": port})
    with pytest.raises(SourceError) as caught, ResultsServer(taken, FIGURES):
        pass
    assert str(caught.value).startswith(f"results cannot be served on 127.0.0.1:{port} (OPC UA)")
    assert "\n" not in str(caught.value)
    assert "another port" in caught.value.hint


# --- as node-opcua sees it ----------------------------------------------------------------------


def by_node(server: ResultsServer, folder: Path, **options: Any) -> dict[str, Any]:
    told = {"url": server.url, "namespace": NAMESPACE, "folder": str(folder / "peer")}
    command = ["node", PEERS / "opcua_client.js", json.dumps(told | options)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


@pytest.mark.slow
@pytest.mark.needs("node-opcua")
def test_node_opcua_reads_and_subscribes_and_cannot_write(
    server: ResultsServer, rig: Results, tmp_path: Path
) -> None:
    with beating(rig):
        found = by_node(
            server,
            tmp_path,
            read=["rig-01.Model.Deviation", "rig-01.Health.Cause", "rig-01.Cycle.leakage_measured"],
            write=["rig-01.Model.Expected", "rig-01.Health.Size"],
            subscribe=["rig-01.Meas.Pressure", "rig-01.Health.State"],
            seconds=1.5,
        )
    read, seen = found["read"], found["seen"]
    assert read["rig-01.Model.Deviation"]["status"] == "Good"
    assert read["rig-01.Health.Cause"]["value"] == "leakage"
    assert read["rig-01.Cycle.leakage_measured"]["status"] == "BadNoDataAvailable"
    assert set(found["write"].values()) == {"BadUserAccessDenied"}
    pressures = seen["rig-01.Meas.Pressure"]
    assert 8 <= len(pressures) <= 20  # one every interval_ms
    times = [row["time"] for row in pressures]
    assert times == sorted(set(times))
    assert [row["value"] for row in seen["rig-01.Health.State"]] == [Standing.DEVIATION]


class beating:  # noqa: N801 - it reads as a function
    """A loop that writes a block every 30 ms; ``longest_s`` is what the longest took."""

    def __init__(self, sink: Results) -> None:
        self._sink = sink
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.longest_s = 0.0

    def _run(self) -> None:
        begin = 1000
        while not self._stop.wait(0.03):
            samples, ticks = rows(begin=begin, pressure=10_000.0 + begin)
            before = time.thread_time()
            self._sink.write(samples, ticks, [])
            self.longest_s = max(self.longest_s, time.thread_time() - before)
            begin += 30

    def __enter__(self) -> "beating":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


@pytest.mark.slow
@pytest.mark.needs("node-opcua")
def test_a_client_that_hangs_holds_up_nobody(
    server: ResultsServer, rig: Results, tmp_path: Path
) -> None:
    told = {"url": server.url, "namespace": NAMESPACE, "folder": str(tmp_path / "peer")}
    hangs = {"subscribe": ["rig-01.Meas.Pressure"], "seconds": 0.3, "freeze": True}
    command = ["node", PEERS / "opcua_client.js", json.dumps(told | hangs)]
    with (
        beating(rig) as loop,
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as client,
    ):
        assert client.stdout is not None
        said = iter(client.stdout.readline, "")
        assert "frozen\n" in said
        before = asked(server, "rig-01.Meas.Pressure")[0].SourceTimestamp
        patience = time.monotonic() + 30.0
        while asked(server, "rig-01.Meas.Pressure")[0].SourceTimestamp - before < FROZEN:
            assert time.monotonic() < patience, "the results stand still"
        client.kill()
    assert loop.longest_s < 0.005


@pytest.mark.slow
@pytest.mark.needs("node-opcua")
@pytest.mark.parametrize("policy", ["Basic256Sha256", "Aes256Sha256RsaPss"])
def test_node_opcua_comes_in_protected(tmp_path: Path, policy: str) -> None:
    acquainted(tmp_path)
    users = quick_users(tmp_path / "users.toml", ("scada", "correct horse", Role.LOOK))
    settings = protected(tmp_path, users=users.path)
    own = certificates.own(tmp_path / "ours", certificates.datetime.now(certificates.UTC))
    ours = {"certificate": str(own.path), "key": str(own.key), "uri": own.uri, "policy": policy}
    read = ["rig-01.Meas.Pressure"]
    with ResultsServer(settings, FIGURES) as server:
        server.sink("rig-01", "").write(*rows(), [])
        time.sleep(0.3)
        right = {"user": {"userName": "scada", "password": "correct horse"}}
        found = by_node(server, tmp_path, read=read, **ours, **right)
        assert found["read"]["rig-01.Meas.Pressure"]["value"] == pytest.approx(400.0)
        wrong = {"user": {"userName": "scada", "password": "wrong horse"}}
        assert (
            "BadUserAccessDenied" in by_node(server, tmp_path, read=read, **ours, **wrong)["error"]
        )
        assert "error" in by_node(server, tmp_path, read=read, **ours)
        assert "error" in by_node(server, tmp_path, read=read, policy="None")


# --- beside a PLC -------------------------------------------------------------------------------


@pytest.mark.slow
def test_beside_a_plc_the_results_follow(server: ResultsServer) -> None:
    document = Document.read(rigs.path_of("test_rig"))
    sink = server.sink("live", "compact-ejector-35")
    seen: list[ua.DataValue] = []
    seen_ns: list[int] = []

    def look() -> None:
        time.sleep(1.0)
        seen.extend(asked(server, "live.Meas.Pressure", "live.Model.Expected", "live.Model.Phase"))
        seen_ns.append(time.time_ns())

    looking = threading.Thread(target=look)
    with start_plc(rigs.path_of("test_rig")) as plc:
        source = open_source(document, f"127.0.0.1:{plc.port}")
        looking.start()

        def until_seen() -> Iterator[Samples]:
            with closing(source):  # type: ignore[type-var]
                for block in source:
                    yield block
                    if not looking.is_alive():
                        return

        run(until_seen(), rigs.twin("test_rig"), rigs.monitor("test_rig"), [sink])
        looking.join()
    pressure, expected, phase = seen
    assert pressure.StatusCode.is_good()
    assert phase.StatusCode.is_good()
    assert pressure.Value.Value == pytest.approx(1013.0, abs=5.0)  # idle for two seconds at first
    assert expected.StatusCode.is_good()
    assert expected.Value.Value == pytest.approx(pressure.Value.Value, abs=5.0)
    assert seen_ns[0] - ua_ns(pressure.SourceTimestamp) < 2e9
    assert sink.health.standing is Standing.STOPPED


@pytest.mark.slow
def test_twin_run_serves_them_to_whoever_asks(tmp_path: Path) -> None:
    port = free_port()
    tables = tomllib.loads(rigs.path_of("test_rig").read_text(encoding="utf-8"))
    tables["plc"]["program"]["commands"] = "coils"  # which nobody sets: it stays idle
    tables["results"] = {"opcua": True, "port": port}
    config = tmp_path / "rig.toml"
    config.write_text(tomli_w.dumps(tables), encoding="utf-8")
    names = [f"rig-01.{name}" for name in ("Meas.Pressure", "Model.Expected", "Health.State")]
    with start_plc(config) as plc:
        command = [sys.executable, "-m", "twin.cli", "run", str(config)]
        command += ["--address", f"127.0.0.1:{plc.port}"]
        with subprocess.Popen(command, cwd=rigs.ROOT, stdout=subprocess.DEVNULL) as process:
            try:
                values = asyncio.run(good(f"opc.tcp://127.0.0.1:{port}", names))
                process.send_signal(signal.SIGINT)
                assert process.wait(30) == 130
            finally:
                process.kill()
    pressure, expected, state = (value.Value.Value for value in values)
    assert pressure == pytest.approx(1013.0, abs=5.0)
    assert expected == pytest.approx(1013.0, abs=5.0)
    assert state == Standing.OK


async def good(url: str, names: list[str], patience_s: float = 60.0) -> list[ua.DataValue]:
    """What is served there once all of it is good."""
    end = time.monotonic() + patience_s
    while True:
        assert time.monotonic() < end
        await asyncio.sleep(0.2)
        with suppress(OSError, TimeoutError, ua.UaError, ValueError):
            async with Client(url) as client:
                index = await client.get_namespace_index(NAMESPACE)
                nodes = [client.get_node(f"ns={index};s={name}") for name in names]
                values = [await node.read_data_value(raise_on_bad_status=False) for node in nodes]
                if all(value.StatusCode.is_good() for value in values):
                    return values
