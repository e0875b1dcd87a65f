"""Cases of the battery: what was hidden in a record, the answer, and what that counts for."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from twin.inference.levels import SIGMAS_95

# By what is asked for: 1 reached, 0 not, or a share; several where a case counts more than once.
Outcomes = dict[str, Any]

FOUND = {
    "commissioning": "commissioned",
    "healthy": "consistent",
    "single": "named",
    "pair": "pairs",
    "unlisted": "unlisted",
}
STORED = ("good", "usable")  # verdicts of a commissioning after which a unit has its twin
MOST_LEFT = 1.2  # sigmas, where explained
SURE = 0.95  # probability from which on a cause is stated surely


@dataclass(frozen=True)
class Hidden:
    """What is hidden in a record."""

    effect: str
    course: str
    size: float  # what a ramp comes to

    def __str__(self) -> str:
        return f"{self.effect} {self.course} {self.size:.3g}"


@dataclass(frozen=True)
class Case:
    """One record: whose it is, what is hidden, and the answer; None where there was an error.

    The answer of a commissioning is what it says of itself, with what the truth says to that.
    """

    kind: str
    seed: int
    system: str
    hidden: Sequence[Hidden] = ()
    answer: Mapping[str, Any] | None = None
    number: int = 0  # among those of its kind and seed
    error: str = ""
    seconds: float = 0.0  # of the processor
    more: Mapping[str, Any] = field(default_factory=dict)  # what only one world knows

    @property
    def key(self) -> tuple[str, int, int]:
        """Which case of its world it is."""
        return self.kind, self.seed, self.number

    @property
    def verdict(self) -> str:
        """Verdict of the answer."""
        return "error" if self.answer is None else str(self.answer["verdict"])

    @property
    def causes(self) -> Sequence[Mapping[str, Any]]:
        """The causes of the answer; a commissioning has none."""
        return (self.answer or {}).get("causes", ())

    @property
    def sets(self) -> list[list[str]]:
        """Each cause of the answer with its look-alikes, the cause first."""
        return [[cause["effect"], *cause["not_separable_from"]] for cause in self.causes]

    @property
    def first(self) -> str | None:
        """The effect that is named first."""
        return self.sets[0][0] if self.sets else None

    @property
    def alone(self) -> bool:
        """Whether exactly one effect is named, with no look-alike."""
        return [len(one) for one in self.sets] == [1]

    @property
    def left(self) -> float:
        """Sigmas that the answer leaves; NaN without one."""
        left = (self.answer or {}).get("extended", {}).get("leftover_sigma")
        return float("nan") if left is None else float(left)

    @property
    def named(self) -> str:
        """The causes of the answer, with course, size and look-alikes."""
        return " + ".join(
            f"{one['effect']} {one['course']} "
            + ", ".join(f"{p.get('at_end', p['value'])}" for p in one["parameters"].values())
            + "".join(f" ~{other}" for other in one["not_separable_from"])
            for one in self.causes
        )

    @property
    def stated(self) -> list[tuple[float, bool]]:
        """Probability of each cause of the answer, and whether it acts."""
        effects = {truth.effect for truth in self.hidden}
        return [(float(one["probability"]), one["effect"] in effects) for one in self.causes]

    @property
    def rank(self) -> float | None:
        """Where the true size lies in what the answer says of it, from 0 to 1; None where unsaid.

        Ranks of many true sizes are uniform where the intervals are right (simulation-based
        calibration).
        """
        if self.kind != "single" or self.answer is None or not self.more.get("comparable", True):
            return None
        (truth,) = self.hidden
        mine = _cause(self, truth)
        said = None if mine is None else stated_interval(mine, truth)
        if said is None:
            return None
        low, value, high = said
        sigma = ((high - value) if truth.size > value else (value - low)) / SIGMAS_95
        return NormalDist().cdf((truth.size - value) / sigma) if sigma > 0.0 else None

    @property
    def answer_outcomes(self) -> Outcomes:
        """What verdict, names, courses and sizes of the answer count for, by what is asked for."""
        if self.answer is None:
            return {FOUND[self.kind]: False}
        found = {name: one for name, one in _JUDGES[self.kind](self).items() if one is not None}
        if sure := [acts for probability, acts in self.stated if probability >= SURE]:
            found["sure"] = sure
        return found

    @property
    def outcomes(self) -> Outcomes:
        """The same, and what a diagnosis leaves and gains."""
        if self.answer is None:
            true = {"true": self.more["true"]} if "true" in self.more else {}
            return self.answer_outcomes | true
        found = self.answer_outcomes
        if self.kind != "commissioning" and self.verdict == "explained":
            share = self.answer["gain"]["share_of_achievable_pct"] / 100.0
            found |= {"left": self.left <= MOST_LEFT, "gain": share}
        return found

    @property
    def found(self) -> bool:
        """Whether the answer is the one that is asked for."""
        return bool(self.outcomes[FOUND[self.kind]])


# --- judging --------------------------------------------------------------------------------------


def _single(case: Case) -> Mapping[str, float | None]:
    """A single effect: in the first cause's set of at most three, alone, size, course."""
    (truth,) = case.hidden
    sets, mine = case.sets, _cause(case, truth)
    covered = "flows" if case.more.get("of_volume") else "covered"
    comparable = mine is not None and case.more.get("comparable", True)
    return {
        "named": bool(sets) and truth.effect in sets[0] and len(sets[0]) <= 3,
        "alone": sets == [[truth.effect]],
        "wrong": case.verdict == "explained" and not any(truth.effect in one for one in sets),
        "spurious": _spurious(case),
        "course": None if mine is None else mine["course"] == truth.course,
        covered: _covers(mine, truth) if comparable else None,
    }


def _pair(case: Case) -> Mapping[str, float | None]:
    """Two effects at once: each in the set of one of the causes."""
    effects = {truth.effect for truth in case.hidden}
    strange = any(not effects & set(one) for one in case.sets)
    return {
        "pairs": all(any(effect in one for one in case.sets) for effect in effects),
        "wrong": case.verdict == "explained" and strange,
        "spurious": _spurious(case),
    }


def _healthy(case: Case) -> Mapping[str, float | None]:
    """A healthy record: consistent."""
    return {"consistent": case.verdict == "consistent", "wrong": case.verdict == "explained"}


def _unlisted(case: Case) -> Mapping[str, float | None]:
    """An effect outside the table: unlisted."""
    return {"unlisted": case.verdict == "unlisted"}


def _commissioning(case: Case) -> Mapping[str, float | None]:
    """A healthy record of a unit that nobody has seen before: it gets its twin."""
    assert case.answer is not None
    if case.verdict not in STORED:  # nothing is wrong with it, and nothing that was told
        return {"commissioned": False, "true": False}
    held = [one["holds"] for one in case.answer["covered"].values()]
    return {"commissioned": True, "parameters": held}


_JUDGES = {
    "commissioning": _commissioning,
    "healthy": _healthy,
    "single": _single,
    "pair": _pair,
    "unlisted": _unlisted,
}


def _spurious(case: Case) -> bool:
    """Whether beside a cause that acts another one is named that does not, nor a look-alike."""
    effects = {truth.effect for truth in case.hidden}
    acts = [bool(effects & set(one)) for one in case.sets]
    return any(acts) and not all(acts)


def _cause(case: Case, truth: Hidden) -> Mapping[str, Any] | None:
    """The cause of the answer that is the effect which is hidden."""
    return next((one for one in case.causes if one["effect"] == truth.effect), None)


def _covers(cause: Mapping[str, Any], truth: Hidden) -> bool | None:
    """Whether the interval of the first parameter holds the true size; None if of another kind."""
    said = stated_interval(cause, truth)
    return None if said is None else bool(said[0] <= truth.size <= said[2])


def stated_interval(cause: Mapping[str, Any], truth: Hidden) -> tuple[float, float, float] | None:
    """Low end, value and high end of the first parameter; None where the course is another."""
    if not cause["parameters"] or cause["course"] != truth.course:
        return None
    found = next(iter(cause["parameters"].values()))
    if truth.course == "ramp":
        return found["at_end_low95"], found["at_end"], found["at_end_high95"]
    return found["low95"], found["value"], found["high95"]


# --- the file -------------------------------------------------------------------------------------


class CaseFile:
    """Cases of a run, one JSON line each as soon as it is answered: a run that is cut goes on.

    The first line says which run it is. ValueError where that is another one's.
    """

    def __init__(self, path: Path | None, run: Mapping[str, Any]) -> None:
        self._path, self._cases = path, dict[tuple[Any, ...], Case]()
        if path is None:
            return
        if not path.exists():
            self._append(run)
            return
        whole = path.read_text(encoding="utf-8").rpartition("\n")[0]  # a cut line is none
        path.write_text(whole + "\n", encoding="utf-8")
        begun, found = read_cases(path)
        if begun != run:
            raise ValueError(f"{path} has cases of another run, {begun}: finish or remove it")
        self._cases = {(world, *case.key): case for world, case in found}

    def get(self, world: str, key: tuple[str, int, int]) -> Case | None:
        """The case of a world, if it is answered."""
        return self._cases.get((world, *key))

    def add(self, world: str, case: Case) -> Case:
        """Keep a case, and give it back."""
        self._cases[world, *case.key] = case
        if self._path is not None:
            self._append({"world": world} | asdict(case))
        return case

    def _append(self, line: Mapping[str, Any]) -> None:
        assert self._path is not None
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, default=float) + "\n")


def read_cases(path: Path) -> tuple[Mapping[str, Any], list[tuple[str, Case]]]:
    """Which run it is whose cases are in the file, and each case with its world."""
    run, *lines = map(json.loads, path.read_text(encoding="utf-8").splitlines())
    found = []
    for line in lines:
        world = line.pop("world")
        hidden = [Hidden(**each) for each in line.pop("hidden")]
        found.append((world, Case(hidden=hidden, **line)))
    return run, found


def first_of(path: Path | None) -> int | None:
    """The first seed of the run whose cases are in the file; None where there is none."""
    if path is None or not path.exists():
        return None
    with path.open(encoding="utf-8") as lines:
        return int(json.loads(next(lines))["first"])


def spread(cases: Sequence[Case], name: str) -> list[float]:
    """Outcomes of all cases for one thing that is asked for."""
    found = [np.atleast_1d(one.outcomes[name]) for one in cases if name in one.outcomes]
    return [float(each) for one in found for each in one]


def of_kind(cases: Sequence[Case], kind: str) -> Iterator[Case]:
    """Those of a kind."""
    return (one for one in cases if one.kind == kind)
