"""Whether the certificate of a partner over OPC UA is believed (OPC 10000-4, 6.1.3).

Trust, revocation, key usage and ApplicationUri are the library's. It has no check of the host: a
certificate that lies in ``trusted/`` itself is known as it is, and one that an authority there has
signed must name the host that we speak to.
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

# What it refuses is said by us; it would write a traceback.
logging.getLogger("asyncuagds.validate").setLevel(logging.CRITICAL)


class Peer(Enum):
    """What the partner is."""

    CLIENT = _Options.PEER_CLIENT
    SERVER = _Options.PEER_SERVER


_WHY = {  # what is wrong, and what to do
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
    whose: str,
    peer: Peer,
    host: str = "",
) -> None:
    """SourceError where the certificate of ``whose`` is not to be believed.

    ``application`` is what it says of itself; ``host`` where we look for a server.
    """
    who = f"{whose}: its certificate ({certificates.described(certificate)})"
    certificates.check_time(certificate, now, who)
    options = _Options.TRUSTED_VALIDATION & ~_Options.TIME_RANGE | peer.value
    validator = CertificateValidator(options, await _store(folder))
    try:
        await validator.validate(certificate, application)
    except ServiceError as error:
        if error.code == ua.StatusCodes.BadCertificateUntrusted:
            raise certificates.untrusted(certificate, folder, who) from error
        why, hint = _WHY[error.code]
        raise SourceError(f"{who} {why}", hint) from error
    is_pinned = certificates.lies_in_trusted(certificate, folder)
    if host and not is_pinned and not _is_for(certificate, host):
        raise SourceError(
            f"{who} is not for {host}",
            f"have one made for that name, or put this very certificate into"
            f" {folder / certificates.TRUSTED}",
        )


async def _store(folder: Path) -> TrustStore:
    """What lies in the folder now; SourceError where a file there is of no use."""
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
        known = {name.lower() for name in names.get_values_for_type(x509.DNSName)}
        return host.lower() in known
