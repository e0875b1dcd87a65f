"""Certificates in a folder: made, kept apart, believed only if a person put them there."""

import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import NameOID

from drivers import certificates
from twin.cli_cert import cert
from twin.errors import ConfigError, SourceError

NOW = datetime.now(UTC)


@pytest.fixture(scope="module")
def keys() -> list[rsa.RSAPrivateKey]:
    return [rsa.generate_private_key(public_exponent=65537, key_size=2048) for _ in range(2)]


def save(folder: Path, certificate: x509.Certificate, *, pem: bool = False) -> None:
    kind = serialization.Encoding.PEM if pem else serialization.Encoding.DER
    path = folder / certificates.TRUSTED / ("c.pem" if pem else "c.der")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(certificate.public_bytes(kind))


def issued(
    key: rsa.RSAPrivateKey, issuer: str, by: rsa.RSAPrivateKey, name: str, *, ca: bool
) -> x509.Certificate:
    def named(text: str) -> x509.Name:
        return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])

    return (
        x509.CertificateBuilder(named(issuer), named(name), key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(NOW - timedelta(days=1))
        .not_valid_after(NOW + timedelta(days=30))
        .add_extension(x509.BasicConstraints(ca=ca, path_length=None), critical=True)
        .sign(by, hashes.SHA256())
    )


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
    with pytest.raises(ConfigError, match="is there already"):
        cert(tmp_path / "pki", "again")


@pytest.mark.parametrize("pem", [False, True])
def test_who_lies_in_trusted_is_trusted(
    tmp_path: Path, keys: list[rsa.RSAPrivateKey], pem: bool
) -> None:
    known = certificates.signed(keys[0], "plc", NOW - timedelta(days=1), 30)
    other = certificates.signed(keys[0], "plc", NOW - timedelta(days=1), 30)
    save(tmp_path, known, pem=pem)
    certificates.check(known, tmp_path, NOW, "plc")
    with pytest.raises(SourceError, match="is not trusted"):  # the same name and key are not enough
        certificates.check(other, tmp_path, NOW, "plc")
    assert len(list((tmp_path / certificates.REJECTED).iterdir())) == 1


@pytest.mark.parametrize(
    ("days", "message"), [(-40, "expired on"), (3, "is valid only from")], ids=["old", "early"]
)
def test_a_trusted_certificate_out_of_date_is_refused(
    tmp_path: Path, keys: list[rsa.RSAPrivateKey], days: int, message: str
) -> None:
    certificate = certificates.signed(keys[0], "plc", NOW + timedelta(days=days), 30)
    save(tmp_path, certificate)
    with pytest.raises(SourceError, match=message):
        certificates.check(certificate, tmp_path, NOW, "plc")


@pytest.mark.parametrize("ca", [True, False])
def test_an_authority_vouches_only_if_it_is_one(
    tmp_path: Path, keys: list[rsa.RSAPrivateKey], ca: bool
) -> None:
    authority = issued(keys[0], "works", keys[0], "works", ca=ca)
    plc = issued(keys[1], "works", keys[0], "plc", ca=False)
    forged = issued(keys[1], "works", keys[1], "plc", ca=False)
    save(tmp_path, authority)
    assert certificates.trusted(plc, tmp_path, NOW) == ca
    assert not certificates.trusted(forged, tmp_path, NOW)
    assert not certificates.trusted(plc, tmp_path, NOW + timedelta(days=60))


def test_files_that_are_no_certificates_trust_nobody(
    tmp_path: Path, keys: list[rsa.RSAPrivateKey]
) -> None:
    for name, content in (("a.der", b"\x30\x82"), ("b.pem", b"-----BEGIN"), ("c.txt", b"")):
        (tmp_path / certificates.TRUSTED).mkdir(exist_ok=True)
        (tmp_path / certificates.TRUSTED / name).write_bytes(content)
    certificate = certificates.signed(keys[0], "plc", NOW - timedelta(days=1), 30)
    assert not certificates.trusted(certificate, tmp_path, NOW)


def test_our_own_that_is_none_is_told(tmp_path: Path) -> None:
    certificates.make(tmp_path)
    (tmp_path / certificates.OWN).write_bytes(b"none")
    with pytest.raises(ConfigError, match="is no certificate"):
        certificates.own(tmp_path, NOW)
