"""A learned classifier on the battery's records, beside ``twin diagnose`` in one table.

    python -m tools.learned (--cases FILE.jsonl | --first SEED) [--units 10]
        [--features FILE.npz] [--training 2000] [--training-units 5] [--write docs/battery.md]

FILE.jsonl holds what ``python -m tools.battery --world first --cases FILE.jsonl`` answered, and
--units is that run's; with --first the cases are answered now. Their records are drawn again, and
the learned one answers them. It is trained on records of the same world with other seeds and other
rigs. With --features what it sees of a record is kept, and a run that was cut goes on.
"""

import argparse
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from tools import battery_first
from tools.battery import first_world
from tools.battery_cases import Case, CaseFile, Outcomes, read_cases, stated_interval
from tools.battery_page import ASKED, calibration_error, marked, table
from tools.learned_features import RecordFile, training_keys
from tools.learned_models import Learned, unlisted_unseen
from tools.version import commit

MARK = "beside a learned classifier"
TWIN, LEARNED = "`twin diagnose`", "the learned one"
# Of each kind in a whole training: as many to each other as are judged.
TRAINING = {"single": 1357, "healthy": 286, "unlisted": 357}
COUNTED = {  # from what counts in an answer to the words of its row
    "named": ASKED["named"].words,
    "first": "single effects named first",
    "alone": ASKED["alone"].words,
    "course": ASKED["course"].words,
    "consistent": ASKED["consistent"].words,
    "unlisted": ASKED["unlisted"].words,
    "wrong": ASKED["wrong"].words,
    "sure": ASKED["sure"].words,
    "covered": ASKED["covered"].words,
}
# What every case of a kind counts for, whatever the answer: there they can be held side by side.
OF_EACH_CASE = ("named", "first", "alone", "consistent", "unlisted", "wrong")
CHANCE = 0.05
TOLD_EVERY = 100  # training records


def answered(learned: Learned, records: RecordFile, case: Case, units: int) -> Case:
    """A case of the battery as the learned one answers it."""
    record = records.get(case.kind, case.seed, units)
    if record.trains:
        raise ValueError(f"{case.kind} {case.seed} may have been learned from: take a lower seed")
    if list(record.hidden) != list(case.hidden):
        raise ValueError(f"{case.kind} {case.seed} hides something else: of another version?")
    begin = time.process_time()
    answer = learned.answer(record.features)
    spent = record.seconds + time.process_time() - begin
    return replace(case, answer=answer, error="", seconds=spent)


def counted(case: Case) -> Outcomes:
    """What an answer counts for."""
    if case.kind != "single":
        return case.answer_outcomes
    return case.answer_outcomes | {"first": case.first == case.hidden[0].effect}


def half_widths(cases: Sequence[Case]) -> list[float]:
    """Of each interval that is compared with the truth: half of it over the size."""
    found = []
    for case in cases:
        if "covered" in case.answer_outcomes:
            (truth,) = case.hidden
            cause = next(one for one in case.causes if one["effect"] == truth.effect)
            if interval := stated_interval(cause, truth):
                low, _, high = interval
                found.append((high - low) / 2.0 / abs(truth.size))
    return found


def figures(cases: Sequence[Case]) -> dict[str, str]:
    """What the answers reach, by the words of the row."""
    found, counts = dict[str, str](), [counted(one) for one in cases]
    for name, words in COUNTED.items():
        here = [np.atleast_1d(one[name]) for one in counts if name in one]
        if here:
            outcomes = np.concatenate(here)
            found[words] = f"{outcomes.sum()} of {len(outcomes)} ({outcomes.mean():.0%})"
    if widths := half_widths(cases):
        found["half of that interval over the size, median"] = f"±{np.median(widths):.0%}"
    if any(one.stated for one in cases):
        found["expected calibration error"] = (
            f"{calibration_error([each for one in cases for each in one.stated]):.3f}"
        )
    return found


def compared(twin: Sequence[Case], learned: Sequence[Case]) -> str:
    """Both answers to the same cases beside each other in Markdown, then who wins where."""
    mine, other, rows = figures(twin), figures(learned), list[Sequence[str]]()
    only = {words: only_one_right(name, twin, learned) for name, words in COUNTED.items()}
    for words in (words for words in mine if words in other):
        apart = only.get(words)
        right = "–" if apart is None else f"{apart[0]} : {apart[1]}"
        rows.append((words, mine[words], other[words], right))
    head = "what", TWIN, LEARNED, "cases that only one of them has right"
    return f"{table(head, iter(rows))}\n\n{who_wins(only)}"


def only_one_right(
    name: str, twin: Sequence[Case], learned: Sequence[Case]
) -> tuple[int, int] | None:
    """How many cases only the one, and only the other has right.

    None where it depends on the answer whether a case counts.
    """
    if name not in OF_EACH_CASE:
        return None
    both = [(counted(one), counted(other)) for one, other in zip(twin, learned, strict=True)]
    pairs = [(one[name], other[name]) for one, other in both if name in one and name in other]
    counts = sum(one > other for one, other in pairs), sum(one < other for one, other in pairs)
    return counts[::-1] if name == "wrong" else counts


def who_wins(only: Mapping[str, tuple[int, int] | None]) -> str:
    """In one sentence who has more cases right than by chance."""
    wins: dict[str, list[str]] = {TWIN: [], LEARNED: []}
    for words, apart in only.items():
        if apart and sum(apart) and binomtest(apart[0], sum(apart)).pvalue < CHANCE:
            wins[TWIN if apart[0] > apart[1] else LEARNED].append(words)
    parts = [f"{who} wins in: {', '.join(what)}" for who, what in wins.items() if what]
    return (
        f"{'; '.join(parts) or 'Neither wins in anything'}. Where nobody is said to win, so unequal"
        f" a count of cases comes about by chance more often than once in {1.0 / CHANCE:.0f} times."
    )


def battery(cases: Path | None, first: int | None, units: int) -> tuple[str, list[Case]]:
    """Cases of the first world with one effect at most, and which commit answered them."""
    if cases is None:
        counts = {kind: battery_first.COUNTS[kind] for kind in TRAINING}
        return commit(), list(first_world(CaseFile(None, {}), first or 0, counts, units))
    run, kept = read_cases(cases)
    here = [case for world, case in kept if world == battery_first.NAME and case.kind in TRAINING]
    return str(run["commit"]), here


def summary(measured: str, cases: Sequence[Case]) -> str:
    """In one line what is compared."""
    seeds, kinds = [one.seed for one in cases], Counter(one.kind for one in cases)
    many = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    return (
        f"**{time.strftime('%Y-%m-%d')}, {TWIN} of commit {measured}, seeds {min(seeds)} to"
        f" {max(seeds)}: {many}.**"
    )


def trained(records: RecordFile, cases: int, units: int) -> tuple[Learned, str]:
    """The learned one, and on what it was trained, with what it makes of unseen mechanisms."""
    keys = training_keys(TRAINING)[:cases]
    known = []
    for number, key in enumerate(keys, 1):
        known.append(records.get(*key, units))
        if number % TOLD_EVERY == 0:
            print(f"{number} of {len(keys)} training records", flush=True)
    records.write()
    begin = time.process_time()
    learned = Learned.fit(known)
    spent = time.process_time() - begin
    unseen = unlisted_unseen(learned, known)
    kinds = ", ".join(f"{what}: {kind}" for what, kind in learned.chosen.items())
    drawn = sum(one.seconds for one in known) / 60.0
    return learned, (
        f"Trained on {len(known)} records of {2 * units} rigs, drawn in {drawn:.0f} min of the"
        f" processor and learned in {spent:.0f} s ({kinds}). Of {len(unseen)} records with an"
        f" unlisted mechanism that was left out of training it calls {sum(unseen)} unlisted."
    )


def written(page: str, part: str) -> str:
    """The page with this comparison in its place."""
    place = marked(MARK, page)
    return page.replace(place[0], f"{place[1]}{part}\n{place[3]}")


def main() -> None:
    """Train, judge and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--cases", type=Path, metavar="FILE", help="of the battery, answered")
    source.add_argument("--first", type=int, metavar="SEED", help="answer the cases from it on")
    parser.add_argument("--units", type=int, default=10, help="rigs of each system judged")
    parser.add_argument("--features", type=Path, metavar="FILE", help="keeps what is seen")
    parser.add_argument("--training", type=int, default=2000, help="records to learn from")
    parser.add_argument("--training-units", type=int, default=5, help="rigs of each system there")
    parser.add_argument("--write", type=Path, metavar="FILE", help="page whose table to replace")
    asked = parser.parse_args()
    records = RecordFile(asked.features)
    learned, training = trained(records, asked.training, asked.training_units)
    measured, twin = battery(asked.cases, asked.first, asked.units)
    other = [answered(learned, records, case, asked.units) for case in twin]
    records.write()
    part = f"{summary(measured, twin)}\n\n{compared(twin, other)}\n\n{training}"
    print(part)
    if asked.write is not None:
        page = asked.write.read_text(encoding="utf-8")
        asked.write.write_text(written(page, part), encoding="utf-8")


if __name__ == "__main__":
    main()
