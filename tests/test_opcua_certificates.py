"""Certificates in a folder: made, kept apart, believed only if a person put them there."""

import asyncio
import ipaddress
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from asyncua import ua
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from drivers.opcua import certificates
from drivers.opcua.trust import Peer, check
from twin.cli.cert import cert
from twin.errors import ConfigError, SourceError

NOW = datetime.now(UTC)
DAY = timedelta(days=1)
URI = "urn:works:plc"
BOTH = (ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH)
Key = rsa.RSAPrivateKey
DER, PEM = serialization.Encoding.DER, serialization.Encoding.PEM


@pytest.fixture(scope="module")
def keys() -> list[Key]:
    return [rsa.generate_private_key(public_exponent=65537, key_size=2048) for _ in range(3)]


def save(
    folder: Path,
    one: x509.Certificate | x509.CertificateRevocationList,
    place: str = certificates.TRUSTED,
    kind: serialization.Encoding = DER,
) -> None:
    path = folder / place / ("c.pem" if kind is PEM else "c.der")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(one.public_bytes(kind))


def named(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def begun(subject: str, key: Key) -> x509.CertificateBuilder:
    """What all certificates of the works have."""
    return (
        x509.CertificateBuilder(named("works"), named(subject), key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(NOW - DAY)
        .not_valid_after(NOW + 30 * DAY)
    )


def authority(key: Key, *, ca: bool = True) -> x509.Certificate:
    identifier = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    return (
        begun("works", key)
        .add_extension(x509.BasicConstraints(ca=ca, path_length=None), critical=True)
        .add_extension(identifier, critical=False)
        .sign(key, hashes.SHA256())
    )


def issued(
    key: Key,
    by: Key,
    *,
    uri: str = URI,
    host: str = "plc.works",
    use: tuple[x509.ObjectIdentifier, ...] = BOTH,
    encipherment: bool = True,
) -> x509.Certificate:
    usage = [True, True, encipherment, encipherment, False, False, False, False, False]
    names = [
        x509.UniformResourceIdentifier(uri),
        x509.DNSName(host),
        x509.IPAddress(ipaddress.ip_address("10.0.0.5")),
    ]
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(by.public_key())
    return (
        begun("plc", key)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.KeyUsage(*usage), critical=True)
        .add_extension(x509.ExtendedKeyUsage(use), critical=False)
        .add_extension(issuer, critical=False)
        .sign(by, hashes.SHA256())
    )


def revoking(certificate: x509.Certificate, by: Key) -> x509.CertificateRevocationList:
    revoked = (
        x509.RevokedCertificateBuilder()
        .serial_number(certificate.serial_number)
        .revocation_date(NOW - DAY)
        .build()
    )
    return (
        x509.CertificateRevocationListBuilder()
        .issuer_name(named("works"))
        .last_update(NOW - DAY)
        .next_update(NOW + 30 * DAY)
        .add_revoked_certificate(revoked)
        .sign(by, hashes.SHA256())
    )


def believe(
    certificate: x509.Certificate,
    folder: Path,
    *,
    now: datetime = NOW,
    uri: str = URI,
    peer: Peer = Peer.SERVER,
    host: str = "plc.works",
) -> None:
    server, client = ua.ApplicationType.Server, ua.ApplicationType.Client
    kind = server if peer is Peer.SERVER else client
    application = ua.ApplicationDescription(ApplicationUri=uri, ApplicationType=kind)
    host = host if peer is Peer.SERVER else ""
    asyncio.run(check(certificate, application, folder, now, "plc", peer, host))


def self_signed(key: Key, begin: datetime = NOW - DAY) -> tuple[x509.Certificate, str]:
    certificate = certificates.signed(key, "plc", begin, 30)
    return certificate, certificates.Own(certificate, Path(), Path()).uri


def test_twin_cert_makes_what_servers_want(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cert(tmp_path / "pki", "line 3")
    own = certificates.own(tmp_path / "pki", NOW)
    said = capsys.readouterr().out
    assert str(own.path) in said
    assert own.certificate.fingerprint(hashes.SHA1()).hex().upper() in said
    assert own.uri.startswith("urn:")
    assert own.uri.endswith(":line-3")
    assert stat.S_IMODE(own.key.stat().st_mode) == 0o600
    usage = own.certificate.extensions.get_extension_for_class(x509.KeyUsage).value
    assert usage.digital_signature
    assert usage.data_encipherment


def test_twin_cert_replaces_a_certificate_with_force_alone(
    tmp_path: Path, keys: list[Key], capsys: pytest.CaptureFixture[str]
) -> None:
    pki = tmp_path / "pki"
    cert(pki, "line 3")
    save(pki, self_signed(keys[0])[0])
    first = certificates.own(pki, NOW)
    first.key.chmod(0o644)
    with pytest.raises(SourceError, match="already a file of that name") as refused:
        cert(pki, "line 3")
    assert "--force" in refused.value.hint
    assert certificates.own(pki, NOW).certificate == first.certificate
    cert(pki, "line 3", force=True)
    assert certificates.own(pki, NOW).certificate != first.certificate
    assert stat.S_IMODE(first.key.stat().st_mode) == 0o600
    assert (pki / certificates.TRUSTED / "c.der").exists()


def test_what_is_said_of_a_certificate_that_cannot_be_used_replaces_it(tmp_path: Path) -> None:
    cert(tmp_path / "pki")
    with pytest.raises(ConfigError, match="expired on") as expired:
        certificates.own(tmp_path / "pki", NOW + (certificates.DAYS + 1) * DAY)
    assert expired.value.hint.endswith(f"twin cert {tmp_path / 'pki'} --force")


@pytest.mark.parametrize("kind", [DER, PEM])
@pytest.mark.parametrize("peer", Peer)
def test_who_lies_in_trusted_is_trusted(
    tmp_path: Path, keys: list[Key], kind: serialization.Encoding, peer: Peer
) -> None:
    known, uri = self_signed(keys[0])
    other, _ = self_signed(keys[0])
    save(tmp_path, known, kind=kind)
    believe(known, tmp_path, uri=uri, peer=peer, host="10.9.9.9")  # known as it is, wherever
    with pytest.raises(SourceError, match="is not trusted"):  # the same name and key are not enough
        believe(other, tmp_path, uri=uri, peer=peer)
    assert len(list((tmp_path / certificates.REJECTED).iterdir())) == 1


@pytest.mark.parametrize(
    ("days", "message"), [(-40, "expired on"), (3, "is valid only from")], ids=["old", "early"]
)
def test_a_trusted_certificate_out_of_date_is_refused(
    tmp_path: Path, keys: list[Key], days: int, message: str
) -> None:
    certificate, uri = self_signed(keys[0], NOW + days * DAY)
    save(tmp_path, certificate)
    with pytest.raises(SourceError, match=message):
        believe(certificate, tmp_path, uri=uri)


@pytest.mark.parametrize("ca", [True, False])
def test_an_authority_vouches_only_if_it_is_one(tmp_path: Path, keys: list[Key], ca: bool) -> None:
    save(tmp_path, authority(keys[0], ca=ca))
    plc, forged = issued(keys[1], keys[0]), issued(keys[1], keys[2])
    if ca:
        believe(plc, tmp_path)
    else:
        with pytest.raises(SourceError, match="is not trusted"):
            believe(plc, tmp_path)
    with pytest.raises(SourceError, match="is not trusted"):
        believe(forged, tmp_path)


@pytest.mark.parametrize("host", ["plc.works", "PLC.works", "10.0.0.5"])
def test_what_an_authority_signed_is_for_its_host(
    tmp_path: Path, keys: list[Key], host: str
) -> None:
    save(tmp_path, authority(keys[0]))
    believe(issued(keys[1], keys[0]), tmp_path, host=host)


@pytest.mark.parametrize("host", ["other.works", "plc.works.evil", "10.0.0.6"])
def test_another_machine_of_the_same_authority_is_not_the_plc(
    tmp_path: Path, keys: list[Key], host: str
) -> None:
    save(tmp_path, authority(keys[0]))
    with pytest.raises(SourceError, match=f"is not for {host}"):
        believe(issued(keys[1], keys[0]), tmp_path, host=host)


@pytest.mark.parametrize("peer", Peer)
def test_an_application_speaks_for_itself_alone(
    tmp_path: Path, keys: list[Key], peer: Peer
) -> None:
    save(tmp_path, authority(keys[0]))
    with pytest.raises(SourceError, match="does not name the application"):
        believe(issued(keys[1], keys[0]), tmp_path, uri="urn:works:other", peer=peer)


@pytest.mark.parametrize("peer", Peer)
def test_a_certificate_for_another_use_is_refused(
    tmp_path: Path, keys: list[Key], peer: Peer
) -> None:
    save(tmp_path, authority(keys[0]))
    other = BOTH[0] if peer is Peer.SERVER else BOTH[1]
    for wrong in (
        issued(keys[1], keys[0], use=(other,)),
        issued(keys[1], keys[0], encipherment=False),
    ):
        with pytest.raises(SourceError, match="is for another use"):
            believe(wrong, tmp_path, peer=peer)


@pytest.mark.parametrize("kind", [DER, PEM])
def test_a_revoked_certificate_is_refused(
    tmp_path: Path, keys: list[Key], kind: serialization.Encoding
) -> None:
    save(tmp_path, authority(keys[0]))
    lost, sound = issued(keys[1], keys[0]), issued(keys[1], keys[0])
    believe(lost, tmp_path)
    save(tmp_path, revoking(lost, keys[0]), certificates.REVOKED, kind)
    with pytest.raises(SourceError, match="was revoked"):
        believe(lost, tmp_path)
    believe(sound, tmp_path)


@pytest.mark.parametrize("place", [certificates.TRUSTED, certificates.REVOKED])
@pytest.mark.parametrize(
    ("name", "content"), [("a.der", b"\x30\x82"), ("b.pem", b"-----BEGIN"), ("c.der", b"")]
)
def test_a_file_that_is_of_no_use_is_told_and_trusts_nobody(
    tmp_path: Path, keys: list[Key], place: str, name: str, content: bytes
) -> None:
    certificate, uri = self_signed(keys[0])
    (tmp_path / place).mkdir()
    (tmp_path / place / name).write_bytes(content)
    with pytest.raises(SourceError, match="cannot be used"):
        believe(certificate, tmp_path, uri=uri)


def test_nobody_is_trusted_where_nobody_is_known(tmp_path: Path, keys: list[Key]) -> None:
    certificate, uri = self_signed(keys[0])
    with pytest.raises(SourceError, match="is not trusted"):
        believe(certificate, tmp_path, uri=uri)


def test_our_own_that_is_none_is_told(tmp_path: Path) -> None:
    certificates.make(tmp_path)
    (tmp_path / certificates.OWN).write_bytes(b"none")
    with pytest.raises(ConfigError, match="is no certificate"):
        certificates.own(tmp_path, NOW)
