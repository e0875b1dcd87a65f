"""Hands letters to a mail server over SMTP, several in one connection."""

import smtplib
import ssl
from collections.abc import Iterable
from contextlib import suppress
from email.headerregistry import Address
from email.message import EmailMessage
from email.policy import SMTP
from email.utils import format_datetime
from pathlib import Path
from typing import NamedTuple, cast

from twin.notifications.deadline import whole_within
from twin.notifications.message import Message
from twin.notifications.people import local_time
from twin.notifications.sender import LostError, Sent
from twin.notifications.settings import EmailSettings
from twin.secret import Say

PORTS = {"starttls": 587, "tls": 465, "none": 25}
LONGEST_SUBJECT = 200  # characters; mail programs show fewer
PERMANENT = 500  # from this status on a server refuses for good


class Letter(NamedTuple):
    """What one person is to read."""

    name: str
    address: str
    subject: str
    text: str


class MailServer:
    """A mail server. Paths are relative to ``folder``.

    ConfigError if a secret or certificate cannot be used.
    """

    def __init__(self, settings: EmailSettings, folder: Path, say: Say) -> None:
        self._settings = settings
        secret, table = settings.password, "notifications.email"
        self._password = secret.read(f"[{table}] password", folder, say) if secret else ""
        self._tls: ssl.SSLContext | None = None
        if settings.encryption != "none":
            self._tls = settings.tls.context(table, folder)
        self._port = settings.port or PORTS[settings.encryption]
        self._where = f"mail server {settings.host}:{self._port}"

    def send(self, letters: Iterable[tuple[Message, Letter]], now_ns: int) -> Sent:
        """Hand over letters; one that is put off does not hold up the others."""
        sent = Sent()
        try:
            client = self._connect()
        except LostError as error:
            sent.lost = error
            return sent
        try:
            for message, letter in letters:
                try:
                    refusal = self._hand_over(client, self._mail(message, letter, now_ns))
                except _PutOffError as error:
                    sent.lost = error
                    continue
                if refusal:
                    sent.refused[message.id] = refusal
                else:
                    sent.delivered.append(message)
        except LostError as error:
            sent.lost = error
        finally:
            _hang_up(client)
        return sent

    def _connect(self) -> smtplib.SMTP:
        """A connection that is protected and logged in; LostError if there is none."""
        settings = self._settings
        client: smtplib.SMTP | None = None
        try:
            if settings.encryption == "tls":
                client = _InTimeTls(
                    settings.host, self._port, timeout=settings.timeout_s, context=self._tls
                )
            else:
                client = _InTime(settings.host, self._port, timeout=settings.timeout_s)
            if settings.encryption == "starttls":
                client.starttls(context=self._tls)
            if settings.user:
                client.login(settings.user, self._password)
        except (OSError, smtplib.SMTPException, ValueError) as error:
            if client is not None:
                client.close()
            raise self._lost(error) from None  # the error's text may contain a secret
        return client

    def _lost(self, error: Exception) -> LostError:
        """What failed, in words without a secret, and what to check."""
        match error:
            case smtplib.SMTPAuthenticationError():
                problem = f"it does not let us in: {_status(error)}"
                return LostError(f"{self._where}: {problem}", "check user and password")
            case smtplib.SMTPNotSupportedError():
                return LostError(
                    f"{self._where}: it offers no {self._settings.encryption} or no way to log in",
                    "check [notifications.email] encryption, port and user",
                )
            case ssl.SSLError():
                hint = "check [notifications.email] encryption, port and tls"
                return LostError(f"{self._where}: {error}", hint)
            case smtplib.SMTPResponseException():
                return LostError(f"{self._where}: {_status(error)}")
            case UnicodeError():
                return LostError(f"{self._where}: it cannot log in such a name or password")
        return LostError(f"{self._where}: {error}", "is it there?")

    def _hand_over(self, client: smtplib.SMTP, mail: EmailMessage) -> str:
        """Why a mail is refused for good, empty if it is taken; LostError without connection."""
        try:
            client.send_message(mail)
        except smtplib.SMTPRecipientsRefused as error:
            ((status, reply),) = error.recipients.values()
            return self._refusal(smtplib.SMTPResponseException(status, reply))
        except smtplib.SMTPResponseException as error:
            return self._refusal(error)
        except (OSError, smtplib.SMTPException) as error:
            raise self._lost(error) from error
        return ""

    def _refusal(self, error: smtplib.SMTPResponseException) -> str:
        """The reason of a refusal for good; _PutOffError for one that may pass."""
        if error.smtp_code < PERMANENT:
            raise _PutOffError(f"{self._where}: {_status(error)}")
        return f"{self._where}: {_status(error)}"

    def _mail(self, message: Message, letter: Letter, now_ns: int) -> EmailMessage:
        """A mail; it has the same ID each time it is sent, by which programs know it again."""
        mail = EmailMessage(policy=SMTP)
        sender = cast(str, self._settings.sender)
        mail["From"] = Address("ejector-twin", addr_spec=sender)
        name = "" if letter.name == letter.address else one_line(letter.name)
        mail["To"] = Address(name, addr_spec=letter.address)
        mail["Subject"] = one_line(letter.subject)[:LONGEST_SUBJECT]
        mail["Date"] = format_datetime(local_time(now_ns, ""))
        mail["Message-ID"] = f"<{message.id}@{sender.rpartition('@')[2]}>"
        mail["Auto-Submitted"] = "auto-generated"  # no automatic answers (RFC 3834)
        mail.set_content(letter.text, cte="quoted-printable")
        return mail


class _InTime(smtplib.SMTP):
    """A connection whose timeout limits each whole reply."""

    def getreply(self) -> tuple[int, bytes]:
        assert self.sock is not None
        try:
            with whole_within(self.sock, self.timeout):
                return super().getreply()
        except TimeoutError:
            self.close()
            raise


class _InTimeTls(_InTime, smtplib.SMTP_SSL):
    pass


class _PutOffError(LostError):
    """One mail is not taken now; others may be."""


def one_line(text: str) -> str:
    """A text that cannot end a header: without line breaks and characters that are not seen."""
    return "".join(sign for sign in " ".join(text.split()) if sign.isprintable())


def _status(error: smtplib.SMTPResponseException) -> str:
    """A server's reply in one line; it comes from outside."""
    reply = error.smtp_error
    text = reply.decode("utf-8", "replace") if isinstance(reply, bytes) else str(reply)
    return one_line(f"status {error.smtp_code} {text}")[:LONGEST_SUBJECT]


def _hang_up(client: smtplib.SMTP) -> None:
    with suppress(OSError, smtplib.SMTPException):  # what was taken is taken
        client.quit()
    client.close()
