"""The languages that are there, and the one that a configuration or an option names."""

from pathlib import Path

from twin.errors import ConfigError, known_names
from twin.extras import require
from twin.languages.texts import ENGLISH, Language


def language_of(code: str, name: str) -> Language:
    """The language with a code; ``name`` is where it was chosen.

    ConfigError if there is no such catalogue, or if the reader of catalogues is not installed.
    """
    if code == ENGLISH.code:
        return ENGLISH
    require("serve", f'{name} "{code}"', "babel")
    from twin.languages.catalogues import Catalogues  # noqa: PLC0415 - of the extra serve

    languages = Catalogues().languages
    if code not in languages:
        raise ConfigError(f'{name}: there are no texts in "{code}"', known_names(code, languages))
    return languages[code]


def all_languages() -> list[Language]:
    """All languages, English first; only English if the reader of catalogues is not installed."""
    try:
        from twin.languages.catalogues import Catalogues  # noqa: PLC0415 - of the extra serve
    except ImportError:
        return [ENGLISH]
    return list(Catalogues().languages.values())


def translation_of(file: Path, code: str) -> Path:
    """The name of a file in a language: ``report.de.html`` beside ``report.html`` in English."""
    return file if code == ENGLISH.code else file.with_suffix(f".{code}{file.suffix}")
