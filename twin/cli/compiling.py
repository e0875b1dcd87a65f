"""The models of a run, compiled by a child process where they are not in the cache.

Run as a program it is that child: it makes the twins of the configurations on stdin, which leaves
all that they need in the cache.
"""

import gc
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
    """Twin and monitor of each ejector: ``load`` takes them from the cache, or has them compiled.

    A child process compiles what has to be. Where that fails, or nothing would be kept, ``take``
    compiles. With ``at_once`` everything has been compiled here when this returns.
    """

    def __init__(self, ejectors: "Mapping[str, Config]", *, at_once: bool) -> None:
        self._ejectors = ejectors
        self._pairs: dict[str, Pair] = {}
        self._child: ChildProcess | None = None
        self._is_loaded = False
        self._one_at_a_time = threading.Lock()  # who loads, takes a pair, or looks for the child
        if at_once:
            self._make_all()
            gc.collect()  # compiling leaves garbage, which a loop would never collect

    def load(self) -> None:
        """Make all pairs if they are in the cache, else have them compiled; once for all."""
        with self._one_at_a_time:
            if not self._is_loaded and not self._made_from_cache():
                self._start()
            self._is_loaded = True

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

    def _made_from_cache(self) -> bool:
        """Make all pairs if that needs no compiling."""
        from twin.model.compiled import NotCachedError, only_cached

        with suppress(NotCachedError), only_cached():
            self._make_all()
        return self._is_loaded

    def _make_all(self) -> None:
        self._pairs = {name: pair_of(settings) for name, settings in self._ejectors.items()}
        self._is_loaded = True

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
