"""Modbus/TCP Security: the same messages inside TLS, to a PLC whose certificate we trust.

The PLC proves itself by its own certificate or that of the authority that signed it, and its name.
"""

import socket
import ssl
from pathlib import Path

from drivers.reconnect import LostError
from twin.errors import ConfigError, SourceError
from twin.tls import OwnCertificate

PORT = 802  # registered for Modbus/TCP Security

# OpenSSL's reasons to reject a certificate (X509_V_ERR_…), as people can put them right.
_NOT_YET, _EXPIRED, _WRONG_NAME, _WRONG_ADDRESS = 9, 10, 62, 64
HANDSHAKE_S = 2.0  # longest handshake; a PLC's processor is slow


class PlcTls(OwnCertificate):
    """Protection of the connection to the PLC; without this table there is none."""

    trusted: Path  # PEM: the PLC's certificate, or the authority's that signed it
    name: str = ""  # name in the PLC's certificate; "" means the host

    def below(self, folder: Path) -> "PlcTls":
        """Give the same with files looked for in ``folder``, unless their paths are absolute."""
        paths = {key: getattr(self, key) for key in ("trusted", "certificate", "key")}
        resolved = {key: folder / path for key, path in paths.items() if path is not None}
        return self.model_copy(update=resolved)


def secured(connection: socket.socket, tls: PlcTls, address: str) -> ssl.SSLSocket:
    """Do the TLS handshake on ``connection`` to ``address`` (host:port); closes it on failure.

    SourceError if the PLC's certificate is not trusted or the PLC rejects ours, LostError if it
    does not speak TLS, ConfigError if our own files cannot be used.
    """
    try:
        context = _context(tls)
        connection.settimeout(HANDSHAKE_S)
        return context.wrap_socket(connection, server_hostname=tls.name or _host(address))
    except OSError as error:
        connection.close()
        raise _explained(error, tls, address) from error
    except BaseException:
        connection.close()
        raise


def rejection(error: Exception, address: str, *, has_answered: bool) -> SourceError | None:
    """The error if the PLC rejects our certificate, which TLS 1.3 reports only after a request.

    ``error`` is that of a lost connection. LostError if it was lost before the first answer without
    a reason; None if it was lost later.
    """
    for cause in (error, error.__context__):  # pymodbus wraps errors of sending
        if isinstance(cause, ssl.SSLError) and _refuses(cause):
            return _unwanted(address)
    return None if has_answered else _unwanted(address, LostError)


def _host(address: str) -> str:
    return address.rpartition(":")[0]


# --- our own files ------------------------------------------------------------------------------


def _context(tls: PlcTls) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_2  # as the protocol has it
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # the PLC's own certificate is enough
    try:
        context.load_verify_locations(cadata=_certificates(tls.trusted))
    except (OSError, ValueError) as error:
        raise _unusable("trusted", tls.trusted, error) from error
    if tls.certificate and tls.key:
        try:
            context.load_cert_chain(tls.certificate, tls.key, password=lambda: "")
        except (OSError, ValueError) as error:
            raise _unusable("certificate and key", tls.certificate, error) from error
    return context


def _certificates(path: Path) -> str | bytes:
    """Text if it is PEM, bytes if DER, as the library takes them."""
    content = path.read_bytes()
    return content.decode("ascii") if b"-----BEGIN" in content else content


def _unusable(key: str, path: Path, error: Exception) -> ConfigError:
    return ConfigError(
        f"[driver.tls] {key} {path}: cannot be used: {error}",
        "trusted: PEM or DER; certificate and key: PEM, the key without a password",
    )


# --- errors of a connection ---------------------------------------------------------------------


def _explained(error: OSError, tls: PlcTls, address: str) -> SourceError:
    if isinstance(error, ssl.SSLCertVerificationError):
        return _untrusted(error, tls, address)
    if isinstance(error, ssl.SSLError) and _refuses(error):
        return _unwanted(address)
    return LostError(
        f"{address}: it does not speak TLS",
        f"is it the secure port (often {PORT}), and is the PLC awake? For a PLC "
        "that speaks plain Modbus TCP leave [driver.tls] out",
    )


def _untrusted(error: ssl.SSLCertVerificationError, tls: PlcTls, address: str) -> SourceError:
    name = tls.name or _host(address)
    if error.verify_code in (_WRONG_NAME, _WRONG_ADDRESS):
        return SourceError(
            f"{address}: its certificate is not for {name}",
            "if it is the right PLC, set name in [driver.tls] to the one in its certificate",
        )
    if error.verify_code in (_EXPIRED, _NOT_YET):
        cause = "has expired" if error.verify_code == _EXPIRED else "is not valid yet"
        return SourceError(
            f"{address}: its certificate {cause}",
            "give the PLC a new certificate, or set its clock and ours",
        )
    return SourceError(
        f"{address}: its certificate is not trusted ({error.verify_message})",
        f"if it is the right PLC, put its certificate, or its authority's, into {tls.trusted}",
    )


def _refuses(error: ssl.SSLError) -> bool:
    """Whether the PLC refused by a TLS alert, and the error is no other."""
    return "_ALERT_" in (error.reason or "")


def _unwanted(address: str, kind: type[SourceError] = SourceError) -> SourceError:
    return kind(
        f"{address}: it does not trust our certificate, or requires one",
        "set certificate and key in [driver.tls], and let the PLC trust them",
    )
