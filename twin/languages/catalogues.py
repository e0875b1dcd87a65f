"""The languages of texts: gettext catalogues, and the choice by a browser's preferences."""

from collections.abc import Mapping, Sequence
from gettext import c2py
from importlib import resources

from babel import Locale
from babel.messages.catalog import Catalog
from babel.messages.pofile import read_po
from babel.numbers import get_decimal_symbol

from twin.languages.texts import ENGLISH, Language, Texts

MOST_ASKED = 20  # languages of a browser that are considered
THIN_SPACE = "\u202f"  # between thousands after ISO 80000-1; a line does not break there


class Catalogues:
    """All languages that come with the program: ``twin/locale/de.po`` and its like."""

    def __init__(self) -> None:
        folder = resources.files("twin").joinpath("locale")
        files = sorted(file.name for file in folder.iterdir() if file.name.endswith(".po"))
        names = {name.removesuffix(".po"): name for name in files}
        self._catalogs = {
            code: read_catalog(folder.joinpath(name).read_bytes(), code)
            for code, name in names.items()
        }
        self.languages: Mapping[str, Language] = {ENGLISH.code: ENGLISH} | {
            code: _language(code, catalog) for code, catalog in self._catalogs.items()
        }

    @property
    def names(self) -> list[dict[str, str]]:
        """Each language's code and its own name."""
        return [{"code": code, "name": _own_name(code)} for code in self.languages]

    def plural_expression(self, code: str) -> str:
        """The index of the plural form of ``n`` as an expression of C, as gettext has it."""
        return str(self._catalogs[code].plural_expr) if code in self._catalogs else "(n != 1)"

    def of_scripts(self, code: str) -> Texts:
        """The texts of a language that scripts in a browser have, by the files they are from."""
        texts = self.languages[code].texts
        ids = (
            message.id[0] if isinstance(message.id, tuple | list) else message.id
            for message in self._catalogs.get(code, ())
            if any(path.endswith(".js") for path, _ in message.locations)
        )
        return {text: texts[text] for text in ids if text in texts}

    def choose(self, chosen: str, accepted: str) -> str:
        """The code of a language: the ``chosen`` one, else the best that a browser accepts."""
        codes = {code.lower(): code for code in self.languages}
        for language in (chosen, *_preferred(accepted)):
            lower_case = language.lower()
            if match := codes.get(lower_case) or codes.get(lower_case.partition("-")[0]):
                return match
        return ENGLISH.code


def read_catalog(file: bytes, code: str) -> Catalog:
    """The catalogue of a language; its plural forms are those of the language."""
    return read_po(file.splitlines(keepends=True), locale=code.replace("-", "_"))


def _language(code: str, catalog: Catalog) -> Language:
    texts: dict[str, str | tuple[str, ...]] = {}
    for message in catalog:
        if not message.id or message.fuzzy:
            continue
        if isinstance(message.id, str):
            if message.string:
                texts[message.id] = str(message.string)
        elif isinstance(message.string, tuple | list) and all(message.string):
            texts[message.id[0]] = tuple(message.string)
    decimal = get_decimal_symbol(Locale.parse(code, sep="-"))
    return Language(code, texts, c2py(catalog.plural_expr), decimal, THIN_SPACE)


def _own_name(code: str) -> str:
    locale = Locale.parse(code, sep="-")
    name = locale.get_display_name(locale) or code
    return name[:1].upper() + name[1:]


def _preferred(accepted: str) -> Sequence[str]:
    """The languages of an Accept-Language header (RFC 9110), in order of preference."""
    languages = []
    for part in accepted.split(",")[:MOST_ASKED]:
        language, _, weight = part.partition(";")
        try:
            quality = float(weight.strip().removeprefix("q=") or 1.0)
        except ValueError:
            continue
        if language.strip() and quality > 0.0:
            languages.append((quality, language.strip()))
    return [language for _, language in sorted(languages, key=lambda item: -item[0])]
