"""The answer: what the simulation gets wrong, why, and what knowing it gains on unseen cycles."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from twin.config import Config
from twin.diagnosis.costs import costs
from twin.diagnosis.covariance import Covariance, Weights, covariance
from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis, collect, thinned
from twin.diagnosis.experiments import next_experiment
from twin.diagnosis.fit import Fitted, white
from twin.diagnosis.healthy import are_odd, left_in_each, usual_leftover
from twin.diagnosis.held_out import LITTLE, Judged, gain, judge, rounded
from twin.diagnosis.hypotheses import hours, parameters, score_with_tempered_prior
from twin.diagnosis.mechanisms import Explained, explain, explain_alone
from twin.diagnosis.search import Search, search, sharpened, stranger
from twin.diagnosis.unlisted import STRANGE, Unlisted, extended, look
from twin.diagnosis.unmodelled import Unmodelled
from twin.inference.levels import SIGMAS_95
from twin.inference.unmodelled import Odds
from twin.instants import CALENDAR_NS, SECOND_NS
from twin.model.courses import Cause, Course
from twin.model.effects import effect_of
from twin.model.mechanism import MECHANISMS
from twin.model.term import Term
from twin.monitor.bins import Floats
from twin.monitor.cycles import Cycle
from twin.monitor.healthy import NOT_COMMISSIONED
from twin.monitor.signal_checks import standing
from twin.signals import Quality, Samples

FORMAT = "ejector-twin-diagnosis/1"
FEWEST_CYCLES = 3  # judged ones: two to fit on, one to judge by
EXPLAINED = 1.2  # sigmas left up to which causes explain a deviation
BEYOND = 1.8  # times the usual deviation, with a share of what was explained: more is left over
ROUGH = 0.06  # of what was explained, that causes may be off
SEVERAL = 1.6  # sigmas that several causes may leave and still be sure,
NEARLY_ALL = 0.1  # or this of chi-square beyond noise: gross effects leave many sigmas
MOST_LEFT = 0.5  # of chi-square beyond noise, that a cause may leave and still be sure
MOST_SATURATED = 0.05  # share of samples
MOST_JUDGED = 24  # cycles of a long log that are looked at, evenly spread
FEW = 0.25  # of the cycles, up to which odd ones are shared out by themselves
MOST_NAMED = 4  # runners-up
WIDEST = 0.9  # of a parameter's range: an interval as wide says nothing
MIMICS = 1.6  # times the usual deviation: one cause that leaves more may mimic what nobody listed
LIKELY = 0.5  # that something acts which nobody listed: more, and it is said
# Of a size, that the data set's own scale is not known better: volume and suction; and how the
# wall's heat is shared between vessel and line.
RELATIVE, OF_HEAT = 0.03, 0.1


@dataclass(frozen=True)
class Diagnosis:
    """The answer with all that a report draws; ``json`` is the contract's form of it."""

    evidence: Evidence
    data_set: str  # content hash of the calibrated twin's
    search: Search | None
    hypothesis: Hypothesis  # the causes found
    terms: tuple[Term, ...]  # what data gave where no mechanism is known either
    before: Judged | None
    after: Judged | None
    held_out: list[int]
    json: dict[str, Any]
    mechanism: Explained | None = None  # what acts beside the causes that nobody listed

    @property
    def acting(self) -> Hypothesis:
        """All that the extended model has: the causes, then the mechanism."""
        return (*self.hypothesis, *((self.mechanism.cause,) if self.mechanism else ()))

    @property
    def told(self) -> list[dict[str, Any]]:
        """What the answer tells of each of them."""
        return [
            *self.json["causes"],
            *([self.json["unlisted"]["mechanism"]] if self.mechanism else []),
        ]


def diagnose(
    config: Config,
    blocks: Iterable[Samples],
    log: str,
    progress: Callable[[str], None],
    before_s: float = 0.0,
    derived: str = "",
) -> Diagnosis:
    """Diagnose a log, or the part of it that begins ``before_s`` into it.

    ``derived`` says how its commands were, where nobody recorded them: then it cannot answer.
    Onsets in the answer count from the log's begin. Without a calibrated twin the answer is
    ``insufficient``: its causes would be those of the data set, not of the ejector.
    """
    progress("running the twin over the log")
    blocks = [block for block in blocks if len(block)]
    evidence = replace(collect(config, blocks), before_s=before_s)
    head: dict[str, Any] = {
        "format": FORMAT,
        "log": log,
        "asset": {"type": config.asset.type, "id": config.asset.id},
    }
    if against := _signals(evidence):
        head["signals"] = against
    part = _part(blocks, before_s)
    unrecorded = f"{derived}: record the commands as well" if derived else None
    if reason := unrecorded or _not_commissioned(config) or insufficient(evidence):
        answer = head | _insufficient(evidence, part, reason)
        return Diagnosis(evidence, config.data.hash, None, HEALTHY, (), None, None, [], answer)
    whole, evidence = evidence, thinned(evidence, evidence.judged, MOST_JUDGED)
    healthy = covariance(evidence)
    fitted, held_out = split(evidence, healthy)
    searched = search(evidence, fitted, healthy, progress)
    if searched.found and whole.cycles > evidence.cycles:
        progress("looking for when it began")
        searched = sharpened(whole, evidence, searched)
    found = searched.found.hypothesis if searched.found else HEALTHY
    progress("judging on the cycles it has not seen")
    known = searched.known
    before = judge(evidence, healthy.of(held_out), HEALTHY)
    after = judge(evidence, known.of(held_out), found)
    progress("looking for what nobody listed")
    beside = Unmodelled(evidence, known.of(evidence.judged), found)
    odds = [beside.odds(number) for number in range(len(found))]
    alone = 0.0 if found else beside.alone()
    likely = any(one.of_unlisted(len(found)) > LIKELY for one in odds) or alone > LIKELY
    strange = look(known, found, fitted, held_out, least=0.0 if likely else STRANGE)
    # Where nothing was fitted, all cycles are unseen.
    left = after.leftover if found else _left_in_all(evidence, healthy.of(evidence.judged))
    verdict = _verdict(found, before, after, left, strange, likely)
    known_by_now = _Found(verdict, searched, found, after, strange)
    it = _with_unlisted(evidence, fitted, held_out, healthy, before, known_by_now, progress)
    causes = _causes(evidence, it.searched, odds, before) if it.found else []
    for cause, cost in zip(causes, costs(config, evidence, it.found, causes), strict=False):
        if cost is not None:  # there are none where no price is configured
            cause["cost"] = cost
    answer = head | {
        "verdict": it.verdict,
        "causes": causes,
        "runners_up": _runners_up(it.searched),
        "unmodelled_probability": _unmodelled(evidence, it.searched, odds, alone, it.verdict),
        "unlisted": _unlisted(evidence, it.strange, it.mechanism)
        if it.verdict == "unlisted"
        else None,
        "cycles": {
            "total": whole.cycles,
            "fitted": [int(evidence.numbers[one]) for one in fitted],
            "held_out": [int(evidence.numbers[one]) for one in held_out],
            **part,
        },
        "baseline": before.figures,
        "extended": it.after.figures,
        "gain": gain(before, it.after),
        "next_experiment": next_experiment(evidence, it.searched, it.mechanism),
    }
    return Diagnosis(
        evidence,
        config.data.hash,
        it.searched,
        it.found,
        it.terms,
        before,
        it.after,
        held_out,
        answer,
        it.mechanism,
    )


@dataclass(frozen=True)
class _Found:
    """What is known of a log: the causes, what they leave, and what acts beside them."""

    verdict: str
    searched: Search
    found: Hypothesis
    after: Judged
    strange: Unlisted
    terms: tuple[Term, ...] = ()
    mechanism: Explained | None = None

    @property
    def without_causes(self) -> "_Found":
        """The same where the causes do not stand."""
        return replace(self, searched=replace(self.searched, found=None), found=HEALTHY)


def _with_unlisted(
    evidence: Evidence,
    fitted: Sequence[int],
    held_out: Sequence[int],
    healthy: Covariance,
    before: Judged,
    it: _Found,
    progress: Callable[[str], None],
) -> _Found:
    """With what nobody listed: a mechanism, or a term from data where there is none.

    Causes that leave more than cycles differ by may mimic a mechanism, and do not stand beside one
    that alone does better.
    """
    little = MIMICS if len(it.found) == 1 else LITTLE
    if it.verdict == "explained" and it.after.rms > little * before.usual:
        alone = explain_alone(evidence, fitted, it.found, progress)
        mechanism, mended = _on_unseen(evidence, alone, it.after, held_out)
        if mechanism is None:
            return it
        strange = look(healthy, HEALTHY, fitted, held_out)
        it = replace(it, verdict="unlisted", strange=strange)
    elif it.verdict == "unlisted":
        if not _sure(it.found, before, it.after):
            strange = look(healthy, HEALTHY, fitted, held_out)
            it = replace(it.without_causes, strange=strange, after=before)
        explained = explain(evidence, fitted, it.found, progress)
        mechanism, mended = _on_unseen(evidence, explained, it.after, held_out)
    else:
        return it
    if mechanism and not mechanism.beside:
        it = it.without_causes
    if mended is None:
        strange, mended = _term_found(evidence, it.found, it.after, it.strange, held_out)
        it = replace(it, strange=strange, terms=strange.terms)
    return replace(it, after=mended or it.after, mechanism=mechanism)


def _on_unseen(
    evidence: Evidence, one: Explained | None, after: Judged, held_out: Sequence[int]
) -> tuple[Explained | None, Judged | None]:
    """A mechanism, where it brings the twin nearer to unseen cycles than ``after``."""
    if one is None:
        return None, None
    hypothesis = one.fitted.hypothesis
    mended = judge(evidence, covariance(evidence, hypothesis).of(held_out), hypothesis)
    return (one, mended) if mended.rms < after.rms else (None, None)


def _term_found(
    evidence: Evidence,
    found: Hypothesis,
    after: Judged,
    strange: Unlisted,
    held_out: Sequence[int],
) -> tuple[Unlisted, Judged | None]:
    """The term from data, where it brings the twin nearer; it holds for this program only."""
    with_terms = extended(evidence, strange.terms)
    mended = judge(with_terms, covariance(with_terms, found).of(held_out), found)
    if mended.rms < after.rms:
        return strange, mended
    return replace(strange, terms=()), None  # less in sigmas, but not in mbar, is no better model


def _signals(evidence: Evidence) -> list[dict[str, str]]:
    """What the ejector reports, or somebody measures, that the pressure contradicts."""
    bounds = pairwise(evidence.starts.tolist())
    cycles = (
        Cycle(number, evidence.samples[first:last], evidence.ticks[first:last], complete=True)
        for number, (first, last) in enumerate(bounds)
    )
    against = standing(cycles, evidence.theta, evidence.knees)
    return [{"signal": one.signal, "what": one.what, "do": one.action} for one in against]


def _left_in_all(evidence: Evidence, weights: Weights) -> float:
    """Sigmas left of the twin without a cause in all cycles; one odd one counts little."""
    residuals = white(evidence, weights, [HEALTHY])[: len(weights.bins), 0]
    return usual_leftover(left_in_each(evidence, weights, residuals))


def _verdict(
    found: Hypothesis, before: Judged, after: Judged, left: float, strange: Unlisted, likely: bool
) -> str:
    """Consistent, explained, or something real is left: in sigmas, in mbar, or of a kind.

    Or it is ``likely``, from what is left, that something acts which nobody listed. In mbar only
    what causes leave counts: rows of steep edges are off by much in healthy cycles too.
    """
    usual = math.hypot(before.usual, ROUGH * before.rms, after.unmeasured)
    beyond = bool(found) and after.rms > BEYOND * usual
    if left > EXPLAINED or beyond or likely or strange.gain >= STRANGE:
        return "unlisted"
    return "explained" if found else "consistent"


def _sure(found: Hypothesis, before: Judged, after: Judged) -> bool:
    """Whether causes stand although something is left: they take away nearly all of it.

    Several together can look like something nobody listed, so little may be left of them, in
    sigmas or beside what they take away. One odd cycle, as where the nozzle went on once more,
    counts little.
    """
    left = after.steady
    share = (left**2 - 1.0) / max(before.steady**2 - 1.0, 1e-9)
    return share < MOST_LEFT and (len(found) == 1 or left < SEVERAL or share < NEARLY_ALL)


def _not_commissioned(config: Config) -> str:
    """What to do first where nobody knows what this unit's healthy cycles are like."""
    if config.monitor.healthy.is_known:
        return ""
    run = f"twin commission HEALTHY.mcap --id {config.asset.id or 'ID'}"
    return f"{NOT_COMMISSIONED}; fit the twin first to a log of healthy cycles: {run}"


def insufficient(evidence: Evidence) -> str:
    """Why the log cannot answer; empty if it can."""
    if not len(evidence.samples):
        return "the log has no complete cycle: record suction, blow-off and the idle after it"
    saturated = np.mean((evidence.samples["quality"] & Quality.OVERFLOW) != 0)
    if saturated > MOST_SATURATED:
        return (
            f"the pressure input is saturated in {saturated:.0%} of the samples: check the sensor's"
            " range and wiring, then record again"
        )
    if len(evidence.judged) < FEWEST_CYCLES:
        return (
            f"only {len(evidence.judged)} cycle{'s' * (len(evidence.judged) != 1)} can be judged:"
            f" record at least {FEWEST_CYCLES + 1} complete ones in a row"
        )
    if not len(evidence.bins.count):
        return "no row can be compared: the twin never found a state to start from"
    return ""


def split(evidence: Evidence, healthy: Covariance) -> tuple[list[int], list[int]]:
    """Cycles to fit on and to judge by, about half of each, in Thue and Morse's order.

    That has no period: what comes in every second or third cycle falls into both. Where few cycles
    are odd they come first, so that what acts in them alone falls into both as well. One alone
    cannot, and stays where it is: a nozzle that went on once more is no cause to be fitted.
    """
    alone = [white(evidence, healthy.of([one]), [HEALTHY]) for one in evidence.judged]
    odd = are_odd(np.array([np.mean(of**2) for of in alone]))
    if not 2 <= np.count_nonzero(odd) <= FEW * len(odd):
        odd[:] = False
    odd_first = [one for first in (True, False) for one in np.array(evidence.judged)[odd == first]]
    held_out = {int(one) for place, one in enumerate(odd_first) if (place + 3).bit_count() % 2}
    return [one for one in evidence.judged if one not in held_out], sorted(held_out)


def _runners_up(searched: Search) -> list[dict[str, Any]]:
    if searched.found is None:
        return []
    others = [one for one in searched.ranking if one.effects != searched.found.effects]
    return [
        {
            "effect": one.effects[0],
            "course": str(one.hypothesis[0].course),
            "leftover_sigma": rounded(one.leftover),
        }
        for one in others[:MOST_NAMED]
    ]


# --- causes ---------------------------------------------------------------------------------------


def _causes(
    evidence: Evidence, searched: Search, odds: Sequence[Odds], before: Judged
) -> list[dict[str, Any]]:
    assert searched.found is not None
    found, first, result = searched.found, 0, []
    for number, cause in enumerate(found.hypothesis):
        count = len(parameters((cause,)))
        part = slice(first, first + count)
        rivals = searched.rivals[number]
        low, high = (of[part] for of in searched.ends)
        values = _parameters(evidence, cause, found.x[part], low, high)
        entry: dict[str, Any] = {
            "effect": cause.effect,
            "course": str(cause.course),
            "onset_s": _rounded_onset(evidence, cause),
            "parameters": values,
            "probability": round(
                odds[number].of_cause(len(found.hypothesis), _weight(evidence, found, rivals)),
                3,
            ),
            "not_separable_from": [stranger(one, found) for one in rivals],
            "why": _why(evidence, cause, values, before),
        }
        if cause.course == Course.STEP:
            entry["onset_low95_s"], entry["onset_high95_s"] = (
                round(evidence.before_s + one, 3) for one in searched.onsets[number]
            )
        if cause.course == Course.INTERMITTENT:
            entry["cycles"] = sorted(cause.cycles)
            judged = {int(evidence.numbers[one]) for one in evidence.judged}
            entry["share_pct"] = rounded(100.0 * len(cause.cycles & judged) / len(judged))
        result.append(entry)
        first += count
    return result


def _unmodelled(
    evidence: Evidence, searched: Search, odds: Sequence[Odds], alone: float, verdict: str
) -> float:
    """Probability of something unlisted in place of the first cause; ``alone`` where none stands.

    With the probability of that cause and those of its rivals it sums to one. Where more is left
    than noise it is likelier than not, whatever its course: no smooth one has to come again.
    """
    if searched.found is None:
        return round(max(alone, LIKELY) if verdict == "unlisted" else alone, 3)
    found = searched.found
    rivals = _weight(evidence, found, searched.rivals[0])
    return round(odds[0].instead(len(found.hypothesis), rivals), 3)


def _weight(evidence: Evidence, found: Fitted, rivals: Sequence[Fitted]) -> float:
    """What rivals weigh beside a cause.

    Of how often listed effects come only what is known counts.
    """
    scores = [
        score_with_tempered_prior(evidence, one.score, one.hypothesis) for one in (found, *rivals)
    ]
    temper = 2.0 * max(found.leftover, 1.0) ** 2
    return sum(math.exp(min((scores[0] - one) / temper, 50.0)) for one in scores[1:])


def _rounded_onset(evidence: Evidence, cause: Cause) -> float | None:
    """When a step or ramp began, s since the log did."""
    timed = cause.course in (Course.STEP, Course.RAMP)
    return round(evidence.before_s + cause.onset_s, 3) if timed else None


def _part(blocks: Sequence[Samples], before_s: float) -> dict[str, Any]:
    """Where in the log the cycles begin, and when the log began by the clock here (UTC, ns).

    None for a log of times that no clock gave, such as a table that counts from 0.
    """
    first_ns = int(blocks[0]["host_ns"][0]) if blocks else 0
    known = first_ns >= CALENDAR_NS
    return {
        "begin_s": round(before_s, 3),
        "log_begin_ns": first_ns - round(before_s * SECOND_NS) if known else None,
    }


def _parameters(
    evidence: Evidence,
    cause: Cause,
    x: Floats,
    lowest: Floats,
    highest: Floats,
) -> dict[str, dict[str, Any]]:
    """Values with intervals; a ramp's are rates, and what they have come to at the log's end."""
    found, theta = {}, evidence.theta
    sized = zip(effect_of(cause.effect).parameters, x, lowest, highest, strict=True)
    for p, size, below, above in sized:
        whole = p.steps_to(p.high, theta) - p.steps_to(p.low, theta)
        if not above - below < WIDEST * whole:
            continue  # nothing in this log depends on it
        ramp = cause.course == Course.RAMP and not p.shapes
        at_neutral = p.neutral(theta)
        neutral = 0.0 if ramp else at_neutral
        value, least, most = (
            one * p.typical if ramp else p.after(one, theta)
            for one in map(float, (size, below, above))
        )
        scale = OF_HEAT if cause.effect == "heat_exchange" else RELATIVE
        unsure = SIGMAS_95 * scale * value
        down, up = (math.hypot(end - value, unsure) for end in (least, most))
        shift = at_neutral - neutral  # of a ramp these are changes, and the bounds are not
        low, high = max(value - down, p.low - shift), min(value + up, p.high - shift)
        per_hour = 1.0 / hours(evidence, cause) if ramp else 1.0
        found[p.name] = {
            "value": rounded(value * per_hour),
            "unit": f"{p.unit}/h" if ramp else p.unit,
            "low95": rounded(low * per_hour),
            "high95": rounded(high * per_hour),
        }
        if ramp:
            for name, change in (("at_end", value), ("at_end_low95", low), ("at_end_high95", high)):
                found[p.name][name] = rounded(at_neutral + change)
    return found


def _why(
    evidence: Evidence, cause: Cause, values: dict[str, dict[str, Any]], before: Judged
) -> str:
    effect = effect_of(cause.effect)
    size = ", ".join(
        f"{name.replace('_', ' ')} {one.get('at_end', one['value']):.3g}"
        f" {one['unit'].removesuffix('/h')}"
        for name, one in values.items()
    )
    when = {
        Course.CONSTANT: "",
        Course.STEP: f", since {evidence.before_s + cause.onset_s:.1f} s",
        Course.RAMP: " by now, and growing",
        Course.INTERMITTENT: f", in {len(cause.cycles)} cycles only",
    }[cause.course]
    return (
        f"{effect.sentence} ({size}{when}); without it the twin is"
        f" {before.figures['rms_mbar']:.1f} mbar off."
    )


# --- what is left ---------------------------------------------------------------------------------


def _unlisted(evidence: Evidence, strange: Unlisted, one: Explained | None) -> dict[str, Any]:
    """Where something is that no listed effect explains, on what it depends, and what it may be."""
    return {
        "where": strange.where,
        "depends_on": [strange.depends_on],
        "shape": strange.shape,
        "mechanism": _mechanism(evidence, one) if one else None,
    }


def _mechanism(evidence: Evidence, one: Explained) -> dict[str, Any]:
    """A mechanism in words, as a formula and with intervals, and what it is not told from."""
    mechanism, first = MECHANISMS[one.cause.effect], len(parameters(one.beside))
    low, high = (end[first:] for end in one.ends)
    return {
        "name": mechanism.name,
        "sentence": mechanism.sentence(one.cause.values),
        "formula": mechanism.formula(one.cause.values),
        "parameters": _parameters(evidence, one.cause, one.fitted.x[first:], low, high),
        "not_separable_from": [
            MECHANISMS[rival.effect].sentence(rival.values) for rival in one.rivals
        ],
    }


def _insufficient(evidence: Evidence, part: dict[str, Any], reason: str) -> dict[str, Any]:
    names = (
        "rms_mbar",
        "max_mbar",
        "evacuation_time_error_pct",
        "h2_time_error_pct",
        "level_rms_mbar",
        "leftover_sigma",
    )
    nothing = dict.fromkeys(names)
    return {
        "verdict": "insufficient",
        "causes": [],
        "runners_up": [],
        "unmodelled_probability": None,
        "unlisted": None,
        "cycles": {"total": evidence.cycles, "fitted": [], "held_out": [], **part},
        "baseline": nothing,
        "extended": nothing,
        "gain": None,
        "next_experiment": reason,
    }
