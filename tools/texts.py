"""Update the catalogues in twin/locale from the code: add new texts empty, drop stale ones.

``python tools/texts.py`` does it to all of them, ``python tools/texts.py fr`` begins another
language. Fill in each ``msgstr``; a text without one stays English.
"""

import re
import sys
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path

from babel.messages.catalog import Catalog
from babel.messages.extract import extract_from_file
from babel.messages.pofile import read_po, write_po

from twin.alarms.causes import cause_of
from twin.alarms.limits import ADJUSTABLE
from twin.alarms.rules import by_cause, default_rules
from twin.alarms.text import COMMISSION
from twin.diagnosis.text import spoken
from twin.figures.table import FIGURES
from twin.model.effects import EFFECTS
from twin.monitor.healthy import NOT_COMMISSIONED
from twin.page import ejector_status as light
from twin.page import plant_overview_text as hall_words
from twin.page.app import MARKED

ROOT = Path(__file__).resolve().parents[1]
LOCALE = ROOT / "twin" / "locale"
STATIC = ROOT / "twin" / "page" / "static"
_OPTIONS = {"parse_template_string": True}  # scripts nest some texts in others
Text = tuple[str, str]  # location and text


def texts() -> Iterator[Text]:
    """Every text that is shown in the reader's language."""
    yield from _in_code(ROOT / "twin", "*.py", "python", "tr")
    yield from _in_code(STATIC, "*.js", "javascript", "t")
    for path in sorted(STATIC.glob("*.html")):
        for text in MARKED.findall(path.read_text(encoding="utf-8")):
            yield _place(path), text
    yield from _in_tables()
    for limit in ADJUSTABLE.values():
        yield from (("twin/alarms/limits.py", text) for text in (limit.title, limit.what))


def _in_code(folder: Path, pattern: str, method: str, keyword: str) -> Iterator[Text]:
    """Marked texts: ``tr("...")`` in Python, ``t("...")`` in scripts."""
    for path in sorted(folder.rglob(pattern)):
        for message in extract_from_file(method, path, {keyword: None}, options=_OPTIONS):
            if isinstance(message[1], str):
                yield _place(path), message[1]


def _in_tables() -> Iterator[Text]:
    """Texts in tables of the program."""
    for effect in EFFECTS.values():
        for text in (spoken(effect.name), effect.sentence, effect.look_at):
            yield "twin/model/effects.py", text
    for rule in by_cause(default_rules()):
        yield from (("twin/alarms/default.toml", text) for text in (rule.consequence, rule.action))
        if not cause_of(rule.value):
            yield "twin/alarms/default.toml", light.spelt(rule.name)
    for figure in FIGURES.values():
        yield "twin/figures/table.py", figure.name.replace("_", " ")
        yield "twin/figures/table.py", figure.what
    yield "twin/monitor/healthy.py", NOT_COMMISSIONED
    yield "twin/alarms/text.py", COMMISSION
    for table in (light.WITHOUT, light.WORDS, light.STATES, light.PRIORITIES):
        yield from (("twin/page/ejector_status.py", text) for text in table.values())
    for text in (*hall_words.WORDS.values(), hall_words.SILENT, hall_words.NOT_KNOWN):
        yield "twin/page/plant_overview_text.py", text
    for status in (400, 401, 403, 404, 503):
        yield "twin/page/app.py", HTTPStatus(status).phrase
    for phase in ("idle", "suction", "hold", "blow-off"):
        yield "twin/page/ejector_status.py", phase


def _place(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def updated(code: str) -> Catalog:
    """The catalogue of a language with each text once: translated and new ones."""
    path, before = LOCALE / f"{code}.po", Catalog(code)
    if path.exists():
        before = read_po(path.read_bytes().splitlines(keepends=True), locale=code)
    after = Catalog(code)
    for location, text in texts():
        translated = before.get(text)
        if text:
            after.add(text, translated.string if translated else "", locations=[(location, None)])
    return after


HEAD = "# Texts of the page and of alarms; python tools/texts.py keeps them up to date.\n\n"


def main() -> None:
    """Write all catalogues, and a new one if asked for."""
    codes = {path.stem for path in LOCALE.glob("*.po")} | set(sys.argv[1:])
    for code in sorted(codes):
        if not re.fullmatch(r"[A-Za-z]{2,3}(-[A-Za-z0-9]{2,8})*", code):
            sys.exit(f"{code!r} is no language: give a code such as fr or pt-BR")
        catalogue = updated(code)
        with (LOCALE / f"{code}.po").open("wb") as file:
            file.write(HEAD.encode())
            write_po(file, catalogue, omit_header=True, width=98)
        empty = sum(not message.string for message in catalogue if message.id)
        print(f"{code}: {len(catalogue)} texts, {empty} of them not translated")


if __name__ == "__main__":
    main()
