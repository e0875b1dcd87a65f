"""The models of a run, compiled by a child process where they are not in the cache.

Run as a program it is that child: it makes the twins of the configurations on stdin, which leaves
all that they need in the cache.
"""

import pickle
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, TypeAlias

from twin.cli.console import complain
from twin.cli.setup import pair_of

if TYPE_CHECKING:
    from twin.config import Config
    from twin.live import Twin
    from twin.monitor.monitor import Monitor

Pair: TypeAlias = "tuple[Twin, Monitor]"

COMMAND = (sys.executable, "-m", "twin.cli.compiling")
COMPILING = "compiling the model for this processor, once; recording meanwhile"


class Models:
    """Twin and monitor of each ejector: at once from the cache, or later, once compiled.

    Where something has to be compiled, ``compiling`` is true and a child process does it. Where
    that fails, or nothing would be kept, ``take`` compiles. Without ``ahead`` everything has been
    compiled here when this returns.
    """

    def __init__(self, ejectors: "Mapping[str, Config]", *, ahead: bool) -> None:
        self._ejectors = ejectors
        self._pairs: dict[str, Pair] = {}
        self._child: Child | None = None
        self._one_at_a_time = threading.Lock()  # who takes a pair, or looks for the child
        if not ahead:
            self._make_all()
        self.compiling = ahead and not self._load()
        if self.compiling:
            self._start()

    def wait(self, seconds: float) -> bool:
        """Whether there is nothing to wait for any more; waits no longer than that."""
        child = self._child
        if child is None:
            return True
        if not child.ended(seconds):
            return False
        with self._one_at_a_time:
            if self._child is not None:
                if failure := self._child.failure():
                    complain(f"{failure}; it is compiled in this process, which takes as long")
                self._close_child()
        return True

    def take(self, name: str) -> Pair:
        """The pair of one ejector; compiles what no child has compiled."""
        with self._one_at_a_time:
            return self._pairs.pop(name, None) or pair_of(self._ejectors[name])

    def close(self) -> None:
        """End the child, if there is one."""
        with self._one_at_a_time:
            self._close_child()

    def _load(self) -> bool:
        """Make all pairs if that needs no compiling."""
        from twin.model.compiled import NotCachedError, only_cached

        with suppress(NotCachedError), only_cached():
            self._make_all()
            return True
        return False

    def _make_all(self) -> None:
        self._pairs = {name: pair_of(settings) for name, settings in self._ejectors.items()}

    def _start(self) -> None:
        from twin.model.compiled import expect_waiting, keeps

        if not keeps():  # which is said when compiling begins
            return
        complain(COMPILING)
        expect_waiting()
        with suppress(OSError):  # no processes left: it is compiled here
            self._child = Child([*self._ejectors.values()])

    def _close_child(self) -> None:
        if self._child is not None:
            self._child.close()
            self._child = None


class Child:
    """A process that compiles what some configurations need; OSError where there can be none."""

    def __init__(self, ejectors: "Sequence[Config]") -> None:
        with ExitStack() as opened:
            asking, self._complaint = (
                opened.enter_context(tempfile.TemporaryFile()) for _ in range(2)
            )
            pickle.dump(ejectors, asking)
            asking.seek(0)
            self._process = subprocess.Popen(  # noqa: S603  # our own program
                COMMAND,
                stdin=asking,
                stdout=subprocess.DEVNULL,
                stderr=self._complaint,
                start_new_session=True,  # a Ctrl-C is the run's to answer
            )
            self._opened = opened.pop_all()

    def ended(self, seconds: float) -> bool:
        """Whether it has ended within ``seconds``."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        return self._process.poll() is not None

    def failure(self) -> str:
        """Why one that has ended has not compiled everything; empty if it has."""
        if self._process.returncode == 0:
            return ""
        self._complaint.seek(0)
        *_, last = [b"it was killed", *self._complaint.read().splitlines()]
        return f"the process that compiles has failed ({last.decode(errors='replace')})"

    def close(self) -> None:
        """End it, if it has not ended."""
        self._process.kill()
        self._process.wait()
        self._opened.close()


def main() -> None:
    """Make the twin and the monitor of each configuration, and let them go."""
    from twin.model.compiled import expect_waiting

    expect_waiting()
    for settings in pickle.load(sys.stdin.buffer):  # noqa: S301  # from Child
        pair_of(settings)


if __name__ == "__main__":
    main()
