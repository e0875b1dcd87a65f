"""What takes long to calculate and tests of several files need: once for all processes of a run."""

import fcntl
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from hashlib import sha256
from pathlib import Path
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
_folders: list[Path] = []


def share(folder: Path) -> None:
    """Keep results in a folder that only processes of this run use."""
    folder.mkdir(exist_ok=True)
    _folders[:] = [folder]


@contextmanager
def alone(name: str) -> Iterator[Path | None]:
    """One process at a time; gives the path of what it may leave to the others."""
    if not _folders:
        yield None
        return
    path = _folders[0] / name
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # until it is closed
        yield path


def _write_whole(path: Path, content: bytes) -> None:
    """The file has all of it or is not there, even if the process ends while it writes."""
    part = path.with_suffix(".part")
    part.write_bytes(content)
    part.rename(path)


def once(function: Callable[P, R]) -> Callable[P, R]:
    """The function, whose results are for reading only; its arguments have a ``repr``."""

    @cache
    @wraps(function)
    def result(*arguments: P.args, **named: P.kwargs) -> R:
        key = repr((function.__module__, function.__qualname__, arguments, named))
        with alone(sha256(key.encode()).hexdigest()) as path:
            if path and path.exists():
                return pickle.loads(path.read_bytes())  # type: ignore[no-any-return]
            found = function(*arguments, **named)
            if path:
                _write_whole(path, pickle.dumps(found))
            return found

    return result  # type: ignore[return-value]
