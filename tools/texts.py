"""Update the catalogues in twin/locale from the code: add new texts empty, drop stale ones.

``python tools/texts.py`` does it to all of them, ``python tools/texts.py fr`` begins another
language. Fill in each ``msgstr``; a text without one stays English.
"""

import re
import sys
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path

from babel.messages.catalog import Catalog, Message
from babel.messages.extract import extract_from_file
from babel.messages.pofile import write_po

from twin.alarms.advice import COMMISSION
from twin.alarms.causes import cause_of
from twin.alarms.limits import ADJUSTABLE
from twin.alarms.rules import by_cause, default_rules
from twin.calibration.page import MARKS
from twin.calibration.verdict import WEAKENS
from twin.diagnosis import text as answer_text
from twin.diagnosis.curves import DEVIATION
from twin.diagnosis.experiments import TESTS
from twin.diagnosis.report import BANNER
from twin.diagnosis.retelling import templates
from twin.diagnosis.text import plain_words
from twin.diagnosis.unlisted import OVER
from twin.figures.key_figures import FIGURES
from twin.instants import DATE
from twin.languages.catalogues import read_catalog
from twin.model.courses import Course
from twin.model.effects import EFFECTS
from twin.model.mechanism import PLACES, WHENS
from twin.model.term import KINDS
from twin.monitor.healthy import NOT_COMMISSIONED
from twin.page import ejector_status as light
from twin.page import plant_overview_text as hall_words
from twin.page.app import MARKED

ROOT = Path(__file__).resolve().parents[1]
LOCALE = ROOT / "twin" / "locale"
STATIC = ROOT / "twin" / "page" / "static"
_OPTIONS = {"parse_template_string": True}  # scripts nest some texts in others
Text = tuple[str, str | tuple[str, str]]  # location, and text or its singular and plural


def texts() -> Iterator[Text]:
    """Every text that is shown in the reader's language."""
    yield from _in_code(ROOT / "twin", "*.py", "python", {"tr": None, "ntr": (1, 2)})
    yield from _in_code(STATIC, "*.js", "javascript", {"t": None, "tn": (1, 2)})
    for path in sorted(STATIC.glob("*.html")):
        for text in MARKED.findall(path.read_text(encoding="utf-8")):
            yield _place(path), text
    yield from _in_tables()
    for limit in ADJUSTABLE.values():
        yield from (("twin/alarms/limits.py", text) for text in (limit.title, limit.what))


def _in_code(
    folder: Path, pattern: str, method: str, keywords: dict[str, tuple[int, int] | None]
) -> Iterator[Text]:
    """Marked texts: ``tr("...")`` in Python, ``t("...")`` in scripts; plurals have two."""
    for path in sorted(folder.rglob(pattern)):
        for message in extract_from_file(method, path, keywords, options=_OPTIONS):
            yield _place(path), message[1]


def _in_tables() -> Iterator[Text]:
    """Texts in tables of the program."""
    for effect in EFFECTS.values():
        for text in (plain_words(effect.name), effect.sentence, effect.look_at):
            yield "twin/model/effects.py", text
    for rule in by_cause(default_rules()):
        yield from (
            ("twin/alarms/default_rules.toml", text) for text in (rule.consequence, rule.action)
        )
        if not cause_of(rule.value):
            yield "twin/alarms/default_rules.toml", light.spelt(rule.name)
    for figure in FIGURES.values():
        yield "twin/figures/key_figures.py", figure.title
        yield "twin/figures/key_figures.py", figure.what
    yield "twin/monitor/healthy.py", NOT_COMMISSIONED
    yield "twin/alarms/advice.py", COMMISSION
    for table in (light.WITHOUT, light.WORDS, light.STATES, light.PRIORITIES):
        yield from (("twin/page/ejector_status.py", text) for text in table.values())
    for text in (*hall_words.WORDS.values(), hall_words.SILENT, hall_words.NOT_KNOWN):
        yield "twin/page/plant_overview_text.py", text
    for status in (400, 401, 403, 404, 503):
        yield "twin/page/app.py", HTTPStatus(status).phrase
    yield "twin/instants.py", DATE
    yield from (("twin/calibration/verdict.py", text) for text in (*MARKS, *WEAKENS.values()))
    yield from _of_answers()


def _of_answers() -> Iterator[Text]:
    """Texts of a diagnosis that are no literals of its report."""
    names = [*KINDS, *OVER.values(), "absolute time", "supply", *Course, *BANNER]
    definitions = [*EFFECTS.values(), *PLACES.values(), *WHENS.values()]
    names += [parameter.name for entry in definitions for parameter in entry.parameters]
    for name in names:
        yield "twin/diagnosis/text.py", plain_words(name)
    for _, figure, _, unit in answer_text.FIGURES:
        yield from (("twin/diagnosis/text.py", text) for text in (figure, unit))
    for reading in answer_text.READ_FROM_ALL.values():
        yield "twin/diagnosis/text.py", reading
    for _, _, verdict in BANNER.values():
        yield "twin/diagnosis/report.py", verdict
    yield "twin/diagnosis/curves.py", DEVIATION
    for template in (*templates(), *(test.words for test in TESTS)):
        yield "twin/diagnosis/retelling.py", template


def _place(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def updated(code: str) -> Catalog:
    """The catalogue of a language with each text once: translated and new ones."""
    path, before = LOCALE / f"{code}.po", Catalog(code)
    if path.exists():
        before = read_catalog(path.read_bytes(), code)
    after = Catalog(code.replace("-", "_"))
    for location, text in texts():
        if not text:
            continue
        translated = before.get(text[0] if isinstance(text, tuple) else text)
        is_kept = translated is not None and translated.id == text
        after.add(text, translated.string if is_kept else "", locations=[(location, None)])
    return after


def is_translated(message: Message) -> bool:
    """Whether a text has a translation, with each of its plural forms."""
    return all(message.string) if isinstance(message.string, tuple) else bool(message.string)


HEAD = (
    "# Texts of page, alarms, reports and mails; python tools/texts.py keeps them up to date.\n\n"
)


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
        empty = sum(not is_translated(message) for message in catalogue if message.id)
        print(f"{code}: {len(catalogue)} texts, {empty} of them not translated")


if __name__ == "__main__":
    main()
