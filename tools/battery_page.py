"""What the battery writes: tables of its newest run, and a line for each older one."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

MOST_LEFT = 1.2  # sigmas, where explained
MORE = 3  # kinds of answer told of an effect that was not named first


class Asked(NamedTuple):
    """What is asked for: in words, and the least share; the most for what must not be."""

    words: str
    share: float
    most: bool = False


ASKED = {
    "named": Asked("single effects named first or in a set of at most three", 0.95),
    "alone": Asked("named alone, no look-alike needed", 0.85),
    "wrong": Asked("confidently wrong", 0.02, most=True),
    "course": Asked("the course right, where named", 0.90),
    "covered": Asked("95 % interval covers the size", 0.90),
    "left": Asked(f"leftover at most {MOST_LEFT} sigmas, where explained", 0.95),
    "gain": Asked("share of the achievable gain, mean, where explained", 0.90),
    "pairs": Asked("pairs, both named", 0.85),
    "consistent": Asked("healthy records called consistent", 29.0 / 30.0),
    "unlisted": Asked("effects outside the table called unlisted", 0.85),
}
FOUND = {"single": "named", "pair": "pairs", "healthy": "consistent", "unlisted": "unlisted"}


@dataclass(frozen=True)
class Hidden:
    """What is hidden in a log."""

    effect: str
    course: str
    size: float  # what a ramp comes to

    def __str__(self) -> str:
        return f"{self.effect} {self.course} {self.size:.3g}"


@dataclass(frozen=True)
class Case:
    """One log: where it is from, what is hidden, and the answer; None where there was an error."""

    kind: str
    seed: int
    system: str
    hidden: Sequence[Hidden]
    answer: Mapping[str, Any] | None
    found: bool

    @property
    def verdict(self) -> str:
        """Verdict of the answer."""
        return "error" if self.answer is None else str(self.answer["verdict"])

    @property
    def first(self) -> str | None:
        """The effect that is named first."""
        causes = self.answer["causes"] if self.answer else []
        return causes[0]["effect"] if causes else None

    @property
    def alone(self) -> bool:
        """Whether exactly one effect is named, with no look-alike."""
        causes = self.answer["causes"] if self.answer else []
        return len(causes) == 1 and not causes[0]["not_separable_from"]

    @property
    def left(self) -> float:
        """Sigmas that the answer leaves; NaN without one."""
        left = self.answer["extended"]["leftover_sigma"] if self.answer else None
        return float("nan") if left is None else float(left)

    @property
    def named(self) -> str:
        """The causes of the answer, with course, size and look-alikes."""
        causes = self.answer["causes"] if self.answer else []
        return " + ".join(
            f"{one['effect']} {one['course']} "
            + ", ".join(f"{p.get('at_end', p['value'])}" for p in one["parameters"].values())
            + "".join(f" ~{other}" for other in one["not_separable_from"])
            for one in causes
        )


@dataclass
class Tally:
    """Outcomes so far, by what is asked for, and the cases."""

    outcomes: dict[str, list[float]] = field(default_factory=dict)
    cases: list[Case] = field(default_factory=list)

    def count(self, **outcomes: float | None) -> None:
        """Count what applies to a case."""
        for name, outcome in outcomes.items():
            if outcome is not None:
                self.outcomes.setdefault(name, []).append(outcome)

    def kept(self, name: str) -> bool:
        """Whether what is asked for is reached."""
        share, asked = float(np.mean(self.outcomes[name])), ASKED[name]
        return share <= asked.share if asked.most else share >= asked.share

    @property
    def all_kept(self) -> bool:
        """Whether all that is asked for is reached."""
        return all(map(self.kept, self.outcomes))


def summary(tally: Tally, when: str, commit: str) -> str:
    """The run in one line: when, of which commit, on which seeds, and what was found."""
    seeds = [one.seed for one in tally.cases]
    kinds = [kind for kind, name in FOUND.items() if name in tally.outcomes]
    found = (
        f"{sum(tally.outcomes[FOUND[kind]]):.0f} of {len(tally.outcomes[FOUND[kind]])} {kind}"
        for kind in kinds
    )
    return f"{when}, commit {commit}, seeds {min(seeds)} to {max(seeds)}: found {', '.join(found)}."


def tables(tally: Tally) -> str:
    """What was reached, what was named for what, and what was not found, in Markdown."""
    parts = [
        _table(("what", "reached", "asked for", "kept"), _figures(tally)),
        _table(
            (
                "hidden",
                "cases",
                "named first",
                "alone",
                "otherwise first",
                "explained",
                "most left",
            ),
            _effects([one for one in tally.cases if one.kind == "single"]),
        ),
        _table(
            ("not found", "seed", "system", "hidden", "verdict", "named", "sigmas left"),
            _missed([one for one in tally.cases if not one.found]),
        ),
    ]
    return "\n\n".join(filter(None, parts))


def with_run(page: str, line: str, run: str) -> str:
    """The page with a new run; the line of the one that it replaces goes to the older ones."""
    newest, older = _marked("newest run", page), _marked("older runs", page)
    before = newest[2].strip().split("\n", 1)[0].strip("*")
    page = page.replace(older[0], f"{older[1]}- {before}\n{older[2]}{older[3]}")
    return page.replace(newest[0], f"{newest[1]}**{line}**\n\n{run}\n{newest[3]}")


def _marked(name: str, page: str) -> re.Match[str]:
    found = re.search(rf"(<!-- {name}: [^\n]*-->\n)(.*?)(<!-- end -->)", page, re.DOTALL)
    if found is None:
        raise ValueError(f'the page has no part between "<!-- {name}: … -->" and "<!-- end -->"')
    return found


def _figures(tally: Tally) -> Iterator[Sequence[str]]:
    for name, asked in ASKED.items():
        if outcomes := tally.outcomes.get(name):
            share = f"{np.mean(outcomes):.0%}"
            whole = name == "gain"  # each a share already
            reached = share if whole else f"{sum(outcomes):.0f} of {len(outcomes)} ({share})"
            word = "at most" if asked.most else "at least"
            kept = "yes" if tally.kept(name) else "**no**"
            yield asked.words, reached, f"{word} {asked.share:.0%}", kept


def _effects(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    for effect in dict.fromkeys(one.hidden[0].effect for one in cases):
        mine = [one for one in cases if one.hidden[0].effect == effect]
        first = [one for one in mine if one.first == effect]
        others = Counter(one.first or one.verdict for one in mine if one.first != effect)
        told = ", ".join(f"{name} {count}" for name, count in others.most_common(MORE))
        counts = (len(mine), len(first), sum(one.alone for one in first))
        explained = sum(one.verdict == "explained" for one in mine)
        left = f"{np.nanmax([0.0, *(one.left for one in mine)]):.2f}"
        yield f"`{effect}`", *map(str, counts), told or "–", str(explained), left


def _missed(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    for one in cases:
        hidden = " + ".join(map(str, one.hidden)) or "healthy"
        left = "–" if np.isnan(one.left) else f"{one.left:.2f}"
        yield one.kind, str(one.seed), one.system, hidden, one.verdict, one.named or "–", left


def _table(heads: Sequence[str], rows: Iterator[Sequence[str]]) -> str:
    """A table, or nothing where it has no row."""
    lines = [" | ".join(row) for row in rows]
    head = [" | ".join(heads), " | ".join("---" for _ in heads)]
    return "\n".join(f"| {line} |" for line in (*head, *lines)) if lines else ""
