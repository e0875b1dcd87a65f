"""The answer: what the simulation gets wrong, why, and what knowing it gains on unseen cycles."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from twin.config import Config
from twin.diagnosis.evidence import Course, Evidence, Floats, collect
from twin.diagnosis.search import SAME, Finding, search
from twin.model import theta as c
from twin.model.effects import EFFECTS
from twin.monitor.cycles import PAPER_VACUUM, time_to_vacuum
from twin.signals import MBAR, MS, NS, Phase, Quality, Samples

FORMAT = "ejector-twin-diagnosis/1"
FEWEST_CYCLES = 3  # judged ones: two to fit on, one to judge by
SIGNIFICANT = 40.0  # chi-square a cause must gain before it is named
SMALLEST = 0.25  # of an effect's typical size: less is within what calibration leaves
EXPLAINED = 1.6  # sigmas left up to which a cause explains a deviation
MOST_SATURATED = 0.05  # share of samples
RESAMPLES = 2000
MISMATCH = 0.05  # of what a cause explains may be the model's own error in its signature

# The cheapest recordings that part look-alikes: the first whose effects hold the best cause and
# one that cannot be told from it.
EXPERIMENTS = (
    (
        {"leakage", "porous_leakage", "check_valve_leak", "cup_compliance"},
        "hold for 10 s with the nozzle off from 750 mbar vacuum down to 300 mbar: "
        "an opening leaks evenly above 472 mbar, a porous part less and less",
    ),
    (
        {"suction_loss", "filter_clogging", "end_vacuum_loss", "supply_pressure_drop"},
        "switch the air saving off and evacuate to the end vacuum for 10 s: "
        "suction, end vacuum and throttling part near the end",
    ),
    (
        {"suction_loss", "added_volume", "heat_exchange"},
        "hold for 3 s with the nozzle off after evacuation: "
        "the leak's pressure rise tells the volume apart from suction",
    ),
    (
        {"sensor_offset", "sensor_gain", "ambient_pressure", "threshold_drift", "end_vacuum_loss"},
        "open the vacuum side to ambient for 1 s with no command: "
        "the reading there is ambient plus the sensor's offset",
    ),
    (
        {"response_delay", "slow_ramp_up", "sensor_lag", "blow_off_delay"},
        "command six short bursts of suction and blow-off: "
        "a valve delays only its own edge, a slow sensor both",
    ),
)


@dataclass(frozen=True)
class Diagnosis:
    """The answer with all that a report draws; ``json`` is the contract's form of it."""

    evidence: Evidence
    data_set: str  # content hash of the calibrated twin's
    ranking: list[Finding]
    cause: Finding | None
    held_out: list[int]
    json: dict[str, Any]


def diagnose(
    config: Config, blocks: Iterable[Samples], log: str, progress: Callable[[str], None]
) -> Diagnosis:
    """Diagnose a log; raises ConfigError where the twin is not calibrated."""
    progress("running the twin over the log")
    evidence = collect(config, blocks)
    head = {
        "format": FORMAT,
        "log": log,
        "asset": {"type": config.asset.type, "id": config.asset.id},
    }
    if reason := insufficient(evidence):
        return Diagnosis(
            evidence, config.data.hash, [], None, [], head | _insufficient(evidence, reason)
        )
    fitted, held_out = split(evidence, None)
    ranking = search(evidence, fitted, progress)
    if ranking and ranking[0].onset is not None:  # the cycle it began in cannot judge
        fitted, held_out = split(evidence, ranking[0].onset)
        ranking = search(evidence, fitted, progress)
    baseline: Course = [(0, evidence.theta)]
    unexplained = _chi2(evidence, baseline, fitted)
    best = ranking[0] if ranking and worth_naming(evidence, ranking[0], unexplained) else None
    extended = best.course(evidence) if best else baseline
    progress("judging on the cycles it has not seen")
    before, after = (judge(evidence, course, held_out) for course in (baseline, extended))
    verdict = "consistent"
    if best or before["leftover_sigma"] > EXPLAINED:
        verdict = "explained" if after["leftover_sigma"] <= EXPLAINED else "unlisted"
    twins = _not_separable(best, ranking, unexplained)
    answer = head | {
        "verdict": verdict,
        "causes": [_cause(evidence, best, ranking, twins, before)] if best else [],
        "runners_up": [
            {"effect": f.effect, "course": _course_name(f), "leftover_sigma": _round(f.leftover)}
            for f in ranking[1:6]
        ]
        if best
        else [],
        "unlisted": _remaining(evidence, extended, held_out) if verdict == "unlisted" else None,
        "cycles": {"total": evidence.cycles, "fitted": fitted, "held_out": held_out},
        "baseline": before,
        "extended": after,
        "gain": gain(evidence, baseline, extended, held_out),
        "next_experiment": next_experiment(best, twins),
    }
    return Diagnosis(evidence, config.data.hash, ranking, best, held_out, answer)


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
    if not len(evidence.bins) or evidence.bins.max() < 0:
        return "no row can be compared: the twin never found a state to start from"
    return ""


def split(evidence: Evidence, onset: int | None) -> tuple[list[int], list[int]]:
    """Cycles to fit on and to judge by, in turn; the one in which an effect began is fitted."""
    began = -1 if onset is None else int(np.searchsorted(evidence.starts, onset, "right")) - 1
    others = [cycle for cycle in evidence.judged if cycle != began]
    held_out = others[1::2]
    return [cycle for cycle in evidence.judged if cycle not in held_out], held_out


def worth_naming(evidence: Evidence, finding: Finding, unexplained: float) -> bool:
    """Whether a finding is significant, and bigger than what calibration leaves."""
    sizes = [
        abs(finding.values[p.name] - p.neutral(evidence.theta)) / p.typical
        for p in EFFECTS[finding.effect].parameters
        if p.name in finding.values
    ]
    return unexplained - finding.chi2 > SIGNIFICANT and max(sizes, default=0.0) >= SMALLEST


def judge(evidence: Evidence, course: Course, cycles: Sequence[int]) -> dict[str, float]:
    """How far measurement and a model part on the given cycles, in the contract's figures."""
    expected = evidence.expect(course)
    off = evidence.off(expected)
    rows = np.concatenate([_rows(evidence, cycle) for cycle in cycles])
    rows = rows[evidence.bins[rows] >= 0]
    deviation = (evidence.samples["pressure"][rows] - expected[rows]) / MBAR
    whitened = np.concatenate([evidence.whitened(off, cycle) for cycle in cycles])
    binned = np.concatenate([_bins(evidence, off, cycle) for cycle in cycles])
    return {
        "rms_mbar": _round(float(np.sqrt(np.mean(deviation**2)))),
        "max_mbar": _round(float(np.max(np.abs(binned)))),
        "evacuation_time_error_pct": _round(_time_error(evidence, expected, cycles)),
        "leftover_sigma": _round(float(np.sqrt(np.mean(whitened**2)))),
    }


def gain(
    evidence: Evidence, baseline: Course, extended: Course, cycles: Sequence[int]
) -> dict[str, float]:
    """Reduction of the rms deviation (%) with its interval from resampling the cycles."""
    squares = np.array(
        [
            [float(np.mean(_bins(evidence, off, cycle) ** 2)) for cycle in cycles]
            for off in (evidence.off(evidence.expect(course)) for course in (baseline, extended))
        ]
    )
    drawn = np.random.default_rng(0).integers(len(cycles), size=(RESAMPLES, len(cycles)))
    ratio = np.sqrt(squares[1][drawn].sum(axis=1) / squares[0][drawn].sum(axis=1))
    low, high = np.percentile(100.0 * (1.0 - ratio), [2.5, 97.5])
    overall = 100.0 * (1.0 - math.sqrt(squares[1].sum() / squares[0].sum()))
    return {
        "rms_reduction_pct": _round(overall),
        "low95": _round(float(low)),
        "high95": _round(float(high)),
    }


def next_experiment(best: Finding | None, twins: list[str]) -> str | None:
    """What to record so that causes this log cannot tell apart come apart."""
    if best is None or not twins:
        return None
    for effects, sentence in EXPERIMENTS:
        if best.effect in effects and effects & set(twins):
            return sentence
    return f"record cycles of another length, to part {best.effect} from {', '.join(twins)}"


def _not_separable(best: Finding | None, ranking: list[Finding], unexplained: float) -> list[str]:
    """Causes that, fitted again, this log cannot reject: by noise, or by the model's own error."""
    if best is None:
        return []
    margin = SAME * max(best.leftover, 1.0) ** 2 + MISMATCH * (unexplained - best.chi2)
    return [f.effect for f in ranking if f is not best and f.chi2 - best.chi2 < margin]


def _cause(
    evidence: Evidence,
    best: Finding,
    ranking: list[Finding],
    twins: list[str],
    before: dict[str, float],
) -> dict[str, Any]:
    temper = 2.0 * max(best.leftover, 1.0) ** 2
    weights = [math.exp(-(finding.chi2 - best.chi2) / temper) for finding in ranking]
    onset_s = None
    if best.onset is not None:
        times = evidence.samples["time_ns"]
        onset_s = round(float(times[best.onset] - evidence.begin_ns) * NS, 3)
    effect = EFFECTS[best.effect]
    return {
        "effect": best.effect,
        "course": _course_name(best),
        "onset_s": onset_s,
        "parameters": {
            p.name: {
                "value": _round(best.values[p.name]),
                "unit": p.unit,
                "low95": _round(best.low95[p.name]),
                "high95": _round(best.high95[p.name]),
            }
            for p in effect.parameters
            if p.name in best.values
        },
        "probability": round(1.0 / sum(weights), 3),
        "not_separable_from": twins,
        "why": _why(best, onset_s, before),
    }


def _why(best: Finding, onset_s: float | None, before: dict[str, float]) -> str:
    effect = EFFECTS[best.effect]
    size = ", ".join(
        f"{p.name.replace('_', ' ')} {best.values[p.name]:.3g} {p.unit}"
        for p in effect.parameters
        if p.name in best.values
    )
    since = f", since {onset_s:.1f} s" if onset_s is not None else ""
    return (
        f"{effect.sentence} ({size}{since}); without it the twin is"
        f" {before['rms_mbar']:.1f} mbar off."
    )


def _remaining(evidence: Evidence, course: Course, cycles: Sequence[int]) -> dict[str, Any]:
    """Where something is left that no listed effect explains."""
    off = evidence.off(evidence.expect(course))
    used = evidence.bins >= 0
    phase = np.zeros(len(off), np.uint8)
    phase[evidence.bins[used]] = evidence.ticks["phase"][used]
    chosen = np.zeros(len(off), bool)
    for cycle in cycles:
        chosen[evidence.bin_starts[cycle] : evidence.bin_starts[cycle + 1]] = True
    worst, excess, mean = Phase.IDLE, 0.0, 0.0
    for one in Phase:
        there = off[chosen & (phase == one)]
        healthy = evidence.healthy.get(f"{one.name.lower()}_rms", (1.0, 0.0))[0]
        rms = float(np.sqrt(np.mean(there**2))) if len(there) else 0.0
        if rms / healthy > excess:
            worst, excess, mean = one, rms / healthy, float(np.mean(there))
    return {
        "where": worst.name.lower(),
        "depends_on": [],
        "shape": f"{mean:+.1f} mbar in the mean, {excess:.1f} times what healthy cycles have",
    }


def _time_error(evidence: Evidence, expected: Floats, cycles: Sequence[int]) -> float:
    """Mean error of the evacuation time to 600 mbar, % of the measured one; NaN-free."""
    ambient = float(evidence.theta[c.AMBIENT])
    errors = []
    for cycle in cycles:
        rows = _rows(evidence, cycle)
        times = evidence.samples["time_ns"][rows]
        measured = evidence.samples["pressure"][rows].astype(np.float64)
        found = [
            time_to_vacuum(PAPER_VACUUM, p, times, ambient) for p in (measured, expected[rows])
        ]
        if found[0] > MS and math.isfinite(found[1]):
            errors.append(100.0 * abs(found[1] / found[0] - 1.0))
    return float(np.mean(errors)) if errors else 0.0


def _insufficient(evidence: Evidence, reason: str) -> dict[str, Any]:
    nothing = {
        "rms_mbar": None,
        "max_mbar": None,
        "evacuation_time_error_pct": None,
        "leftover_sigma": None,
    }
    return {
        "verdict": "insufficient",
        "causes": [],
        "runners_up": [],
        "unlisted": None,
        "cycles": {"total": evidence.cycles, "fitted": [], "held_out": []},
        "baseline": nothing,
        "extended": nothing,
        "gain": None,
        "next_experiment": reason,
    }


def _chi2(evidence: Evidence, course: Course, cycles: Sequence[int]) -> float:
    residuals = evidence.residuals(course)
    parts = [residuals[evidence.judged.index(cycle)] for cycle in cycles]
    return sum(float(part @ part) for part in parts)


def _rows(evidence: Evidence, cycle: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.arange(evidence.starts[cycle], evidence.starts[cycle + 1])


def _bins(evidence: Evidence, off: Floats, cycle: int) -> Floats:
    return off[evidence.bin_starts[cycle] : evidence.bin_starts[cycle + 1]]


def _course_name(finding: Finding) -> str:
    return "constant" if finding.onset is None else "step"


def _round(value: float) -> float:
    """Four significant digits: more would be a claim."""
    return float(f"{value:.4g}")
