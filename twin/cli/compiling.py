"""The models of a run, compiled by a child process where they are not in the cache.

Run as a program it is that child: it makes the twins of the configurations on stdin, which leaves
all that they need in the cache.
"""

import pickle
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, TypeAlias

from twin.child_process import ChildProcess
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
        self._child: ChildProcess | None = None
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
                if self._child.answer() is None:
                    complain(
                        f"the process that compiles has failed ({self._child.complaint()});"
                        " it is compiled in this process, which takes as long"
                    )
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
            self._child = ChildProcess(COMMAND, [*self._ejectors.values()])

    def _close_child(self) -> None:
        if self._child is not None:
            self._child.close()
            self._child = None


def main() -> None:
    """Make the twin and the monitor of each configuration, and let them go."""
    from twin.model.compiled import expect_waiting

    expect_waiting()
    for settings in pickle.load(sys.stdin.buffer):  # noqa: S301  # from our parent
        pair_of(settings)


if __name__ == "__main__":
    main()
