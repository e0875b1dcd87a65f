"""The keys of a table and the comments beside them, for editors and for the reference.

A comment at the end of a field's line, or in lines of its own above it, describes the key. So the
description is written once, where the key is declared.
"""

import ast
import inspect
import io
import textwrap
import tokenize
from collections.abc import Iterator
from functools import cache
from typing import Any

from pydantic import BaseModel

from twin.settings import Settings
from twin.validation import alternatives, elements

ANY = "NAME"  # stands for a key that a person chooses
UNWRITTEN = {"healthy"}  # keys that a calibration fills in, not a person


def tables_below(
    kind: type[BaseModel], path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], type[BaseModel]]]:
    """A kind of table and those inside it, each with its path; a list's path ends with ``[]``."""
    yield path, kind
    for name, field in kind.model_fields.items():
        if name not in UNWRITTEN:
            for inner_path, inner in _models(field.annotation, (*path, name)):
                yield from tables_below(inner, inner_path)


def _models(
    annotation: Any, path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], type[BaseModel]]]:
    for alternative in alternatives(annotation):
        if isinstance(alternative, type) and issubclass(alternative, BaseModel):
            yield path, alternative
            continue
        for inner in elements(alternative):
            is_table = alternative.__origin__ not in (tuple, list)
            yield from _models(inner, (*path, ANY) if is_table else (*path[:-1], f"{path[-1]}[]"))


def defaults_of(kind: type[BaseModel]) -> dict[str, Any]:
    """The defaults of a table's keys for JSON; a required key has none."""
    defaults = kind.model_construct().model_dump(mode="json", warnings=False)
    return {
        name: defaults[name] for name, field in kind.model_fields.items() if not field.is_required()
    }


@cache
def comments_of(kind: type[BaseModel]) -> dict[str, str]:
    """The comment on each key of a table, including inherited keys."""
    comments: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if issubclass(base, BaseModel) and base not in (BaseModel, Settings):
            comments |= {name: text for name, text in _own_comments(base).items() if text}
    return {name: comments.get(name, "") for name in kind.model_fields}


def _own_comments(kind: type[BaseModel]) -> dict[str, str]:
    source = textwrap.dedent(inspect.getsource(kind))
    comments: dict[
        int, tuple[str, bool]
    ] = {}  # by line: text, and whether the line has only the comment
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and "noqa" not in token.string:
            is_alone = not token.line[: token.start[1]].strip()
            comments[token.start[0]] = token.string.lstrip("# "), is_alone
    (body,) = ast.parse(source).body
    assert isinstance(body, ast.ClassDef)
    texts = {}
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
            own_lines = [comments[line][0] for line in lines if line in comments]
            texts[node.target.id] = " ".join(own_lines or _above(comments, node.lineno))
    return texts


def _above(comments: dict[int, tuple[str, bool]], line: int) -> list[str]:
    """The lines of a comment directly above a line."""
    texts: list[str] = []
    while comments.get(line - 1, ("", False))[1]:
        line -= 1
        texts.insert(0, comments[line][0])
    return texts
