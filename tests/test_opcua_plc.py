"""The simulated PLC over OPC UA, by real sockets to a second process: what a client meets there."""

import asyncio
import logging
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asyncua import Client, ua
from opcua_plc import OpcuaPlc, acquainted, start_opcua, started, trust
from user_files import quick_users

from drivers.opcua import certificates
from drivers.opcua.probe import probe
from drivers.opcua.settings import OpcuaSettings
from drivers.opcua.source import blocks
from drivers.reconnect import REAL, Clock, LostError
from drivers.sources import open_source
from twin.errors import ConfigError, SourceError
from twin.quality import Quality
from twin.settings import Document
from twin.signals import SAMPLE, Samples
from twin.users import Role

SUBSCRIBE = {"mode": "subscribe", "interval_ms": 50, "sampling_ms": 5}


def taken(source: Iterator[Samples], rows: int, patience_s: float = 20.0) -> Samples:
    """At least so many rows of a stream."""
    end = time.monotonic() + patience_s
    parts = [np.empty(0, SAMPLE)]
    while sum(map(len, parts)) < rows:
        assert time.monotonic() < end, f"only {sum(map(len, parts))} rows came"
        parts.append(next(source))
    return np.concatenate(parts)


def refused(settings: OpcuaSettings, clock: Clock = REAL) -> SourceError | ConfigError:
    with (
        closing(blocks(settings, clock)) as source,
        pytest.raises((SourceError, ConfigError)) as caught,
    ):
        next(source)
    assert caught.value.hint
    assert "\n" not in str(caught.value)
    return caught.value


# --- what comes ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_trace_comes_whole_and_is_the_one_that_modbus_serves(opcua: OpcuaPlc) -> None:
    document = Document.read(opcua.folder / "plc.toml")
    with closing(open_source(document, f"127.0.0.1:{opcua.port}")) as source:  # type: ignore[type-var]
        samples = taken(source, 400)
    assert (np.diff(samples["sequence"]) == 1).all()
    assert (np.diff(samples["time_ns"]) > 0).all()
    assert not samples["quality"].any()
    assert np.isfinite(samples["supply"]).all()
    assert 20_000 < samples["pressure"].min() <= samples["pressure"].max() < 130_000
    same = ["sequence", "pressure", "commands"]
    assert (samples[same] == by_modbus(opcua, samples)[same]).all()


def by_modbus(opcua: OpcuaPlc, samples: Samples) -> Samples:
    """The same scans, from the registers of the ring."""
    from drivers.modbus.client import ModbusClient
    from drivers.modbus.ring import Trace
    from drivers.modbus.settings import ModbusSettings

    tags = {"pressure": {"address": "input:1", "type": "float32", "unit": "mbar"}}
    tags["pressure"]["reference"] = "absolute"
    table = {"host": "127.0.0.1", "port": opcua.process.port, "tags": tags}
    settings = ModbusSettings.model_validate(table)
    link, trace = ModbusClient(settings), Trace(settings, REAL)
    with closing(link):
        link.open()
        trace._header = trace.start(link)
        trace._next = int(samples["sequence"][0])
        read = trace._read(link)
    return read[: len(samples)]


def test_subscribed_nodes_come_at_the_granted_interval(opcua: OpcuaPlc) -> None:
    with closing(blocks(opcua.settings(**SUBSCRIBE))) as source:
        samples = taken(source, 100)[1:]  # the first is of when it was asked for
    assert (np.diff(samples["sequence"]) == 1).all()
    assert (np.diff(samples["time_ns"]) == 5_000_000).all()
    assert not samples["quality"].any()
    assert np.isfinite(samples["supply"]).all()
    late_ns = samples["host_ns"] - samples["time_ns"]
    assert (np.abs(late_ns) < 1e9).all()  # the source's time, and not that of its receipt


@pytest.mark.parametrize("policy", ["Basic256Sha256", "Aes256Sha256RsaPss"])
def test_signed_and_encrypted(opcua: OpcuaPlc, policy: str) -> None:
    with closing(blocks(opcua.settings(security=opcua.secure(policy)))) as source:
        samples = taken(source, 100)
    assert (np.diff(samples["sequence"]) == 1).all()


def test_probe_shows_all_of_it(opcua: OpcuaPlc) -> None:
    lines = probe(opcua.settings())
    assert [line.what for line in lines if line.good][:5] == [
        *("connection", "pressure", "suction", "blow_off", "supply"),
    ]
    assert {line.what for line in lines} >= {"round trip", "trace", "scan rate"}
    subscribed = probe(opcua.settings(**SUBSCRIBE))[-1]
    assert subscribed.good
    assert subscribed.text.startswith("samples every 5 ms, publishes every 50 ms, keeps 400")


def asked(url: str, question: Callable[[Client], Any]) -> Any:
    """What an independent look at the address space gives."""

    async def ask() -> Any:
        async with Client(url) as client:
            return await question(client)

    return asyncio.run(ask())


def test_the_address_space_is_as_an_engineer_expects(opcua: OpcuaPlc) -> None:
    async def look(client: Client) -> dict[str, Any]:
        index = await client.get_namespace_index("urn:ejector-twin:plc")
        root = await client.nodes.objects.get_child(f"{index}:Ejector")
        groups = {(await child.read_browse_name()).Name for child in await root.get_children()}
        pressure = client.get_node(f"ns={index};s=Meas.Pressure")
        unit = await (await pressure.get_child("0:EngineeringUnits")).read_value()
        span = await (await pressure.get_child("0:EURange")).read_value()
        kind = (await pressure.read_type_definition()).Identifier
        return {"groups": groups, "unit": unit, "span": (span.Low, span.High), "kind": kind}

    found = asked(opcua.url, look)
    assert found["groups"] == {"Identification", "Cmd", "Meas", "Param", "Trace"}
    assert (found["unit"].UnitId, found["unit"].DisplayName.Text) == (5063250, "mbar")
    assert found["span"] == (0.0, 2000.0)
    assert found["kind"] == ua.ObjectIds.AnalogItemType


@pytest.mark.parametrize("node", ["Meas.Pressure", "Cmd.Suction", "Trace.Pressures", "Param.H1"])
def test_nothing_can_be_written_where_the_program_commands(opcua: OpcuaPlc, node: str) -> None:
    async def write(client: Client) -> None:
        index = await client.get_namespace_index("urn:ejector-twin:plc")
        target = client.get_node(f"ns={index};s={node}")
        await target.write_value(await target.read_data_value())

    with pytest.raises(ua.UaStatusCodeError, match=r"BadUserAccessDenied|BadNotWritable"):
        asked(opcua.url, write)


# --- what is refused ----------------------------------------------------------------------------


def with_node(opcua: OpcuaPlc, node: str, mode: str) -> OpcuaSettings:
    """A configuration that expects the pressure elsewhere."""
    tags = opcua.settings().tags
    other = tags.pressure.model_copy(update={"node": type(tags.pressure.node)(node)})
    trace = opcua.settings().trace.model_copy(update={"pressures": other.node})
    return opcua.settings(mode=mode).model_copy(
        update={"tags": tags.model_copy(update={"pressure": other}), "trace": trace}
    )


@pytest.mark.parametrize("mode", ["block", "subscribe"])
def test_a_node_that_does_not_exist(opcua: OpcuaPlc, mode: str) -> None:
    error = refused(with_node(opcua, "s=Meas.Presure", mode))
    assert str(error) == f"{opcua.url}: there is no node s=Meas.Presure"


@pytest.mark.parametrize("mode", ["block", "subscribe"])
def test_a_node_of_another_type(opcua: OpcuaPlc, mode: str) -> None:
    error = refused(with_node(opcua, "s=Identification.Model", mode))
    assert str(error).startswith("s=Identification.Model holds String; expected is a")


def test_a_namespace_that_is_not_there(opcua: OpcuaPlc) -> None:
    error = refused(opcua.settings(namespace="urn:somewhere"))
    assert str(error) == f"{opcua.url}: it has no namespace 'urn:somewhere'"
    assert "urn:ejector-twin:plc" in error.hint


def test_no_server_at_the_port(opcua: OpcuaPlc) -> None:
    nobody = opcua.settings().at("127.0.0.1", 9)
    error = refused(nobody)
    assert str(error) == "opc.tcp://127.0.0.1:9: no connection: the machine refuses this port"
    assert "is the OPC UA server started there" in error.hint


def test_a_server_of_another_kind_at_the_port(opcua: OpcuaPlc) -> None:
    modbus = opcua.settings(timeout_ms=300).at("127.0.0.1", opcua.process.port)
    assert isinstance(refused(modbus), LostError)


def test_a_server_that_we_do_not_know(opcua: OpcuaPlc, tmp_path: Path) -> None:
    certificates.make(tmp_path)
    error = refused(opcua.settings(security=opcua.secure("Basic256Sha256", tmp_path)))
    assert "CN=plc, SHA1 " in str(error)
    assert str(error).endswith("is not trusted")
    kept, *_ = (tmp_path / certificates.REJECTED).iterdir()
    assert f"mv {kept} {tmp_path / certificates.TRUSTED}/" in error.hint
    shutil.move(kept, tmp_path / certificates.TRUSTED)  # what the hint says helps
    again = refused(opcua.settings(security=opcua.secure("Basic256Sha256", tmp_path)))
    assert "it does not trust our certificate" in str(again)  # now it is the server's turn


def later(days: int) -> Clock:
    return replace(REAL, wall_ns=lambda: time.time_ns() + days * 86_400_000_000_000)


def test_a_server_whose_certificate_has_expired(opcua: OpcuaPlc, tmp_path: Path) -> None:
    lasting_longer(tmp_path)
    trust(tmp_path, opcua.folder / "theirs")
    settings = opcua.settings(security=opcua.secure("Basic256Sha256", tmp_path))
    error = refused(settings, later(6 * 365))
    assert "CN=plc, SHA1 " in str(error)
    assert ") expired on 20" in str(error)


def lasting_longer(folder: Path) -> None:
    certificates.make(folder, days=3650)


def test_our_own_certificate_that_has_expired(opcua: OpcuaPlc) -> None:
    error = refused(opcua.settings(security=opcua.secure("Basic256Sha256")), later(6 * 365))
    assert "our own certificate expired on" in str(error)
    assert "twin cert" in error.hint


def test_no_certificate_of_our_own(opcua: OpcuaPlc, tmp_path: Path) -> None:
    error = refused(opcua.settings(security=opcua.secure("Basic256Sha256", tmp_path)))
    assert "there is no certificate of our own" in str(error)


# --- a server that wants to know who we are, and behaves like real ones -------------------------


@pytest.fixture(scope="module")
def awkward(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OpcuaPlc]:
    folder = tmp_path_factory.mktemp("awkward")
    acquainted(folder)
    certificates.make(folder / "person", "someone")
    trust(folder / "theirs", folder / "person", certificates.USERS)
    users = quick_users(folder / "users.toml", ("twin", "gehäuse-s3cret", Role.LOOK))
    with start_opcua(
        folder,
        policies=["Basic256Sha256"],
        certificates=str(folder / "theirs"),
        users=str(users.path),
        min_sampling_ms=20,
        min_publishing_ms=100,
        late_publishing_ms=30,
        drop_every_s=2.0,
    ) as running:
        yield running


def as_user(plc: OpcuaPlc, tmp_path: Path, password: str, **changes: Any) -> OpcuaSettings:
    file = tmp_path / "password"
    file.write_text(f"{password}\n", encoding="utf-8")
    file.chmod(0o600)  # else it is said that others may read it
    user = {"name": "twin", "password": {"file": file}}
    return plc.settings(user=user, security=plc.secure("Basic256Sha256"), **changes)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["secret", "gehaeuse-s3cret", "gehäuse-secret"])
def test_a_wrong_password(awkward: OpcuaPlc, tmp_path: Path, wrong: str) -> None:
    error = refused(as_user(awkward, tmp_path, wrong))
    assert str(error).startswith(f"{awkward.url}: it does not let this user in (BadUserAccess")
    assert "secret" not in str(error)


def test_nobody_is_not_let_in(awkward: OpcuaPlc) -> None:
    error = refused(awkward.settings(security=awkward.secure("Basic256Sha256")))
    assert "it does not let this user in" in str(error)


def test_a_person_by_certificate(awkward: OpcuaPlc, tmp_path: Path) -> None:
    certificates.make(tmp_path, "someone else")
    protected = awkward.secure("Basic256Sha256")
    for folder, known in ((awkward.folder / "person", True), (tmp_path, False)):
        user = {"certificate": folder / certificates.OWN, "key": folder / certificates.KEY}
        settings = awkward.settings(user=user, security=protected)
        if known:
            with closing(blocks(settings)) as source:
                assert len(taken(source, 50))
        else:
            assert "it does not let this user in" in str(refused(settings))


def test_a_password_that_cannot_be_read(awkward: OpcuaPlc, tmp_path: Path) -> None:
    user = {"name": "twin", "password": {"file": tmp_path / "none"}}
    error = refused(awkward.settings(user=user, security=awkward.secure("Basic256Sha256")))
    assert "[driver.user] password" in str(error)


def test_a_policy_that_is_not_offered(awkward: OpcuaPlc) -> None:
    error = refused(awkward.settings(security=awkward.secure("Aes256Sha256RsaPss")))
    assert "it does not offer Aes256Sha256RsaPss" in str(error)
    assert error.hint.endswith("Basic256Sha256")


@pytest.mark.slow
def test_revised_intervals_and_dropped_connections(
    awkward: OpcuaPlc, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    settings = as_user(awkward, tmp_path, "gehäuse-s3cret", **SUBSCRIBE)
    lost: list[SourceError] = []  # it may hang up before there is a block, too
    with (
        closing(blocks(settings, away=lost.append)) as source,
        caplog.at_level(logging.WARNING),
    ):
        samples = taken(source, 120)  # 2.4 s: it hangs up at least once meanwhile
    assert caplog.messages == [
        f"{awkward.url}: the server samples every 20 ms, not 5, publishes every 100 ms, not 50"
    ]
    steps = np.diff(samples["sequence"])
    gaps = np.flatnonzero(samples["quality"] & Quality.GAP)
    assert len(gaps)
    assert (steps[gaps - 1] > 1).all()
    ran = np.diff(samples["time_ns"]) / 20e6
    assert steps == pytest.approx(np.maximum(np.rint(ran), 1))
    assert (samples["quality"] & ~np.uint8(Quality.GAP) == 0).all()


# --- restarts -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_restart_with_another_namespace_index_is_survived(tmp_path: Path) -> None:
    plc = started(tmp_path, namespace_index=2)
    with closing(blocks(plc.settings(timeout_ms=500))) as source:
        with plc.process:
            before = taken(source, 60)
            plc.process.kill()
        assert len(before)
        assert not sum(len(next(source)) for _ in range(3))
        again = started(tmp_path, namespace_index=5, port=plc.port)
        with again.process:
            after = taken(source, 60)
    # It had scanned for longer than its ring is deep before it could be reached.
    assert np.flatnonzero(after["quality"]).tolist() == [0]
    assert after["quality"][0] == Quality.RESTART | Quality.GAP
    assert (np.diff(after["sequence"]) == 1).all()


# --- garbage at the socket ----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_garbage_is_no_connection_and_leaves_nothing_behind(seed: int) -> None:
    random = np.random.default_rng(seed)
    garbage = [random.bytes(200), b"ACKF" + random.bytes(40), b"ERRF\x10\0\0\0" + random.bytes(8)]

    async def serve() -> SourceError:
        async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.read(100)
            writer.write(garbage[seed % 3])
            await writer.drain()
            writer.close()

        server = await asyncio.start_server(answer, "127.0.0.1", 0)
        async with server:
            port = server.sockets[0].getsockname()[1]
            table = {"pressure": {"node": "s=P", "unit": "mbar", "reference": "absolute"}}
            settings = OpcuaSettings(
                url=f"opc.tcp://127.0.0.1:{port}", namespace="urn:x", tags=table, timeout_ms=200
            )
            return await asyncio.to_thread(refused, settings)

    assert isinstance(asyncio.run(serve()), LostError)
