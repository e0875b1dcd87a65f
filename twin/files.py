"""Writes files of answers: checked before the work, and written atomically where needed.

It also provides private folders, and a limit of the memory that a file may claim.
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

from twin.errors import ConfigError, SourceError

MOST_DEEP = 20  # levels of a JSON document; an answer of a diagnosis has eight
LONGEST_BITS = 64  # of an integer in JSON; Python refuses to print very long ones
REPLACE = "choose another name, or replace it with --force"
MEMORY_BUDGET = 64 << 20  # bytes; no valid record, batch of rows or package comes near it


def require_within_budget(size: int, subject: str) -> None:
    """ValueError if a file declares more bytes than fit; call it before allocating."""
    if size > MEMORY_BUDGET:
        mib = MEMORY_BUDGET >> 20
        raise ValueError(
            f"{subject} claims {size / 2**20:.0f} MiB; more than {mib} MiB are not read"
        )


def unzipped_within_budget(archive: ZipFile) -> None:
    """ValueError if an archive is too large when unpacked."""
    require_within_budget(sum(entry.file_size for entry in archive.infolist()), "unpacked it")


def require_writable(*paths: Path | None) -> None:
    """SourceError if an answer could not be written; call it before the work."""
    for path in paths:
        if path is None:
            continue
        if path.is_dir():
            raise _unwritable(path, "it is a folder")
        if path.exists():  # overwriting needs no right to the folder: /dev/stdout
            if not os.access(path, os.W_OK):
                raise _unwritable(path, os.strerror(errno.EACCES))
        elif not os.access(path.parent, os.W_OK):
            raise _unwritable(path, "no folder to write to")


def refuse_existing(path: Path, *, force: bool = False, hint: str = REPLACE) -> None:
    """SourceError if a file with data or settings would be replaced without ``--force``.

    A command without that option gives its own ``hint``.
    """
    if path.exists() and not force:
        raise SourceError(f"{path}: there is already a file of that name", hint)


def require_ending(path: Path, *endings: str) -> str:
    """The ending of a new file's name, in small letters: it decides the format.

    ConfigError unless it is one of ``endings``; call it before the work.
    """
    ending = path.suffix.lower()
    if ending not in endings:
        *some, last = endings
        expected = f"{', '.join(some)} or {last}" if some else last
        example = path.parent / f"{path.stem or 'file'}{endings[0]}"
        raise ConfigError(
            f"{path}: the name does not end in {expected}",
            f"the ending decides the format, as in {example}",
        )
    return ending


@contextmanager
def said_plainly(path: Path) -> Iterator[None]:
    """Turn an OSError of the block into a SourceError."""
    try:
        yield
    except OSError as error:
        raise _unwritable(path, error.strerror or str(error)) from error


def write_text(path: Path, text: str) -> None:
    """Write or overwrite a file; SourceError if that fails."""
    with said_plainly(path):
        path.write_text(text, encoding="utf-8")


def write_json(path: Path, document: object) -> None:
    """Write a JSON document for programs."""
    write_text(path, json_text(document, indent=1) + "\n")


def json_text(document: Any, indent: int | None = None) -> str:
    """Valid JSON for every reader; it never fails: a note replaces what JSON cannot hold."""
    return json.dumps(finite(document), indent=indent, ensure_ascii=False, allow_nan=False)


def finite(value: Any, depth: int = MOST_DEEP) -> Any:
    """A value that JSON can hold: null for numbers that are not finite, plain numbers for NumPy's.

    A text replaces what JSON cannot hold, and what nests deeper than ``depth``. A number replaces
    half a character, which UTF-8 cannot hold.
    """
    if isinstance(value, Mapping) and depth:
        return {utf8(str(key)): finite(item, depth - 1) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset) and depth:
        return [finite(item, depth - 1) for item in value]
    if hasattr(value, "tolist") and depth:  # NumPy's, which costs too much to import here
        return finite(value.tolist(), depth - 1)
    return _scalar(value)


def _scalar(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or (isinstance(value, int) and value.bit_length() <= LONGEST_BITS):
        return value
    if isinstance(value, str):
        return utf8(value)
    return f"not JSON ({type(value).__name__}){_excerpt(value)}"


def _excerpt(value: Any) -> str:
    try:
        return f": {reprlib.repr(value)}"
    except ValueError:  # Python prints no integer of thousands of digits
        return ""


def utf8(text: str) -> str:
    """A text that UTF-8 can hold; a number replaces half a character."""
    return text.encode(errors="backslashreplace").decode()


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically; SourceError if it cannot be written."""
    part = path.with_name(path.name + ".part")
    try:
        with said_plainly(path):
            part.write_bytes(content)
            part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink()


def user_cache() -> Path:
    """The cache folder of this user, after the XDG specification.

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
    """Create a folder for this user only; SourceError if an existing one is not private.

    The parent folder must be this user's too: whoever may write there could exchange the folder.
    Its group may write, since many systems give each user a group of his own.
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
    """SourceError if a folder is another user's, or others have a right of ``forbidden``."""
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode):
        raise _unwritable(folder, "it is a link: somebody else may have put it there")
    if status.st_uid != os.geteuid():
        raise SourceError(
            f"{folder} belongs to another user and is not trusted", "have it removed, or given back"
        )
    if status.st_mode & forbidden:
        raise SourceError(
            f"{folder}: others may use it, so it is not trusted", f"chmod 700 {folder}"
        )


def _unwritable(path: Path, cause: str) -> SourceError:
    hint = "check that the folder exists, may be written to and has space"
    return SourceError(f"{path}: cannot be written: {cause}", hint)
