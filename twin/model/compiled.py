"""Decorators for compiled functions, with a cache that is never out of date.

Numba's own cache looks at the time stamp of a function's file, so it misses changes of a called
function in another file. Here the cache is in a folder whose name is a hash of all sources that are
compiled or hold their constants.

Numba unpickles the cached files, and unpickling can run any code. So the folder must belong to the
user alone; otherwise there is no cache.
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
SHARED = ("signals.py", "quality.py", "cpu_target.py")
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


def _delete_unused(folder: Path) -> None:
    """Delete folders that no version has used for a day; numba itself never does."""
    os.utime(folder)
    for other in folder.parent.glob("compiled-*"):
        if other != folder and time.time() - other.stat().st_mtime > DAY_S:
            shutil.rmtree(other, ignore_errors=True)


def _cache_folder() -> tuple[str, str]:
    """The folder and an empty text, or an empty text and the reason why there is none."""
    try:
        folder = private_folder(private_folder(user_cache()) / _folder_name())
        with suppress(FileNotFoundError):  # another process has deleted the same folder
            _delete_unused(folder)
    except TwinError as error:
        return "", f"{error}; {error.hint}"
    return str(folder), ""


_FOLDER, _NO_CACHE = _cache_folder()
numba.config.CACHE_DIR = _FOLDER  # type: ignore[attr-defined]

# A loop over hypotheses reads and writes about fifty rows of three arrays. Before it runs a
# vectorised loop, LLVM checks that no rows overlap. By default it permits fewer checks.
for _limit in ("runtime-memory-check-threshold", "vectorize-memory-check-threshold"):
    llvm.set_option("", f"--{_limit}=100000")


class NotCachedError(Exception):
    """A function is not in the cache, and the caller does not want it compiled here."""


class _CompileListener(event.Listener):
    """Warns the first time that a function is not in the cache: compiling takes long."""

    has_warned = False
    is_refused = False  # compiling, for the moment

    def on_start(self, event: object) -> None:
        if self.is_refused:
            raise NotCachedError
        if not self.has_warned:
            self.has_warned = True
            kept = f"and not kept: {_NO_CACHE}" if _NO_CACHE else "then kept"
            _log.warning(
                "compiling what is not yet compiled for this processor: 1 to 3 minutes, %s", kept
            )

    def on_end(self, event: object) -> None:
        pass


_listener = _CompileListener()
event.register("numba:compile", _listener)  # type: ignore[no-untyped-call]


@contextmanager
def only_cached() -> Iterator[None]:
    """Raise NotCachedError if the block needs a function that is not in the cache.

    Use it before other threads start that may compile.
    """
    _listener.is_refused = True
    try:
        yield
    finally:
        _listener.is_refused = False


def keeps() -> bool:
    """Whether there is a cache, so that one process finds what another one has compiled."""
    return bool(_FOLDER)


def expect_waiting() -> None:
    """Suppress the warning about compiling: the caller has given its own."""
    _listener.has_warned = True


class _InOwnFolder(CompileResultCacheImpl):
    """Restricts the cache to the checked folder: numba would fall back on others."""

    _locator_classes = [UserProvidedCacheLocator]  # noqa: RUF012 - as numba has it


class _Cache(FunctionCache):
    """Numba's cache, except that a hit does not initialise the compiler.

    Numba would initialise it before the look-up, which is a sixth of the time that a command takes
    to start. After a miss, the compiler initialises itself.
    """

    _impl_class = _InOwnFolder

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]


# No fast-math: results stay the same to the last bit. Division by zero gives inf, as in NumPy.
# _nrt is set explicitly, since numba would inherit it from a caller that is ``per_row``.
_with_arrays = njit(nogil=True, error_model="numpy", _nrt=True)  # type: ignore[call-overload]


class Compiled(Protocol[P, R_co]):
    """A compiled function, with the types of the Python function that it was made from."""

    @property
    def py_func(self) -> Callable[P, R_co]:
        """The Python function, which runs without compiling anything."""
        ...

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R_co:
        """Run it; compile it first if no call has had arguments of these types."""
        ...


def compiled(function: Callable[P, R_co]) -> Compiled[P, R_co]:
    """Compile a function that Python calls, or that is not worth inlining; cached on disk."""
    dispatcher = _with_arrays(function)
    if _FOLDER:
        with suppress(RuntimeError):  # the disk is full
            # As ``cache=True`` does with numba's own cache.
            dispatcher._cache = _Cache(function)  # type: ignore[no-untyped-call]
    return cast("Compiled[P, R_co]", dispatcher)


# For functions called in a loop. Over hypotheses, LLVM only vectorises a loop without calls; over
# rows, a call costs as much as a few lines.
_inlined = njit(forceinline=True, error_model="numpy")

# The same for loops over rows, in functions that create no arrays. Their arguments' references are
# not counted, which saves two atomic additions for each array at every row. A loop over hypotheses
# counts no references anyway, and with this option LLVM would not vectorise it.
_per_row = njit(forceinline=True, error_model="numpy", _nrt=False)  # type: ignore[call-overload]


def inlined(function: Callable[P, R_co]) -> Compiled[P, R_co]:
    """Compile a function that is inlined into a loop over hypotheses."""
    return cast("Compiled[P, R_co]", _inlined(function))


def per_row(function: Callable[P, R_co]) -> Compiled[P, R_co]:
    """Compile a function that is inlined into a loop over rows; it may create no arrays."""
    return cast("Compiled[P, R_co]", _per_row(function))
