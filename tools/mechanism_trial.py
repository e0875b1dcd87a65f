"""Hide mechanisms that are not in the table, extend the model, and judge it on other conditions.

    python -m tools.mechanism_trial [--world first|second] [--first SEED] [--cases 12]
        [--file FILE.jsonl] [--write docs/mechanisms.md]

A mechanism is hidden in a log of twelve cycles of a unit: one of two calibrated ones of each system
of the first world, or a commissioned rig of the second. The extended model is judged on new logs:
of the same program, of suction twice and half as long, of 1 bar more and less supply, and of a
vessel that is 30 % larger and smaller, with the data set changed likewise.

With --file each case is stored as soon as it is judged, and an interrupted run resumes there.
"""

import argparse
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tools import battery_first, battery_second
from tools.battery_cases import Case, CaseFile, first_of
from tools.battery_page import marked
from tools.mechanism_worlds import CHANGES, Change, Subject, changed_config, first, second
from tools.version import commit
from twin.diagnosis.another_log import judged_on
from twin.diagnosis.answer import Diagnosis, diagnose
from twin.diagnosis.evidence import HEALTHY, collect
from twin.diagnosis.held_out import LITTLE, judge
from twin.diagnosis.residual_covariance import covariance
from twin.errors import TwinError
from twin.signals import Samples

WORLDS = (battery_first.NAME, battery_second.NAME)
MOST_ALIKE = 2  # mechanisms that an answer may name as not separable and still be right
ENOUGH = 0.8  # share of the achievable reduction that is asked for
NOT_WORSE = 1.02  # times the deviation of the twin as it stands: what chance in a log may add
AIR = ("inflow", "opening", "seepage")
# Places and ways of acting that say what each hidden mechanism does; (): the grammar has none.
RIGHT: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "lip_lift": (AIR, ("above", "beyond", "beyond_slowly")),
    "lifting_lip": (AIR, ("above", "beyond", "beyond_slowly")),
    "supply_swing": (("supply",), ("swinging",)),
    "second_ejector": (("supply",), ("swinging",)),
    "nozzle_icing": (("suction", "nozzle", "supply"), ("nozzle_on_slowly",)),
    "filling_silencer": (("end_pressure", "nozzle"), ("nozzle_on_slowly",)),
    "creeping_cup": (("volume",), ("beyond_slowly", "nozzle_on_slowly")),
    "cup_backlash": (("volume",), ("above", "beyond", "beyond_slowly")),
    "blow_off_valve_leak": (("inflow",), ("always",)),
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


# --- one case -------------------------------------------------------------------------------------


def judged(diagnosis: Diagnosis, subject: Subject, change: Change) -> list[float]:
    """Rms (mbar) under other conditions: the twin as it stands, extended, and the least possible.

    The last is that of the twin as it stands on a log in which nothing is hidden.
    """
    config, log = changed_config(subject.config, change), subject.record(change, True)
    healthy = _rms(config, subject.record(change, False))
    answer = judged_on(diagnosis, config, "other.mcap", [log])
    if answer is None:  # nothing was found: the extended model is the twin as it stands
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
    places, whens = RIGHT.get(effect) or CONDENSATE[case.more["world"]]
    right = {f"{place}_{when}" for place in places for when in whens}
    names = case.more.get("mechanisms", [])
    return bool(right & set(names[: 1 + MOST_ALIKE])) and len(names) <= 1 + MOST_ALIKE


def share(rms: Sequence[float]) -> float | None:
    """Share of the achievable reduction; None where hardly anything could be reduced."""
    before, after, healthy = rms
    return (before - after) / (before - healthy) if before > LITTLE * healthy else None


def is_worse(rms: Sequence[float]) -> bool:
    """Whether the extended model is worse than the twin as it stands."""
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
    for name in CHANGES:
        rms = case.more.get("judged", {}).get(name)
        cells.append("–" if rms is None else f"{rms[0]:.1f} → {rms[1]:.1f} ({rms[2]:.1f})")
    return f"| {' | '.join([*cells, f'{case.seconds:.0f}'])} |"


def table(results: Sequence[Case]) -> str:
    """The results in Markdown."""
    head = ["unit", "hidden", "what the answer says", "right", *CHANGES, "s"]
    rule = "|" + " --- |" * len(head)
    return "\n".join([f"| {' | '.join(head)} |", rule, *map(row, results), "", summary(results)])


def summary(results: Sequence[Case]) -> str:
    """Scores of all cases, in sentences."""
    logs = [rms for case in results for rms in case.more.get("judged", {}).values()]
    shares = [value for value in map(share, logs) if value is not None]
    right = sum(map(is_right, results))
    return (
        f"Place and dependence are right in {right} of {len(results)} cases. Of {len(shares)} logs"
        f" that the twin as it stands does not fit, the extended model has at least"
        f" {ENOUGH:.0%} of the achievable reduction in {sum(s >= ENOUGH for s in shares)}"
        f" (median {np.median(shares) if shares else 0.0:.0%}). It is worse than the twin as it"
        f" stands in {sum(map(is_worse, logs))} of {len(logs)} logs."
    )


def main() -> int:
    """Run the trial; write its table into a page if asked."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--world", choices=WORLDS, default=battery_first.NAME)
    parser.add_argument("--first", type=int, help="seed of the first case")
    parser.add_argument("--cases", type=int, default=len(battery_first.OUTSIDE))
    parser.add_argument("--file", type=Path, help="keeps each case; an interrupted run goes on")
    parser.add_argument("--write", type=Path, help="page whose table is replaced")
    arguments = parser.parse_args()
    first_seed = arguments.first if arguments.first is not None else first_of(arguments.file)
    first_seed = int(time.time()) % 1_000_000 if first_seed is None else first_seed
    file = CaseFile(arguments.file, {"first": first_seed, "commit": commit()})
    results = []
    for case in cases(arguments.world, first_seed, arguments.cases, file):
        print(row(case), flush=True)
        results.append(case)
    text = table(results)
    print(summary(results))
    if arguments.write:
        page = arguments.write.read_text(encoding="utf-8")
        part = marked(f"mechanisms in the {arguments.world} world", page)
        page = page.replace(part[0], f"{part[1]}{text}\n{part[3]}")
        arguments.write.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
