"""The languages of the page: gettext catalogues, and the choice by a browser's preferences."""

from collections.abc import Mapping, Sequence
from importlib import resources

from babel import Locale
from babel.messages.pofile import read_po

from twin.language import Texts

ENGLISH = "en"
MOST_ASKED = 20  # languages of a browser that are considered


class Catalogues:
    """All languages that come with the program: ``twin/locale/de.po`` and its like."""

    def __init__(self) -> None:
        folder = resources.files("twin").joinpath("locale")
        files = sorted(file.name for file in folder.iterdir() if file.name.endswith(".po"))
        self.texts: Mapping[str, Texts] = {ENGLISH: {}} | {
            name.removesuffix(".po"): _read(folder.joinpath(name).read_bytes()) for name in files
        }

    @property
    def names(self) -> list[dict[str, str]]:
        """Each language's code and its own name."""
        return [{"code": code, "name": _own_name(code)} for code in self.texts]

    def choose(self, chosen: str, accepted: str) -> str:
        """The code of a language: the ``chosen`` one, else the best that a browser accepts."""
        codes = {code.lower(): code for code in self.texts}
        for language in (chosen, *_preferred(accepted)):
            lower_case = language.lower()
            if match := codes.get(lower_case) or codes.get(lower_case.partition("-")[0]):
                return match
        return ENGLISH


def _read(file: bytes) -> Texts:
    messages = read_po(file.splitlines(keepends=True))
    return {
        str(message.id): str(message.string)
        for message in messages
        if message.id and message.string and not message.fuzzy
    }


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
