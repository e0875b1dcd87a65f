"""How often what was stated with some probability is right: live and offline, in both worlds.

    python -m tools.naming_trial --keep LIVE.jsonl          # and --world second
    python -m tools.battery --cases CASES.jsonl
    python -m tools.reliability [--live LIVE.jsonl …] [--cases CASES.jsonl …]

A statement is a cause with its probability: offline each cause of an answer, live the first name of
an alarm. It is right if that effect acts. A third kind is the probability of something unlisted in
each answer: it is right if the record has an effect outside the table. Adds the statements of files
to docs/reliability.json, and writes docs/reliability.md from the whole file. A run that is stored
already is replaced.
"""

import argparse
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tools.battery_cases import SURE, read_cases
from tools.battery_page import by_probability, calibration_error, marked, table
from tools.naming_trial import Watched

PAGE = Path(__file__).parents[1] / "docs" / "reliability.md"
DATA = PAGE.with_suffix(".json")
MARK = "reliability"
UNLISTED = "unlisted"
KINDS = {
    "live": "first name of an alarm",
    "offline": "causes of a diagnosis",
    UNLISTED: "something unlisted in a diagnosis",
}
WORDS = {UNLISTED: ("diagnoses", "are right")}  # heads of its columns

Stated = Sequence[tuple[float, bool]]


@dataclass(frozen=True)
class Run:
    """Statements of one run: probabilities, each with whether that effect acts."""

    kind: str  # one of KINDS
    world: str
    commit: str
    first: int  # its first seed
    stated: Stated


def live(path: Path) -> Iterator[Run]:
    """The statements of alarms in a file, a run for each world."""
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    commits = [line.pop("commit") for line in lines]
    runs = [Watched(**line) for line in lines]
    for world in sorted({run.world for run in runs}):
        world_runs = [run for run in runs if run.world == world]
        stated = [statement for run in world_runs for statement in run.stated]
        yield Run("live", world, commits[0], min(run.seed for run in world_runs), stated)


def offline(path: Path) -> Iterator[Run]:
    """The statements of diagnoses in a file, a run for each world."""
    run, cases = read_cases(path)
    commit, first = str(run["commit"]), int(run["first"])
    for world in sorted({world for world, _ in cases}):
        of_world = [case for case_world, case in cases if case_world == world]
        causes = [statement for case in of_world for statement in case.stated]
        yield Run("offline", world, commit, first, causes)
        unlisted = [case.unlisted for case in of_world if case.unlisted is not None]
        yield Run(UNLISTED, world, commit, first, unlisted)


def known() -> list[Run]:
    """The stored runs."""
    if not DATA.exists():
        return []
    return [Run(**entry) for entry in json.loads(DATA.read_text(encoding="utf-8"))]


def together(runs: Iterable[Run]) -> list[Run]:
    """The runs in order; of runs with the same key only the last."""
    latest = {(run.kind, run.world, run.commit, run.first): run for run in runs}
    return [latest[key] for key in sorted(latest)]


def tables(runs: Sequence[Run]) -> str:
    """Markdown: a line for each kind and world, then how often each probability is right."""
    rows, parts = list[Sequence[str]](), list[str]()
    for kind, world in dict.fromkeys((run.kind, run.world) for run in runs):
        selected = [run for run in runs if (run.kind, run.world) == (kind, world)]
        name, stated = f"{KINDS[kind]}, {world} world", _all(selected)
        commits = ", ".join(f"{run.commit} ({len(run.stated)})" for run in selected)
        rows.append((name, *_line(stated)))
        parts += [f"## {name.capitalize()}", f"Commits: {commits}."]
        parts += by_probability(stated, *WORDS.get(kind, ()))
    causes = _all(run for run in runs if run.kind != UNLISTED)
    rows.append(("all causes", *_line(causes)))
    head = "statements", "how many", "right", f"stated with {SURE:.0%} or more", "of these right"
    lines = table((*head, "expected calibration error"), iter(rows))
    return "\n\n".join([lines, "## All causes", *by_probability(causes), *parts])


def _all(runs: Iterable[Run]) -> Stated:
    return [statement for run in runs for statement in run.stated]


def _line(stated: Stated) -> tuple[str, ...]:
    sure = [acts for probability, acts in stated if probability >= SURE]
    right = f"{np.mean([acts for _, acts in stated]):.1%}"
    share = f"{np.mean(sure):.1%}" if sure else "–"
    error = calibration_error(stated)
    return str(len(stated)), right, str(len(sure)), share, f"{error:.3f}"


def written(page: str, runs: Sequence[Run]) -> str:
    """The page with its tables replaced by those of ``runs``."""
    part = marked(MARK, page)
    return page.replace(part[0], f"{part[1]}{tables(runs)}\n{part[3]}")


def main() -> None:
    """Add the statements of the given files, write the page, and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--live", type=Path, nargs="*", default=(), metavar="FILE")
    parser.add_argument("--cases", type=Path, nargs="*", default=(), metavar="FILE")
    arguments = parser.parse_args()
    collected = known()
    for path in arguments.live:
        collected += live(path)
    for path in arguments.cases:
        collected += offline(path)
    runs = together(collected)
    lines = ",\n".join(json.dumps(asdict(run)) for run in runs)
    DATA.write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8"), runs), encoding="utf-8")
    print(tables(runs))


if __name__ == "__main__":
    main()
