"""A diagnosis in a process of its own: the question on stdin, the answer as JSON on stdout.

Where the question names a file for it, the answer is drawn there as well.
"""

import json
import pickle
import sys
from contextlib import suppress
from pathlib import Path

from twin.diagnosis.answer import Diagnosis, diagnose
from twin.errors import TwinError

MOST_REPORTS = 100  # that a folder keeps, the newest


def main() -> None:
    """Answer; an error is one line on stderr and exit code 1."""
    config, samples, log, report, before_s = pickle.load(sys.stdin.buffer)  # noqa: S301  # from process.Asked
    try:
        diagnosis = diagnose(config, [samples], log, lambda _what: None, before_s)
    except TwinError as error:
        sys.exit(str(error))
    json.dump(diagnosis.json, sys.stdout)
    if report is not None and diagnosis.json["verdict"] in ("explained", "unlisted"):
        with suppress(OSError, TwinError):  # the answer matters more
            keep(diagnosis, report)


def keep(diagnosis: Diagnosis, report: Path) -> None:
    """Draw it, whole or not at all; the oldest of too many go."""
    from twin.diagnosis.report import write_report  # noqa: PLC0415  # it takes long to come

    report.parent.mkdir(parents=True, exist_ok=True)
    part = report.with_suffix(".part")
    write_report(diagnosis, part)
    part.rename(report)
    kept = sorted(report.parent.glob(f"*{report.suffix}"), key=lambda one: one.stat().st_mtime_ns)
    for old in kept[:-MOST_REPORTS]:
        old.unlink()


if __name__ == "__main__":
    main()
