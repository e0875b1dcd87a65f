"""Who may come in over OPC UA: any letters, not as often as one likes, and only while a user."""

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from asyncua import Client, Server, ua
from asyncua.common.utils import ServiceError
from asyncua.ua import UaStatusCodeError
from cryptography.hazmat.primitives.serialization import Encoding
from user_files import Clock, quick_users, throttled_by

from drivers.opcua import certificates
from drivers.opcua.security import ADDRESS, Door, GuardedServer, Person, authenticator_of, secure
from twin.audit import Audit, records
from twin.errors import ConfigError
from twin.login import ADDRESS_S, Authenticator
from twin.throttle import FREE_TRIES
from twin.users import Role, Users

WORD = "correct horse"


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return throttled_by(monkeypatch)


@pytest.fixture
def users(tmp_path: Path) -> Users:
    known = ("ann", WORD, Role.LOOK), ("Schlüssel", "Grüße aus Ölde", Role.LOOK)
    return quick_users(tmp_path / "users.toml", *known)


@pytest.fixture
def door(users: Users, clock: Clock) -> Door:
    audit = Audit(users.path.parent, "opcua", pytest.fail)
    return Door(None, Authenticator(users, audit), pytest.fail)


def let_in(door: Door, name: str, password: str | None, address: str = "192.0.2.7") -> bool:
    token = ADDRESS.set(address)
    try:
        return door.get_user(None, name, password) is not None
    finally:
        ADDRESS.reset(token)


def test_a_password_may_have_any_letter(door: Door) -> None:
    assert let_in(door, "ann", WORD)
    assert let_in(door, "Schlüssel", "Grüße aus Ölde")
    for password in ("Grusse aus Olde", "Grüsse aus Ölde", "", None):
        assert not let_in(door, "Schlüssel", password)


def test_who_guesses_has_to_wait(door: Door, clock: Clock) -> None:
    for number in range(FREE_TRIES):
        assert not let_in(door, "ann", "wrong horse", f"192.0.2.{number}")
    assert not let_in(door, "ann", WORD)
    assert let_in(door, "Schlüssel", "Grüße aus Ölde")
    clock.now += 1.0
    assert let_in(door, "ann", WORD)


def test_an_address_has_to_wait_whatever_name_it_tries(door: Door, clock: Clock) -> None:
    for number in range(FREE_TRIES):
        assert not let_in(door, f"guess{number}", WORD)
    assert not let_in(door, "ann", WORD)
    assert let_in(door, "ann", WORD, "192.0.2.8")
    clock.now += ADDRESS_S
    assert let_in(door, "ann", WORD)


def test_users_that_cannot_be_read_let_nobody_in(users: Users) -> None:
    said: list[str] = []
    audit = Audit(users.path.parent, "opcua", pytest.fail)
    door = Door(None, Authenticator(users, audit), said.append)
    users.path.write_text("nonsense")
    for _ in range(3):
        assert not let_in(door, "ann", WORD)
    assert not door.anybody
    (why,) = said
    assert "not a file of users" in why


def test_a_certificate_is_told_by_its_name(users: Users, tmp_path: Path) -> None:
    known = certificates.make(tmp_path / "person", "panel 7").certificate
    other = certificates.make(tmp_path / "stranger", "nobody").certificate
    pki = tmp_path / "pki"
    (pki / certificates.USERS).mkdir(parents=True)
    der = known.public_bytes(Encoding.DER)
    (pki / certificates.USERS / "panel.der").write_bytes(der)
    audit = Audit(users.path.parent, "opcua", pytest.fail)
    door = Door(pki, Authenticator(users, audit), pytest.fail)
    person = door.get_user(None, certificate=der)
    assert person is not None
    assert person.name is None
    assert door.get_user(None, certificate=other.public_bytes(Encoding.DER)) is None
    assert door.get_user(None) is None
    inside, outside = records(users.path.parent)[0]
    assert (inside["what"], outside["what"]) == ("logged_in", "denied")
    assert inside["who"] == certificates.described(known)
    assert "panel 7" in inside["who"]
    assert "nobody" in outside["who"]


def test_without_users_anybody_may_look_and_has_no_name() -> None:
    door = Door(None, None, pytest.fail)
    assert door.anybody
    person = door.get_user(None)
    assert person is not None
    assert (person.name, person.is_still) == (None, True)
    assert door.get_user(None, "ann", WORD) is None


def test_a_session_is_over_for_who_is_no_user_any_more(users: Users, door: Door) -> None:
    first, second = door.get_user(None, "ann", WORD), door.get_user(None, "Schlüssel", "x" * 10)
    assert isinstance(first, Person)
    assert second is None
    assert first.is_still
    users.set_role("ann", Role.ACKNOWLEDGE)
    assert first.is_still
    users.set_password("ann", "another horse")
    assert not first.is_still
    later = door.get_user(None, "ann", "another horse")
    assert later is not None
    users.remove("ann")
    assert not later.is_still
    users.path.chmod(0o644)
    assert not later.is_still


def test_over_the_wire_the_address_is_told_and_a_removed_user_reads_no_more(users: Users) -> None:
    said: list[str] = []

    async def talk() -> None:
        server = Server(GuardedServer())
        await server.init()
        server.set_endpoint("opc.tcp://127.0.0.1:0/")
        settings = SimpleNamespace(policies=["None"], certificates=None, users=users.path)
        authenticator = authenticator_of(users.path, said.append)
        await secure(server, settings, authenticator, said.append)
        await server.start()
        assert server.bserver is not None
        try:
            await _come_and_stay(f"opc.tcp://127.0.0.1:{server.bserver.port}", users)
        finally:
            await server.stop()

    asyncio.run(talk())
    assert said == []
    told = [(entry["what"], entry["who"], entry["from"]) for entry in records(users.path.parent)[0]]
    assert told == [
        ("wrong_password", "Schlüssel", "127.0.0.1"),
        ("logged_in", "Schlüssel", "127.0.0.1"),
    ]


async def _come_and_stay(url: str, users: Users) -> None:
    with pytest.raises(UaStatusCodeError, match="BadUserAccessDenied"):
        async with _client(url, "Grüße aus Olde"):
            pass
    client = _client(url, "Grüße aus Ölde")
    await client.connect()
    try:
        node = client.get_node(ua.ObjectIds.Server_ServerStatus_State)
        assert await node.read_value() == 0
        users.remove("Schlüssel")
        with pytest.raises((UaStatusCodeError, ServiceError), match="BadUserAccessDenied"):
            await node.read_value()
    finally:
        client.disconnect_socket()


def _client(url: str, password: str) -> Any:
    client = Client(url)
    client.set_user("Schlüssel")
    client.set_password(password)
    return client


def test_a_server_without_users_in_its_file_does_not_begin(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no users, so nobody could come in"):
        authenticator_of(tmp_path / "users.toml", pytest.fail)
    assert authenticator_of(None, pytest.fail) is None
