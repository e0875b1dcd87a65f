"""Uploads finished logs when asked over the broker, one request after the other, in a thread.

A request is in the database before the broker is told that it arrived, and stays there until it is
done. So it outlives the program and lost networks.
"""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from twin.backoff import Backoff
from twin.errors import TwinError
from twin.notifications.logs import Found
from twin.notifications.message import Asset, Message, beside
from twin.notifications.upload_destinations import Place, StoppedError, described
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
MOST_OPEN = 20  # requests that wait
FIRST_PAUSE_S = 2.0  # after a failure; the next ones are twice as long each
LONGEST_PAUSE_S = 300.0

Tell = Callable[[Message], None]


class Uploader:
    """Takes requests and does them. ``ending`` is set by ``end``, for all who read files for it.

    ``find`` gives the files that a request means, or raises RefusedError. What goes wrong is said
    once, until it goes well again.
    """

    def __init__(
        self,
        asset: Asset,
        open_uploads: Callable[[], Uploads],
        find: Callable[[UploadRequest], Found],
        place: Place,
        ending: threading.Event,
        say: Say,
    ) -> None:
        self._asset, self._open_uploads = asset, open_uploads
        self._find, self._place, self._say = find, place, say
        self._tell: Tell = lambda _message: None
        self._failed = False
        self._backoff = Backoff(FIRST_PAUSE_S, LONGEST_PAUSE_S)
        self._ending, self._wake = ending, threading.Event()
        self._thread = threading.Thread(target=self._work, name="uploads", daemon=True)

    def start(self, tell: Tell) -> None:
        """Begin, with what an earlier run has left; answers go to ``tell``."""
        self._tell = tell
        self._wake.set()
        self._thread.start()

    def end(self) -> None:
        """Stop in the middle of a file; the next run sends it again."""
        self._ending.set()
        self._wake.set()

    def join(self, patience_s: float | None = None) -> bool:
        """Wait until it has stopped; whether it has."""
        self._thread.join(patience_s)
        return not self._thread.is_alive()

    def hear(self, payload: bytes) -> None:
        """Take a request and answer it; SourceError if it cannot be kept: it is to come again."""
        try:
            request = parse(payload)
        except RefusedError as error:
            self._answer(None, REFUSED, why=str(error))
            return
        with self._open_uploads() as uploads:
            if known := uploads.find(request.id):
                self._answer(request.id, known.state, known.files, why=known.why)
                return
            if len(uploads.waiting()) >= MOST_OPEN:
                why = f"{MOST_OPEN} requests wait already: ask again later"
                self._answer(request.id, REFUSED, why=why)
                return
            uploads.add(request)
        self._answer(request.id, ACCEPTED)
        self._wake.set()

    def _answer(
        self, number: str | None, state: str, files: Sequence[File] = (), **more: Any
    ) -> None:
        told = {"request": number, "state": state, "files": [vars(one) for one in files], **more}
        self._tell(beside(ANSWER_FORMAT, self._asset, time.time_ns(), told))

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

    def _do(self, uploads: Uploads, asked: Asked) -> None:
        """Upload what is still to be; LostError if it is to be tried again."""
        number, files = asked.request.id, list(asked.files)
        try:
            found = self._find(asked.request)
            more: dict[str, Any] = {"unfinished": list(found.unfinished)}
            if asked.state == ACCEPTED:
                uploads.note(asked.number, RUNNING, files)
                self._answer(number, RUNNING, **more)
            for path in found.parts:
                if path.name in {one.name for one in files}:
                    continue
                file = described(path, self._ending)
                self._place.put(path, file)
                files.append(file)
                uploads.note(asked.number, RUNNING, files)
        except RefusedError as error:
            uploads.note(asked.number, REFUSED, files, str(error))
            self._answer(number, REFUSED, files, why=str(error))
            return
        uploads.note(asked.number, DONE, files)
        self._answer(number, DONE, files, **more)

    def _fail(self, error: TwinError) -> None:
        if not self._failed:
            self._say(f"uploads wait: {error}")
        self._failed = True
        self._ending.wait(self._backoff.next_s())
        self._wake.set()
