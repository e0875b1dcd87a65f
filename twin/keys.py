"""The keys of a table and what the comments beside them say: for editors and for the reference.

A comment at the end of a field's line, or in lines of its own above it, is what is to be known of
the key. So it stands once, where the key is declared.
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
UNWRITTEN = {"healthy"}  # keys that a calibration fills in, and no person


def tables_below(
    kind: type[BaseModel], path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], type[BaseModel]]]:
    """A kind of table and those inside it, each with its path; that of a list ends with ``[]``."""
    yield path, kind
    for name, field in kind.model_fields.items():
        if name not in UNWRITTEN:
            for below, inner in _models(field.annotation, (*path, name)):
                yield from tables_below(inner, below)


def _models(
    annotation: Any, path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], type[BaseModel]]]:
    for one in alternatives(annotation):
        if isinstance(one, type) and issubclass(one, BaseModel):
            yield path, one
            continue
        for inner in elements(one):
            is_table = one.__origin__ not in (tuple, list)
            yield from _models(inner, (*path, ANY) if is_table else (*path[:-1], f"{path[-1]}[]"))


def defaults_of(kind: type[BaseModel]) -> dict[str, Any]:
    """The defaults of a table's keys as JSON has them; a required key has none."""
    made = kind.model_construct().model_dump(mode="json", warnings=False)
    return {
        name: made[name] for name, field in kind.model_fields.items() if not field.is_required()
    }


@cache
def comments_of(kind: type[BaseModel]) -> dict[str, str]:
    """What is said of each key of a table, also of those it has from another kind of table."""
    found: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        if issubclass(one, BaseModel) and one not in (BaseModel, Settings):
            found |= {name: text for name, text in _own_comments(one).items() if text}
    return {name: found.get(name, "") for name in kind.model_fields}


def _own_comments(kind: type[BaseModel]) -> dict[str, str]:
    source = textwrap.dedent(inspect.getsource(kind))
    comments: dict[int, tuple[str, bool]] = {}  # by line: the text, and whether it stands alone
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and "noqa" not in token.string:
            is_alone = not token.line[: token.start[1]].strip()
            comments[token.start[0]] = token.string.lstrip("# "), is_alone
    (body,) = ast.parse(source).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
            beside = [comments[line][0] for line in lines if line in comments]
            found[node.target.id] = " ".join(beside or _above(comments, node.lineno))
    return found


def _above(comments: dict[int, tuple[str, bool]], line: int) -> list[str]:
    """The lines of a comment that ends right above a line."""
    texts: list[str] = []
    while comments.get(line - 1, ("", False))[1]:
        line -= 1
        texts.insert(0, comments[line][0])
    return texts
