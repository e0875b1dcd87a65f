"""The battery's page: tables of the newest run in each world, a line for each older run."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest, kstest

from tools.battery_cases import FOUND, MOST_LEFT, SURE, Case, of_kind, spread

MORE = 3  # most answers listed for an effect that was not named first
WHOLE = ("gain",)  # targets whose outcomes are shares
WORST = "the worst phase"
STATED = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 1.01)  # bounds of the groups of probabilities


class Asked(NamedTuple):
    """A target in words, with the least share; with the largest share if ``most``."""

    words: str
    share: float
    most: bool = False


ASKED = {
    "commissioned": Asked("rigs commissioned without editing a number", 0.95),
    "true": Asked("refused for a reason that is true of the record", 1.0),
    "parameters": Asked("95 % interval covers a parameter, where the world has it", 0.90),
    "named": Asked("single effects named first or in a set of at most three", 0.98),
    "alone": Asked("named alone, no look-alike needed", 0.85),
    "wrong": Asked("`explained` without a cause that acts, of all `explained`", 0.005, most=True),
    "spurious": Asked("answers with a cause that does not act, of all answers", 0.03, most=True),
    "sure": Asked(f"causes stated with {SURE:.0%} or more that act", 0.95),
    "course": Asked("the course right, where named", 0.90),
    "covered": Asked("95 % interval covers the size", 0.90),
    "flows": Asked("95 % interval covers a flow or volume, the vessel's told a fifth off", 0.90),
    "left": Asked(f"leftover at most {MOST_LEFT} sigmas, where explained", 0.95),
    "gain": Asked("share of the achievable gain, mean, where explained", 0.90),
    "pairs": Asked("pairs, both named", 0.90),
    "consistent": Asked("healthy records called consistent", 0.98),
    "unlisted": Asked("effects outside the table called unlisted", 0.92),
    "shown": Asked("those of them that move the record by more than its noise", 0.92),
}


def kept(cases: Sequence[Case], name: str) -> bool:
    """Whether a target is reached."""
    share, target = float(np.mean(spread(cases, name))), ASKED[name]
    return share <= target.share if target.most else share >= target.share


def all_kept(cases: Sequence[Case]) -> bool:
    """Whether all targets that have outcomes are reached."""
    return all(kept(cases, name) for name in ASKED if spread(cases, name))


def likely(cases: Sequence[Case], name: str, share: float | None = None) -> float:
    """Probability of a count at least this bad if the true share is ``share``, or the target."""
    outcomes, target = spread(cases, name), ASKED[name]
    side = "greater" if target.most else "less"
    true_share = target.share if share is None else share
    return float(binomtest(round(sum(outcomes)), len(outcomes), true_share, side).pvalue)


def expected(name: str, world: str, page: str) -> float:
    """The share that a target asks for; what the world's newest run reached where that is short."""
    target, run = ASKED[name], marked(f"newest run of the {world} world", page)[2]
    row = re.search(rf"\| {re.escape(target.words)} \| (\d+) of (\d+) ", run)
    if row is None:
        return target.share
    reached = int(row[1]) / int(row[2])
    return max(target.share, reached) if target.most else min(target.share, reached)


def summary(world: str, cases: Sequence[Case], when: str, commit: str) -> str:
    """The run in one line: date, commit, seeds, and how many answers of each kind were right."""
    seeds = [case.seed for case in cases]
    counts = []
    for kind, name in FOUND.items():
        if outcomes := spread(cases, name):
            counts.append(f"{sum(outcomes):.0f} of {len(outcomes)} {_PLURAL.get(kind, kind)}")
    return (
        f"{when}, {world} world, commit {commit}, seeds {min(seeds)} to {max(seeds)}:"
        f" found {', '.join(counts)}."
    )


_PLURAL = {"commissioning": "commissioned"}


def tables(cases: Sequence[Case]) -> str:
    """Targets reached, names given for each effect, and missed cases, in Markdown."""
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
            ("hidden, outside the table", "cases", *_OUTSIDE_VERDICTS),
            _outside(list(of_kind(cases, "unlisted"))),
        ),
        table(
            (
                "not found",
                "seed",
                "system",
                "hidden",
                "moves the record",
                "noise",
                "verdict",
                "named",
                "sigmas left",
            ),
            _missed([case for case in cases if not case.found and case.kind != "commissioning"]),
        ),
        *reliability(cases),
        table(("processor time of", "cases", "median", "95 %", "most"), _seconds(cases)),
    ]
    return "\n\n".join(filter(None, parts))


def reliability(cases: Sequence[Case]) -> Iterator[str]:
    """How often stated causes act, by probability, and whether sizes scatter as stated."""
    yield from by_probability([statement for case in cases for statement in case.stated])
    ranks = [case.rank for case in cases if case.rank is not None]
    if ranks:
        test = kstest(ranks, "uniform")
        yield (
            f"Ranks of {len(ranks)} true sizes within what was said of them: uniform but for"
            f" {test.statistic:.2f} (Kolmogorov and Smirnov), by chance once in"
            f" {1.0 / max(float(test.pvalue), 1e-6):.3g}."
        )


def by_probability(
    stated: Sequence[tuple[float, bool]], what: str = "causes", right: str = "act"
) -> Iterator[str]:
    """A table of stated probabilities and how often they are right, then the mean error."""
    rows = list[Sequence[str]]()
    for low, high, group in _by_probability(stated):
        mean, acts = group.mean(axis=0)
        ends = binomtest(int(group[:, 1].sum()), len(group)).proportion_ci(0.95)
        chance = f"{ends.low:.0%} to {ends.high:.0%}"
        bounds = f"{low:.0%} to {min(high, 1.0):.0%}"
        rows.append((bounds, str(len(group)), f"{mean:.1%}", f"{acts:.1%}", chance))
    if rows:
        yield table(("probability stated", what, "mean", right, "by chance"), iter(rows))
        error = calibration_error(stated)
        yield f"Expected calibration error: {error:.3f}, over {len(stated)} {what}."


def calibration_error(stated: Sequence[tuple[float, bool]]) -> float:
    """Mean difference between stated probability and observed share; NaN without statements."""
    groups = [group for _, _, group in _by_probability(stated)]
    if not groups:
        return float("nan")
    errors = [abs(float(np.diff(group.mean(axis=0))[0])) for group in groups]
    return float(np.average(errors, weights=[len(group) for group in groups]))


def _by_probability(
    stated: Sequence[tuple[float, bool]],
) -> Iterator[tuple[float, float, npt.NDArray[np.float64]]]:
    """Both bounds of each group of STATED, and its causes: probability, and 1 if it acts."""
    pairs = np.array(stated, np.float64).reshape(-1, 2)
    for low, high in pairwise(STATED):
        group = pairs[(pairs[:, 0] >= low) & (pairs[:, 0] < high)]
        if len(group):
            yield low, high, group


def commissionings(cases: Sequence[Case]) -> Iterator[str]:
    """Verdicts by kind of rig, residuals by phase, parameters, and reasons of refusals."""
    yield table(("rigs", "drawn", "good", "usable", "refused", "error"), _verdicts(cases))
    yield table(("left over floor", "rigs", "median", "90 %", "most"), _phases(cases))
    yield table(
        ("parameter", "rigs", "95 % interval holds it", "off, median", "interval, median"),
        _parameters(cases),
    )
    yield table(("not commissioned because", "rigs", "true", "seeds"), _reasons(cases))


def with_run(page: str, world: str, line: str, run: str) -> str:
    """The page with a world's new run; the line of the run it replaces moves to the older runs."""
    newest, older = marked(f"newest run of the {world} world", page), marked("older runs", page)
    before = newest[2].strip().split("\n", 1)[0].strip("*")
    if before and before.partition(":")[0] != line.partition(":")[0]:  # not the same counted anew
        page = page.replace(older[0], f"{older[1]}- {before}\n{older[2]}{older[3]}")
    return page.replace(newest[0], f"{newest[1]}**{line}**\n\n{run}\n{newest[3]}")


def marked(name: str, page: str) -> re.Match[str]:
    """The named part of a page as groups: opening mark, content, closing mark."""
    match = re.search(rf"(<!-- {name}: [^\n]*-->\n)(.*?)(<!-- end -->)", page, re.DOTALL)
    if match is None:
        raise ValueError(f'the page has no part between "<!-- {name}: … -->" and "<!-- end -->"')
    return match


def _figures(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    for name, target in ASKED.items():
        if outcomes := spread(cases, name):
            count, share = len(outcomes), f"{np.mean(outcomes):.0%}"
            reached, chance = share, "–"
            if name not in WHOLE:
                reached = f"{sum(outcomes):.0f} of {count} ({share})"
                ends = binomtest(round(sum(outcomes)), count).proportion_ci(0.95)
                chance = f"{ends.low:.0%} to {ends.high:.0%}"
            word = "at most" if target.most else "at least"
            yes = "yes" if kept(cases, name) else "**no**"
            yield target.words, reached, chance, f"{word} {100.0 * target.share:g}%", yes


def _verdicts(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    names = ("good", "usable", "refused", "error")
    for system in [*dict.fromkeys(sorted(case.system for case in cases)), ""]:
        selected = [case for case in cases if case.system == system or not system]
        counts = Counter(case.verdict for case in selected)
        if selected:
            yield system or "all", str(len(selected)), *(str(counts[name] or "–") for name in names)


def _phases(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    ratios: dict[str, list[float]] = {}
    for case in cases:
        residuals = case.answer["residual"] if case.answer else {}
        times = {phase: residual["times"] for phase, residual in residuals.items()}
        for phase, ratio in times.items():
            ratios.setdefault(phase, []).append(ratio)
        if times:
            ratios.setdefault(WORST, []).append(max(times.values()))
    for phase in [name for name in ratios if name != WORST] + [WORST] * (WORST in ratios):
        yield phase, str(len(ratios[phase])), *_quantiles(ratios[phase], "{:.2f}")


def _quantiles(values: Sequence[float], form: str) -> Iterator[str]:
    return (form.format(value) for value in (*np.quantile(values, (0.5, 0.9)), max(values)))


def _parameters(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    by_name: dict[str, list[Mapping[str, float]]] = {}
    for case in cases:
        if case.found and case.answer is not None:
            for name, parameter in case.answer["covered"].items():
                by_name.setdefault(name, []).append(parameter)
    for name, rigs in by_name.items():
        held = sum(parameter["holds"] for parameter in rigs)
        error = np.median([abs(parameter["value"] / parameter["true"] - 1.0) for parameter in rigs])
        half = np.median(
            [
                (parameter["high95"] - parameter["low95"]) / 2.0 / abs(parameter["value"])
                for parameter in rigs
            ]
        )
        yield f"`{name}`", str(len(rigs)), str(held), f"{error:.0%}", f"±{half:.0%}"


def _reasons(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    for reason, group in _grouped(cases, _reason):
        true = {case.outcomes.get("true") for case in group}
        word = "yes" if true == {True} else "**no**" if true == {False} else "some"
        yield reason, str(len(group)), word, ", ".join(str(case.seed) for case in group)


def _reason(case: Case) -> str | None:
    """Why a rig has no twin, with numbers replaced by "…"; None if it has one."""
    if case.found:
        return None
    if case.answer is not None:
        phases = case.answer["residual"]
        worst = max(phases, key=lambda phase: phases[phase]["times"])
        return f"refused: the twin is off by more than its cycles differ, most in {worst}"
    return re.sub(r"\d+(\.\d+)?", "…", case.error.strip().splitlines()[-1]).replace("|", "/")


def _grouped(
    cases: Sequence[Case], key: Callable[[Case], str | None]
) -> list[tuple[str, list[Case]]]:
    groups: dict[str, list[Case]] = {}
    for case in cases:
        if (name := key(case)) is not None:
            groups.setdefault(name, []).append(case)
    return sorted(groups.items(), key=lambda group: -len(group[1]))


def _effects(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    for effect in dict.fromkeys(case.hidden[0].effect for case in cases):
        selected = [case for case in cases if case.hidden[0].effect == effect]
        first = [case for case in selected if case.first == effect]
        other_names = Counter(
            case.first or case.verdict for case in selected if case.first != effect
        )
        names = ", ".join(f"{name} {count}" for name, count in other_names.most_common(MORE))
        counts = (len(selected), len(first), sum(case.alone for case in first))
        explained = sum(case.verdict == "explained" for case in selected)
        leftover = f"{np.nanmax([0.0, *(case.left for case in selected)]):.2f}"
        yield f"`{effect}`", *map(str, counts), names or "–", str(explained), leftover


def _outside(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    for effect in sorted({case.hidden[0].effect for case in cases if case.hidden}):
        verdicts = Counter(
            case.verdict for case in cases if case.hidden and case.hidden[0].effect == effect
        )
        counts = (verdicts.total(), *(verdicts[name] for name in _OUTSIDE_VERDICTS))
        yield f"`{effect}`", *map(str, counts)


_OUTSIDE_VERDICTS = ("unlisted", "explained", "consistent")


def _missed(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    for case in cases:
        hidden = " + ".join(map(str, case.hidden)) or "healthy"
        leftover = "–" if np.isnan(case.left) else f"{case.left:.2f}"
        yield (
            case.kind,
            str(case.seed),
            case.system,
            hidden,
            *(_mbar(case.more.get(key)) for key in ("moved_mbar", "noise_mbar")),
            case.verdict,
            case.named or "–",
            leftover,
        )


def _mbar(value: float | None) -> str:
    """An rms over all rows; a world may not have it."""
    return "–" if value is None else f"{value:.2g} mbar"


def _seconds(cases: Sequence[Case]) -> Iterator[Sequence[str]]:
    for kind in FOUND:
        if seconds := [case.seconds for case in of_kind(cases, kind)]:
            middle, high = np.quantile(seconds, (0.5, 0.95))
            yield (
                kind,
                str(len(seconds)),
                f"{middle:.1f} s",
                f"{high:.1f} s",
                f"{max(seconds):.1f} s",
            )


def table(heads: Sequence[str], rows: Iterator[Sequence[str]]) -> str:
    """A Markdown table; empty without rows."""
    lines = [" | ".join(row) for row in rows]
    head = [" | ".join(heads), " | ".join("---" for _ in heads)]
    return "\n".join(f"| {line} |" for line in (*head, *lines)) if lines else ""
