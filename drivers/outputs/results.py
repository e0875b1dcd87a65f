"""What the twin finds, served over OPC UA by a process of its own (``drivers.outputs.serve``).

The loops leave what is newest in their ``Results`` and go on. A thread here takes it at an even
pace and sends what has changed; it waits for each answer, so that nothing piles up. A server that
dies or does not answer is ended and started again, with all that it showed; the loops are told.
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
SILENCE_S = 10.0  # a server that takes longer with what is new has hung
LOOK_S = 0.05  # between looks for what the server asks, and whether to stop
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0  # before a server is started again
SOUND_S = 60.0  # a server that ran so long and dies is told of again
NICE = 5  # beyond the loop's own

_log = logging.getLogger(__name__)

Acknowledge = Callable[[str, str], None]  # asks it: which alarm, and who does
Tell = Callable[[str], None]  # told that the server is down, and why


class DownError(Exception):
    """The process has ended, or does not answer; the text says how."""


@dataclass
class Branch:
    """What one ejector has to show, and what of it the server has."""

    results: Results
    kind: str
    acknowledge: Acknowledge | None
    tell: Tell | None
    shown: dict[str, Reading] = field(default_factory=dict)
    standing: dict[str, Mapping[str, Any]] = field(default_factory=dict)  # alarms of concern
    laid_out: threading.Event = field(default_factory=threading.Event)

    def news(self) -> tuple[str, dict[str, Reading], list[Mapping[str, Any]]]:
        """What has changed since the last time."""
        changes = self.changes()
        readings = self.results.readings()
        changed = {name: one for name, one in readings.items() if one != self.shown.get(name)}
        self.shown = readings
        return self.results.asset, changed, changes

    def changes(self) -> list[Mapping[str, Any]]:
        """How alarms have changed; those that still concern anybody are kept."""
        changes = self.results.changes()
        for change in changes:
            self.standing.pop(change["alarm"], None)
            if change["active"] or not change["acknowledged"]:
                self.standing[change["alarm"]] = change
        return changes


class Server:
    """One process that serves; ``port`` is where. DownError where it has ended or hangs."""

    def __init__(self, settings: ResultsSettings, figures: Mapping[str, str]) -> None:
        if not hasattr(os, "posix_spawn"):
            raise SourceError(
                "results are served on Linux only", "leave out opcua = true under [results]"
            )
        ours, theirs = socket.socketpair()
        seconds = struct.pack("@ll", round(SILENCE_S), 0)  # struct timeval: s, µs
        for option in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
            ours.setsockopt(socket.SOL_SOCKET, option, seconds)
        self._complaint = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        with theirs:
            command = [sys.executable, "-m", "drivers.outputs.serve", str(theirs.fileno())]
            self._process = subprocess.Popen(  # noqa: S603  # our own program
                command,
                pass_fds=[theirs.fileno()],
                stderr=self._complaint,
                start_new_session=True,  # a Ctrl-C is the loop's to answer
            )
        self._pipe = Connection(ours.detach())
        with suppress(OSError):  # where that is not allowed it runs as it is
            own = os.getpriority(os.PRIO_PROCESS, 0)
            os.setpriority(os.PRIO_PROCESS, self._process.pid, own + NICE)
        self.send((settings, dict(figures)))

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def runs(self) -> bool:
        """Whether it was not closed."""
        return not self._pipe.closed

    def send(self, message: object) -> None:
        """Send it; DownError if nobody takes it."""
        try:
            self._pipe.send(message)
        except OSError as error:
            raise DownError(self._why()) from error

    def heard(self, seconds: float) -> Any:
        """The next message, or None if none comes within so long; DownError if none will come."""
        try:
            return self._pipe.recv() if self._pipe.poll(seconds) else None
        except (EOFError, OSError) as error:
            raise DownError(self._why()) from error

    def _why(self) -> str:
        try:
            code = self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            return "it does not answer"
        self._complaint.seek(0)
        *_, last = [b"", *self._complaint.read().splitlines()]
        said = last.decode(errors="replace")
        return f"it was ended by signal {-code}" if code < 0 else said or f"exit code {code}"

    def close(self) -> None:
        """Have it end; one that does not is ended."""
        self._pipe.close()
        try:
            self._process.wait(SILENCE_S)
        except subprocess.TimeoutExpired:
            self.kill()
        self._complaint.close()

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.wait()


class ResultsServer:
    """A server for all twins of a process; use it in a ``with``, and before the loops begin.

    ``figures`` are the key figures of a cycle and their units. SourceError where the address
    cannot be had, ConfigError where certificates or passwords cannot be used.
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
        """Where it is reached."""
        return f"opc.tcp://{self._settings.host}:{self._settings.port}"

    @property
    def pid(self) -> int:
        """Of the process that serves."""
        return self._server.pid

    def sink(
        self,
        asset: str,
        kind: str,
        acknowledge: Acknowledge | None = None,
        tell: Tell | None = None,
    ) -> Results:
        """Give a sink whose rows are served as ``asset``, of the type ``kind`` of ejectors.

        ``acknowledge`` is asked to acknowledge an alarm, in a thread; it may raise TwinError.
        ``tell`` is told, in a thread, that the server is down; it is started again by itself.
        """
        branch = Branch(Results(asset, tuple(self._figures)), kind, acknowledge, tell)
        self._branches.append(branch)
        branch.laid_out.wait(PATIENCE_S)
        return branch.results

    # --- in its own thread ----------------------------------------------------------------------

    def _run(self) -> None:
        backoff, told = Backoff(FIRST_PAUSE_S, LONGEST_PAUSE_S), False
        while not self._stop.is_set():
            begun = time.monotonic()
            try:
                self._begin_again()
                self._show_until_stopped()
            except (DownError, TwinError) as error:
                if time.monotonic() - begun > SOUND_S:
                    backoff.reset()
                    told = False
                self._server.close()
                pause_s = backoff.next_s()
                if not told:
                    self._say(str(error), pause_s)
                    told = True
                self._wait(pause_s)
        self._server.close()

    def _say(self, why: str, pause_s: float) -> None:
        text = f"the results server (OPC UA) is down: {why}; it is started again in {pause_s:.0f} s"
        for branch in list(self._branches):
            if branch.tell is not None:
                branch.tell(text)

    def _wait(self, seconds: float) -> None:
        """Until the next try; what alarms do meanwhile is kept as far as it concerns."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not self._stop.wait(LOOK_S):
            for branch in list(self._branches):
                branch.changes()

    def _begin(self) -> None:
        """Start a server, and know its port."""
        self._server = Server(self._settings, self._figures)
        try:
            what, told = self._answer(PATIENCE_S)
            if what == "failed":
                raise told
        except BaseException:
            self._server.close()
            raise
        self._settings = self._settings.model_copy(update={"port": told})

    def _begin_again(self) -> None:
        """Start one with all that was shown, unless the first one runs."""
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
        """Have its nodes laid out, and what stands shown."""
        asset, branch.shown = branch.results.asset, {}
        self._ask("add", asset, branch.kind, branch.acknowledge is not None)
        changes = list(branch.standing.values())
        _, readings, new = branch.news()
        self._ask("show", [(asset, readings, [*changes, *new])])
        branch.laid_out.set()

    def _ask(self, *message: Any) -> None:
        """Have something done, and wait until it is."""
        self._server.send(message)
        self._answer(SILENCE_S)

    def _answer(self, patience_s: float) -> Any:
        """The answer of the server; what it asks meanwhile is seen to."""
        end = time.monotonic() + patience_s
        while time.monotonic() < end:
            message = self._heard(LOOK_S)
            if message is not None:
                return message
        self._server.kill()
        raise DownError("it did not answer, and was ended")

    def _listen(self, seconds: float) -> None:
        """See to what the server asks for so long."""
        end = time.monotonic() + seconds
        while (rest := end - time.monotonic()) > 0 and not self._stop.is_set():
            self._heard(min(rest, LOOK_S))

    def _heard(self, seconds: float) -> Any:
        """A message within so long, unless it asks for something; that is passed on."""
        with suppress(Empty):
            while True:
                self._server.send(self._answers.get_nowait())
        message = self._server.heard(seconds)
        if message is not None and message[0] == "complaint":
            _log.warning(message[1])
            return None
        if message is None or message[0] != "acknowledge":
            return message
        threading.Thread(target=self._acknowledge, args=message[1:], daemon=True).start()
        return None

    def _acknowledge(self, number: int, asset: str, alarm: str, who: str) -> None:
        """Acknowledge an alarm; it may wait for a database."""
        refused = f"{asset}: no such ejector"
        for branch in self._branches:
            if branch.results.asset == asset and branch.acknowledge is not None:
                try:
                    branch.acknowledge(alarm, who)
                    refused = ""
                except TwinError as error:
                    refused = str(error)
        self._answers.put(("acknowledged", number, refused))


__all__ = ["ResultsServer", "ResultsSettings"]
