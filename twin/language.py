"""The language of texts for people: English, unless another one was chosen.

A text is its own key, as in gettext. Each task and thread has its own choice, and inherits the one
of its creator.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar

Texts = Mapping[str, str]  # English text -> the same in another language

_ENGLISH: Texts = {}
_chosen: ContextVar[Texts] = ContextVar("texts", default=_ENGLISH)


def tr(text: str, **values: object) -> str:
    """A text in the chosen language, or in English if the catalogue lacks it.

    ``values`` replace their names in braces; without values the text stays as it is.
    """
    translated = _chosen.get().get(text, text)
    return translated.format(**values) if values else translated


@contextmanager
def speaking(texts: Texts) -> Iterator[None]:
    """Choose the language of texts inside the block."""
    token = _chosen.set(texts)
    try:
        yield
    finally:
        _chosen.reset(token)


def is_english() -> bool:
    """Whether the language is English."""
    return not _chosen.get()
