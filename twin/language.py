"""The language in which texts for people are said: English, unless somebody chose another one.

A text is its own key, as in gettext. Each task and thread has its own choice, and begins with the
one of whoever started it.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar

Texts = Mapping[str, str]  # English text -> the same in another language

_ENGLISH: Texts = {}
_chosen: ContextVar[Texts] = ContextVar("texts", default=_ENGLISH)


def tr(text: str, **values: object) -> str:
    """A text in the chosen language, or in English where the catalogue lacks it.

    ``values`` replace their names in braces; without any the text is taken as it is.
    """
    said = _chosen.get().get(text, text)
    return said.format(**values) if values else said


@contextmanager
def speaking(texts: Texts) -> Iterator[None]:
    """Choose a language for what is said inside."""
    token = _chosen.set(texts)
    try:
        yield
    finally:
        _chosen.reset(token)


def is_english() -> bool:
    """Whether nothing else was chosen."""
    return not _chosen.get()
