"""Short constructors of submodels and their elements; a ``semanticId`` gives each a meaning."""

import re
from collections.abc import Iterable, Mapping
from typing import Any

from basyx.aas import model
from basyx.aas.model import datatypes

Element = model.SubmodelElement

ARBITRARY = (
    "https://admin-shell.io/SMT/General/Arbitrary"  # for elements that no dictionary defines
)
MOST_TEXT, MOST_NAME = 1000, 128  # characters, of a text in a language and of an idShort

_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9_]")
_NOT_IN_TEXTS = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def meaning(identifier: str) -> model.ExternalReference:
    """A reference to a meaning."""
    return model.ExternalReference((model.Key(model.KeyTypes.GLOBAL_REFERENCE, identifier),))


def submodel(
    identifier: str, name: str, elements: Iterable[Element], semantic: str
) -> model.Submodel:
    """A submodel."""
    return model.Submodel(identifier, elements, name, semantic_id=meaning(semantic))


def group(name: str | None, elements: Iterable[Element], semantic: str) -> Element:
    """A collection; one without a name stands in a list."""
    return model.SubmodelElementCollection(name, elements, semantic_id=meaning(semantic))


def listed(name: str, groups: Iterable[Element], semantic: str) -> Element:
    """A list of collections, which have no names."""
    return model.SubmodelElementList(
        name, model.SubmodelElementCollection, groups, semantic_id=meaning(semantic)
    )


def typed(name: str, kind: Any, value: object, semantic: str) -> Element:
    """A value of a type of XML Schema; None if it is unknown."""
    converted = None if value is None else kind(value)
    return model.Property(name, kind, converted, semantic_id=meaning(semantic))


def text(name: str, value: str | None, semantic: str) -> Element:
    """A text; None if it is unknown."""
    return typed(name, datatypes.String, value, semantic)


def words(name: str, value: str | None, semantic: str) -> Element:
    """A text in a language, here English; None if it is unknown."""
    translations = model.MultiLanguageTextType({"en": _shown(value)[:MOST_TEXT]}) if value else None
    return model.MultiLanguageProperty(name, translations, semantic_id=meaning(semantic))


def link(name: str, path: str, content: str, semantic: str) -> Element:
    """A file, in the package or elsewhere; ``content`` is its media type."""
    return model.File(name, content, path, semantic_id=meaning(semantic))


def numbers(name: str, values: Iterable[float]) -> Element:
    """A list of numbers."""
    kind = datatypes.Double
    properties = (model.Property(None, kind, float(number)) for number in values)
    return model.SubmodelElementList(
        name,
        model.Property,
        properties,
        value_type_list_element=kind,
        semantic_id=meaning(ARBITRARY),
    )


def tree(table: Mapping[str, Any]) -> list[Element]:
    """Nested tables as nested collections, without null and empty values."""
    named: dict[str, Any] = {}
    for key, value in table.items():
        name = short(key)
        while name in named:
            name = short(f"{name}_")
        named[name] = _branch(name, value)
    return [element for element in named.values() if element is not None]


def short(name: str) -> str:
    """A name as a valid idShort: letters, digits and underscores, a letter first."""
    plain = _NOT_IN_NAMES.sub("_", name)
    return (plain if re.match("[A-Za-z]", plain) else f"x_{plain}")[:MOST_NAME]


def _branch(name: str, value: Any) -> Element | None:
    if isinstance(value, list) and value and all(_is_number(item) for item in value):
        return numbers(name, value)
    if isinstance(value, list):
        value = {f"{name}_{index}": item for index, item in enumerate(value)}
    if isinstance(value, Mapping):
        inner = tree(value)
        return group(name, inner, ARBITRARY) if inner else None
    if isinstance(value, str):
        return text(name, _shown(value), ARBITRARY)
    kind = next((item for item in (bool, int, float) if isinstance(value, item)), None)
    return None if kind is None else typed(name, kind, value, ARBITRARY)  # True is an int as well


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _shown(value: str) -> str:
    """The text without characters that shells cannot hold."""
    return _NOT_IN_TEXTS.sub("\ufffd", value)
