"""Files that answers are written to: refused before the work, whole or not at all after it.

And folders that nobody else may write to, and how much a file may make us hold in memory.
"""

import errno
import json
import math
import os
import reprlib
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from zipfile import ZipFile

from twin.errors import SourceError

MOST_DEEP = 20  # levels of what is written as JSON; an answer of a diagnosis has eight
LONGEST_BITS = 64  # of an integer there; Python refuses to print very long ones
MEMORY_BUDGET = 64 << 20  # bytes; no record, batch of rows or package of ours is ever near it


def require_within_budget(size: int, what: str) -> None:
    """ValueError if what a file declares is too much to be held; ask before it is allocated."""
    if size > MEMORY_BUDGET:
        mib = MEMORY_BUDGET >> 20
        raise ValueError(f"{what} claims {size / 2**20:.0f} MiB; more than {mib} MiB are not read")


def unzipped_within_budget(archive: ZipFile) -> None:
    """ValueError if all of an archive is too much to be held unpacked."""
    require_within_budget(sum(one.file_size for one in archive.infolist()), "unpacked it")


def require_writable(*paths: Path | None) -> None:
    """SourceError before the work is done, if its answer could not be written."""
    for path in paths:
        if path is None:
            continue
        if path.is_dir():
            raise _unwritable(path, "it is a folder")
        if path.exists():  # it is written over, whatever its folder allows: /dev/stdout
            if not os.access(path, os.W_OK):
                raise _unwritable(path, os.strerror(errno.EACCES))
        elif not os.access(path.parent, os.W_OK):
            raise _unwritable(path, "no folder to write to")


@contextmanager
def said_plainly(path: Path) -> Iterator[None]:
    """SourceError where what is written inside cannot be written."""
    try:
        yield
    except OSError as error:
        raise _unwritable(path, error.strerror or str(error)) from error


def write_text(path: Path, text: str) -> None:
    """Write a file that may be there already; SourceError if that cannot be done."""
    with said_plainly(path):
        path.write_text(text, encoding="utf-8")


def write_json(path: Path, document: object) -> None:
    """Write an answer for programs."""
    write_text(path, json_text(document, indent=1) + "\n")


def json_text(document: Any, indent: int | None = None) -> str:
    """JSON that every reader takes; it never fails: what has no form there is said to have none."""
    return json.dumps(finite(document), indent=indent, ensure_ascii=False, allow_nan=False)


def finite(value: Any, deep: int = MOST_DEEP) -> Any:
    """What JSON can hold: null for a number that is not finite, plain numbers for NumPy's.

    Text for what it cannot hold, and for what nests deeper than ``deep``; half a character, which
    UTF-8 cannot hold, as its number.
    """
    if isinstance(value, Mapping) and deep:
        return {utf8(str(key)): finite(one, deep - 1) for key, one in value.items()}
    if isinstance(value, list | tuple | set | frozenset) and deep:
        return [finite(one, deep - 1) for one in value]
    if hasattr(value, "tolist") and deep:  # NumPy's, which costs too much to import here
        return finite(value.tolist(), deep - 1)
    return _single(value)


def _single(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or (isinstance(value, int) and value.bit_length() <= LONGEST_BITS):
        return value
    if isinstance(value, str):
        return utf8(value)
    return f"not JSON ({type(value).__name__}){_shown(value)}"


def _shown(value: Any) -> str:
    try:
        return f": {reprlib.repr(value)}"
    except ValueError:  # Python prints no integer of thousands of digits
        return ""


def utf8(text: str) -> str:
    """A text that UTF-8 can hold: half a character is its number."""
    return text.encode(errors="backslashreplace").decode()


def write_whole(path: Path, content: bytes) -> None:
    """The file is there complete, or as it was before; SourceError if it cannot be written."""
    part = path.with_name(path.name + ".part")
    try:
        with said_plainly(path):
            part.write_bytes(content)
            part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink()


def user_cache() -> Path:
    """Where what can be made again is kept for this user, as the XDG specification has it.

    SourceError for a user without a home.
    """
    chosen = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if chosen.is_absolute():
        return chosen / "ejector-twin"
    try:
        return Path.home() / ".cache" / "ejector-twin"
    except RuntimeError as error:
        raise SourceError("this user has no home folder", "set XDG_CACHE_HOME") from error


def private_folder(folder: Path) -> Path:
    """Make a folder for this user only, if it is not there; SourceError if it is not private.

    Who may write into the folder above could exchange it: that one, too, is this user's. A group
    may, as many systems give each user one of his own.
    """
    with said_plainly(folder):
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        _require_own(folder.parent.resolve(), stat.S_IWOTH)
        _require_own(folder, stat.S_IRWXG | stat.S_IRWXO)
        if not os.access(folder, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    return folder


def _require_own(folder: Path, forbidden: int) -> None:
    """SourceError where a folder is another user's, or others have a right of ``forbidden``."""
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode):
        raise _unwritable(folder, "it is a link: somebody else may have put it there")
    if found.st_uid != os.geteuid():
        raise SourceError(
            f"{folder} belongs to another user and is not trusted", "have it removed, or given back"
        )
    if found.st_mode & forbidden:
        raise SourceError(
            f"{folder}: others may use it, so it is not trusted", f"chmod 700 {folder}"
        )


def _unwritable(path: Path, why: str) -> SourceError:
    hint = "check that the folder exists, may be written to and has space"
    return SourceError(f"{path}: cannot be written: {why}", hint)
