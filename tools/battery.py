"""Hide effects in simulated rigs' data, by seed, and see whether the diagnosis finds them.

    python tools/battery.py [--world both|first|second] [--first SEED] [--cases FILE.jsonl]
        [--single 152] [--pair 20] [--healthy 30] [--unlisted 20] [--units 10]
        [--rigs 60] [--cadences 1 2 5 10] [--records 6] [--write docs/battery.md]

The first world is the rig behind the simulated PLC, calibrated from its type's data. The second
one (tests/second_world) shares no equation with the model. Each drawn rig is commissioned from a
record and from what a person reads off it. Then effects are hidden in further records.

Without --first the first seed is drawn at random. With --cases each case is stored in FILE as soon
as it is answered, and an interrupted run resumes. Prints a line for each case, and the tables.
--write puts the tables into the page. Exits with 1 if a figure misses its target.

    python tools/battery.py --recount FILE.jsonl [--write docs/battery.md]

counts the stored cases of a complete run anew and runs nothing.
"""

import argparse
import secrets
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path

from tools import battery_first, battery_second
from tools.battery_cases import Case, CaseFile, first_of, read_cases
from tools.battery_page import all_kept, summary, tables, with_run
from tools.version import commit

SEEDS = 1_000_000  # without --first, the first seed is drawn below this
WORLDS = (battery_first.NAME, battery_second.NAME)


def first_world(
    file: CaseFile, first: int, counts: Mapping[str, int], units: int
) -> Iterator[Case]:
    """Each case of the first world; it is diagnosed unless the file has its answer."""
    for kind, seed in battery_first.keys(first, counts):
        case = file.get(battery_first.NAME, (kind, seed, 0))
        yield case or file.add(battery_first.NAME, battery_first.answered(kind, seed, units))


def second_world(
    file: CaseFile, seeds: range, cadences: Sequence[int], records: int
) -> Iterator[Case]:
    """Each case of the second world: of each rig its commissioning, then up to ``records`` more.

    A rig that is not commissioned has no more cases.
    """
    name = battery_second.NAME
    for seed in seeds:
        drawn = battery_second.drawn(seed, cadences)
        if drawn is None:
            continue
        answered = file.get(name, ("commissioning", seed, 0))
        commissioning = answered or file.add(name, battery_second.commissioned(drawn))
        yield commissioning
        unit = battery_second.with_unit(drawn, commissioning)
        for kind, number, hidden in islice(battery_second.cases(drawn), records if unit else 0):
            case = file.get(name, (kind, seed, number))
            yield case or file.add(name, battery_second.diagnosed(unit, kind, number, hidden))


def line(case: Case) -> str:
    """A case as one line of text."""
    hidden = " + ".join(map(str, case.hidden)) or "healthy"
    answer = case.error.strip().splitlines()[-1] if case.error else f"{case.verdict} {case.named}"
    outcome = "ok" if case.found else "MISSED"
    return (
        f"{outcome:<7}{case.kind} {case.seed} {case.system}: {hidden} -> {answer}"
        f" ({case.seconds:.0f} s)"
    )


def shown(world: str, cases: Sequence[Case], when: str, measured: str, page: Path | None) -> None:
    """Print the tables of a run, and put them into a page."""
    head, run = summary(world, cases, when, measured), tables(cases)
    print(f"\n{head}\n\n{run}\n")
    if page is not None:
        text = page.read_text(encoding="utf-8")
        page.write_text(with_run(text, world, head, run), encoding="utf-8")


def recounted(path: Path, page: Path | None) -> bool:
    """Count a stored run anew, dated as its file; whether it reached all targets."""
    run, stored = read_cases(path)
    when, reached = time.strftime("%Y-%m-%d", time.gmtime(path.stat().st_mtime)), True
    for name in WORLDS:
        if cases := [case for world, case in stored if world == name]:
            shown(name, cases, when, run["commit"], page)
            reached &= all_kept(cases)
    return reached


def main() -> int:
    """Run the battery; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--world", choices=("both", *WORLDS), default="both")
    parser.add_argument("--first", type=int, help="seed of the first case of each kind")
    parser.add_argument("--cases", type=Path, metavar="FILE", help="keeps each case; goes on there")
    for kind, count in battery_first.COUNTS.items():
        parser.add_argument(f"--{kind}", type=int, default=count, help="cases in the first world")
    parser.add_argument("--units", type=int, default=10, help="rigs of each system there")
    parser.add_argument(
        "--rigs", type=int, default=battery_second.RIGS, help="seeds of the second world"
    )
    parser.add_argument(
        "--cadences",
        type=int,
        nargs="+",
        choices=battery_second.CADENCES,
        default=battery_second.CADENCES,
        help="ms between rows there; rigs with another are left out",
    )
    parser.add_argument(
        "--records", type=int, default=battery_second.RECORDS, help="after a commissioning there"
    )
    parser.add_argument("--write", type=Path, metavar="FILE", help="page whose tables to replace")
    parser.add_argument("--recount", type=Path, metavar="FILE", help="cases of a complete run")
    arguments = parser.parse_args()
    if arguments.recount is not None:
        return 0 if recounted(arguments.recount, arguments.write) else 1
    first = first_of(arguments.cases) if arguments.first is None else arguments.first
    first = secrets.randbelow(SEEDS) if first is None else first
    when, measured = time.strftime("%Y-%m-%d"), commit()  # before the run, which takes long
    file = CaseFile(arguments.cases, {"first": first, "commit": measured})
    counts = {kind: getattr(arguments, kind) for kind in battery_first.COUNTS}
    runs = {
        battery_first.NAME: first_world(file, first, counts, arguments.units),
        battery_second.NAME: second_world(
            file, range(first, first + arguments.rigs), arguments.cadences, arguments.records
        ),
    }
    reached = True
    for world in WORLDS if arguments.world == "both" else (arguments.world,):
        cases = []
        for case in runs[world]:
            cases.append(case)
            print(line(case), flush=True)
        if not cases:
            continue
        reached &= all_kept(cases)
        shown(world, cases, when, measured, arguments.write)
    if arguments.write is not None and arguments.cases is not None:
        # The run is complete, so its file must not be resumed.
        arguments.cases.rename(arguments.cases.with_stem(f"{arguments.cases.stem}-{first}"))
    return 0 if reached else 1


if __name__ == "__main__":
    sys.exit(main())
