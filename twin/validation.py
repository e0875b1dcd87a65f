"""Errors of a table in words: Pydantic's finding, and the key that was probably meant."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from textwrap import shorten
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

_MOST_KEYS = 12  # listed keys if none is similar
_IS_ENOUGH = ("missing", "value_error", "extra_forbidden")  # without the value: it may be a table
_BOUNDS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}
_CHOICES = {  # keys of the expected and the given value, and a label
    "literal_error": ("expected", "", ""),
    "enum": ("expected", "", ""),
    "union_tag_invalid": ("expected_tags", "tag", "kind "),
}
_KINDS = {  # beginnings of Pydantic's error names, and the requirement in words
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
    """Pydantic's errors in a table of ``kind``, each with its text.

    Mistyped keys come first. Errors that follow from others are left out: that the right key is
    missing, and that a default cannot be made of a wrong value.
    """
    problems = error.errors(include_url=False)
    intended: set[tuple[str | int, ...]] = set()
    for problem in sorted(problems, key=lambda problem: problem["type"] != "extra_forbidden"):
        loc = problem["loc"]
        if problem["type"] == "default_factory_not_called":
            continue
        if problem["type"] == "missing" and loc in intended:
            continue
        text = in_words(problem, kind, loc)
        if problem["type"] == "extra_forbidden" and text.endswith("?"):
            intended.add((*loc[:-1], text.rpartition(" ")[2].rstrip("?")))
        yield problem, text


def in_words(problem: Mapping[str, Any], kind: type[BaseModel], loc: Sequence[str | int]) -> str:
    """The error at ``loc`` below a table of ``kind`` in words, with the value there.

    ``problem`` is one of Pydantic's errors.
    """
    if loc and loc[-1] == "[key]" and problem["type"] in _CHOICES:
        asked = str(problem["input"])
        return f"there is no key {asked}: {alike(asked, _names(problem['ctx']['expected']))}"
    text = _text_of(problem, kind, loc)
    given = "" if problem["type"] in _IS_ENOUGH else f" (is {shorten(repr(problem['input']), 80)})"
    return text + given


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
    """The question whether a similar name is meant, or all names if none is similar."""
    sorted_names = sorted(set(names))
    if nearest := get_close_matches(asked.lower(), sorted_names, n=1):
        return f"do you mean {nearest[0]}?"
    more = f" and {len(sorted_names) - _MOST_KEYS} more" if len(sorted_names) > _MOST_KEYS else ""
    return f"known are {', '.join(sorted_names[:_MOST_KEYS])}{more}" if sorted_names else ""


def models_at(annotation: Any, loc: Sequence[str | int] = ()) -> Iterator[type[BaseModel]]:
    """The kinds of table that are possible at ``loc`` (as in Pydantic's errors) below a type."""
    for alternative in alternatives(annotation):
        is_model = isinstance(alternative, type) and issubclass(alternative, BaseModel)
        if not loc:
            if is_model:
                yield alternative
            continue
        key, rest = loc[0], loc[1:]
        if is_model and key in alternative.model_fields:
            yield from models_at(alternative.model_fields[key].annotation, rest)
        elif is_model and key in _tags(alternative):
            yield from models_at(alternative, rest)
        elif not is_model:
            for inner in elements(alternative):
                yield from models_at(inner, rest)


def without_tags(kind: type[BaseModel], loc: Sequence[str | int]) -> list[str | int]:
    """A location without the kinds that distinguish tables: they are no keys of a file."""
    keys = []
    for depth, key in enumerate(loc):
        models = list(models_at(kind, loc[:depth]))
        is_field = any(key in model.model_fields for model in models)
        if is_field or not any(key in _tags(model) for model in models):
            keys.append(key)
    return keys


def _text_of(problem: Mapping[str, Any], kind: type[BaseModel], loc: Sequence[str | int]) -> str:
    name, context = problem["type"], problem.get("ctx", {})
    if name == "extra_forbidden":
        keys = {key for model in models_at(kind, loc[:-1]) for key in model.model_fields}
        question = alike(str(loc[-1]), keys)
        return f"unknown key{': ' if question else ''}{question}"
    if name in _BOUNDS:
        bound, words = _BOUNDS[name]
        return f"must be {words} {context[bound]:g}"
    if name in _CHOICES:
        expected, given, label = _CHOICES[name]
        return _one_of(context[expected], context.get(given, problem["input"]), label)
    if "error" in context:
        return str(context["error"])
    plain = (words for beginning, words in _KINDS.items() if name.startswith(beginning))
    return next(plain, str(problem["msg"]))


def _one_of(expected: str, given: object, label: str = "") -> str:
    """The text for a choice among ``expected``."""
    names = _names(expected)
    by_case = {name.lower(): name for name in names}
    nearest = get_close_matches(str(given).lower(), by_case, n=1)
    question = f": do you mean {by_case[nearest[0]]}?" if nearest else ""
    return f"{label}must be {' or '.join(names)}{question}"


def _names(expected: str) -> list[str]:
    """The names of a choice that is in Pydantic's form: quoted, with commas."""
    return [name.strip(" '\"") for name in expected.replace(" or ", ", ").split(",")]


def alternatives(annotation: Any) -> Iterator[Any]:
    """The types that a value may have, without annotations."""
    origin = get_origin(annotation)
    if origin is Annotated:
        yield from alternatives(get_args(annotation)[0])
    elif origin in (Union, UnionType):
        for argument in get_args(annotation):
            yield from alternatives(argument)
    else:
        yield annotation


def elements(annotation: Any) -> Iterator[Any]:
    """The types of the elements of a list, or of a table with any keys."""
    arguments = get_args(annotation)
    origin = get_origin(annotation)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        yield arguments[1]
    elif isinstance(origin, type) and issubclass(origin, Sequence):
        yield from (argument for argument in arguments if argument is not Ellipsis)


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    """The kinds that distinguish a table from others in its place."""
    field = model.model_fields.get("kind")
    is_literal = field is not None and get_origin(field.annotation) is Literal
    return get_args(field.annotation) if field is not None and is_literal else ()
