"""A small SMTP server (RFC 5321) on loopback, with STARTTLS, implicit TLS and AUTH.

It shares no code with the client in the standard library. A test says what it refuses.
"""

import base64
import ipaddress
import socket
import ssl
import threading
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from email import message_from_bytes, policy
from email.message import EmailMessage
from pathlib import Path
from typing import cast

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID


class SmtpServer:
    """Takes one client after the other, in a thread; ``mails`` are those that it has taken."""

    def __init__(
        self,
        *,
        port: int = 0,
        certificate: Path | None = None,
        implicit: bool = False,
        password: str = "",
    ) -> None:
        self.mails: list[EmailMessage] = []
        self.envelopes: list[tuple[str, str]] = []  # sender and recipient of each
        self.commands: list[tuple[str, bool]] = []  # each command, and whether it came inside TLS
        self.answers: dict[str, str] = {}  # by begin of a command: the reply in place of the usual
        self._password, self._implicit = password, implicit
        self._context: ssl.SSLContext | None = None
        if certificate is not None:
            self._context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
            self._context.load_cert_chain(certificate)
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = int(self._listener.getsockname()[1])
        self._client: socket.socket | None = None
        self._thread = threading.Thread(target=self._serve, name="smtp server")
        self._thread.start()

    @property
    def subjects(self) -> list[str]:
        return [str(mail["Subject"]) for mail in self.mails]

    def close(self) -> None:
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        if self._client is not None:
            with suppress(OSError):
                self._client.shutdown(socket.SHUT_RDWR)
        self._thread.join()

    def _serve(self) -> None:
        while True:
            try:
                self._client, _ = self._listener.accept()
            except OSError:  # closed
                return
            with suppress(OSError, EOFError), self._client:
                self._talk(self._client)

    def _talk(self, plain: socket.socket) -> None:
        sock, is_inside = plain, False
        if self._implicit:
            assert self._context is not None
            sock, is_inside = self._context.wrap_socket(plain, server_side=True), True
        try:
            _reply(sock, "220 here")
            while True:
                command = _line(sock)
                self.commands.append((command, is_inside))
                if command.upper() == "STARTTLS" and self._context is not None:
                    _reply(sock, "220 go ahead")
                    sock, is_inside = self._context.wrap_socket(plain, server_side=True), True
                    continue
                _reply(sock, self._answer(sock, command, is_inside))
                if command.upper() == "QUIT":
                    return
        finally:
            sock.close()

    def _answer(self, sock: socket.socket, command: str, is_inside: bool) -> str:
        for begin, answer in self.answers.items():
            if command.lower().startswith(begin.lower()):
                return answer
        verb = command.upper().partition(" ")[0]
        match verb:
            case "EHLO":
                offers = ["here", "8BITMIME"]
                offers += ["STARTTLS"] if self._context and not is_inside else []
                offers += ["AUTH PLAIN"] if self._password else []
                return "\r\n".join(
                    f"250{'-' if number < len(offers) else ' '}{offer}"
                    for number, offer in enumerate(offers, 1)
                )
            case "AUTH":
                given = base64.b64decode(command.split()[2]).decode()
                is_right = given == f"\0twin\0{self._password}"
                return "235 come in" if is_right else "535 no such user"
            case "MAIL":
                self._sender = command.partition("<")[2].partition(">")[0]
            case "RCPT":
                self._recipient = command.partition("<")[2].partition(">")[0]
            case "DATA":
                _reply(sock, "354 speak")
                self._take(sock)
            case "QUIT":
                return "221 bye"
        return "250 fine"

    def _take(self, sock: socket.socket) -> None:
        lines: list[str] = []
        while (line := _line(sock)) != ".":
            lines.append(line.removeprefix(".") if line.startswith("..") else line)
        mail = message_from_bytes("\r\n".join(lines).encode(), policy=policy.default)
        self.envelopes.append((self._sender, self._recipient))
        self.mails.append(cast(EmailMessage, mail))


def _line(sock: socket.socket) -> str:
    """One line, read byte by byte: what follows may be a handshake."""
    line = b""
    while not line.endswith(b"\r\n"):
        if not (byte := sock.recv(1)):
            raise EOFError
        line += byte
    return line[:-2].decode()


def _reply(sock: socket.socket, text: str) -> None:
    sock.sendall(f"{text}\r\n".encode())


def certificate(folder: Path) -> Path:
    """A self-signed certificate of 127.0.0.1 with its key, as PEM."""
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "mail")])
    names = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    signed = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + timedelta(days=2))
        .add_extension(names, critical=False)
        .sign(key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    private = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    path = folder / "mail.pem"
    path.write_bytes(signed.public_bytes(pem) + key.private_bytes(pem, *private))
    return path
