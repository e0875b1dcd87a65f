"""A learned classifier on the battery's records, beside ``twin diagnose`` in one table.

    python -m tools.learned (--cases FILE.jsonl | --first SEED) [--units 10]
        [--features FILE.npz] [--training 2000] [--training-units 5] [--write docs/battery.md]

FILE.jsonl has the answers of ``python -m tools.battery --world first --cases FILE.jsonl``, and
--units is that of the run; with --first the cases are answered now. Their records are drawn again
for the learned classifier. It is trained on records of the same world with other seeds and other
rigs. With --features the features of records are kept, so that an interrupted run can continue.
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
OF_EACH_CASE = ("named", "first", "alone", "consistent", "unlisted")
CHANCE = 0.05
TOLD_EVERY = 100  # training records


def answered(learned: Learned, records: RecordFile, case: Case, units: int) -> Case:
    """A case of the battery with the answer of the learned classifier."""
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
    """The outcomes of an answer."""
    if case.kind != "single":
        return case.answer_outcomes
    return case.answer_outcomes | {"first": case.first == case.hidden[0].effect}


def half_widths(cases: Sequence[Case]) -> list[float]:
    """Half width over size, of each interval that is compared with the truth."""
    widths = []
    for case in cases:
        if "covered" in case.answer_outcomes:
            (truth,) = case.hidden
            cause = next(entry for entry in case.causes if entry["effect"] == truth.effect)
            if interval := stated_interval(cause, truth):
                low, _, high = interval
                widths.append((high - low) / 2.0 / abs(truth.size))
    return widths


def figures(cases: Sequence[Case]) -> dict[str, str]:
    """Figures of the answers, by the words of the row."""
    texts, counts = dict[str, str](), [counted(case) for case in cases]
    for name, words in COUNTED.items():
        shown = [
            np.atleast_1d(counts_of_case[name])
            for counts_of_case in counts
            if name in counts_of_case
        ]
        if shown:
            outcomes = np.concatenate(shown)
            texts[words] = f"{outcomes.sum()} of {len(outcomes)} ({outcomes.mean():.0%})"
    if widths := half_widths(cases):
        texts["half of that interval over the size, median"] = f"±{np.median(widths):.0%}"
    if any(case.stated for case in cases):
        texts["expected calibration error"] = (
            f"{calibration_error([pair for case in cases for pair in case.stated]):.3f}"
        )
    return texts


def compared(twin: Sequence[Case], learned: Sequence[Case]) -> str:
    """A Markdown table of both answers to the same cases, then the winner of each row."""
    twin_figures, learned_figures, rows = figures(twin), figures(learned), list[Sequence[str]]()
    only = {words: only_one_right(name, twin, learned) for name, words in COUNTED.items()}
    for words in (words for words in twin_figures if words in learned_figures):
        counts = only.get(words)
        right = "–" if counts is None else f"{counts[0]} : {counts[1]}"
        rows.append((words, twin_figures[words], learned_figures[words], right))
    head = "what", TWIN, LEARNED, "cases that only one of them has right"
    return f"{table(head, iter(rows))}\n\n{who_wins(only)}"


def only_one_right(
    name: str, twin: Sequence[Case], learned: Sequence[Case]
) -> tuple[int, int] | None:
    """Numbers of cases that only the first, and only the second has right.

    None if it depends on the answer whether a case counts.
    """
    if name not in OF_EACH_CASE:
        return None
    outcomes = [
        (counted(twin_outcome), counted(learned_outcome))
        for twin_outcome, learned_outcome in zip(twin, learned, strict=True)
    ]
    pairs = [
        (twin_outcome[name], learned_outcome[name])
        for twin_outcome, learned_outcome in outcomes
        if name in twin_outcome and name in learned_outcome
    ]
    return (
        sum(twin_outcome > learned_outcome for twin_outcome, learned_outcome in pairs),
        sum(twin_outcome < learned_outcome for twin_outcome, learned_outcome in pairs),
    )


def who_wins(only: Mapping[str, tuple[int, int] | None]) -> str:
    """One sentence on who has more cases right than by chance."""
    wins: dict[str, list[str]] = {TWIN: [], LEARNED: []}
    for words, counts in only.items():
        if counts and sum(counts) and binomtest(counts[0], sum(counts)).pvalue < CHANCE:
            wins[TWIN if counts[0] > counts[1] else LEARNED].append(words)
    parts = [f"{who} wins in: {', '.join(rows)}" for who, rows in wins.items() if rows]
    return (
        f"{'; '.join(parts) or 'Neither wins in anything'}. Where nobody is said to win, so unequal"
        f" a count of cases comes about by chance more often than once in {1.0 / CHANCE:.0f} times."
    )


def battery(cases: Path | None, first: int | None, units: int) -> tuple[str, list[Case]]:
    """Cases of the first world with one effect at most, and which commit answered them."""
    if cases is None:
        counts = {kind: battery_first.COUNTS[kind] for kind in TRAINING}
        return commit(), list(first_world(CaseFile(None, {}), first or 0, counts, units))
    run, cases_read = read_cases(cases)
    chosen = [
        case for world, case in cases_read if world == battery_first.NAME and case.kind in TRAINING
    ]
    return str(run["commit"]), chosen


def summary(measured: str, cases: Sequence[Case]) -> str:
    """One line on what is compared."""
    seeds, kinds = [case.seed for case in cases], Counter(case.kind for case in cases)
    numbers = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    return (
        f"**{time.strftime('%Y-%m-%d')}, {TWIN} of commit {measured}, seeds {min(seeds)} to"
        f" {max(seeds)}: {numbers}.**"
    )


def trained(records: RecordFile, cases: int, units: int) -> tuple[Learned, str]:
    """The learned classifier, and text on its training and on unseen mechanisms."""
    keys = training_keys(TRAINING)[:cases]
    training = []
    for number, key in enumerate(keys, 1):
        training.append(records.get(*key, units))
        if number % TOLD_EVERY == 0:
            print(f"{number} of {len(keys)} training records", flush=True)
    records.write()
    begin = time.process_time()
    learned = Learned.fit(training)
    spent = time.process_time() - begin
    unseen = unlisted_unseen(learned, training)
    kinds = ", ".join(f"{name}: {kind}" for name, kind in learned.chosen.items())
    drawn = sum(record.seconds for record in training) / 60.0
    return learned, (
        f"Trained on {len(training)} records of {2 * units} rigs, drawn in {drawn:.0f} min of the"
        f" processor and learned in {spent:.0f} s ({kinds}). Of {len(unseen)} records with an"
        f" unlisted mechanism that was left out of training it calls {sum(unseen)} unlisted."
    )


def written(page: str, part: str) -> str:
    """The page with this comparison in its place."""
    parts = marked(MARK, page)
    return page.replace(parts[0], f"{parts[1]}{part}\n{parts[3]}")


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
    arguments = parser.parse_args()
    records = RecordFile(arguments.features)
    learned, training = trained(records, arguments.training, arguments.training_units)
    measured, twin = battery(arguments.cases, arguments.first, arguments.units)
    learned_cases = [answered(learned, records, case, arguments.units) for case in twin]
    records.write()
    part = f"{summary(measured, twin)}\n\n{compared(twin, learned_cases)}\n\n{training}"
    print(part)
    if arguments.write is not None:
        page = arguments.write.read_text(encoding="utf-8")
        arguments.write.write_text(written(page, part), encoding="utf-8")


if __name__ == "__main__":
    main()
