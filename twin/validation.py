"""What is wrong with a table, in words: Pydantic's finding, and what the key could have been."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from textwrap import shorten
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

_MOST_KEYS = 12  # that are listed where none is alike
_IS_ENOUGH = ("missing", "value_error", "extra_forbidden")  # or what is given may be a whole table
_BOUNDS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}
_CHOICES = {  # what is expected, what is given, and what that is
    "literal_error": ("expected", "", ""),
    "enum": ("expected", "", ""),
    "union_tag_invalid": ("expected_tags", "tag", "kind "),
}
_KINDS = {  # beginnings of Pydantic's names of errors, and what must stand there
    "missing": "is missing, and has no default",
    "union_tag_not_found": "needs a kind",
    "finite_number": "must be a finite number",
    "float_": "must be a number",
    "int_from_float": "must be a whole number",
    "int_": "must be a whole number",
    "bool_": "must be true or false",
    "string_type": 'must be text, in quotation marks: "..."',
    "path_type": 'must be a path, in quotation marks: "..."',
    "mapping_type": "must be a table",
    "dict_type": "must be a table",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
    "tuple_type": "must be a list: [...]",
    "list_type": "must be a list: [...]",
}


def findings(
    error: ValidationError, kind: type[BaseModel]
) -> Iterator[tuple[Mapping[str, Any], str]]:
    """What Pydantic found wrong with a table of ``kind``, each with what it is in words.

    A mistyped key comes first. What follows from another finding is left out: that the right key
    is missing, and that a default cannot be made of a wrong value.
    """
    problems = error.errors(include_url=False)
    meant: set[tuple[str | int, ...]] = set()
    for problem in sorted(problems, key=lambda one: one["type"] != "extra_forbidden"):
        loc = problem["loc"]
        if problem["type"] == "default_factory_not_called":
            continue
        if problem["type"] == "missing" and loc in meant:
            continue
        what = in_words(problem, kind, loc)
        if problem["type"] == "extra_forbidden" and what.endswith("?"):
            meant.add((*loc[:-1], what.rpartition(" ")[2].rstrip("?")))
        yield problem, what


def in_words(problem: Mapping[str, Any], kind: type[BaseModel], loc: Sequence[str | int]) -> str:
    """What is wrong at ``loc`` below a table of ``kind``, with what stands there.

    ``problem`` is one of Pydantic's errors.
    """
    what = _what(problem, kind, loc)
    given = "" if problem["type"] in _IS_ENOUGH else f" (is {shorten(repr(problem['input']), 80)})"
    return what + given


def path_in_words(keys: Sequence[str | int]) -> str:
    """A key with the tables above it; entries of lists are counted from 1."""
    path = ""
    for key in keys:
        if isinstance(key, int):
            path += f", {ordinal(key + 1)} entry,"
        else:
            path += f" {key}" if path.endswith(",") else f".{key}"
    return path.lstrip(".").rstrip(",")


def ordinal(number: int) -> str:
    """1st, 2nd, 3rd, 4th."""
    ending = {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{'th' if number % 100 in (11, 12, 13) else ending}"


def alike(asked: str, names: Iterable[str]) -> str:
    """The question whether one of these names is meant, or all of them where none is alike."""
    there = sorted(set(names))
    if nearest := get_close_matches(asked.lower(), there, n=1):
        return f"do you mean {nearest[0]}?"
    more = f" and {len(there) - _MOST_KEYS} more" if len(there) > _MOST_KEYS else ""
    return f"known are {', '.join(there[:_MOST_KEYS])}{more}" if there else ""


def models_at(annotation: Any, loc: Sequence[str | int] = ()) -> Iterator[type[BaseModel]]:
    """The kinds of table that may stand at a place below a type, given as Pydantic's errors do."""
    for one in alternatives(annotation):
        is_model = isinstance(one, type) and issubclass(one, BaseModel)
        if not loc:
            if is_model:
                yield one
            continue
        key, below = loc[0], loc[1:]
        if is_model and key in one.model_fields:
            yield from models_at(one.model_fields[key].annotation, below)
        elif is_model and key in _tags(one):
            yield from models_at(one, below)
        elif not is_model:
            for inner in elements(one):
                yield from models_at(inner, below)


def without_tags(kind: type[BaseModel], loc: Sequence[str | int]) -> list[str | int]:
    """A place without the kinds by which tables are told apart: no file has these as keys."""
    kept = []
    for at, key in enumerate(loc):
        models = list(models_at(kind, loc[:at]))
        is_field = any(key in model.model_fields for model in models)
        if is_field or not any(key in _tags(model) for model in models):
            kept.append(key)
    return kept


def _what(problem: Mapping[str, Any], kind: type[BaseModel], loc: Sequence[str | int]) -> str:
    name, context = problem["type"], problem.get("ctx", {})
    if name == "extra_forbidden":
        keys = {key for model in models_at(kind, loc[:-1]) for key in model.model_fields}
        question = alike(str(loc[-1]), keys)
        return f"unknown key{': ' if question else ''}{question}"
    if name in _BOUNDS:
        bound, words = _BOUNDS[name]
        return f"must be {words} {context[bound]:g}"
    if name in _CHOICES:
        expected, given, what = _CHOICES[name]
        return _one_of(context[expected], context.get(given, problem["input"]), what)
    if "error" in context:
        return str(context["error"])
    plain = (words for beginning, words in _KINDS.items() if name.startswith(beginning))
    return next(plain, str(problem["msg"]))


def _one_of(expected: str, given: object, what: str = "") -> str:
    """``expected`` as Pydantic writes it: quoted, with commas."""
    names = [name.strip(" '\"") for name in expected.replace(" or ", ", ").split(",")]
    by_case = {name.lower(): name for name in names}
    nearest = get_close_matches(str(given).lower(), by_case, n=1)
    question = f": do you mean {by_case[nearest[0]]}?" if nearest else ""
    if question and len(names) > _MOST_KEYS:
        return f"{what}is none that is known{question}"
    return f"{what}must be {' or '.join(names)}{question}"


def alternatives(annotation: Any) -> Iterator[Any]:
    """The types that a value may have, without what is said beside them."""
    origin = get_origin(annotation)
    if origin is Annotated:
        yield from alternatives(get_args(annotation)[0])
    elif origin in (Union, UnionType):
        for one in get_args(annotation):
            yield from alternatives(one)
    else:
        yield annotation


def elements(annotation: Any) -> Iterator[Any]:
    """What a table of any keys, or a list, holds."""
    arguments = get_args(annotation)
    origin = get_origin(annotation)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        yield arguments[1]
    elif isinstance(origin, type) and issubclass(origin, Sequence):
        yield from (one for one in arguments if one is not Ellipsis)


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    """The kinds by which a table is told from others in its place."""
    field = model.model_fields.get("kind")
    is_literal = field is not None and get_origin(field.annotation) is Literal
    return get_args(field.annotation) if field is not None and is_literal else ()
