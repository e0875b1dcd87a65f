"""Results of the twins, served over OPC UA by a process of its own (``drivers.outputs.serve``).

Each loop leaves its newest results in its ``Results`` and goes on. A thread here sends the changes
at an even pace; it waits for each answer, so that nothing piles up. A server that dies or does not
answer is ended and started again with all that it showed; the loops are told.
"""

import logging
import os
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, Self

from drivers.outputs.settings import ResultsSettings
from drivers.outputs.state import Reading, Results
from twin.backoff import Backoff
from twin.errors import SourceError, TwinError

PATIENCE_S = 60.0  # for the library to build its address space on a busy machine
SILENCE_S = 10.0  # a server that takes longer for an update has hung
LOOK_S = 0.05  # between checks for requests of the server, and for the end
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0  # before a server is started again
SOUND_S = 60.0  # after a longer run the death of a server is reported again
NICE = 5  # beyond the loop's own

_log = logging.getLogger(__name__)

Acknowledge = Callable[[str, str], None]  # takes the alarm's name, and the person's
Tell = Callable[[str], None]  # receives that the server is down, and why


class DownError(Exception):
    """The process has ended, or does not answer; the text says how."""


@dataclass
class Branch:
    """The results of one ejector, and what the server already shows of them."""

    results: Results
    kind: str
    acknowledge: Acknowledge | None
    tell: Tell | None
    shown: dict[str, Reading] = field(default_factory=dict)
    standing: dict[str, Mapping[str, Any]] = field(default_factory=dict)  # alarms of concern
    laid_out: threading.Event = field(default_factory=threading.Event)

    def news(self) -> tuple[str, dict[str, Reading], list[Mapping[str, Any]]]:
        """Asset, changed readings and changes of alarms since the last call."""
        changes = self.changes()
        readings = self.results.readings()
        changed = {
            name: reading for name, reading in readings.items() if reading != self.shown.get(name)
        }
        self.shown = readings
        return self.results.asset, changed, changes

    def changes(self) -> list[Mapping[str, Any]]:
        """Changes of alarms since the last call; active or unacknowledged ones are kept."""
        changes = self.results.changes()
        for change in changes:
            self.standing.pop(change["alarm"], None)
            if change["active"] or not change["acknowledged"]:
                self.standing[change["alarm"]] = change
        return changes


class Server:
    """The process that serves. DownError once it has ended or hangs."""

    def __init__(self, settings: ResultsSettings, figures: Mapping[str, str]) -> None:
        if not hasattr(os, "posix_spawn"):
            raise SourceError(
                "results are served on Linux only", "leave out opcua = true under [results]"
            )
        parent_end, child_end = socket.socketpair()
        seconds = struct.pack("@ll", round(SILENCE_S), 0)  # struct timeval: s, µs
        for option in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
            parent_end.setsockopt(socket.SOL_SOCKET, option, seconds)
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        with child_end:
            command = [sys.executable, "-m", "drivers.outputs.serve", str(child_end.fileno())]
            self._process = subprocess.Popen(  # noqa: S603  # our own program
                command,
                pass_fds=[child_end.fileno()],
                stderr=self._stderr,
                start_new_session=True,  # Ctrl-C goes to the loop alone
            )
        self._pipe = Connection(parent_end.detach())
        with suppress(OSError):  # without the right to it, the priority stays
            niceness = os.getpriority(os.PRIO_PROCESS, 0)
            os.setpriority(os.PRIO_PROCESS, self._process.pid, niceness + NICE)
        self.send((settings, dict(figures)))

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    @property
    def runs(self) -> bool:
        """Whether it was not closed."""
        return not self._pipe.closed

    def send(self, message: object) -> None:
        """Send a message; DownError if the process does not take it."""
        try:
            self._pipe.send(message)
        except OSError as error:
            raise DownError(self._cause()) from error

    def receive(self, seconds: float) -> Any:
        """The next message; None if none comes in time, DownError if none can come any more."""
        try:
            return self._pipe.recv() if self._pipe.poll(seconds) else None
        except (EOFError, OSError) as error:
            raise DownError(self._cause()) from error

    def _cause(self) -> str:
        try:
            code = self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            return "it does not answer"
        self._stderr.seek(0)
        *_, last = [b"", *self._stderr.read().splitlines()]
        last_line = last.decode(errors="replace")
        return f"it was ended by signal {-code}" if code < 0 else last_line or f"exit code {code}"

    def close(self) -> None:
        """Ask the process to end; kill it if it does not."""
        self._pipe.close()
        try:
            self._process.wait(SILENCE_S)
        except subprocess.TimeoutExpired:
            self.kill()
        self._stderr.close()

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.wait()


class ResultsServer:
    """A server for all twins of a process; enter its ``with`` before the loops begin.

    ``figures`` are the key figures of a cycle and their units. SourceError if the address is not
    available, ConfigError if certificates or passwords cannot be used.
    """

    def __init__(self, settings: ResultsSettings, figures: Mapping[str, str]) -> None:
        self._settings, self._figures = settings, figures
        self._branches: list[Branch] = []
        self._answers: SimpleQueue[tuple[str, int, str]] = SimpleQueue()  # for the server
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="results")

    def __enter__(self) -> Self:
        try:
            self._begin()
        except DownError as error:
            raise SourceError(f"results cannot be served over OPC UA: {error}") from error
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._thread.join()

    @property
    def url(self) -> str:
        """The address for clients."""
        return f"opc.tcp://{self._settings.host}:{self._settings.port}"

    @property
    def pid(self) -> int:
        """Id of the process that serves."""
        return self._server.pid

    def sink(
        self,
        asset: str,
        kind: str,
        acknowledge: Acknowledge | None = None,
        tell: Tell | None = None,
    ) -> Results:
        """Give a sink whose rows are served as ``asset``, an ejector of type ``kind``.

        ``acknowledge`` is called to acknowledge an alarm, in a thread; it may raise TwinError.
        ``tell`` is called in a thread when the server is down; it restarts by itself.
        """
        branch = Branch(Results(asset, tuple(self._figures)), kind, acknowledge, tell)
        self._branches.append(branch)
        branch.laid_out.wait(PATIENCE_S)
        return branch.results

    # --- in its own thread ----------------------------------------------------------------------

    def _run(self) -> None:
        backoff, reported = Backoff(FIRST_PAUSE_S, LONGEST_PAUSE_S), False
        while not self._stop.is_set():
            started = time.monotonic()
            try:
                self._restart()
                self._show_until_stopped()
            except (DownError, TwinError) as error:
                if time.monotonic() - started > SOUND_S:
                    backoff.reset()
                    reported = False
                self._server.close()
                pause_s = backoff.next_s()
                if not reported:
                    self._report_down(str(error), pause_s)
                    reported = True
                self._wait(pause_s)
        self._server.close()

    def _report_down(self, cause: str, pause_s: float) -> None:
        text = (
            f"the results server (OPC UA) is down: {cause}; it is started again in {pause_s:.0f} s"
        )
        for branch in list(self._branches):
            if branch.tell is not None:
                branch.tell(text)

    def _wait(self, seconds: float) -> None:
        """Wait until the next attempt, and collect changes of alarms meanwhile."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not self._stop.wait(LOOK_S):
            for branch in list(self._branches):
                branch.changes()

    def _begin(self) -> None:
        """Start a server, and learn its port."""
        self._server = Server(self._settings, self._figures)
        try:
            status, payload = self._answer(PATIENCE_S)
            if status == "failed":
                raise payload
        except BaseException:
            self._server.close()
            raise
        self._settings = self._settings.model_copy(update={"port": payload})

    def _restart(self) -> None:
        """Start a server that shows everything anew, unless one is running."""
        if self._server.runs:
            return
        self._begin()
        for branch in self._branches:
            branch.laid_out.clear()

    def _show_until_stopped(self) -> None:
        while not self._stop.is_set():
            for branch in list(self._branches):
                if not branch.laid_out.is_set():
                    self._add(branch)
            self._ask("show", [branch.news() for branch in self._branches])
            self._listen(self._settings.interval_ms * 1e-3)

    def _add(self, branch: Branch) -> None:
        """Have the branch's nodes created, and show its present state."""
        asset, branch.shown = branch.results.asset, {}
        self._ask("add", asset, branch.kind, branch.acknowledge is not None)
        changes = list(branch.standing.values())
        _, readings, new_changes = branch.news()
        self._ask("show", [(asset, readings, [*changes, *new_changes])])
        branch.laid_out.set()

    def _ask(self, *message: Any) -> None:
        """Send a request, and wait until it is done."""
        self._server.send(message)
        self._answer(SILENCE_S)

    def _answer(self, patience_s: float) -> Any:
        """The server's answer; its own requests are served meanwhile."""
        end = time.monotonic() + patience_s
        while time.monotonic() < end:
            message = self._receive(LOOK_S)
            if message is not None:
                return message
        self._server.kill()
        raise DownError("it did not answer, and was ended")

    def _listen(self, seconds: float) -> None:
        """Serve the server's requests for so long."""
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0 and not self._stop.is_set():
            self._receive(min(remaining, LOOK_S))

    def _receive(self, seconds: float) -> Any:
        """The next answer, None if none comes in time; requests are served, complaints logged."""
        with suppress(Empty):
            while True:
                self._server.send(self._answers.get_nowait())
        message = self._server.receive(seconds)
        if message is not None and message[0] == "complaint":
            _log.warning(message[1])
            return None
        if message is None or message[0] != "acknowledge":
            return message
        threading.Thread(target=self._acknowledge, args=message[1:], daemon=True).start()
        return None

    def _acknowledge(self, number: int, asset: str, alarm: str, user: str) -> None:
        """Acknowledge an alarm, and queue the answer; this may wait for a database."""
        refused = f"{asset}: no such ejector"
        for branch in self._branches:
            if branch.results.asset == asset and branch.acknowledge is not None:
                try:
                    branch.acknowledge(alarm, user)
                    refused = ""
                except TwinError as error:
                    refused = str(error)
        self._answers.put(("acknowledged", number, refused))


__all__ = ["ResultsServer", "ResultsSettings"]
