"""The answer: what the simulation gets wrong, why, and the gain on held-out cycles."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from twin.config import Config
from twin.diagnosis.costs import costs
from twin.diagnosis.evidence import (
    HEALTHY,
    Evidence,
    Hypothesis,
    LogCycles,
    of_cycles,
    read_again,
    read_cycles,
    thinned,
)
from twin.diagnosis.experiments import MOSTLY, beside_weather, next_experiment, show_more
from twin.diagnosis.fit import Fitted, white
from twin.diagnosis.healthy import apart, are_odd, left_in_each, usual_leftover
from twin.diagnosis.held_out import LITTLE, Judged, gain, judge, rounded
from twin.diagnosis.hypotheses import hours, often, parameters, score_with_tempered_prior
from twin.diagnosis.mechanisms import Explained, explain, explain_alone
from twin.diagnosis.residual_covariance import Covariance, ResidualWhitener, covariance
from twin.diagnosis.search import Search, search, sharpened, stranger
from twin.diagnosis.unlisted import STRANGE, Unlisted, extended, look
from twin.diagnosis.unmodelled import Unmodelled
from twin.inference.levels import SIGMAS_95
from twin.inference.unmodelled import LEAST_SURE, Odds
from twin.instants import CALENDAR_NS, SECOND_NS
from twin.model.courses import Cause, Course
from twin.model.effects import Parameter, effect_of
from twin.model.mechanism import MECHANISMS
from twin.model.term import Term
from twin.monitor.bins import Floats, Ints
from twin.monitor.cycles import Cycle
from twin.monitor.healthy import NOT_COMMISSIONED
from twin.monitor.measured_supply import is_known
from twin.monitor.signal_checks import standing
from twin.signals import Samples

FORMAT = "ejector-twin-diagnosis/1"
FEWEST_CYCLES = 3  # judged cycles: two to fit on, one to judge by
EXPLAINED = 1.2  # largest leftover, in sigmas, of an explanation
BEYOND = 1.8  # times the usual deviation (see _verdict): a larger rest is unlisted
ROUGH = 0.06  # share of the explained deviation by which causes may be off
SEVERAL = 1.6  # sigmas that several causes may leave and still be sure,
NEARLY_ALL = 0.1  # or share of chi-square beyond noise: gross effects leave many sigmas
MOST_LEFT = 0.5  # share of chi-square beyond noise that a cause may leave and still be sure
MOST_SATURATED = 0.05  # share of samples
MOST_JUDGED = 24  # cycles of a long log that are evaluated, evenly spread
FEW = 0.25  # largest share of odd cycles that are split between fitted and held out separately
MOST_NAMED = 4  # runners-up
# Cells of a log that count beside a runner-up. The model's error is alike in neighbouring cells and
# in all cycles: thousands of cells say no more of causes that both leave little. Chosen by how
# often stated causes act, docs/decisions/0117-evidence-of-forty-cells.md.
INDEPENDENT = 40.0
WIDEST = 0.9  # share of a parameter's range: an interval as wide determines nothing
MIMICS = 1.6  # times the usual deviation: a cause that leaves more may mimic an unlisted mechanism
LIKELY = 0.5  # probability of something unlisted above which the verdict is "unlisted"


@dataclass(frozen=True)
class Diagnosis:
    """The answer with everything that a report draws; ``json`` is its stored form."""

    evidence: Evidence
    data_set: str  # content hash of the calibrated twin's
    search: Search | None
    hypothesis: Hypothesis  # the causes
    terms: tuple[Term, ...]  # curves from data, if no mechanism was found
    before: Judged | None
    after: Judged | None
    held_out: list[int]
    json: dict[str, Any]
    mechanism: Explained | None = None  # unlisted, acts beside the causes

    @property
    def acting(self) -> Hypothesis:
        """Everything in the extended model: the causes, then the mechanism."""
        return (*self.hypothesis, *((self.mechanism.cause,) if self.mechanism else ()))

    @property
    def told(self) -> list[dict[str, Any]]:
        """The answer's entry for each item of ``acting``."""
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

    ``derived`` says how commands were derived if nobody recorded them; then the answer is
    ``insufficient``. Onsets in the answer count from the beginning of the log. The answer is also
    ``insufficient`` without a calibrated twin: its causes would be errors of the data set.
    """
    progress("running the twin over the log")
    blocks = read_again(blocks)
    whole_log = read_cycles(config, blocks)
    whole_log = replace(whole_log, base=replace(whole_log.base, before_s=before_s))
    head: dict[str, Any] = {
        "format": FORMAT,
        "log": log,
        "asset": {"type": config.asset.type, "id": config.asset.id},
    }
    if against := _signals(whole_log):
        head["signals"] = against
    if config.weak:
        head["twin"] = {"verdict": "usable", "weak": dict(config.weak)}
    part = _part(blocks, before_s)
    if whole_log.without_part:
        part["without_part"] = whole_log.without_part
    unrecorded = f"{derived}: record the commands as well" if derived else None
    evidence = thinned(whole_log, whole_log.judged, MOST_JUDGED)
    if reason := unrecorded or _not_commissioned(config) or insufficient(whole_log, evidence):
        answer = head | _insufficient(whole_log, part, reason)
        last_cycle = of_cycles(whole_log, range(whole_log.cycles)[-1:])
        return Diagnosis(last_cycle, config.data.hash, None, HEALTHY, (), None, None, [], answer)
    healthy = covariance(evidence)
    fitted, held_out = split(evidence, healthy)
    searched = search(evidence, fitted, healthy, progress)
    if searched.found and whole_log.cycles > evidence.cycles:
        progress("looking for when it began")
        searched = sharpened(whole_log, evidence, searched)
    hypothesis = searched.found.hypothesis if searched.found else HEALTHY
    progress("judging on the cycles it has not seen")
    searched_covariance = searched.known
    before = judge(evidence, healthy.of(held_out), HEALTHY)
    after = judge(evidence, searched_covariance.of(held_out), hypothesis)
    progress("looking for what nobody listed")
    beside = Unmodelled(evidence, searched_covariance.of(evidence.judged), hypothesis)
    odds = [beside.odds(number) for number in range(len(hypothesis))]
    probability_alone = 0.0 if hypothesis else beside.alone()
    like_weather = None if hypothesis else beside_weather(evidence, healthy)
    if like_weather:  # what the model has wrong of such weather is smooth, and recurs as well
        probability_alone = min(probability_alone, LIKELY)
    likely = probability_alone > LIKELY or any(
        beside.can_show(number) and cause_odds.of_unlisted(len(hypothesis)) > LIKELY
        for number, cause_odds in enumerate(odds)
    )
    strange = look(
        searched_covariance, hypothesis, fitted, held_out, least=0.0 if likely else STRANGE
    )
    # If nothing was fitted, all cycles count as held out.
    leftover = after.leftover if hypothesis else _left_in_all(evidence, healthy.of(evidence.judged))
    verdict = _verdict(hypothesis, before, after, leftover, strange, likely)
    is_doubtful = _is_doubtful(evidence, hypothesis, _probabilities(evidence, searched, odds))
    listed_findings = _Findings(verdict, searched, hypothesis, after, strange, is_doubtful)
    findings = _with_unlisted(
        evidence, fitted, held_out, healthy, before, listed_findings, progress
    )
    is_beside = findings.verdict == "unlisted"
    close = _close_runners_up(searched, leftover)
    probabilities = _probabilities(evidence, searched, odds, close, is_beside=is_beside)
    causes = _causes(evidence, findings.searched, probabilities, before) if findings.causes else []
    for cause, cost in zip(causes, costs(config, evidence, findings.causes, causes), strict=False):
        if cost is not None:  # a price is configured, and a size is known
            cause["cost"] = cost
    answer = head | {
        "verdict": findings.verdict,
        "causes": causes,
        "runners_up": _runners_up(findings.searched),
        "unmodelled_probability": _unmodelled(
            evidence, findings.searched, odds, probability_alone, findings.verdict
        ),
        "unlisted": _unlisted(evidence, findings.strange, findings.mechanism)
        if findings.verdict == "unlisted"
        else None,
        "cycles": {
            "total": whole_log.cycles,
            "fitted": [int(evidence.numbers[cycle]) for cycle in fitted],
            "held_out": [int(evidence.numbers[cycle]) for cycle in held_out],
            **part,
        },
        "baseline": before.figures,
        "extended": findings.after.figures,
        "gain": gain(before, findings.after),
        "next_experiment": _odd_cycles(evidence, healthy) or like_weather
        if findings.verdict == "consistent"
        else _next_experiment(evidence, findings, healthy),
    }
    return Diagnosis(
        evidence,
        config.data.hash,
        findings.searched,
        findings.causes,
        findings.terms,
        before,
        findings.after,
        held_out,
        answer,
        findings.mechanism,
    )


@dataclass(frozen=True)
class _Findings:
    """Findings about a log: the causes, what they leave, and what acts beside them."""

    verdict: str
    searched: Search
    causes: Hypothesis
    after: Judged
    strange: Unlisted
    is_doubtful: bool  # each cause is by far less likely than look-alikes and something unlisted
    terms: tuple[Term, ...] = ()
    mechanism: Explained | None = None

    @property
    def without_causes(self) -> "_Findings":
        """The same with the causes withdrawn."""
        return replace(self, searched=replace(self.searched, found=None), causes=HEALTHY)


def _with_unlisted(
    evidence: Evidence,
    fitted: Sequence[int],
    held_out: Sequence[int],
    healthy: Covariance,
    before: Judged,
    findings: _Findings,
    progress: Callable[[str], None],
) -> _Findings:
    """The findings with something unlisted: a mechanism, or a term from data without one.

    Causes that leave more than the scatter between cycles may mimic a mechanism. They are withdrawn
    if a mechanism alone does better, in mbar and in sigmas: what is known of a cause, such as how
    far its waveform may be off, counts in sigmas alone.
    """
    limit = MIMICS if len(findings.causes) == 1 else LITTLE
    opened = math.sqrt(max(findings.after.unmeasured**2 - before.unmeasured**2, 0.0))
    usual = math.hypot(before.usual, opened)
    if findings.verdict == "explained" and findings.after.rms > limit * usual:
        mechanism_alone = explain_alone(evidence, fitted, findings.causes, progress)
        mechanism, mended = _on_unseen(evidence, mechanism_alone, findings.after, held_out)
        if mended is None or mended.leftover >= findings.after.leftover:
            return findings
        strange = look(healthy, HEALTHY, fitted, held_out)
        findings = replace(findings, verdict="unlisted", strange=strange)
    elif findings.verdict == "unlisted":
        if findings.is_doubtful or not _sure(findings.causes, before, findings.after):
            strange = look(healthy, HEALTHY, fitted, held_out)
            findings = replace(findings.without_causes, strange=strange, after=before)
        explained = explain(evidence, fitted, findings.causes, progress)
        mechanism, mended = _on_unseen(evidence, explained, findings.after, held_out)
    else:
        return findings
    if mechanism and not mechanism.beside:
        findings = findings.without_causes
    if mended is None:
        strange, mended = _term_found(
            evidence, findings.causes, findings.after, findings.strange, held_out
        )
        findings = replace(findings, strange=strange, terms=strange.terms)
    return replace(findings, after=mended or findings.after, mechanism=mechanism)


def _next_experiment(evidence: Evidence, findings: _Findings, healthy: Covariance) -> str | None:
    """What to record or measure next; None if a cause or a mechanism alone explains the log."""
    recording = next_experiment(evidence, findings.searched, findings.mechanism)
    if recording or findings.mechanism:
        return recording
    about = findings.searched.known if findings.causes else healthy
    weather = beside_weather(evidence, about, findings.causes, MOSTLY)
    is_unlisted = findings.verdict == "unlisted"
    return weather or (show_more(findings.strange.where) if is_unlisted else None)


def _on_unseen(
    evidence: Evidence, explained: Explained | None, after: Judged, held_out: Sequence[int]
) -> tuple[Explained | None, Judged | None]:
    """The mechanism and its judgement on held-out cycles; None if rms is not below ``after``."""
    if explained is None:
        return None, None
    hypothesis = explained.fitted.hypothesis
    mended = judge(evidence, covariance(evidence, hypothesis).of(held_out), hypothesis)
    return (explained, mended) if mended.rms < after.rms else (None, None)


def _term_found(
    evidence: Evidence,
    causes: Hypothesis,
    after: Judged,
    strange: Unlisted,
    held_out: Sequence[int],
) -> tuple[Unlisted, Judged | None]:
    """``strange`` with its term and the judgement; no term and None if rms is not below ``after``.

    A term holds for this program of commands only.
    """
    with_terms = extended(evidence, strange.terms)
    mended = judge(with_terms, covariance(with_terms, causes).of(held_out), causes)
    if mended.rms < after.rms:
        return strange, mended
    return replace(strange, terms=()), None  # lower in sigmas only: no better model


def _signals(log: LogCycles) -> list[dict[str, str]]:
    """Reported or measured signals that contradict the pressure."""
    cycles = (Cycle(number, *log.rows(number), complete=True) for number in range(log.cycles))
    gauged = is_known(log.base.healthy)
    contradictions = standing(cycles, log.base.theta, log.base.detector, gauged=gauged)
    return [
        {"signal": contradiction.signal, "what": contradiction.what, "do": contradiction.action}
        for contradiction in contradictions
    ]


def _left_in_all(evidence: Evidence, weights: ResidualWhitener) -> float:
    """Leftover (sigmas) of the twin without causes over all cycles; an odd cycle counts little."""
    return usual_leftover(_left_by_cycle(evidence, weights))


def _left_by_cycle(evidence: Evidence, weights: ResidualWhitener) -> Floats:
    """Chi-square of the twin without causes per residual in each cycle, by weights of all."""
    residuals = white(evidence, weights, [HEALTHY])[: len(weights.bins), 0]
    return left_in_each(evidence, weights, residuals)


def _odd_cycles(evidence: Evidence, healthy: Covariance) -> str | None:
    """The cycles of a ``consistent`` log that are not, in words; None if there are none."""
    chi2 = _left_by_cycle(evidence, healthy.of(evidence.judged))
    odd = np.array(evidence.judged)[are_odd(np.maximum(chi2, 1.0))]
    if not len(odd):
        return None
    bins = evidence.bins
    rows = np.isin(bins.cycle, odd)
    (off,) = evidence.off([HEALTHY]).T
    rms = float(np.sqrt(np.average(off[rows] ** 2, weights=bins.count[rows])))
    cycles = ", ".join(str(evidence.numbers[cycle]) for cycle in odd)
    which = f"cycles {cycles} alone deviate" if len(odd) > 1 else f"cycle {cycles} alone deviates"
    return (
        f"{which}, by {rms:.1f} mbar (rms): so few cannot show a cause;"
        " record more cycles if it comes again"
    )


def _verdict(
    causes: Hypothesis,
    before: Judged,
    after: Judged,
    leftover: float,
    strange: Unlisted,
    likely: bool,
) -> str:
    """The verdict: ``consistent``, ``explained`` or ``unlisted``.

    It is ``unlisted`` if too much is left in sigmas or in mbar, if an unlisted pattern gains
    enough, or if ``likely``. Millibars count only with causes: steep edges deviate in healthy
    cycles too.
    """
    usual = math.hypot(before.usual, ROUGH * before.rms, after.unmeasured)
    beyond = bool(causes) and after.rms > BEYOND * usual
    if leftover > EXPLAINED or beyond or likely or strange.gain >= STRANGE:
        return "unlisted"
    return "explained" if causes else "consistent"


def _sure(causes: Hypothesis, before: Judged, after: Judged) -> bool:
    """Whether causes stand although something is left, because they take away nearly all of it.

    Several causes together can imitate something unlisted, so they may leave only little, in sigmas
    or relative to what they take away. Odd cycles that the causes leave as they were do not count,
    such as one in which the nozzle went on once more.
    """
    is_odd = are_odd(after.chi2) & (after.chi2 > MOST_LEFT * before.chi2)
    left, was = float(after.chi2[~is_odd].mean()), float(before.chi2[~is_odd].mean())
    share = (left - 1.0) / max(was - 1.0, 1e-9)
    return share < MOST_LEFT and (len(causes) == 1 or after.steady < SEVERAL or share < NEARLY_ALL)


def _not_commissioned(config: Config) -> str:
    """What to do first if this unit's healthy scatter is unknown; else empty."""
    if config.monitor.healthy.is_known:
        return ""
    run = f"twin commission HEALTHY.mcap --id {config.asset.id or 'ID'}"
    return f"{NOT_COMMISSIONED}; fit the twin first to a log of healthy cycles: {run}"


def insufficient(log: LogCycles, evidence: Evidence) -> str:
    """Why a log cannot answer by some evidence of it; empty if it can."""
    if not log.cycles:
        return "the log has no complete cycle: record suction, blow-off and the idle after it"
    if log.saturated > MOST_SATURATED:
        return (
            f"the pressure input is saturated in {log.saturated:.0%} of the samples: check the"
            " sensor's range and wiring, then record again"
        )
    if len(log.judged) < FEWEST_CYCLES:
        return (
            f"only {len(log.judged)} cycle{'s' * (len(log.judged) != 1)} can be judged:"
            f" record at least {FEWEST_CYCLES + 1} complete ones in a row"
        )
    if not len(evidence.bins.count):
        return "no row can be compared: the twin never found a state to start from"
    return ""


def split(evidence: Evidence, healthy: Covariance) -> tuple[list[int], list[int]]:
    """Fitted and held-out cycles, about half of each, in the order of the Thue–Morse sequence.

    The sequence has no period, so an effect in every second or third cycle falls into both halves.
    If few cycles are odd, they are split first, so an effect in them alone falls into both as well.
    So are cycles that deviate much, if nearly all of them fell into one part: then an effect that
    comes and goes would be fitted where it is not, or judged where it is not. A single odd cycle
    keeps its place: a nozzle that went on once more is no cause to fit.
    """
    cycles = np.array(evidence.judged)
    odd = are_odd(_deviations(evidence, healthy))
    if not 2 <= np.count_nonzero(odd) <= FEW * len(odd):
        odd = apart(_mean_squares(evidence))
        held_out = _held_out(cycles)
        if all(_in_both(cycles[odd == group], held_out) for group in (True, False)):
            odd[:] = False
    held_out = _held_out(np.concatenate([cycles[odd], cycles[~odd]]))
    return [cycle for cycle in evidence.judged if cycle not in held_out], sorted(held_out)


def _deviations(evidence: Evidence, residual_covariance: Covariance) -> Floats:
    """Mean square of each judged cycle's residuals without causes, in sigmas."""
    residuals = [
        white(evidence, residual_covariance.of([cycle]), [HEALTHY]) for cycle in evidence.judged
    ]
    return np.array([np.mean(cycle_residuals**2) for cycle_residuals in residuals])  # pyright: ignore[reportReturnType]


def _mean_squares(evidence: Evidence) -> Floats:
    """Mean square of each judged cycle's deviation (mbar²) from the twin without causes.

    In sigmas an effect in some cycles would hide: all cycles share what is unknown of the twin.
    """
    squares, bins = evidence.off([HEALTHY])[:, 0] ** 2, evidence.bins
    return np.array(  # pyright: ignore[reportReturnType]
        [
            np.average(squares[bins.cycle == cycle], weights=bins.count[bins.cycle == cycle])
            for cycle in evidence.judged
        ]
    )


def _held_out(ordered: Ints) -> set[int]:
    """Cycles of these that are held out: a sequence without any period says which."""
    return {int(cycle) for position, cycle in enumerate(ordered) if (position + 3).bit_count() % 2}


def _in_both(group: Ints, held_out: set[int]) -> bool:
    """Whether a third of a group's cycles, rounded down, is held out and as many are not."""
    inside = sum(int(cycle) in held_out for cycle in group)
    return min(inside, len(group) - inside) >= len(group) // 3


def _runners_up(searched: Search) -> list[dict[str, Any]]:
    return [
        {
            "effect": fit.effects[0],
            "course": str(fit.hypothesis[0].course),
            "leftover_sigma": rounded(fit.leftover),
        }
        for fit in _next_best(searched)
    ]


def _next_best(searched: Search) -> list[Fitted]:
    """The best single causes beside what was found."""
    if searched.found is None:
        return []
    return [fit for fit in searched.ranking if fit.effects != searched.found.effects][:MOST_NAMED]


# --- causes ---------------------------------------------------------------------------------------


def _probabilities(
    evidence: Evidence,
    searched: Search,
    odds: Sequence[Odds],
    close: float = 0.0,
    *,
    is_beside: bool = False,
) -> list[float]:
    """Probability of each cause found, beside its rivals and something unlisted.

    ``close`` is the weight of ``_close_runners_up``. ``is_beside`` says that something unlisted
    acts.
    """
    if searched.found is None:
        return []
    found = searched.found
    weights = [_weight(evidence, found, rivals) for rivals in searched.rivals]
    return [
        cause_odds.of_cause(len(found.hypothesis), weight + close, is_beside=is_beside)
        for cause_odds, weight in zip(odds, weights, strict=True)
    ]


def _close_runners_up(searched: Search, leftover: float) -> float:
    """Weight of the runners-up that leave hardly more than a single cause, ``leftover`` (sigmas).

    That of the cause is of held-out cycles, those of runners-up of the cycles they were fitted to:
    INDEPENDENT was chosen so. Its rivals are left out: the log cannot reject these at all.
    """
    if searched.found is None or len(searched.found.hypothesis) > 1:
        return 0.0
    rivals = {stranger(rival, searched.found) for rival in searched.rivals[0]}
    weights = 0.0
    for fit in _next_best(searched):
        if fit.effects[0] not in rivals:
            behind = max(fit.leftover**2 - leftover**2, 0.0) / max(leftover, 1.0) ** 2
            weights += math.exp(-0.5 * INDEPENDENT * behind)
    return weights


def _is_doubtful(evidence: Evidence, causes: Hypothesis, probabilities: Sequence[float]) -> bool:
    """Whether causes are no answer where more than noise is left.

    So is weather that nobody measured, since it moves everything a little, as it is on any day.
    """
    is_weather = len(causes) == 1 and often(evidence, causes[0]) > 1.0
    return is_weather or all(probability < LEAST_SURE for probability in probabilities)


def _causes(
    evidence: Evidence, searched: Search, probabilities: Sequence[float], before: Judged
) -> list[dict[str, Any]]:
    """The answer's entry for each cause found, with its probability."""
    assert searched.found is not None
    best, first, result = searched.found, 0, []
    for number, cause in enumerate(best.hypothesis):
        count = len(parameters((cause,)))
        part = slice(first, first + count)
        rivals = searched.rivals[number]
        low, high = (end[part] for end in searched.ends)
        values = _parameters(evidence, cause, best.x[part], low, high)
        entry: dict[str, Any] = {
            "effect": cause.effect,
            "course": str(cause.course),
            "onset_s": _rounded_onset(evidence, cause),
            "parameters": values,
            "probability": round(probabilities[number], 3),
            "not_separable_from": [stranger(rival, best) for rival in rivals],
            "why": _why(evidence, cause, values, before),
        }
        if cause.course == Course.STEP:
            entry["onset_low95_s"], entry["onset_high95_s"] = (
                round(evidence.before_s + onset_s, 3) for onset_s in searched.onsets[number]
            )
        if cause.course == Course.INTERMITTENT:
            entry["cycles"] = sorted(cause.cycles)
            judged = {int(evidence.numbers[cycle]) for cycle in evidence.judged}
            entry["share_pct"] = rounded(100.0 * len(cause.cycles & judged) / len(judged))
        result.append(entry)
        first += count
    return result


def _unmodelled(
    evidence: Evidence, searched: Search, odds: Sequence[Odds], alone: float, verdict: str
) -> float:
    """Probability of something unlisted instead of the first cause; from ``alone`` without causes.

    But for runners-up it sums to one with the probabilities of that cause and its rivals. Without
    causes, under the verdict ``unlisted``, it is at least LIKELY, whatever its course: a smooth one
    need not recur.
    """
    if searched.found is None:
        return round(max(alone, LIKELY) if verdict == "unlisted" else alone, 3)
    best = searched.found
    rivals = _weight(evidence, best, searched.rivals[0])
    is_beside = verdict == "unlisted"
    return round(odds[0].instead(len(best.hypothesis), rivals, is_beside=is_beside), 3)


def _weight(evidence: Evidence, best: Fitted, rivals: Sequence[Fitted]) -> float:
    """Weight of the rivals relative to the cause.

    Of prior frequencies of listed effects only the known part counts.
    """
    scores = [
        score_with_tempered_prior(evidence, candidate.score, candidate.hypothesis)
        for candidate in (best, *rivals)
    ]
    temper = 2.0 * max(best.leftover, 1.0) ** 2
    return sum(math.exp(min((scores[0] - score) / temper, 50.0)) for score in scores[1:])


def _rounded_onset(evidence: Evidence, cause: Cause) -> float | None:
    """Onset of a step or ramp, in s from the beginning of the log; None for other courses."""
    timed = cause.course in (Course.STEP, Course.RAMP)
    return round(evidence.before_s + cause.onset_s, 3) if timed else None


def _part(blocks: Iterable[Samples], before_s: float) -> dict[str, Any]:
    """Where in the log the cycles begin (s), and the host time of the log's beginning (UTC, ns).

    The latter is None if no clock gave the times, as in a table that counts from 0.
    """
    first_ns = next((int(block["host_ns"][0]) for block in blocks if len(block)), 0)
    is_dated = first_ns >= CALENDAR_NS
    return {
        "begin_s": round(before_s, 3),
        "log_begin_ns": first_ns - round(before_s * SECOND_NS) if is_dated else None,
    }


def _parameters(
    evidence: Evidence,
    cause: Cause,
    x: Floats,
    lowest: Floats,
    highest: Floats,
) -> dict[str, dict[str, Any]]:
    """Values with 95 % intervals; for a ramp the rates, and the values at the log's end."""
    entries, theta = {}, evidence.theta
    sized = zip(effect_of(cause.effect).parameters, x, lowest, highest, strict=True)
    for p, size, below, above in sized:
        full_range = p.steps_to(p.high, theta) - p.steps_to(p.low, theta)
        if not above - below < WIDEST * full_range:
            continue  # the log does not determine it
        ramp = cause.course == Course.RAMP and not p.shapes
        at_neutral = p.neutral(theta)
        neutral = 0.0 if ramp else at_neutral
        value, lower, upper = (
            steps * p.typical if ramp else p.after(steps, theta)
            for steps in map(float, (size, below, above))
        )
        toward_zero, away = _relative_errors(p, evidence.volumes_within)
        smaller, larger = (toward_zero, away) if value > 0.0 else (away, toward_zero)
        down = math.hypot(lower - value, smaller * value)
        up = math.hypot(upper - value, larger * value)
        shift = at_neutral - neutral  # a ramp's values are changes, its bounds are not
        low, high = max(value - down, p.low - shift), min(value + up, p.high - shift)
        per_hour = 1.0 / hours(evidence, cause) if ramp else 1.0
        entries[p.name] = {
            "value": rounded(value * per_hour),
            "unit": f"{p.unit}/h" if ramp else p.unit,
            "low95": rounded(low * per_hour),
            "high95": rounded(high * per_hour),
        }
        if ramp:
            for name, change in (("at_end", value), ("at_end_low95", low), ("at_end_high95", high)):
                entries[p.name][name] = rounded(at_neutral + change)
    return entries


def _relative_errors(p: Parameter, volumes_within: float) -> tuple[float, float]:
    """Relative errors (95 %) of a size, toward zero and away, beside what the log leaves open.

    A flow or volume is as many times larger or smaller as the system's volumes are than told.
    """
    of_model = SIGMAS_95 * p.relative_error
    if not p.scales_with_volumes:
        return of_model, of_model
    return math.hypot(of_model, 1.0 - 1.0 / volumes_within), math.hypot(
        of_model, volumes_within - 1.0
    )


def _why(
    evidence: Evidence, cause: Cause, values: dict[str, dict[str, Any]], before: Judged
) -> str:
    effect = effect_of(cause.effect)
    size = ", ".join(
        f"{name.replace('_', ' ')} {entry.get('at_end', entry['value']):.3g}"
        f" {entry['unit'].removesuffix('/h')}"
        for name, entry in values.items()
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


# --- what is unlisted -----------------------------------------------------------------------------


def _unlisted(evidence: Evidence, strange: Unlisted, explained: Explained | None) -> dict[str, Any]:
    """Where something unlisted acts, on what it depends, its shape, and its mechanism."""
    return {
        "where": strange.where,
        "depends_on": [strange.depends_on],
        "shape": strange.shape,
        "mechanism": _mechanism(evidence, explained) if explained else None,
    }


def _mechanism(evidence: Evidence, explained: Explained) -> dict[str, Any]:
    """A mechanism in words, as a formula and with intervals, and its look-alikes."""
    mechanism, first = MECHANISMS[explained.cause.effect], len(parameters(explained.beside))
    low, high = (end[first:] for end in explained.ends)
    return {
        "name": mechanism.name,
        "sentence": mechanism.sentence(explained.cause.values),
        "formula": mechanism.formula(explained.cause.values),
        "parameters": _parameters(evidence, explained.cause, explained.fitted.x[first:], low, high),
        "not_separable_from": [
            MECHANISMS[rival.effect].sentence(rival.values) for rival in explained.rivals
        ],
    }


def _insufficient(log: LogCycles, part: dict[str, Any], reason: str) -> dict[str, Any]:
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
        "cycles": {"total": log.cycles, "fitted": [], "held_out": [], **part},
        "baseline": nothing,
        "extended": nothing,
        "gain": None,
        "next_experiment": reason,
    }
