"""A connection inside TLS waits as a plain one does: for whole answers, and not for ever."""

import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.rsa import RSAPrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key
from independent import pem
from pydantic import ValidationError

from drivers.modbus.client import ModbusClient
from drivers.modbus.plan import Request
from drivers.modbus.poll_socket import head
from drivers.modbus.settings import ModbusSettings
from drivers.modbus.tls import PlcTls, secured
from drivers.opcua import certificates
from drivers.reconnect import LostError
from drivers.sources import open_source
from drivers.tags import Address
from twin.errors import ConfigError, SourceError
from twin.settings import Document

FOUR = Request(Address("input", 1), 4)
TIMEOUT_MS = 100
ANSWER = head(FOUR.size, 1, 1, 4) + bytes(range(8))


class Plc:
    """Shakes hands with one client after the other, and does with its first request as told."""

    def __init__(
        self,
        folder: Path,
        act: Callable[[ssl.SSLSocket], None],
        certificate: Path | None = None,
        clients: Path | None = None,
    ) -> None:
        if certificate is None:
            certificates.make(folder)
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._context.load_cert_chain(certificate or pem(folder), folder / certificates.KEY)
        if clients is not None:  # that are let in
            self._context.verify_mode = ssl.CERT_REQUIRED
            self._context.load_verify_locations(clients)
        self._act = act
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        with suppress(OSError):
            client, _ = self._listener.accept()
            with self._context.wrap_socket(client, server_side=True) as inside:
                assert len(inside.recv(12)) == 12
                self._act(inside)
                inside.recv(1)  # until the client has gone

    def close(self) -> None:
        self._listener.close()
        self._thread.join()


@pytest.fixture
def linked(tmp_path: Path) -> Iterator[Callable[[Callable[[ssl.SSLSocket], None]], ModbusClient]]:
    opened: list[ModbusClient | Plc] = []

    def link_to(act: Callable[[ssl.SSLSocket], None]) -> ModbusClient:
        plc = Plc(tmp_path, act)
        tag = {"address": "30002", "type": "float32", "unit": "mbar", "reference": "absolute"}
        table = {"host": "127.0.0.1", "port": plc.port, "timeout_ms": TIMEOUT_MS}
        tls = {"trusted": tmp_path / certificates.OWN, "name": socket.gethostname()}
        link = ModbusClient(
            ModbusSettings.model_validate(table | {"tags": {"pressure": tag}, "tls": tls})
        )
        opened.extend((link, plc))
        link.open()
        return link

    yield link_to
    for connection in opened:
        connection.close()


def test_an_answer_comes_in_pieces(linked: Callable[..., ModbusClient]) -> None:
    def act(client: ssl.SSLSocket) -> None:
        for piece in (ANSWER[:3], ANSWER[3:10], ANSWER[10:]):
            client.sendall(piece)
            time.sleep(0.01)

    assert linked(act).read(FOUR.address, 4).tolist() == [0x0001, 0x0203, 0x0405, 0x0607]


def dribble(client: ssl.SSLSocket) -> None:
    for byte in ANSWER:
        client.sendall(bytes([byte]))
        time.sleep(0.6 * TIMEOUT_MS * 1e-3)


@pytest.mark.parametrize("act", [lambda client: None, dribble], ids=["silent", "dribbling"])
def test_one_that_does_not_answer_in_time_is_lost(
    linked: Callable[..., ModbusClient], act: Callable[[ssl.SSLSocket], None]
) -> None:
    link = linked(act)
    begun = time.monotonic()
    with pytest.raises(LostError, match="no answer"):
        link.read(FOUR.address, 4)
    assert time.monotonic() - begun < 5 * TIMEOUT_MS * 1e-3
    with pytest.raises(LostError, match="the connection is closed"):
        link.read(FOUR.address, 4)


def test_one_that_hangs_up_at_once_may_not_want_us(linked: Callable[..., ModbusClient]) -> None:
    link = linked(lambda client: client.close())
    with pytest.raises(LostError, match="it does not trust our certificate, or requires one"):
        link.read(FOUR.address, 4)


# Who is trusted.


@contextmanager
def reaching(plc: Plc, folder: Path, **changes: object) -> Iterator[ModbusClient]:
    """A link to a PLC whose files are in ``folder``; both end."""
    tag = {"address": "30002", "type": "float32", "unit": "mbar", "reference": "absolute"}
    table = {"host": "127.0.0.1", "port": plc.port, "timeout_ms": 250}
    tls = {"trusted": folder / certificates.OWN, "name": socket.gethostname()} | changes
    link = ModbusClient(
        ModbusSettings.model_validate(table | {"tags": {"pressure": tag}, "tls": tls})
    )
    with closing(plc), closing(link):
        yield link


def answer(client: ssl.SSLSocket) -> None:
    client.sendall(ANSWER)


def test_a_certificate_that_nobody_trusts_is_refused(tmp_path: Path) -> None:
    stranger = tmp_path / "stranger"
    certificates.make(stranger)
    plc = Plc(tmp_path / "plc", answer)
    with (
        reaching(plc, stranger) as link,
        pytest.raises(SourceError, match=r"its certificate is not trusted \(self-signed") as told,
    ):
        link.open()
    assert str(stranger / certificates.OWN) in told.value.hint


def test_a_certificate_for_another_name_is_refused(tmp_path: Path) -> None:
    with (
        reaching(Plc(tmp_path, answer), tmp_path, name="") as link,
        pytest.raises(SourceError, match=r"its certificate is not for 127\.0\.0\.1"),
    ):
        link.open()


@pytest.mark.parametrize(("begin_days", "said"), [(-3, "has expired"), (3, "is not valid yet")])
def test_a_certificate_out_of_date_is_refused(tmp_path: Path, begin_days: int, said: str) -> None:
    certificates.make(tmp_path)
    key = load_pem_private_key((tmp_path / certificates.KEY).read_bytes(), None)
    assert isinstance(key, RSAPrivateKey)
    begin = datetime.now(UTC) + timedelta(days=begin_days)
    path = tmp_path / "old.pem"
    path.write_bytes(certificates.signed(key, "plc", begin, 1).public_bytes(Encoding.PEM))
    with (
        reaching(Plc(tmp_path, answer, certificate=path), tmp_path, trusted=path) as link,
        pytest.raises(SourceError, match=f"its certificate {said}"),
    ):
        link.open()


@pytest.mark.parametrize("known", [True, False])
def test_a_plc_that_wants_a_certificate_takes_the_one_it_knows(tmp_path: Path, known: bool) -> None:
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    for place in (ours, theirs):
        certificates.make(place)
    plc = Plc(tmp_path / "plc", answer, clients=pem(ours if known else theirs))
    own = {"certificate": pem(ours), "key": ours / certificates.KEY}
    with reaching(plc, tmp_path / "plc", **own) as link:
        if known:
            assert _opened_and_read(link) == [1, 515, 1029, 1543]
            return
        with pytest.raises(SourceError, match="it does not trust our certificate, or requires one"):
            _opened_and_read(link)


def _opened_and_read(link: ModbusClient) -> list[int]:
    link.open()
    return [*link.read(FOUR.address, 4).tolist()]


def test_a_plc_that_speaks_plain_modbus_is_told_so(tmp_path: Path) -> None:
    class Plain(Plc):
        def _serve(self) -> None:
            client, _ = self._listener.accept()
            with client:
                client.sendall(ANSWER)

    with (
        reaching(Plain(tmp_path, answer), tmp_path) as link,
        pytest.raises(LostError, match="it does not speak TLS") as told,
    ):
        link.open()
    assert "leave [driver.tls] out" in told.value.hint


def test_our_own_files_that_are_of_no_use_are_named(tmp_path: Path) -> None:
    broken = tmp_path / "broken.pem"
    broken.write_text("nothing")
    own = {"certificate": broken, "key": broken}
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        certificates.make(tmp_path)
        for changes, said in ((own, "certificate and key"), ({"trusted": broken}, "trusted")):
            tls = PlcTls.model_validate({"trusted": tmp_path / certificates.OWN} | changes)
            connection = socket.create_connection(("127.0.0.1", port))
            with pytest.raises(ConfigError, match=f"{said} {broken}: cannot be used"):
                secured(connection, tls, f"127.0.0.1:{port}")
            assert connection.fileno() == -1  # it is closed
    with pytest.raises(ValidationError, match="certificate and key belong together"):
        PlcTls.model_validate({"trusted": broken, "key": broken})


def test_files_lie_beside_the_configuration(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        text = f"""
            [driver]
            host = "127.0.0.1"
            port = {listener.getsockname()[1]}
            [driver.tags.pressure]
            address = "30002"
            type = "float32"
            unit = "mbar"
            reference = "absolute"
            [driver.tls]
            trusted = "plc.pem"
        """
        document = Document.parse(text, str(tmp_path / "rig.toml"))
        with (
            closing(open_source(document)) as source,  # type: ignore[type-var]
            pytest.raises(ConfigError, match=f"trusted {tmp_path}/plc.pem: cannot be used"),
        ):
            next(source)
