"""Destinations of log uploads: an address that takes PUT, or a folder, which may be a share."""

import base64
import hashlib
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Protocol
from urllib.parse import quote, urlsplit

import urllib3

from twin.assets.unit import Unit
from twin.notifications.sender import LostError
from twin.notifications.settings import UploadSettings
from twin.notifications.upload_requests import File, RefusedError
from twin.notifications.webhook import LATER, header_secret
from twin.secret import Say

PIECE = 1 << 20  # bytes read at once
CONNECT_S = 10.0


class StoppedError(Exception):
    """The program ends; the next one goes on."""


class UploadDestination(Protocol):
    """Takes files. LostError if a retry makes sense, RefusedError if not."""

    def put(self, path: Path, file: File) -> None:
        """Store a whole file there."""


class Source:
    """An open file; reading stops when the program ends."""

    def __init__(self, file: BinaryIO, ending: threading.Event) -> None:
        self._file, self._ending = file, ending

    def read(self, size: int = PIECE) -> bytes:
        """The next bytes; StoppedError once the program ends."""
        if self._ending.is_set():
            raise StoppedError
        return self._file.read(size)

    def __iter__(self) -> Iterator[bytes]:
        """The whole file in pieces."""
        while piece := self.read():
            yield piece


@contextmanager
def open_source(path: Path, ending: threading.Event) -> Iterator[Source]:
    """Open a file, but no link; RefusedError if it can no longer be read."""
    try:
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW), "rb")
    except OSError as error:
        raise RefusedError(f"{path.name} cannot be read: {error.strerror}") from error
    with file:
        yield Source(file, ending)


def described(path: Path, ending: threading.Event) -> File:
    """A file with its size and hash."""
    digest, size = hashlib.sha256(), 0
    with open_source(path, ending) as source:
        for piece in source:
            digest.update(piece)
            size += len(piece)
    return File(path.name, size, digest.hexdigest())


def place_of(
    settings: UploadSettings, unit: Unit, folder: Path, ending: threading.Event, say: Say
) -> UploadDestination:
    """The destination that a configuration names; paths are relative to ``folder``.

    ConfigError if a secret or certificate cannot be used.
    """
    if settings.folder is not None:
        return Share(folder / settings.folder, unit, ending)
    return Address(settings, unit, folder, ending, say)


class Share:
    """A folder with a subfolder for each type and unit. It must exist: it may be a mount."""

    def __init__(self, folder: Path, unit: Unit, ending: threading.Event) -> None:
        self._folder, self._ending = folder, ending
        self._unit_folder = folder.joinpath(*_levels(unit))

    def put(self, path: Path, file: File) -> None:
        """Copy a file; it gets its name when it is whole. Existing files are never replaced."""
        if not self._folder.is_dir():
            raise LostError(f"{self._folder}: no such folder", "is the share mounted?")
        target = self._unit_folder / file.name
        try:
            self._unit_folder.mkdir(parents=True, exist_ok=True)
            if target.exists():
                self._check_same(target, file)
                return
            self._copy(path, target)
        except OSError as error:
            raise LostError(f"{target}: cannot be written: {error.strerror}") from error

    def _check_same(self, target: Path, file: File) -> None:
        if described(target, self._ending) != file:
            raise RefusedError(f"another file called {file.name} is already there")

    def _copy(self, path: Path, target: Path) -> None:
        part = target.with_name(f"{target.name}.part")
        with open_source(path, self._ending) as source, part.open("wb") as copy:
            for piece in source:
                copy.write(piece)
            copy.flush()
            os.fsync(copy.fileno())
        part.replace(target)


class Address:
    """A server that takes files by PUT below its URL, with a level for each type and unit."""

    def __init__(
        self,
        settings: UploadSettings,
        unit: Unit,
        folder: Path,
        ending: threading.Event,
        say: Say,
    ) -> None:
        url = settings.address("outlets.upload", folder, say)
        self._url = "/".join((url.rstrip("/"), *_levels(unit)))
        parts = urlsplit(url)
        self._where = f"{parts.scheme}://{parts.netloc}"  # what follows may be a secret
        self._ending = ending
        self._headers = {
            name: header_secret(f"[outlets.upload] headers.{name}", secret, folder, say)
            for name, secret in settings.headers.items()
        }
        is_secure = parts.scheme == "https"
        self._pool = urllib3.PoolManager(
            1,
            retries=False,  # nor redirects
            timeout=urllib3.Timeout(connect=CONNECT_S, read=settings.timeout_s),
            ssl_context=settings.tls.context("outlets.upload", folder) if is_secure else None,
        )

    def put(self, path: Path, file: File) -> None:
        """Upload a file with its hash (RFC 9530)."""
        digest = base64.b64encode(bytes.fromhex(file.sha256)).decode()
        headers = {
            **self._headers,
            "Content-Type": "application/octet-stream",
            "Content-Length": str(file.size),
            "Content-Digest": f"sha-256=:{digest}:",
        }
        try:
            with open_source(path, self._ending) as source:
                url = f"{self._url}/{quote(file.name, safe='')}"
                answer = self._pool.request(
                    "PUT", url, body=source, headers=headers, preload_content=False
                )
                answer.close()
        except urllib3.exceptions.HTTPError as error:
            raise LostError(f"{self._where}: {error}", "is it there?") from error
        finally:
            self._pool.clear()
        if answer.status in LATER or answer.status >= 500:
            raise LostError(f"{self._where}: status {answer.status} {answer.reason or ''}".rstrip())
        if answer.status >= 300:
            raise RefusedError(f"the place of uploads answers with status {answer.status}")


def _levels(unit: Unit) -> list[str]:
    """Type and unit as names of folders; a dot alone would be another folder."""
    return [quote(name, safe="").replace(".", "%2E") or "-" for name in unit]
