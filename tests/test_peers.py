"""One body for every driver and every kind of PLC, most of them of other make than ours."""

import socket
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import opcua_plc
import pytest
import rigs
from cryptography.hazmat.primitives.asymmetric.rsa import RSAPrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key
from independent import (
    Server,
    Truth,
    known_signal,
    libmodbus,
    libmodbus_in_tls,
    node_opcua,
    pem,
    simulated,
)
from plc_process import start_plc

from drivers.modbus import source as modbus
from drivers.modbus.settings import ModbusSettings
from drivers.opcua import certificates
from drivers.opcua import source as opcua
from drivers.opcua.settings import OpcuaSettings
from drivers.reconnect import LostError
from twin.errors import ConfigError, SourceError
from twin.quality import Quality
from twin.signals import SAMPLE, Samples

LONGEST_RUN = 40_000  # scans that a PLC makes before its test is over
ATTEMPTS = 5  # as a busy machine may let an answer come late
PLC = "plc"  # the name in the certificate of the PLC behind TLS
DriverSettings = ModbusSettings | OpcuaSettings
NODE, LIBMODBUS = ("node-opcua",), ("cc", "libmodbus")
STUNNEL = (*LIBMODBUS, "stunnel")


@dataclass(frozen=True)
class Peer:
    """A kind of PLC, and how a driver reads it."""

    start: Callable[[Path, int], AbstractContextManager[Any]]  # gives what has ``port``, ``kill``
    settings: Callable[[Path, int], DriverSettings]
    wrong: Callable[[DriverSettings], DriverSettings]  # the same with something that is not there
    complaint: str  # about it
    truth: Callable[[], Truth] = known_signal
    scans: bool = True  # rows are the PLC's scans; else values at the times they are of
    slack_ms: int = 0  # so far these times may be off
    needs: tuple[str, ...] = ()  # programs of the system


# --- our settings -------------------------------------------------------------------------------


def by_modbus(port: int, **changes: Any) -> ModbusSettings:
    table = tomllib.loads(rigs.path_of("test_rig").read_text(encoding="utf-8"))["driver"]
    return ModbusSettings.model_validate(table | {"port": port} | changes)


def by_opcua(port: int, **changes: Any) -> OpcuaSettings:
    table = opcua_plc.tables()["driver"] | {"url": f"opc.tcp://127.0.0.1:{port}"}
    return OpcuaSettings.model_validate(table | changes)


def secured(folder: Path, policy: str) -> dict[str, Any]:
    (folder / "password").write_text("s3cret\n", encoding="utf-8")
    return {
        "security": {"policy": policy, "certificates": folder / "ours"},
        "user": {"name": "twin", "password": {"file": folder / "password"}},
    }


def in_tls(folder: Path, **changes: Any) -> dict[str, Any]:
    return {"tls": {"trusted": folder / PLC / certificates.OWN, "name": host_name()} | changes}


def host_name() -> str:
    """The name that ``certificates.make`` writes into a certificate."""
    return socket.gethostname()


def replaced(table: Any, path: tuple[str, ...], value: Any) -> Any:
    """The same settings with another value somewhere inside."""
    if not path:
        return value
    inner = replaced(getattr(table, path[0]), path[1:], value)
    return table.model_copy(update={path[0]: inner})


def elsewhere(*path: str, to: str) -> Callable[[DriverSettings], DriverSettings]:
    """Settings that look for something at a place where nothing is."""

    def change(settings: DriverSettings) -> DriverSettings:
        here: Any = settings
        for key in path:
            here = getattr(here, key)
        return replaced(settings, path, type(here).parse(to))  # type: ignore[no-any-return]

    return change


NO_HEADER = elsewhere("ring", "header", to="holding:20000")
NO_INPUT = elsewhere("tags", "pressure", "address", to="input:900")
NO_TRACE = elsewhere("trace", "pressures", to="s=Nowhere")
NO_NODE = elsewhere("tags", "pressure", "node", to="s=Nowhere")
REFUSED = "illegal data address: it does not serve this address"
UNKNOWN = "there is no node s=Nowhere"


# --- the PLCs -----------------------------------------------------------------------------------


@contextmanager
def our_modbus(folder: Path, port: int) -> Iterator[Any]:
    with start_plc(rigs.path_of("test_rig"), port=port) as process:
        yield process


@contextmanager
def our_opcua(folder: Path, port: int) -> Iterator[Any]:
    plc = opcua_plc.started(folder, port=port)
    with plc.process:
        yield Server(plc.port, [plc.process.process])


@contextmanager
def node_secure(folder: Path, port: int) -> Iterator[Server]:
    policies = ["Basic256Sha256", "Aes256Sha256RsaPss"]
    with node_opcua(folder, port, policies=policies, users={"twin": "s3cret"}) as server:
        yield server


PEERS = {
    "our Modbus, ring": Peer(
        our_modbus, lambda _, port: by_modbus(port), NO_HEADER, REFUSED, lambda: simulated(0)
    ),
    "our Modbus, polled": Peer(
        our_modbus,
        lambda _, port: by_modbus(port, mode="poll"),
        NO_INPUT,
        REFUSED,
        lambda: simulated(0),
        scans=False,
        slack_ms=100,
    ),
    "our OPC UA, trace": Peer(
        our_opcua, lambda _, port: by_opcua(port), NO_TRACE, UNKNOWN, lambda: simulated(3)
    ),
    "our OPC UA, subscribed": Peer(
        our_opcua,
        lambda _, port: by_opcua(port, mode="subscribe", sampling_ms=5),
        NO_NODE,
        UNKNOWN,
        lambda: simulated(3),
        scans=False,
    ),
    "node-opcua, trace": Peer(
        node_opcua, lambda _, port: by_opcua(port), NO_TRACE, UNKNOWN, needs=NODE
    ),
    "node-opcua, subscribed": Peer(
        node_opcua,
        lambda _, port: by_opcua(port, mode="subscribe"),
        NO_NODE,
        UNKNOWN,
        scans=False,
        needs=NODE,
    ),
    "node-opcua, trace, Basic256Sha256": Peer(
        node_secure,
        lambda folder, port: by_opcua(port, **secured(folder, "Basic256Sha256")),
        NO_TRACE,
        UNKNOWN,
        needs=NODE,
    ),
    "node-opcua, subscribed, Aes256Sha256RsaPss": Peer(
        node_secure,
        lambda folder, port: by_opcua(
            port, mode="subscribe", **secured(folder, "Aes256Sha256RsaPss")
        ),
        NO_NODE,
        UNKNOWN,
        scans=False,
        needs=NODE,
    ),
    "libmodbus, ring": Peer(
        libmodbus, lambda _, port: by_modbus(port), NO_HEADER, REFUSED, needs=LIBMODBUS
    ),
    "libmodbus, polled": Peer(
        libmodbus,
        lambda _, port: by_modbus(port, mode="poll"),
        NO_INPUT,
        REFUSED,
        scans=False,
        slack_ms=100,
        needs=LIBMODBUS,
    ),
    "libmodbus in TLS, ring": Peer(
        libmodbus_in_tls,
        lambda folder, port: by_modbus(port, **in_tls(folder)),
        NO_HEADER,
        REFUSED,
        needs=STUNNEL,
    ),
    "libmodbus in TLS, polled": Peer(
        libmodbus_in_tls,
        lambda folder, port: by_modbus(port, mode="poll", **in_tls(folder)),
        NO_INPUT,
        REFUSED,
        scans=False,
        slack_ms=100,
        needs=STUNNEL,
    ),
}


def furnished(folder: Path) -> Path:
    """A folder with all certificates."""
    opcua_plc.acquainted(folder)
    certificates.make(folder / PLC, PLC)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return furnished(tmp_path_factory.mktemp("peers"))


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(peer, id=name, marks=[pytest.mark.needs(*peer.needs)] if peer.needs else [])
        for name, peer in PEERS.items()
    ],
)
def peer(request: pytest.FixtureRequest) -> Peer:
    kind: Peer = request.param
    return kind


@pytest.fixture(scope="module")
def settings(peer: Peer, folder: Path) -> Iterator[DriverSettings]:
    """For one of them that runs; nobody may stop it."""
    with peer.start(folder, 0) as server:
        yield peer.settings(folder, server.port)


# --- the body -----------------------------------------------------------------------------------


def blocks(settings: DriverSettings) -> Any:
    if isinstance(settings, ModbusSettings):
        return modbus.blocks(settings)
    return opcua.blocks(settings)


def taken(source: Iterator[Samples], seconds: float, patience_s: float = 20.0) -> Samples:
    """The rows of so much PLC time, as soon as there are any."""
    end = time.monotonic() + patience_s
    rows = np.empty(0, SAMPLE)
    while not len(rows) or rows["time_ns"][-1] - rows["time_ns"][0] < seconds * 1e9:
        assert time.monotonic() < end, f"only {len(rows)} rows came"
        rows = np.concatenate([rows, next(source)])
    return rows


def assert_true(peer: Peer, rows: Samples) -> None:
    """Each value is that of its own scan, or of its own time."""
    truth = peer.truth()
    scan = rows["sequence"]
    if not peer.scans:
        scan = scans_of(truth, rows)
    slack = np.arange(-peer.slack_ms, peer.slack_ms + 1)
    around = np.clip(scan[:, np.newaxis] + slack, 0, len(truth.pressure) - 1)
    same = truth.pressure[around] == rows["pressure"][:, np.newaxis]
    same &= truth.commands[around] == rows["commands"][:, np.newaxis]
    wrong = ~same.any(axis=1)
    assert not wrong.any(), f"{wrong.sum()} of {len(rows)}: {rows[wrong][:5]}"


def scans_of(truth: Truth, rows: Samples) -> Any:
    """The scans that the rows' times mean, as most of their values have it, within 3 ms."""
    since = np.rint((rows["time_ns"] - rows["time_ns"][0]) * 1e-6).astype(np.int64)
    pressure = truth.pressure[:LONGEST_RUN]
    begins = np.flatnonzero(pressure[3 : -since[-1] - 4] == rows["pressure"][0]) + 3
    assert len(begins), "the first value is none that was served"
    scans = begins[:, np.newaxis] + since
    right = np.zeros(scans.shape, bool)
    for off in range(-3, 4):
        right |= pressure[scans + off] == rows["pressure"]
    exactly = (pressure[scans] == rows["pressure"]).mean(axis=1)  # neighbours tie in a rest
    return begins[(right.sum(axis=1) + exactly).argmax()] + since


@pytest.mark.slow
def test_what_it_serves_comes_complete_in_order_and_right(
    peer: Peer, settings: DriverSettings
) -> None:
    with closing(blocks(settings)) as source:
        rows = taken(source, 1.5)
    assert (np.diff(rows["time_ns"]) > 0).all()
    assert (np.diff(rows["sequence"]) > 0).all()
    assert not (rows["quality"] & ~np.uint8(Quality.GAP)).any()
    assert np.abs(rows["host_ns"] - rows["time_ns"]).max() < 2e9
    assert_true(peer, rows)
    if peer.scans:
        assert (np.diff(rows["sequence"]) == 1).all()
        assert (np.diff(rows["time_ns"]) == 1_000_000).all()
        assert not rows["quality"].any()
    else:  # how many come depends on how busy this machine is
        assert np.isfinite(rows["supply"]).all()


def test_what_is_not_there_is_told_in_one_sentence(peer: Peer, settings: DriverSettings) -> None:
    assert peer.complaint in str(refused_in_the_end(peer.wrong(settings)))


@pytest.mark.slow
def test_killed_and_started_again_it_is_found_again(peer: Peer, tmp_path: Path) -> None:
    furnished(tmp_path)
    with peer.start(tmp_path, 0) as server:
        source = blocks(peer.settings(tmp_path, server.port))
        with closing(source):
            before = taken(source, 0.3)
            port = server.port
            server.kill()
            silent_since = time.monotonic()
            while time.monotonic() - silent_since < 0.6:
                before = np.concatenate([before, next(source)])
            with peer.start(tmp_path, port):
                after = taken(source, 0.5)
    assert_true(peer, before)
    assert_true(peer, after)
    assert after["quality"][0] & (Quality.RESTART if peer.scans else Quality.GAP)
    if peer.scans:  # a busy machine may miss some of the others
        assert not before["quality"].any()
        assert not after["quality"][1:].any()


# --- who is not trusted, and who does not trust us ----------------------------------------------


def refused(settings: DriverSettings) -> SourceError | ConfigError:
    with (
        closing(blocks(settings)) as source,
        pytest.raises((SourceError, ConfigError)) as caught,
    ):
        next(source)
    assert caught.value.hint
    assert "\n" not in str(caught.value)
    return caught.value


def refused_in_the_end(settings: DriverSettings) -> SourceError | ConfigError:
    """Why it is refused by a PLC that answers, asked again where an answer came too late."""
    error = refused(settings)
    for _ in range(ATTEMPTS):
        if "no answer" not in str(error):
            break
        error = refused(settings)
    return error


def out_of_date(folder: Path, begin_days: int) -> Path:
    """A certificate for the key of the PLC that begins then and lasts a day."""
    key = load_pem_private_key((folder / PLC / certificates.KEY).read_bytes(), None)
    assert isinstance(key, RSAPrivateKey)
    begin = datetime.now(UTC) + timedelta(days=begin_days)
    path = folder / f"begins-{begin_days}.pem"
    certificate = certificates.signed(key, PLC, begin, 1)
    path.write_bytes(certificate.public_bytes(Encoding.PEM))
    return path


@pytest.mark.needs(*STUNNEL)
@pytest.mark.parametrize(("begin_days", "said"), [(-3, "has expired"), (3, "is not valid yet")])
def test_tls_with_a_certificate_out_of_date(folder: Path, begin_days: int, said: str) -> None:
    certificate = out_of_date(folder, begin_days)
    with libmodbus_in_tls(folder, certificate=certificate) as server:
        error = refused(by_modbus(server.port, **in_tls(folder, trusted=certificate)))
    assert str(error) == f"127.0.0.1:{server.port}: its certificate {said}"


@pytest.fixture(scope="module", params=[pytest.param("tls", marks=pytest.mark.needs(*STUNNEL))])
def tls(folder: Path) -> Iterator[int]:
    with libmodbus_in_tls(folder) as server:
        yield server.port


def test_tls_with_a_certificate_that_nobody_trusts(folder: Path, tls: int) -> None:
    stranger = folder / "ours" / certificates.OWN
    error = refused(by_modbus(tls, **in_tls(folder, trusted=stranger)))
    assert "its certificate is not trusted (self-signed certificate)" in str(error)
    assert str(stranger) in error.hint


def test_tls_with_a_certificate_of_somebody_else(folder: Path, tls: int) -> None:
    error = refused(by_modbus(tls, **in_tls(folder, name="")))
    assert str(error) == f"127.0.0.1:{tls}: its certificate is not for 127.0.0.1"
    assert "set name" in error.hint


@pytest.mark.needs(*LIBMODBUS)
def test_tls_to_a_plc_that_speaks_plain_modbus(folder: Path) -> None:
    with libmodbus(folder) as server:
        error = refused(by_modbus(server.port, **in_tls(folder)))
    assert str(error) == f"127.0.0.1:{server.port}: it does not speak TLS"
    assert "leave [driver.tls] out" in error.hint


def test_plain_modbus_to_a_plc_that_speaks_tls(tls: int) -> None:
    error = refused(by_modbus(tls))
    assert "no answer" in str(error)
    assert "needs [driver.tls]" in error.hint


@pytest.mark.needs(*STUNNEL)
@pytest.mark.parametrize("ours", [None, "ours"])
def test_tls_to_a_plc_that_wants_another_certificate(folder: Path, ours: str | None) -> None:
    own = {}
    if ours:
        own = {"certificate": pem(folder / ours), "key": folder / ours / certificates.KEY}
    with libmodbus_in_tls(folder, clients=pem(folder / "theirs")) as server:
        error = refused(by_modbus(server.port, **in_tls(folder, **own)))
    assert str(error).endswith("it does not trust our certificate, or requires one")


@pytest.mark.needs(*STUNNEL)
def test_tls_with_a_certificate_of_our_own(folder: Path) -> None:
    own = {"certificate": pem(folder / "ours"), "key": folder / "ours" / certificates.KEY}
    with libmodbus_in_tls(folder, clients=pem(folder / "ours")) as server:
        source = blocks(by_modbus(server.port, **in_tls(folder, **own)))
        with closing(source):
            assert len(taken(source, 0.1))


@pytest.mark.parametrize("key", ["trusted", "certificate"])
def test_tls_files_that_cannot_be_used(folder: Path, tls: int, key: str) -> None:
    wrong = {key: folder / "password.txt"} | ({"key": folder / "no"} if key != "trusted" else {})
    (folder / "password.txt").write_text("none", encoding="utf-8")
    error = refused(by_modbus(tls, **in_tls(folder, **wrong)))
    assert isinstance(error, ConfigError)
    assert f"{folder}/password.txt: cannot be used" in str(error)


@pytest.fixture(scope="module", params=[pytest.param("node", marks=pytest.mark.needs(*NODE))])
def node(folder: Path) -> Iterator[int]:
    with node_secure(folder, 0) as server:
        yield server.port


@pytest.mark.slow
def test_node_opcua_does_not_know_us(folder: Path, node: int, tmp_path: Path) -> None:
    certificates.make(tmp_path / "ours")
    opcua_plc.trust(tmp_path / "ours", folder / "theirs")
    error = refused(by_opcua(node, **secured(tmp_path, "Basic256Sha256")))
    assert "it does not trust our certificate, or requires one" in str(error)


def test_node_opcua_is_not_known_to_us(node: int, tmp_path: Path) -> None:
    certificates.make(tmp_path / "ours")
    error = refused(by_opcua(node, **secured(tmp_path, "Basic256Sha256")))
    assert "CN=plc, SHA1 " in str(error)
    assert str(error).endswith("is not trusted")


@pytest.mark.parametrize("user", ["twin", "nobody"])
def test_node_opcua_does_not_let_everybody_in(folder: Path, node: int, user: str) -> None:
    settings = secured(folder, "Basic256Sha256")
    (folder / "wrong").write_text("secret", encoding="utf-8")
    settings["user"] = {"name": user, "password": {"file": folder / "wrong"}}
    assert "it does not let this user in" in str(refused(by_opcua(node, **settings)))
    error = refused(by_opcua(node, security=settings["security"]))
    assert "it does not let this user in" in str(error)


def test_node_opcua_without_the_policy(node: int) -> None:
    error = refused(by_opcua(node))
    assert "wants the connection protected otherwise (BadSecurityModeRejected)" in str(error)
    assert "Basic256Sha256, Aes256Sha256RsaPss" in error.hint
    assert not isinstance(error, LostError)


@pytest.mark.needs(*NODE)
def test_node_opcua_with_another_policy(folder: Path) -> None:
    with node_opcua(folder, policies=["None", "Basic256Sha256"]) as server:
        error = refused(by_opcua(server.port, **secured(folder, "Aes256Sha256RsaPss")))
    assert "it does not offer Aes256Sha256RsaPss with signing and encryption" in str(error)
    assert error.hint.endswith(": Basic256Sha256, None")
