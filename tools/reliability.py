"""How often what was stated with some probability is right: live and offline, in both worlds.

    python -m tools.naming_trial --keep LIVE.jsonl          # and --world second
    python -m tools.battery --cases CASES.jsonl
    python -m tools.reliability [--live LIVE.jsonl …] [--cases CASES.jsonl …]

A statement is a cause with its probability: offline each cause of an answer, live the first name of
an alarm. It is right if that effect acts. Adds the statements of files to docs/reliability.json,
and writes docs/reliability.md from all that is there. A run that is there already is replaced.
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
KINDS = {"live": "first name of an alarm", "offline": "causes of a diagnosis"}

Stated = Sequence[tuple[float, bool]]


@dataclass(frozen=True)
class Run:
    """What was stated in one run: probabilities, each with whether that effect acts."""

    kind: str  # one of KINDS
    world: str
    commit: str
    first: int  # seed
    stated: Stated


def live(path: Path) -> Iterator[Run]:
    """What alarms stated, by world."""
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    commits = [line.pop("commit") for line in lines]
    runs = [Watched(**line) for line in lines]
    for world in sorted({one.world for one in runs}):
        mine = [one for one in runs if one.world == world]
        stated = [each for one in mine for each in one.stated]
        yield Run("live", world, commits[0], min(one.seed for one in mine), stated)


def offline(path: Path) -> Iterator[Run]:
    """What answers stated, by world."""
    run, cases = read_cases(path)
    for world in sorted({world for world, _ in cases}):
        stated = [each for of, case in cases if of == world for each in case.stated]
        yield Run("offline", world, str(run["commit"]), int(run["first"]), stated)


def known() -> list[Run]:
    """The runs that are kept."""
    if not DATA.exists():
        return []
    return [Run(**one) for one in json.loads(DATA.read_text(encoding="utf-8"))]


def together(runs: Iterable[Run]) -> list[Run]:
    """The runs in order, of each the last."""
    found = {(one.kind, one.world, one.commit, one.first): one for one in runs}
    return [found[key] for key in sorted(found)]


def tables(runs: Sequence[Run]) -> str:
    """In Markdown: a line for each kind and world, then how often each probability is right."""
    rows, parts = list[Sequence[str]](), list[str]()
    for kind, world in dict.fromkeys((one.kind, one.world) for one in runs):
        mine = [one for one in runs if (one.kind, one.world) == (kind, world)]
        name, stated = f"{KINDS[kind]}, {world} world", _all(mine)
        commits = ", ".join(f"{one.commit} ({len(one.stated)})" for one in mine)
        rows.append((name, *_line(stated)))
        parts += [f"## {name.capitalize()}", f"Commits: {commits}.", *by_probability(stated)]
    rows.append(("all", *_line(_all(runs))))
    head = "statements", "how many", "right", f"stated with {SURE:.0%} or more", "of these right"
    lines = table((*head, "expected calibration error"), iter(rows))
    return "\n\n".join([lines, "## All", *by_probability(_all(runs)), *parts])


def _all(runs: Iterable[Run]) -> Stated:
    return [each for one in runs for each in one.stated]


def _line(stated: Stated) -> tuple[str, ...]:
    sure = [acts for probability, acts in stated if probability >= SURE]
    right = f"{np.mean([acts for _, acts in stated]):.1%}"
    share = f"{np.mean(sure):.1%}" if sure else "–"
    off = calibration_error(stated)
    return str(len(stated)), right, str(len(sure)), share, f"{off:.3f}"


def written(page: str, runs: Sequence[Run]) -> str:
    """The page with the tables of some runs."""
    place = marked(MARK, page)
    return page.replace(place[0], f"{place[1]}{tables(runs)}\n{place[3]}")


def main() -> None:
    """Add what is given, write the page, and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--live", type=Path, nargs="*", default=(), metavar="FILE")
    parser.add_argument("--cases", type=Path, nargs="*", default=(), metavar="FILE")
    asked = parser.parse_args()
    found = known()
    for path in asked.live:
        found += live(path)
    for path in asked.cases:
        found += offline(path)
    runs = together(found)
    lines = ",\n".join(json.dumps(asdict(one)) for one in runs)
    DATA.write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8"), runs), encoding="utf-8")
    print(tables(runs))


if __name__ == "__main__":
    main()
