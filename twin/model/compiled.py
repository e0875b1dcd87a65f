"""The decorator for compiled functions, with a cache that never serves yesterday's physics.

Numba caches each function by the time stamp of its own file, so a change in a function it calls in
another file goes unnoticed. Here the cache lies in a folder named by all sources that are compiled
or hold constants for it.

Numba unpickles what it finds there, and that runs whatever stands in it. So the folder is the
user's own, and where it is not there is no cache.
"""

import hashlib
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeVar, cast

import llvmlite.binding as llvm
import numba
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator
from numba.core.runtime.nrt import rtsys

from twin.cpu_target import njit
from twin.errors import TwinError
from twin.files import private_folder, user_cache

DAY_S = 86_400.0
SHARED = ("signals.py", "cpu_target.py")
_log = logging.getLogger(__name__)
P = ParamSpec("P")
R_co = TypeVar("R_co", covariant=True)
_PACKAGE = Path(__file__).parent.parent


def _folder_name() -> str:
    sources = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        text = path.read_bytes()
        if path.parent.name == "model" or path.name in SHARED or b"model.compiled" in text:
            sources.update(text)
    return f"compiled-{sources.hexdigest()[:12]}"


def _forget_others(folder: Path) -> None:
    """Delete what no version has used for a day; numba itself never does."""
    os.utime(folder)
    for other in folder.parent.glob("compiled-*"):
        if other != folder and time.time() - other.stat().st_mtime > DAY_S:
            shutil.rmtree(other, ignore_errors=True)


def _cache_folder() -> tuple[str, str]:
    """The folder, or nothing and why."""
    try:
        folder = private_folder(private_folder(user_cache()) / _folder_name())
        with suppress(FileNotFoundError):  # another process forgets the same
            _forget_others(folder)
    except TwinError as error:
        return "", f"{error}; {error.hint}"
    return str(folder), ""


_FOLDER, _NO_CACHE = _cache_folder()
numba.config.CACHE_DIR = _FOLDER  # type: ignore[attr-defined]

# A loop over hypotheses reads and writes some fifty rows of three arrays. Whether rows overlap is
# checked before such a loop is run four at a time, and by default LLVM balks at so many checks.
for _limit in ("runtime-memory-check-threshold", "vectorize-memory-check-threshold"):
    llvm.set_option("", f"--{_limit}=100000")


class NotCachedError(Exception):
    """Something is not in the cache, and the caller does not want it compiled here."""


class _Waiting(event.Listener):
    """Says what a process waits for, the first time something is not found in the cache."""

    said = False
    refused = False  # compiling, for the moment

    def on_start(self, event: object) -> None:
        if self.refused:
            raise NotCachedError
        if not self.said:
            self.said = True
            kept = f"and not kept: {_NO_CACHE}" if _NO_CACHE else "then kept"
            _log.warning(
                "compiling what is not yet compiled for this processor: 1 to 3 minutes, %s", kept
            )

    def on_end(self, event: object) -> None:
        pass


_waiting = _Waiting()
event.register("numba:compile", _waiting)  # type: ignore[no-untyped-call]


@contextmanager
def only_cached() -> Iterator[None]:
    """Raise NotCachedError where the block needs something that is not in the cache.

    For one thread, before there are others that may compile.
    """
    _waiting.refused = True
    try:
        yield
    finally:
        _waiting.refused = False


def keeps() -> bool:
    """Whether there is a cache: what another process compiles is then found by this one."""
    return bool(_FOLDER)


def expect_waiting() -> None:
    """Say nothing when something is compiled: the caller has said what is waited for."""
    _waiting.said = True


class _InOwnFolder(CompileResultCacheImpl):
    """Looks nowhere else: numba has folders to fall back on that nobody checks."""

    _locator_classes = [UserProvidedCacheLocator]  # noqa: RUF012 - as numba has it


class _Cache(FunctionCache):
    """Numba's cache; but what is found in it needs nothing of what numba can compile.

    Numba gets all of that ready before it looks, a sixth of the time that a command takes to start.
    Where nothing is found, its compiler does the same as it begins.
    """

    _impl_class = _InOwnFolder

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]


# Results stay the same to the last bit: no fast-math. Dividing by zero gives inf as in NumPy. What
# is called from ``per_row`` may have arrays of its own (numba would pass that on).
_with_arrays = njit(nogil=True, error_model="numpy", _nrt=True)  # type: ignore[call-overload]


class Compiled(Protocol[P, R_co]):
    """A compiled function, with the types of the Python function that it was made from."""

    @property
    def py_func(self) -> Callable[P, R_co]:
        """The Python function, which runs without compiling anything."""

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R_co:
        """Run what is compiled; compile it first where no call had such arguments."""


def compiled(function: Callable[P, R_co]) -> Compiled[P, R_co]:
    """A function to be called from Python, or where inlining it is not worth it; kept on disk."""
    dispatcher = _with_arrays(function)
    if _FOLDER:
        with suppress(RuntimeError):  # the disk is full
            # What ``cache=True`` does with numba's own.
            dispatcher._cache = _Cache(function)  # type: ignore[no-untyped-call]
    return cast("Compiled[P, R_co]", dispatcher)


# For functions called inside a loop: over hypotheses only one without calls is vectorised, and over
# rows a call costs as much as a few lines.
_inlined = njit(forceinline=True, error_model="numpy")

# The same for what runs over rows, with no arrays of its own. It does not count the references to
# those it is given: two atomic additions for each, at every row. Over hypotheses nothing is counted
# in any case, and so compiled LLVM takes them one at a time.
_per_row = njit(forceinline=True, error_model="numpy", _nrt=False)  # type: ignore[call-overload]


def inlined(function: Callable[P, R_co]) -> Compiled[P, R_co]:
    """A function that is part of its callers, inside a loop over hypotheses."""
    return cast("Compiled[P, R_co]", _inlined(function))


def per_row(function: Callable[P, R_co]) -> Compiled[P, R_co]:
    """A function that is part of its callers, inside a loop over rows; it has no arrays."""
    return cast("Compiled[P, R_co]", _per_row(function))
