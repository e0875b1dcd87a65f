"""A child process that gets a pickled question on stdin; its answer and complaints go to files."""

import pickle
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack, suppress


class ChildProcess:
    """Runs a command of our own beside this process; OSError where it cannot start."""

    def __init__(self, command: Sequence[str], question: object) -> None:
        with ExitStack() as opened:
            asked, self._answer, self._complaints = (
                opened.enter_context(tempfile.TemporaryFile()) for _ in range(3)
            )
            pickle.dump(question, asked)
            asked.seek(0)
            self._process = subprocess.Popen(  # noqa: S603  # our own program
                command,
                stdin=asked,
                stdout=self._answer,
                stderr=self._complaints,
                start_new_session=True,  # a Ctrl-C is the parent's to answer
            )
            self._opened = opened.pop_all()
        self.pid = self._process.pid

    def ended(self, seconds: float = 0.0) -> bool:
        """Whether it has ended within ``seconds``."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        return self._process.poll() is not None

    def answer(self) -> bytes | None:
        """What one that has ended wrote to stdout; None if it failed or was killed."""
        if self._process.returncode != 0:
            return None
        self._answer.seek(0)
        return self._answer.read()

    def complaint(self) -> str:
        """The last line on stderr of one that has failed, or that it was killed."""
        self._complaints.seek(0)
        *_, last = [b"it was killed", *self._complaints.read().splitlines()]
        return last.decode(errors="replace")

    def close(self) -> None:
        """End the process if it still runs."""
        self._process.kill()
        self._process.wait()
        self._opened.close()
