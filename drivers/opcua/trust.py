"""Validation of a peer's certificate over OPC UA (OPC 10000-4, 6.1.3).

The library checks trust, revocation, key usage and ApplicationUri, but not the host. A certificate
that lies in ``trusted/`` itself is accepted for any host. One that an authority there has signed
must name the host that we connect to.
"""

import ipaddress
import logging
from datetime import datetime
from enum import Enum
from pathlib import Path

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.truststore import TrustStore
from asyncua.crypto.validator import CertificateValidator
from asyncua.crypto.validator import CertificateValidatorOptions as _Options
from cryptography import x509

from drivers.opcua import certificates
from twin.errors import SourceError

# We report what it refuses; it would log a traceback.
logging.getLogger("asyncuagds.validate").setLevel(logging.CRITICAL)


class Peer(Enum):
    """The role of the peer."""

    CLIENT = _Options.PEER_CLIENT
    SERVER = _Options.PEER_SERVER


_FAULTS = {  # what is wrong, and what to do
    ua.StatusCodes.BadCertificateUriInvalid: (
        "does not name the application that it came from",
        "have a certificate made for the ApplicationUri that it tells",
    ),
    ua.StatusCodes.BadCertificateUseNotAllowed: (
        "is for another use: its key usage does not fit",
        "have one made for OPC UA: signature, non-repudiation, encryption of keys and data, and"
        " authentication of servers or clients",
    ),
    ua.StatusCodes.BadCertificateInvalid: (
        "lacks what OPC UA wants: alternative names, key usage, extended key usage",
        "have one made for OPC UA",
    ),
    ua.StatusCodes.BadCertificateRevoked: (
        "was revoked by its authority",
        "give it a new certificate, and find out why",
    ),
}


async def check(
    certificate: x509.Certificate,
    application: ua.ApplicationDescription,
    folder: Path,
    now: datetime,
    owner: str,
    peer: Peer,
    host: str = "",
) -> None:
    """SourceError if the certificate of ``owner`` is not to be trusted.

    ``application`` is the peer's own description; ``host`` is where we look for a server.
    """
    subject = f"{owner}: its certificate ({certificates.described(certificate)})"
    certificates.check_time(certificate, now, subject)
    options = _Options.TRUSTED_VALIDATION & ~_Options.TIME_RANGE | peer.value
    validator = CertificateValidator(options, await _store(folder))
    try:
        await validator.validate(certificate, application)
    except ServiceError as error:
        if error.code == ua.StatusCodes.BadCertificateUntrusted:
            raise certificates.untrusted(certificate, folder, subject) from error
        fault, hint = _FAULTS[error.code]
        raise SourceError(f"{subject} {fault}", hint) from error
    is_pinned = certificates.lies_in_trusted(certificate, folder)
    if host and not is_pinned and not _is_for(certificate, host):
        raise SourceError(
            f"{subject} is not for {host}",
            f"have one made for that name, or put this very certificate into"
            f" {folder / certificates.TRUSTED}",
        )


async def _store(folder: Path) -> TrustStore:
    """The folder's present content; SourceError if a file there is unusable."""
    trusted, revoked = folder / certificates.TRUSTED, folder / certificates.REVOKED
    store = TrustStore([trusted], [revoked])
    try:
        await store.load_crl()
        if any(trusted.glob("*.*")):  # else nobody is trusted, and there is nothing to load
            await store.load_trust()
    except (ValueError, OSError) as error:
        raise SourceError(
            f"{folder}: {trusted.name} or {revoked.name} cannot be used: {error}",
            f"only certificates lie in {trusted.name}, and only revocation lists in"
            f" {revoked.name}: *.der or *.pem",
        ) from error
    return store


def _is_for(certificate: x509.Certificate, host: str) -> bool:
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    try:
        return ipaddress.ip_address(host) in names.get_values_for_type(x509.IPAddress)
    except ValueError:  # a name
        listed = {name.lower() for name in names.get_values_for_type(x509.DNSName)}
        return host.lower() in listed
