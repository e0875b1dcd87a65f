"""What the battery writes: tables of its newest run in each world, a line for each older one."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest, kstest

from tools.battery_cases import FOUND, MOST_LEFT, SURE, Case, of_kind, spread

MORE = 3  # kinds of answer told of an effect that was not named first
WHOLE = ("gain",)  # each a share already
WORST = "the worst phase"
STATED = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 1.01)  # probabilities that are counted together


class Asked(NamedTuple):
    """What is asked for: in words, and the least share; the most for what must not be."""

    words: str
    share: float
    most: bool = False


ASKED = {
    "commissioned": Asked("rigs commissioned without editing a number", 0.95),
    "true": Asked("refused for a reason that is true of the record", 1.0),
    "parameters": Asked("95 % interval covers a parameter, where the world has it", 0.90),
    "named": Asked("single effects named first or in a set of at most three", 0.95),
    "alone": Asked("named alone, no look-alike needed", 0.85),
    "wrong": Asked("explained and wrong", 0.01, most=True),
    "spurious": Asked(
        "answers with a cause beside the true ones that does not act", 0.03, most=True
    ),
    "sure": Asked(f"causes stated with {SURE:.0%} or more that act", 0.95),
    "course": Asked("the course right, where named", 0.90),
    "covered": Asked("95 % interval covers the size", 0.90),
    "flows": Asked("95 % interval covers a flow or volume, the vessel's told a fifth off", 0.90),
    "left": Asked(f"leftover at most {MOST_LEFT} sigmas, where explained", 0.95),
    "gain": Asked("share of the achievable gain, mean, where explained", 0.90),
    "pairs": Asked("pairs, both named", 0.85),
    "consistent": Asked("healthy records called consistent", 0.97),
    "unlisted": Asked("effects outside the table called unlisted", 0.85),
}


def kept(cases: Sequence[Case], name: str) -> bool:
    """Whether what is asked for is reached."""
    share, asked = float(np.mean(spread(cases, name))), ASKED[name]
    return share <= asked.share if asked.most else share >= asked.share


def all_kept(cases: Sequence[Case]) -> bool:
    """Whether all that is asked for is reached."""
    return all(kept(cases, name) for name in ASKED if spread(cases, name))


def likely(cases: Sequence[Case], name: str) -> float:
    """How likely so bad a count is by chance where what is asked for holds just so."""
    outcomes, asked = spread(cases, name), ASKED[name]
    side = "greater" if asked.most else "less"
    return float(binomtest(round(sum(outcomes)), len(outcomes), asked.share, side).pvalue)


def summary(world: str, cases: Sequence[Case], when: str, commit: str) -> str:
    """The run in one line: when, of which commit, on which seeds, and what was found."""
    seeds = [one.seed for one in cases]
    found = []
    for kind, name in FOUND.items():
        if outcomes := spread(cases, name):
            found.append(f"{sum(outcomes):.0f} of {len(outcomes)} {_PLURAL.get(kind, kind)}")
    return (
        f"{when}, {world} world, commit {commit}, seeds {min(seeds)} to {max(seeds)}:"
        f" found {', '.join(found)}."
    )


_PLURAL = {"commissioning": "commissioned"}


def tables(cases: Sequence[Case]) -> str:
    """What was reached, what was named for what, and what was not found, in Markdown."""
    parts = [
        table(("what", "reached", "by chance", "asked for", "kept"), _figures(cases)),
        *commissionings(list(of_kind(cases, "commissioning"))),
        table(
            (
                "hidden",
                "cases",
                "named first",
                "alone",
                "otherwise first",
                "explained",
                "most left",
            ),
            _effects(list(of_kind(cases, "single"))),
        ),
        table(
            ("not found", "seed", "system", "hidden", "verdict", "named", "sigmas left"),
            _missed([one for one in cases if not one.found and one.kind != "commissioning"]),
        ),
        *reliability(cases),
        table(("processor time of", "cases", "median", "95 %", "most"), _seconds(cases)),
    ]
    return "\n\n".join(filter(None, parts))


def reliability(cases: Sequence[Case]) -> Iterator[str]:
    """How often causes act that were stated with some probability; how far that is off in all."""
    yield from by_probability([each for one in cases for each in one.stated])
    ranks = [one.rank for one in cases if one.rank is not None]
    if ranks:
        test = kstest(ranks, "uniform")
        yield (
            f"Ranks of {len(ranks)} true sizes within what was said of them: uniform but for"
            f" {test.statistic:.2f} (Kolmogorov and Smirnov), by chance once in"
            f" {1.0 / max(float(test.pvalue), 1e-6):.3g}."
        )


def by_probability(stated: Sequence[tuple[float, bool]]) -> Iterator[str]:
    """The table of probabilities stated and how often they are right, and the mean error."""
    rows = list[Sequence[str]]()
    for low, high, here in _by_probability(stated):
        said, acts = here.mean(axis=0)
        ends = binomtest(int(here[:, 1].sum()), len(here)).proportion_ci(0.95)
        chance = f"{ends.low:.0%} to {ends.high:.0%}"
        said_of = f"{low:.0%} to {min(high, 1.0):.0%}"
        rows.append((said_of, str(len(here)), f"{said:.1%}", f"{acts:.1%}", chance))
    if rows:
        yield table(("probability stated", "causes", "mean", "act", "by chance"), iter(rows))
        off = calibration_error(stated)
        yield f"Expected calibration error: {off:.3f}, over {len(stated)} causes."


def calibration_error(stated: Sequence[tuple[float, bool]]) -> float:
    """By how much causes act more or less often than stated, mean over all; NaN without any."""
    groups = [here for _, _, here in _by_probability(stated)]
    if not groups:
        return float("nan")
    off = [abs(float(np.diff(here.mean(axis=0))[0])) for here in groups]
    return float(np.average(off, weights=[len(here) for here in groups]))


def _by_probability(
    stated: Sequence[tuple[float, bool]],
) -> Iterator[tuple[float, float, npt.NDArray[np.float64]]]:
    """Causes stated with a probability from a bound to the next: probability, and 1 if it acts."""
    pairs = np.array(stated, np.float64).reshape(-1, 2)
    for low, high in pairwise(STATED):
        here = pairs[(pairs[:, 0] >= low) & (pairs[:, 0] < high)]
        if len(here):
            yield low, high, here


def commissionings(cases: Sequence[Case]) -> Iterator[str]:
    """Verdicts by kind of rig, what is left by phase, parameters, and reasons of refusals."""
    yield table(("rigs", "drawn", "good", "usable", "refused", "error"), _verdicts(cases))
    yield table(("left over floor", "rigs", "median", "90 %", "most"), _phases(cases))
    yield table(
        ("parameter", "rigs", "95 % interval holds it", "off, median", "interval, median"),
        _parameters(cases),
    )
    yield table(("not commissioned because", "rigs", "true", "seeds"), _reasons(cases))


def with_run(page: str, world: str, line: str, run: str) -> str:
    """The page with a world's new run; the line of the one that it replaces goes to the older."""
    newest, older = marked(f"newest run of the {world} world", page), marked("older runs", page)
    before = newest[2].strip().split("\n", 1)[0].strip("*")
    if before:
        page = page.replace(older[0], f"{older[1]}- {before}\n{older[2]}{older[3]}")
    return page.replace(newest[0], f"{newest[1]}**{line}**\n\n{run}\n{newest[3]}")


def marked(name: str, page: str) -> re.Match[str]:
    """The part of a page of some name: the mark it begins with, what it holds, its end."""
    found = re.search(rf"(<!-- {name}: [^\n]*-->\n)(.*?)(<!-- end -->)", page, re.DOTALL)
    if found is None:
        raise ValueError(f'the page has no part between "<!-- {name}: … -->" and "<!-- end -->"')
    return found


def _figures(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    for name, asked in ASKED.items():
        if outcomes := spread(cases, name):
            count, share = len(outcomes), f"{np.mean(outcomes):.0%}"
            reached, chance = share, "–"
            if name not in WHOLE:
                reached = f"{sum(outcomes):.0f} of {count} ({share})"
                ends = binomtest(round(sum(outcomes)), count).proportion_ci(0.95)
                chance = f"{ends.low:.0%} to {ends.high:.0%}"
            word = "at most" if asked.most else "at least"
            yes = "yes" if kept(cases, name) else "**no**"
            yield asked.words, reached, chance, f"{word} {asked.share:.0%}", yes


def _verdicts(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    names = ("good", "usable", "refused", "error")
    for system in [*dict.fromkeys(sorted(one.system for one in cases)), ""]:
        mine = [one for one in cases if one.system == system or not system]
        counts = Counter(one.verdict for one in mine)
        if mine:
            yield system or "all", str(len(mine)), *(str(counts[name] or "–") for name in names)


def _phases(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    left: dict[str, list[float]] = {}
    for one in cases:
        residuals = one.answer["residual"] if one.answer else {}
        times = {phase: each["times"] for phase, each in residuals.items()}
        for phase, each in times.items():
            left.setdefault(phase, []).append(each)
        if times:
            left.setdefault(WORST, []).append(max(times.values()))
    for phase in [name for name in left if name != WORST] + [WORST] * (WORST in left):
        yield phase, str(len(left[phase])), *_quantiles(left[phase], "{:.2f}")


def _quantiles(values: Sequence[float], form: str) -> Iterator[str]:
    return (form.format(one) for one in (*np.quantile(values, (0.5, 0.9)), max(values)))


def _parameters(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    found: dict[str, list[Mapping[str, float]]] = {}
    for one in cases:
        if one.found and one.answer is not None:
            for name, each in one.answer["covered"].items():
                found.setdefault(name, []).append(each)
    for name, rigs in found.items():
        held = sum(one["holds"] for one in rigs)
        off = np.median([abs(one["value"] / one["true"] - 1.0) for one in rigs])
        half = np.median([(one["high95"] - one["low95"]) / 2.0 / abs(one["value"]) for one in rigs])
        yield f"`{name}`", str(len(rigs)), str(held), f"{off:.0%}", f"±{half:.0%}"


def _reasons(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    for reason, mine in _grouped(cases, _reason):
        true = {one.outcomes.get("true") for one in mine}
        word = "yes" if true == {True} else "**no**" if true == {False} else "some"
        yield reason, str(len(mine)), word, ", ".join(str(one.seed) for one in mine)


def _reason(case: Case) -> str | None:
    """Why a rig has no twin, numbers left out."""
    if case.found:
        return None
    if case.answer is not None:
        phases = case.answer["residual"]
        worst = max(phases, key=lambda phase: phases[phase]["times"])
        return f"refused: the twin is off by more than its cycles differ, most in {worst}"
    return re.sub(r"\d+(\.\d+)?", "…", case.error.strip().splitlines()[-1]).replace("|", "/")


def _grouped(
    cases: Sequence[Case], of: Callable[[Case], str | None]
) -> list[tuple[str, list[Case]]]:
    groups: dict[str, list[Case]] = {}
    for one in cases:
        if (name := of(one)) is not None:
            groups.setdefault(name, []).append(one)
    return sorted(groups.items(), key=lambda group: -len(group[1]))


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


def _seconds(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    for kind in FOUND:
        if spent := [one.seconds for one in of_kind(cases, kind)]:
            middle, high = np.quantile(spent, (0.5, 0.95))
            yield kind, str(len(spent)), f"{middle:.1f} s", f"{high:.1f} s", f"{max(spent):.1f} s"


def table(heads: Sequence[str], rows: Iterator[Sequence[str]]) -> str:
    """A table, or nothing where it has no row."""
    lines = [" | ".join(row) for row in rows]
    head = [" | ".join(heads), " | ".join("---" for _ in heads)]
    return "\n".join(f"| {line} |" for line in (*head, *lines)) if lines else ""
