"""The language of texts for people, and its notation of numbers: English, unless chosen otherwise.

A text is its own key, as in gettext; ``twin/locale`` has its translations. Each task and thread has
its own choice, and inherits the one of its creator.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

# English text -> the same in another language; a singular -> all its plural forms.
Texts = Mapping[str, str | tuple[str, ...]]


@dataclass(frozen=True)
class Language:
    """Texts of a language, and its notation of numbers."""

    code: str = "en"
    texts: Texts = field(default_factory=dict)
    plural_form: Callable[[int], int] = lambda count: int(count != 1)  # index of the form
    decimal: str = "."
    group: str = ""  # between thousands of numbers with five digits or more


ENGLISH = Language()
_FIVE_DIGITS = re.compile(r"[-+−]?\d{5,}")
_THOUSAND = re.compile(r"(?<=\d)(?=(?:\d{3})+$)")
_NUMBER = re.compile(r"(?<![\w.])[-+−]?\d+(?:\.\d+)?(?![\w.]*\d)")
_chosen: ContextVar[Language] = ContextVar("language", default=ENGLISH)


def tr(text: str, **values: object) -> str:
    """A text in the chosen language, or in English if the catalogue lacks it.

    ``values`` replace their names in braces; without values the text stays as it is.
    """
    translated = _chosen.get().texts.get(text, text)
    assert isinstance(translated, str), text
    return translated.format(**values) if values else translated


def ntr(singular: str, plural: str, count: int, **values: object) -> str:
    """The form of a text for a count, which replaces ``{count}``; otherwise like ``tr``."""
    language = _chosen.get()
    forms = language.texts.get(singular)
    if isinstance(forms, tuple):
        text = forms[language.plural_form(count)]
    else:
        text = singular if count == 1 else plural
    return text.format(count=numeral(count, "d"), **values)


def numeral(value: float, spec: str) -> str:
    """A number formatted by a format specification, in the notation of the chosen language."""
    return notation(format(value, spec))


def notation(text: str) -> str:
    """A number that is formatted in English, in the notation of the chosen language."""
    language = _chosen.get()
    whole, point, fraction = text.partition(".")
    if _FIVE_DIGITS.fullmatch(whole):
        whole = _THOUSAND.sub(language.group, whole)
    return whole + point.replace(".", language.decimal) + fraction


def notation_within(text: str) -> str:
    """A text with all its numbers in the notation of the chosen language."""
    return _NUMBER.sub(lambda match: notation(match[0]), text)


@contextmanager
def speaking(language: Language) -> Iterator[None]:
    """Choose the language of texts inside the block."""
    token = _chosen.set(language)
    try:
        yield
    finally:
        _chosen.reset(token)


def language_code() -> str:
    """The code of the chosen language, such as ``en`` or ``pt-BR``."""
    return _chosen.get().code
