"""Certificates in a folder: our own with its key, trusted ones, rejected ones.

``own/certificate.der`` and ``own/key.pem`` identify us. ``trusted/`` holds the certificates that we
trust, or those of authorities that sign them; lists in ``revoked/`` withdraw them. A rejected
certificate is kept in ``rejected/``, so that a person can look at it and move it.
"""

import socket
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from twin.errors import ConfigError, SourceError
from twin.files import refuse_existing

OWN, KEY = Path("own") / "certificate.der", Path("own") / "key.pem"
TRUSTED, REVOKED, REJECTED = "trusted", "revoked", "rejected"
USERS = "users"  # of a server: those of the persons that it lets in
KEY_BITS = 2048
DAYS = 5 * 365
CLOCK_SKEW = timedelta(days=1)  # of a PLC that is behind: it would find a fresh one not yet valid


@dataclass(frozen=True)
class Own:
    """Our own certificate, and where it and its key are."""

    certificate: x509.Certificate
    path: Path
    key: Path

    @property
    def uri(self) -> str:
        """The application that it names; "" if it names none."""
        names = _alternative_names(self.certificate)
        return next(iter(names.get_values_for_type(x509.UniformResourceIdentifier)), "")


def make(folder: Path, name: str = "ejector-twin", days: int = DAYS, *, force: bool = False) -> Own:
    """Make a certificate of our own and its key; SourceError if one would be replaced unforced."""
    path = folder / OWN
    for existing in (path, folder / KEY):
        refuse_existing(existing, force=force)
    for subfolder in (path.parent, *(folder / name for name in (TRUSTED, REVOKED, REJECTED))):
        subfolder.mkdir(parents=True, exist_ok=True)
    key = rsa.generate_private_key(public_exponent=65537, key_size=KEY_BITS)
    _write_key(folder / KEY, key)
    certificate = signed(key, name, datetime.now(UTC) - CLOCK_SKEW, days)
    path.write_bytes(certificate.public_bytes(serialization.Encoding.DER))
    return Own(certificate, path, folder / KEY)


def _write_key(path: Path, key: rsa.RSAPrivateKey) -> None:
    path.unlink(missing_ok=True)  # it may be readable for others
    path.touch(mode=0o600)  # before it holds the key
    path.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )


def signed(key: rsa.RSAPrivateKey, name: str, begin: datetime, days: int) -> x509.Certificate:
    """A self-signed certificate of an OPC UA application (OPC 10000-6, 6.2.2)."""
    host = socket.gethostname()
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    public = key.public_key()
    identifier = x509.SubjectKeyIdentifier.from_public_key(public)
    usage = x509.KeyUsage(
        digital_signature=True,
        content_commitment=True,
        key_encipherment=True,
        data_encipherment=True,
        key_agreement=False,
        key_cert_sign=True,  # itself
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )
    extensions: list[tuple[x509.ExtensionType, bool]] = [
        (_names(name, host), False),
        (x509.BasicConstraints(ca=False, path_length=None), True),
        (usage, True),
        (
            x509.ExtendedKeyUsage(
                [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]
            ),
            False,
        ),
        (identifier, False),
        (x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(identifier), False),
    ]
    builder = x509.CertificateBuilder(
        issuer_name=subject,
        subject_name=subject,
        public_key=public,
        serial_number=x509.random_serial_number(),
        not_valid_before=begin,
        not_valid_after=begin + timedelta(days=days),
    )
    for extension, critical in extensions:
        builder = builder.add_extension(extension, critical)
    return builder.sign(key, hashes.SHA256())


def _names(name: str, host: str) -> x509.SubjectAlternativeName:
    uri = f"urn:{host}:{name}".replace(" ", "-")
    return x509.SubjectAlternativeName([x509.UniformResourceIdentifier(uri), x509.DNSName(host)])


def _alternative_names(certificate: x509.Certificate) -> x509.SubjectAlternativeName:
    try:
        kind = x509.SubjectAlternativeName
        return certificate.extensions.get_extension_for_class(kind).value
    except (x509.ExtensionNotFound, ValueError):
        return x509.SubjectAlternativeName([])


def own(folder: Path, now: datetime) -> Own:
    """Our own certificate; ConfigError if it is missing, unreadable, or out of date."""
    path, key = folder / OWN, folder / KEY
    command = f"make one: twin cert {folder}"
    if not (path.is_file() and key.is_file()):
        raise ConfigError(f"{folder}: there is no certificate of our own", command)
    certificate = _read(path)
    if certificate is None:
        raise ConfigError(f"{path} is no certificate", f"{command} --force")
    if not _in_time(certificate, now):
        raise ConfigError(
            f"{path}: our own certificate {_when(certificate, now)}", f"{command} --force"
        )
    return Own(certificate, path, key)


def check_time(certificate: x509.Certificate, now: datetime, subject: str) -> None:
    """SourceError if the certificate is out of date; ``subject`` names it in the message."""
    if not _in_time(certificate, now):
        raise SourceError(
            f"{subject} {_when(certificate, now)}",
            "give it a new certificate, or set its clock and ours",
        )


def untrusted(certificate: x509.Certificate, folder: Path, subject: str) -> SourceError:
    """The error for an untrusted certificate, which is kept for a person to look at."""
    path = _keep(certificate, folder)
    return SourceError(
        f"{subject} is not trusted",
        f"if the fingerprint is the one that it shows: mv {path} {folder / TRUSTED}/",
    )


def lies_in_trusted(certificate: x509.Certificate, folder: Path) -> bool:
    """Whether the certificate itself is in ``trusted/``, not only its authority."""
    return certificate in [_read(path) for path in (folder / TRUSTED).glob("*.*")]


def described(certificate: x509.Certificate) -> str:
    """Its name and fingerprint, as servers show them."""
    fingerprint = certificate.fingerprint(hashes.SHA1()).hex().upper()  # noqa: S303 - as shown
    return f"{certificate.subject.rfc4514_string()}, SHA1 {fingerprint}"


def _keep(certificate: x509.Certificate, folder: Path) -> Path:
    fingerprint = certificate.fingerprint(hashes.SHA1()).hex().upper()  # noqa: S303 - as shown
    path = folder / REJECTED / f"{fingerprint}.der"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(certificate.public_bytes(serialization.Encoding.DER))
    return path


def _read(path: Path) -> x509.Certificate | None:
    """A certificate from a DER or PEM file; None if it is none."""
    content = path.read_bytes()
    try:
        if content.startswith(b"-----BEGIN"):
            return x509.load_pem_x509_certificate(content)
        return x509.load_der_x509_certificate(content)
    except ValueError:
        return None


def _in_time(certificate: x509.Certificate, now: datetime) -> bool:
    return certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc


def _when(certificate: x509.Certificate, now: datetime) -> str:
    if now < certificate.not_valid_before_utc:
        return f"is valid only from {certificate.not_valid_before_utc:%Y-%m-%d} on"
    return f"expired on {certificate.not_valid_after_utc:%Y-%m-%d}"
