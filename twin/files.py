"""Files that answers are written to: refused before the work, whole or not at all after it."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from twin.errors import SourceError


def require_writable(*paths: Path | None) -> None:
    """SourceError before the work is done, if its answer could not be written."""
    for path in paths:
        if path is None:
            continue
        if path.is_dir():
            raise _unwritable(path, "it is a folder")
        if not os.access(path.parent, os.W_OK):
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
    """Write an answer for programs; NaN is none of JSON's numbers."""
    write_text(path, json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


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
