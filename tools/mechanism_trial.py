"""Hide mechanisms that are not in the table, extend the model, and judge it on other conditions.

    python -m tools.mechanism_trial [--world first|second] [--first SEED] [--cases 12]
        [--file FILE.jsonl] [--write docs/mechanisms.md]

A mechanism is hidden in a log of twelve cycles of a unit: one of two calibrated ones of each system
of the first world, or a commissioned rig of the second. The extended model is judged on new logs:
of the same program, of suction twice and half as long, of 1 bar more and less supply, and of a
vessel that is 30 % larger and smaller, with the data set changed likewise.

With --file each case is stored as soon as it is judged, and an interrupted run resumes there.
--recount FILE.jsonl scores the stored cases of a run anew and runs nothing.
"""

import argparse
import sys
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tools import battery_first, battery_second
from tools.battery_cases import SURE, Case, CaseFile, first_of, read_cases
from tools.battery_page import marked
from tools.mechanism_worlds import CHANGES, Change, Subject, changed_config, first, second
from tools.version import commit
from twin.diagnosis.another_log import judged_on
from twin.diagnosis.answer import Diagnosis, diagnose
from twin.diagnosis.evidence import HEALTHY, collect
from twin.diagnosis.held_out import LITTLE, judge
from twin.diagnosis.residual_covariance import covariance
from twin.errors import TwinError
from twin.model.mechanism import PLACES
from twin.signals import Samples

WORLDS = (battery_first.NAME, battery_second.NAME)
MOST_ALIKE = 2  # mechanisms that an answer may name as not separable and still be right
ENOUGH = 0.8  # share of the achievable reduction that is asked for
NOT_WORSE = 1.02  # times the deviation of the unchanged twin: what chance in a log may add
AIR = ("inflow", "opening", "seepage")
# Places and ways of acting that say what each hidden mechanism does; (): the grammar has none.
RIGHT: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "lip_lift": (AIR, ("above", "beyond", "beyond_slowly")),
    "lifting_lip": (AIR, ("above", "beyond", "beyond_slowly")),
    "supply_swing": (("supply",), ("swinging",)),
    "second_ejector": (("supply",), ("pulsed",)),
    "nozzle_icing": (("suction", "nozzle", "supply"), ("nozzle_on_slowly",)),
    "filling_silencer": (("end_pressure", "nozzle"), ("nozzle_on_slowly",)),
    "creeping_cup": (("volume",), ("beyond_slowly", "nozzle_on_slowly")),
    "cup_backlash": (("volume",), ("above", "beyond", "beyond_slowly")),
    "blow_off_valve_leak": (("port", "inflow"), ("always",)),
    "adsorbed_moisture": (AIR, ("used_up",)),
    "outgassing": (AIR, ("used_up",)),
    "sensor_thermal_drift": (("sensor",), ("warming_up",)),
    "collapsing_hose": (("line",), ("beyond", "above", "beyond_slowly")),
    "leaking_flap": (("suction", "end_pressure", "nozzle"), ("nozzle_on", "beyond", "above")),
    "sensor_backlash": ((), ()),
    "sticking_valve": ((), ()),  # named as a delay in some cycles: a listed effect with a course
}
# Of the first world vapour comes, of the second water narrows the hose.
CONDENSATE = {
    "first": (AIR, ("used_up",)),
    "second": (("line",), ("gathered", "nozzle_on_slowly")),
}
# Parameter of a place, or of a listed effect, that has the unit and the meaning of a hidden size.
# Ice, moisture and a neighbour are told by other quantities.
SIZES = {
    "lip_lift": {"opening": "sonic_flow", "inflow": "flow"},
    "supply_swing": {"supply": "drop"},
    "second_ejector": {"supply": "drop"},
    "filling_silencer": {"end_pressure": "end_pressure_rise"},
    "creeping_cup": {"volume": "volume_at_full_vacuum"},
    "blow_off_valve_leak": {"port": "flow", "inflow": "flow"},
    "sensor_thermal_drift": {"sensor": "offset"},
    "sticking_valve": {"response_delay": "delay"},
}
# Flows and volumes of the second world are told by a vessel that is up to a fifth off.
OF_VOLUME = {"creeping_cup", "blow_off_valve_leak"}


# --- one case -------------------------------------------------------------------------------------


def judged(diagnosis: Diagnosis, subject: Subject, change: Change) -> list[float]:
    """Rms (mbar) under other conditions: the unchanged twin, extended, and the least possible.

    The last is that of the unchanged twin on a log in which nothing is hidden.
    """
    config, log = changed_config(subject.config, change), subject.record(change, True)
    healthy = _rms(config, subject.record(change, False))
    answer = judged_on(diagnosis, config, "other.mcap", [log])
    if answer is None:  # nothing was found: the extended model is the unchanged twin
        before = _rms(config, log)
        return [before, before, healthy]
    return [answer["baseline"]["rms_mbar"], answer["extended"]["rms_mbar"], healthy]


def _rms(config: Any, samples: Samples) -> float:
    evidence = collect(config, [samples])
    return judge(evidence, covariance(evidence).of(evidence.judged), HEALTHY).rms


def trial(world: str, seed: int, subject: Subject) -> Case:
    """Hide a mechanism, extend the twin, and judge it under conditions that it has not seen."""
    begin, error, answer, more = time.process_time(), "", None, dict[str, Any]()
    try:
        diagnosis = diagnose(subject.config, [subject.samples], "trial", lambda _: None)
        answer, seconds = diagnosis.json, time.process_time() - begin
        found = diagnosis.mechanism
        rivals = [rival.effect for rival in found.rivals] if found else []
        more["mechanisms"] = [found.cause.effect, *rivals] if found else []
        more["judged"] = {
            name: judged(diagnosis, subject, change) for name, change in CHANGES.items()
        }
    except TwinError as refusal:
        error, seconds = str(refusal), time.process_time() - begin
    except Exception:  # a crash is a finding of its own
        error, seconds = "crashed: " + traceback.format_exc(), time.process_time() - begin
    return Case(
        "unlisted",
        seed,
        subject.name,
        [subject.hidden],
        answer,
        error=error,
        seconds=round(seconds, 1),
        more={**more, "world": world},
    )


def cases(world: str, first_seed: int, count: int, file: CaseFile) -> Iterator[Case]:
    """The cases of a run, from the file if they are there; rigs without a twin are left out."""
    for seed in range(first_seed, first_seed + count):
        case = file.get(world, ("unlisted", seed, 0))
        if case is None:
            subject = first(seed) if world == battery_first.NAME else second(seed, file)
            if subject is None:
                continue
            case = file.add(world, trial(world, seed, subject))
        yield case


# --- scores ---------------------------------------------------------------------------------------


def is_right(case: Case) -> bool:
    """Whether the answer has the right place and dependence, among at most three."""
    effect = case.hidden[0].effect
    if effect == "sticking_valve":
        return any(c["effect"] == "response_delay" for c in case.causes)
    names = case.more.get("mechanisms", [])
    few = names[: 1 + MOST_ALIKE]
    return any(_does(case, name) for name in few) and len(names) <= 1 + MOST_ALIKE


def _does(case: Case, mechanism: str) -> bool:
    """Whether a mechanism has the place and the way of acting of what is hidden."""
    places, whens = RIGHT.get(case.hidden[0].effect) or CONDENSATE[case.more["world"]]
    return mechanism in {f"{place}_{when}" for place in places for when in whens}


def holds_size(case: Case) -> bool | None:
    """Whether the interval of a rightly named size holds the true one; None without such a size.

    What swings begins anywhere in its period, so that its sign means nothing.
    """
    truth = case.hidden[0]
    if truth.effect in OF_VOLUME and case.more["world"] == battery_second.NAME:
        return None
    for name, parameters in _told(case):
        parameter = SIZES.get(truth.effect, {}).get(name)
        if parameter in parameters:
            ends = [parameters[parameter][end] for end in ("low95", "high95")]
            low, high = sorted(map(abs, ends) if truth.effect == "supply_swing" else ends)
            return bool(low <= truth.size <= high)
    return None


def _told(case: Case) -> Iterator[tuple[str, Mapping[str, Mapping[str, float]]]]:
    """Place of the mechanism if it is right, and each cause, with what is told of their sizes."""
    mechanism = ((case.answer or {}).get("unlisted") or {}).get("mechanism")
    if mechanism and _does(case, mechanism["name"]):
        place = next(p for p in PLACES if mechanism["name"].startswith(f"{p}_"))
        yield place, mechanism["parameters"]
    for cause in case.causes:
        yield cause["effect"], cause["parameters"]


def wrongly_sure(case: Case) -> list[str]:
    """Listed causes that do not act and are stated as surely as others that do."""
    stated = zip(case.causes, case.stated, strict=True)
    return [c["effect"] for c, (probability, acts) in stated if probability >= SURE and not acts]


def reduces(case: Case) -> bool | None:
    """Whether enough can be reduced in each of a case's other logs; None if nothing can be."""
    judged = case.more.get("judged", {})
    shares = [share(rms) for name, rms in judged.items() if name != "same"]
    reducible = [value for value in shares if value is not None]
    return min(reducible) >= ENOUGH if reducible else None


def share(rms: Sequence[float]) -> float | None:
    """Share of the achievable reduction; None where hardly anything could be reduced."""
    before, after, healthy = rms
    return (before - after) / (before - healthy) if before > LITTLE * healthy else None


def is_worse(rms: Sequence[float]) -> bool:
    """Whether the extended model is worse than the unchanged twin."""
    return rms[1] > NOT_WORSE * rms[0]


# --- text -----------------------------------------------------------------------------------------


def named(case: Case) -> str:
    """What the answer says."""
    if case.answer is None:
        return case.error.strip().splitlines()[-1]
    causes = ", ".join(cause["effect"] for cause in case.causes)
    mechanism = (case.answer["unlisted"] or {}).get("mechanism")
    sentence = mechanism["sentence"] if mechanism else ""
    return f"{case.verdict}: {'; '.join(part for part in (causes, sentence) if part) or '–'}"


def row(case: Case) -> str:
    """The line of the table."""
    cells = [case.system, f"{case.hidden[0].effect} {case.hidden[0].size:.3g}", named(case)]
    cells.append("yes" if is_right(case) else "no")
    cells.append({True: "yes", False: "no", None: "–"}[holds_size(case)])
    cells.append(", ".join(wrongly_sure(case)) or "–")
    for name in CHANGES:
        rms = case.more.get("judged", {}).get(name)
        cells.append("–" if rms is None else f"{rms[0]:.1f} → {rms[1]:.1f} ({rms[2]:.1f})")
    return f"| {' | '.join([*cells, f'{case.seconds:.0f}'])} |"


def table(results: Sequence[Case]) -> str:
    """The results in Markdown."""
    told = ["what the answer says", "right", "size held", "surely wrong"]
    head = ["unit", "hidden", *told, *CHANGES, "s"]
    rule = "|" + " --- |" * len(head)
    return "\n".join([f"| {' | '.join(head)} |", rule, *map(row, results), "", summary(results)])


def summary(results: Sequence[Case]) -> str:
    """Scores of all cases, in sentences."""
    logs = [rms for case in results for rms in case.more.get("judged", {}).values()]
    shares = [value for value in map(share, logs) if value is not None]
    right = sum(map(is_right, results))
    sizes = [held for held in map(holds_size, results) if held is not None]
    reduced = [enough for enough in map(reduces, results) if enough is not None]
    return (
        f"Place and dependence are right in {right} of {len(results)} cases. Of {len(shares)} logs"
        f" that the unchanged twin does not fit, the extended model has at least"
        f" {ENOUGH:.0%} of the achievable reduction in {sum(s >= ENOUGH for s in shares)}"
        f" (median {np.median(shares) if shares else 0.0:.0%}). It is worse than the twin as it"
        f" stands in {sum(map(is_worse, logs))} of {len(logs)} logs.\n\nIn {sum(reduced)} of"
        f" {len(reduced)} cases it has that share in each log of another program, supply or volume"
        f" that can be reduced. The interval of a size holds the true one in {sum(sizes)} of"
        f" {len(sizes)} cases where both mean the same. A listed cause that does not act is stated"
        f" with {SURE:.0%} or more in {sum(map(bool, map(wrongly_sure, results)))} of"
        f" {len(results)} cases."
    )


def write(page: Path, world: str, results: Sequence[Case]) -> None:
    """Put the table of a world into a page."""
    text = page.read_text(encoding="utf-8")
    part = marked(f"mechanisms in the {world} world", text)
    page.write_text(
        text.replace(part[0], f"{part[1]}{table(results)}\n{part[3]}"), encoding="utf-8"
    )


def recounted(path: Path) -> dict[str, list[Case]]:
    """The stored cases of a run by world, without commissionings."""
    _, stored = read_cases(path)
    trials = [(world, case) for world, case in stored if case.kind == "unlisted"]
    return {name: [case for world, case in trials if world == name] for name in WORLDS}


def main() -> int:
    """Run the trial; write its table into a page if asked."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--world", choices=WORLDS, default=battery_first.NAME)
    parser.add_argument("--first", type=int, help="seed of the first case")
    parser.add_argument("--cases", type=int, default=len(battery_first.OUTSIDE))
    parser.add_argument("--file", type=Path, help="keeps each case; an interrupted run goes on")
    parser.add_argument("--write", type=Path, help="page whose table is replaced")
    parser.add_argument("--recount", type=Path, metavar="FILE", help="score a stored run anew")
    arguments = parser.parse_args()
    if arguments.recount:
        runs = recounted(arguments.recount)
    else:
        first_seed = arguments.first if arguments.first is not None else first_of(arguments.file)
        first_seed = int(time.time()) % 1_000_000 if first_seed is None else first_seed
        file = CaseFile(arguments.file, {"first": first_seed, "commit": commit()})
        runs = {arguments.world: []}
        for case in cases(arguments.world, first_seed, arguments.cases, file):
            print(row(case), flush=True)
            runs[arguments.world].append(case)
    for world, results in runs.items():
        if results:
            print(summary(results))
            if arguments.write:
                write(arguments.write, world, results)
    return 0


if __name__ == "__main__":
    sys.exit(main())
