"""A diagnosis in its own process: the question on stdin, the answer as JSON on stdout.

If the question names a file for the report, the report is written there as well.
"""

import json
import pickle
import sys
from contextlib import suppress
from pathlib import Path

from twin.diagnosis.answer import Diagnosis, diagnose
from twin.errors import TwinError
from twin.languages.choice import all_languages, translation_of

MOST_REPORTS = 100  # newest reports that a folder keeps, each in all languages


def main() -> None:
    """Answer; an error is one line on stderr and exit code 1."""
    config, samples, log, report, before_s = pickle.load(sys.stdin.buffer)  # noqa: S301  # from process.Asked
    try:
        diagnosis = diagnose(config, [samples], log, lambda _what: None, before_s)
    except TwinError as error:
        sys.exit(str(error))
    json.dump(diagnosis.json, sys.stdout)
    if report is not None and diagnosis.json["verdict"] in ("explained", "unlisted"):
        with suppress(OSError, TwinError):  # the answer must not fail with its report
            keep(diagnosis, report)


def keep(diagnosis: Diagnosis, report: Path) -> None:
    """Write the report in each language, atomically, and delete the oldest of too many."""
    from twin.diagnosis.report import write_report  # noqa: PLC0415  # its import takes long

    report.parent.mkdir(parents=True, exist_ok=True)
    for language in all_languages():
        part = report.with_suffix(".part")
        write_report(diagnosis, part, language)
        part.rename(translation_of(report, language.code))
    english = [path for path in report.parent.glob(f"*{report.suffix}") if "." not in path.stem]
    for old in sorted(english, key=lambda path: path.stat().st_mtime_ns)[:-MOST_REPORTS]:
        for file in report.parent.glob(f"{old.stem}.*"):
            file.unlink()


if __name__ == "__main__":
    main()
