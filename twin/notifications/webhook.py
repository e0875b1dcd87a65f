"""Posts alarms as JSON to an address, one after the other."""

import threading
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

import urllib3
from urllib3.connection import HTTPConnection, HTTPSConnection
from urllib3.response import HTTPResponse

from twin.errors import ConfigError
from twin.notifications.deadline import whole_within
from twin.notifications.message import Message
from twin.notifications.sender import ALARM, LostError, Sent
from twin.notifications.settings import WebhookSettings
from twin.secret import Say, Secret

LATER = (408, 425, 429)  # client errors that mean: try again later
IDLE_S = 0.2


class Webhook:
    """A channel (``twin.notifications.sender.Channel``).

    Paths are relative to ``folder``. ConfigError if a secret or certificate cannot be used.
    """

    def __init__(self, settings: WebhookSettings, folder: Path, say: Say) -> None:
        self._settings = settings
        self._headers = {"Content-Type": "application/json"} | {
            name: header_secret(f"[webhook] headers.{name}", secret, folder, say)
            for name, secret in settings.headers.items()
        }
        self._url = settings.address("webhook", folder, say)
        parts = urlsplit(self._url)
        self._where = f"{parts.scheme}://{parts.netloc}"  # what follows may be a secret
        is_secure = parts.scheme == "https"
        self._pool = urllib3.PoolManager(
            1,
            retries=False,  # nor redirects
            timeout=urllib3.Timeout(total=settings.timeout_s),
            ssl_context=settings.tls.context("webhook", folder) if is_secure else None,
        )
        self._pool.pool_classes_by_scheme = {"http": _Plain, "https": _Secured}

    def open(self) -> bool:
        """Do nothing: each request connects if need be."""
        return False

    def send(self, messages: Sequence[Message], _topic: str = ALARM) -> Sent:
        """Post each message, until the destination cannot be reached."""
        sent = Sent()
        for message in messages:
            try:
                refusal = self._post(message)
            except LostError as error:
                sent.lost = error
                break
            if refusal:
                sent.refused[message.id] = refusal
            else:
                sent.delivered.append(message)
        return sent

    def idle(self, wake: threading.Event) -> None:
        """Wait: there is no connection to keep."""
        wake.wait(IDLE_S)

    def hang_up(self) -> None:
        """Close all connections."""
        self._pool.clear()

    def close(self) -> None:
        """Close all connections."""
        self._pool.clear()

    def _post(self, message: Message) -> str:
        """Why a message is refused for good; empty if it is taken. LostError if a retry helps."""
        headers = {**self._headers, "Idempotency-Key": message.id}
        try:
            answer = self._pool.request(
                "POST",
                self._url,
                body=message.body.encode(),
                headers=headers,
                preload_content=False,  # nobody reads it, however long it is
            )
            answer.close()
        except urllib3.exceptions.HTTPError as error:
            raise LostError(f"webhook {self._where}: {error}", "is it there?") from error
        except ValueError as error:  # its text may contain a secret
            cause = f"the request cannot be made ({type(error).__name__})"
            raise LostError(f"webhook {self._where}: {cause}", "check [webhook]") from None
        if answer.status in LATER or answer.status >= 500:
            raise LostError(f"webhook {self._where}: status {answer.status} {answer.reason or ''}")
        if answer.status >= 300:
            return f"{self._where}: status {answer.status} {answer.reason or ''}".rstrip()
        return ""


class _InTime(HTTPConnection):
    """A connection whose timeout limits the whole answer; the library's limits each piece."""

    def getresponse(self) -> HTTPResponse:  # type: ignore[override]  # as the library has it
        with whole_within(self.sock, self.timeout or 0.0):
            return super().getresponse()


class _InTimeTls(_InTime, HTTPSConnection):
    pass


class _Plain(urllib3.HTTPConnectionPool):
    ConnectionCls = _InTime


class _Secured(urllib3.HTTPSConnectionPool):
    ConnectionCls = _InTimeTls


def header_secret(key: str, secret: Secret, folder: Path, say: Say) -> str:
    """The secret of a header; ConfigError if a header cannot contain it."""
    text = secret.read(key, folder, say)
    try:
        text.encode("latin-1")
    except UnicodeEncodeError:
        raise ConfigError(
            f"{key}: the secret has a character that no header can have",
            "only Latin letters, digits and signs; was it copied whole and right?",
        ) from None
    return text
