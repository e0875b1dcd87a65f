"""The web server of the page: its address, and limits for clients."""

import asyncio
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from twin.errors import ConfigError, SourceError
from twin.tls import is_loopback

MOST_AT_ONCE = 200  # connections
HEAD_S = 10.0  # limit for the head of a request to arrive
QUIET_S = 20.0  # a browser counts as gone after so long without an answer


@dataclass(frozen=True)
class Place:
    """The address of the page; with ``certificate`` and ``key`` (PEM) over TLS."""

    host: str
    port: int
    certificate: Path | None = None
    key: Path | None = None

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine reaches it."""
        return is_loopback(self.host)

    @property
    def scheme(self) -> str:
        """The scheme of its URL."""
        return "https" if self.certificate else "http"


def listen(place: Place) -> socket.socket:
    """Listen on the port; SourceError if that is not possible."""
    family = socket.AF_INET6 if ":" in place.host else socket.AF_INET
    try:
        return socket.create_server((place.host, place.port), family=family, backlog=64)
    except OSError as error:
        raise SourceError(
            f"{place.host}:{place.port}: nobody can listen there: {error.strerror}",
            "check --host, or take another --port",
        ) from error


def address(place: Place, listening: socket.socket) -> str:
    """The URL to open in a browser."""
    host, port = listening.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    return f"{place.scheme}://{shown}:{port}/"


class _TimelyProtocol(H11Protocol):
    """Closes connections without a request; uvicorn would wait for the head for ever."""

    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timer for a request."""
        super().connection_made(transport)
        self._late = self.loop.call_later(HEAD_S, transport.close)

    def data_received(self, data: bytes) -> None:
        """Stop the timer after a whole head; start it with the beginning of another one."""
        super().data_received(data)
        if self.conn.their_state is not h11.IDLE:
            self._forget()
        elif self._late is None:
            self._late = self.loop.call_later(HEAD_S, self.transport.close)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer."""
        self._forget()
        super().connection_lost(exc)

    def _forget(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None


def make_server(app: ASGIApp, place: Place) -> uvicorn.Server:
    """A server that runs until Ctrl-C or SIGTERM; ConfigError for a bad certificate or key."""
    config = uvicorn.Config(
        app,
        http=_TimelyProtocol,
        ws="websockets-sansio",
        ws_max_size=64,
        ws_ping_interval=QUIET_S,
        ws_ping_timeout=QUIET_S,
        limit_concurrency=MOST_AT_ONCE,
        timeout_keep_alive=15,
        timeout_graceful_shutdown=2,
        server_header=False,
        proxy_headers=False,
        access_log=False,
        log_level="warning",
        ssl_certfile=place.certificate,
        ssl_keyfile=place.key,
    )
    try:
        config.load()
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(
            f"{place.certificate}: cannot be used: {error}", "both files as PEM, and of one pair"
        ) from error
    return uvicorn.Server(config)
