"""Files that answers are written to: refused before the work, whole or not at all after it."""

import errno
import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from twin.errors import SourceError


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
    text = json.dumps(finite(document), indent=1, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")


def finite(value: Any) -> Any:
    """What JSON can hold: null for a number that is not finite, plain numbers for NumPy's."""
    if isinstance(value, Mapping):
        return {str(key): finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    if hasattr(value, "item"):  # NumPy's numbers
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


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


def _unwritable(path: Path, why: str) -> SourceError:
    hint = "check that the folder exists, may be written to and has space"
    return SourceError(f"{path}: cannot be written: {why}", hint)
