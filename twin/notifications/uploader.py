"""Uploads finished logs on request over the broker, one request at a time, in a thread.

A request is stored in the database before the broker gets its acknowledgement, and stays there
until it is done. So it outlives the program and lost networks.
"""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from twin.backoff import Backoff
from twin.errors import TwinError
from twin.notifications.logs import Found
from twin.notifications.message import Asset, Message, beside
from twin.notifications.upload_destinations import StoppedError, UploadDestination, described
from twin.notifications.upload_requests import (
    ACCEPTED,
    DONE,
    REFUSED,
    RUNNING,
    Asked,
    File,
    RefusedError,
    UploadRequest,
    Uploads,
    parse,
)
from twin.secret import Say

ANSWER_FORMAT = "ejector-twin-upload/1"
UPLOAD = "upload"  # the topic of answers, below the unit's
MOST_OPEN = 20  # waiting requests
FIRST_PAUSE_S = 2.0  # after a failure; each further pause is twice as long
LONGEST_PAUSE_S = 300.0

Tell = Callable[[Message], None]


class Uploader:
    """Takes requests and carries them out. ``end`` sets ``ending``, which stops reading files.

    ``find`` returns the files that a request asks for, or raises RefusedError. A failure is
    reported once, and its end too.
    """

    def __init__(
        self,
        asset: Asset,
        open_uploads: Callable[[], Uploads],
        find: Callable[[UploadRequest], Found],
        place: UploadDestination,
        ending: threading.Event,
        say: Say,
    ) -> None:
        self._asset, self._open_uploads = asset, open_uploads
        self._find, self._destination, self._say = find, place, say
        self._tell: Tell = lambda _message: None
        self._failed = False
        self._backoff = Backoff(FIRST_PAUSE_S, LONGEST_PAUSE_S)
        self._ending, self._wake = ending, threading.Event()
        self._thread = threading.Thread(target=self._work, name="uploads", daemon=True)

    def start(self, tell: Tell) -> None:
        """Start with the requests that an earlier run left; answers go to ``tell``."""
        self._tell = tell
        self._wake.set()
        self._thread.start()

    def end(self) -> None:
        """Stop, even in the middle of a file; the next run sends that file again."""
        self._ending.set()
        self._wake.set()

    def join(self, patience_s: float | None = None) -> bool:
        """Wait until the thread has stopped; returns whether it has."""
        self._thread.join(patience_s)
        return not self._thread.is_alive()

    def receive(self, payload: bytes) -> None:
        """Take a request and answer it; SourceError if it cannot be stored and must come again."""
        try:
            request = parse(payload)
        except RefusedError as error:
            self._answer(None, REFUSED, why=str(error))
            return
        with self._open_uploads() as uploads:
            if earlier := uploads.find(request.id):
                self._answer(request.id, earlier.state, earlier.files, why=earlier.why)
                return
            if len(uploads.waiting()) >= MOST_OPEN:
                reason = f"{MOST_OPEN} requests wait already: ask again later"
                self._answer(request.id, REFUSED, why=reason)
                return
            uploads.add(request)
        self._answer(request.id, ACCEPTED)
        self._wake.set()

    def _answer(
        self, number: str | None, state: str, files: Sequence[File] = (), **details: Any
    ) -> None:
        content = {
            "request": number,
            "state": state,
            "files": [vars(file) for file in files],
            **details,
        }
        self._tell(beside(ANSWER_FORMAT, self._asset, time.time_ns(), content))

    # --- the thread -----------------------------------------------------------------------------

    def _work(self) -> None:
        while not self._ending.is_set():
            self._wake.wait()
            self._wake.clear()
            try:
                self._do_all()
            except StoppedError:
                return
            except TwinError as error:
                self._fail(error)

    def _do_all(self) -> None:
        with self._open_uploads() as uploads:
            while not self._ending.is_set() and (waiting := uploads.waiting()):
                self._do(uploads, waiting[0])
                if self._failed:
                    self._say("logs are uploaded again")
                self._failed = False
                self._backoff.reset()

    def _do(self, uploads: Uploads, job: Asked) -> None:
        """Upload the remaining files of a request; LostError if it must be tried again."""
        number, files = job.request.id, list(job.files)
        try:
            selection = self._find(job.request)
            details: dict[str, Any] = {"unfinished": list(selection.unfinished)}
            if job.state == ACCEPTED:
                uploads.note(job.number, RUNNING, files)
                self._answer(number, RUNNING, **details)
            for path in selection.parts:
                if path.name in {sent.name for sent in files}:
                    continue
                file = described(path, self._ending)
                self._destination.put(path, file)
                files.append(file)
                uploads.note(job.number, RUNNING, files)
        except RefusedError as error:
            uploads.note(job.number, REFUSED, files, str(error))
            self._answer(number, REFUSED, files, why=str(error))
            return
        uploads.note(job.number, DONE, files)
        self._answer(number, DONE, files, **details)

    def _fail(self, error: TwinError) -> None:
        if not self._failed:
            self._say(f"uploads wait: {error}")
        self._failed = True
        self._ending.wait(self._backoff.next_s())
        self._wake.set()
