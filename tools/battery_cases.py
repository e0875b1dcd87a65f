"""Cases of the battery: effects hidden in a record, the answer, and how it is scored."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from twin.inference.levels import SIGMAS_95

# By name of a target: 1 reached, 0 missed, or a share; a list if a case counts more than once.
Outcomes = dict[str, Any]

FOUND = {
    "commissioning": "commissioned",
    "healthy": "consistent",
    "single": "named",
    "pair": "pairs",
    "unlisted": "unlisted",
}
STORED = ("good", "usable")  # verdicts of a commissioning after which a unit has its twin
MOST_LEFT = 1.2  # sigmas that an explanation may leave
SURE = 0.95  # from this probability on a cause counts as stated surely
# Mechanisms outside the table that a listed effect describes with a course: what is right as well.
ALSO = {"sticking_valve": ("response_delay", "intermittent")}


@dataclass(frozen=True)
class Hidden:
    """An effect hidden in a record."""

    effect: str
    course: str
    size: float  # of a ramp at its end

    def __str__(self) -> str:
        return f"{self.effect} {self.course} {self.size:.3g}"


@dataclass(frozen=True)
class Case:
    """One record: its rig, the hidden effects, and the answer; None if there was an error.

    The answer of a commissioning is its own result, compared with the rig's true values.
    """

    kind: str
    seed: int
    system: str
    hidden: Sequence[Hidden] = ()
    answer: Mapping[str, Any] | None = None
    number: int = 0  # among the cases of the same kind and seed
    error: str = ""
    seconds: float = 0.0  # processor time
    more: Mapping[str, Any] = field(default_factory=dict)  # entries of one world only

    @property
    def key(self) -> tuple[str, int, int]:
        """What identifies the case within its world: kind, seed and number."""
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
        return [len(names) for names in self.sets] == [1]

    @property
    def left(self) -> float:
        """Leftover of the answer in sigmas; NaN without one."""
        leftover = (self.answer or {}).get("extended", {}).get("leftover_sigma")
        return float("nan") if leftover is None else float(leftover)

    @property
    def named(self) -> str:
        """The causes of the answer, with course, size and look-alikes."""
        return " + ".join(
            f"{cause['effect']} {cause['course']} "
            + ", ".join(f"{p.get('at_end', p['value'])}" for p in cause["parameters"].values())
            + "".join(f" ~{rival}" for rival in cause["not_separable_from"])
            for cause in self.causes
        )

    @property
    def stated(self) -> list[tuple[float, bool]]:
        """Probability of each cause of the answer, and whether it acts."""
        return [
            (float(cause["probability"]), self._acts(cause, cause["effect"]))
            for cause in self.causes
        ]

    @property
    def unlisted(self) -> tuple[float, bool] | None:
        """Probability of something unlisted, and whether the record has it; None without one."""
        stated = (self.answer or {}).get("unmodelled_probability")
        return None if stated is None else (float(stated), self.kind == "unlisted")

    @property
    def right_causes(self) -> list[bool]:
        """Whether each cause of the answer acts, itself or by a look-alike."""
        return [
            any(self._acts(cause, name) for name in names)
            for cause, names in zip(self.causes, self.sets, strict=True)
        ]

    def _acts(self, cause: Mapping[str, Any], effect: str) -> bool:
        """Whether an effect with the course of a cause is among what is hidden."""
        return any(
            effect == truth.effect or ALSO.get(truth.effect) == (effect, cause["course"])
            for truth in self.hidden
        )

    @property
    def rank(self) -> float | None:
        """Rank of the true size in the stated distribution, from 0 to 1; None without one.

        Ranks of many true sizes are uniform if the intervals are right (simulation-based
        calibration).
        """
        if self.kind != "single" or self.answer is None or not self.more.get("comparable", True):
            return None
        (truth,) = self.hidden
        cause = _cause(self, truth)
        interval = None if cause is None else stated_interval(cause, truth)
        if interval is None:
            return None
        low, value, high = interval
        sigma = ((high - value) if truth.size > value else (value - low)) / SIGMAS_95
        return NormalDist().cdf((truth.size - value) / sigma) if sigma > 0.0 else None

    @property
    def answer_outcomes(self) -> Outcomes:
        """Scores of the answer's verdict, names, courses and sizes, by target."""
        if self.answer is None:
            return {FOUND[self.kind]: False}
        outcomes = {
            name: outcome
            for name, outcome in _JUDGES[self.kind](self).items()
            if outcome is not None
        }
        if self.kind != "commissioning":
            outcomes["spurious"] = not all(self.right_causes)
            if self.verdict == "explained":
                outcomes["wrong"] = not any(self.right_causes)
        if sure := [acts for probability, acts in self.stated if probability >= SURE]:
            outcomes["sure"] = sure
        return outcomes

    @property
    def outcomes(self) -> Outcomes:
        """``answer_outcomes``, with the leftover and the gain of an explanation."""
        if self.answer is None:
            true = {"true": self.more["true"]} if "true" in self.more else {}
            return self.answer_outcomes | true
        outcomes = self.answer_outcomes
        if self.kind != "commissioning" and self.verdict == "explained":
            share = self.answer["gain"]["share_of_achievable_pct"] / 100.0
            outcomes |= {"left": self.left <= MOST_LEFT, "gain": share}
        return outcomes

    @property
    def found(self) -> bool:
        """Whether the answer is right, by the target of the case's kind."""
        return bool(self.outcomes[FOUND[self.kind]])


# --- judging --------------------------------------------------------------------------------------


def _single(case: Case) -> Mapping[str, float | None]:
    """A single effect: in the first cause's set of at most three, alone, size, course."""
    (truth,) = case.hidden
    sets, cause = case.sets, _cause(case, truth)
    covered = "flows" if case.more.get("of_volume") else "covered"
    comparable = cause is not None and case.more.get("comparable", True)
    return {
        "named": bool(sets) and truth.effect in sets[0] and len(sets[0]) <= 3,
        "alone": sets == [[truth.effect]],
        "course": None if cause is None else cause["course"] == truth.course,
        covered: _covers(cause, truth) if comparable else None,
    }


def _pair(case: Case) -> Mapping[str, float | None]:
    """Two effects at once: each in the set of one of the causes."""
    effects = {truth.effect for truth in case.hidden}
    return {"pairs": all(any(effect in names for names in case.sets) for effect in effects)}


def _healthy(case: Case) -> Mapping[str, float | None]:
    """A healthy record: consistent."""
    return {"consistent": case.verdict == "consistent"}


def _unlisted(case: Case) -> Mapping[str, float | None]:
    """An effect outside the table: unlisted, or explained by what describes it as well.

    Counted apart where it moves the record by more (rms) than a row's noise, if that is known.
    """
    described = case.verdict == "explained" and all(case.right_causes)
    is_right = case.verdict == "unlisted" or described
    moved, noise = (case.more.get(key) for key in ("moved_mbar", "noise_mbar"))
    shows = moved is not None and noise is not None and moved > noise
    return {"unlisted": is_right, "shown": is_right if shows else None}


def _commissioning(case: Case) -> Mapping[str, float | None]:
    """A healthy record of an unknown unit: it gets its twin."""
    assert case.answer is not None
    if case.verdict not in STORED:  # neither the record nor the configuration is wrong
        return {"commissioned": False, "true": False}
    held = [parameter["holds"] for parameter in case.answer["covered"].values()]
    return {"commissioned": True, "parameters": held}


_JUDGES = {
    "commissioning": _commissioning,
    "healthy": _healthy,
    "single": _single,
    "pair": _pair,
    "unlisted": _unlisted,
}


def _cause(case: Case, truth: Hidden) -> Mapping[str, Any] | None:
    """The cause of the answer that names the hidden effect."""
    return next((cause for cause in case.causes if cause["effect"] == truth.effect), None)


def _covers(cause: Mapping[str, Any], truth: Hidden) -> bool | None:
    """Whether the first parameter's interval covers the true size; None for another course."""
    interval = stated_interval(cause, truth)
    return None if interval is None else bool(interval[0] <= truth.size <= interval[2])


def stated_interval(cause: Mapping[str, Any], truth: Hidden) -> tuple[float, float, float] | None:
    """Low end, value and high end of the first parameter; None for another course."""
    if not cause["parameters"] or cause["course"] != truth.course:
        return None
    parameter = next(iter(cause["parameters"].values()))
    if truth.course == "ramp":
        return parameter["at_end_low95"], parameter["at_end"], parameter["at_end_high95"]
    return parameter["low95"], parameter["value"], parameter["high95"]


# --- the file -------------------------------------------------------------------------------------


class CaseFile:
    """Cases of a run, stored as one JSON line each, so that an interrupted run can resume.

    The first line identifies the run. Raises ValueError if the file is of another run.
    """

    def __init__(self, path: Path | None, run: Mapping[str, Any]) -> None:
        self._path, self._cases = path, dict[tuple[Any, ...], Case]()
        if path is None:
            return
        if not path.exists():
            self._append(run)
            return
        # The last line may be incomplete: it is dropped.
        complete_lines = path.read_text(encoding="utf-8").rpartition("\n")[0]
        path.write_text(complete_lines + "\n", encoding="utf-8")
        stored_run, cases = read_cases(path)
        if stored_run != run:
            raise ValueError(f"{path} has cases of another run, {stored_run}: finish or remove it")
        self._cases = {(world, *case.key): case for world, case in cases}

    def get(self, world: str, key: tuple[str, int, int]) -> Case | None:
        """The answered case of a world; None if it is not answered yet."""
        return self._cases.get((world, *key))

    def add(self, world: str, case: Case) -> Case:
        """Store a case, and return it."""
        self._cases[world, *case.key] = case
        if self._path is not None:
            self._append({"world": world} | asdict(case))
        return case

    def _append(self, line: Mapping[str, Any]) -> None:
        assert self._path is not None
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, default=float) + "\n")


def read_cases(path: Path) -> tuple[Mapping[str, Any], list[tuple[str, Case]]]:
    """What identifies the run of the file, and each case with its world."""
    run, *lines = map(json.loads, path.read_text(encoding="utf-8").splitlines())
    cases = []
    for line in lines:
        world = line.pop("world")
        hidden = [Hidden(**entry) for entry in line.pop("hidden")]
        cases.append((world, Case(hidden=hidden, **line)))
    return run, cases


def first_of(path: Path | None) -> int | None:
    """The first seed of the run in the file; None without a file."""
    if path is None or not path.exists():
        return None
    with path.open(encoding="utf-8") as lines:
        return int(json.loads(next(lines))["first"])


def spread(cases: Sequence[Case], name: str) -> list[float]:
    """Outcomes of all cases for one target."""
    outcomes = [np.atleast_1d(case.outcomes[name]) for case in cases if name in case.outcomes]
    return [float(outcome) for case_outcomes in outcomes for outcome in case_outcomes]


def of_kind(cases: Sequence[Case], kind: str) -> Iterator[Case]:
    """The cases of a kind."""
    return (case for case in cases if case.kind == kind)
