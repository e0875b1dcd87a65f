"""Hide effects in the simulated rigs' data, by seed, and see whether the diagnosis finds them.

    python tools/battery.py [--single 152] [--pair 20] [--healthy 30] [--unlisted 20]
        [--first SEED] [--write docs/battery.md]

Each case has a rig of its own (true values about those of a shipped configuration), calibrated on a
healthy record of its own; then effect, course and size are drawn. Without --first the seeds are
some that nobody has looked at. Prints a line for each case and the tables, which --write puts into
the page; exits with 1 where a figure is below what is asked for.
"""

import argparse
import math
import secrets
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from drivers.plc.faults import Fault, parse_fault
from drivers.plc.settings import PlcSettings
from tools.battery_page import FOUND, MOST_LEFT, Case, Hidden, Tally, summary, tables, with_run
from tools.calibration_coverage import SYSTEMS, as_type, drawn, recorded, rig_of, shipped
from tools.version import commit
from twin.calibration.calibrate import calibrate
from twin.config import Config
from twin.diagnosis.answer import diagnose
from twin.errors import TwinError
from twin.signals import MS, Samples

CYCLES = 12
# Sizes from just isolable to gross, in the unit of the effect's parameter; drawn evenly in their
# logarithm. The gripper's volume is a sixth of the tank's, its wall takes up less heat.
SIZES = {
    "leakage": (0.4, 8.0),
    "porous_leakage": (0.4, 6.0),
    "check_valve_leak": (0.5, 5.0),
    "suction_loss": (3.0, 30.0),
    "end_vacuum_loss": (10.0, 60.0),
    "supply_pressure_drop": (0.25, 1.5),
    "filter_clogging": (15.0, 150.0),
    "added_volume": (15.0, 200.0),
    "cup_compliance": (10.0, 80.0),
    "heat_exchange": (14.0, 25.0),
    "response_delay": (4.0, 40.0),
    "slow_ramp_up": (8.0, 50.0),
    "threshold_drift": (5.0, 40.0),
    "weak_blow_off": (6.0, 50.0),
    "blow_off_delay": (4.0, 40.0),
    "sensor_offset": (3.0, 30.0),
    "sensor_gain": (0.8, 6.0),
    "sensor_lag": (5.0, 40.0),
    "ambient_pressure": (6.0, 40.0),
}
ON_GRIPPER = {
    "added_volume": (8.0, 60.0),
    "cup_compliance": (10.0, 50.0),
    "heat_exchange": (25.0, 50.0),
}
SIGNED = {"threshold_drift", "sensor_offset", "sensor_gain"}
NEGATIVE = {"ambient_pressure"}
UNLISTED = {
    "lip_lift": (1.5, 8.0),
    "supply_swing": (0.4, 1.5),
    "condensate": (3.0, 12.0),
    "nozzle_icing": (10.0, 50.0),
    "sensor_backlash": (10.0, 50.0),
}
COURSES = {"constant": 0.4, "step": 0.25, "ramp": 0.15, "intermittent": 0.2}
SEEDS = 1_000_000  # among which a run that is given none begins


@dataclass(frozen=True)
class Unit:
    """One rig, and its calibrated configuration."""

    name: str
    plc: PlcSettings
    config: Config


@cache
def unit(name: str, seed: int) -> Unit:
    """A rig with true values of its own, calibrated on its own healthy record."""
    document = shipped(name)
    plc, config = drawn(rig_of(document), 1000 + seed), as_type(document)
    found = calibrate(config, [recorded(plc, 10, 5000 + seed)], _quiet)
    monitor = config.monitor.model_copy(update={"healthy": found.healthy})
    return Unit(name, plc, replace(config, data=found.fitted.data, monitor=monitor))


def _quiet(_what: str) -> None:
    """Take progress and say nothing."""


def draw_size(rng: np.random.Generator, name: str, effect: str, least: float = 0.0) -> float:
    """Size of an effect on a system; ``least`` is the share of its range to begin at."""
    table = {**SIZES, **(ON_GRIPPER if name == "gripper" else {}), **UNLISTED}
    low, high = (math.log(one) for one in table[effect])
    size = math.exp(rng.uniform(low + least * (high - low), high))
    down = effect in NEGATIVE or (effect in SIGNED and rng.random() < 0.5)
    return -size if down else size


def fault(rng: np.random.Generator, plc: PlcSettings, hidden: Hidden) -> Fault:
    """The rig's fault for what is hidden; when and in which cycles is drawn."""
    program = plc.program
    cycle = (program.suction_ms + program.blow_off_ms + program.idle_ms) * MS
    text = f"{hidden.effect}={hidden.size:.4f}"
    if hidden.course == "step":
        text += f"@{0.5 + cycle * rng.uniform(4.0, 8.0):.2f}"
    elif hidden.course == "ramp":
        text += f"/ramp:{0.5 + CYCLES * cycle:.1f}"
    elif hidden.course == "intermittent":
        text += f"/share:{rng.uniform(0.35, 0.65):.2f}"
    return parse_fault(text)


def case(kind: str, seed: int, units: int) -> tuple[Unit, list[Hidden], Samples]:
    """A unit, what is hidden, and the log."""
    rng = np.random.default_rng([2026, seed, sorted(KINDS).index(kind)])
    name = SYSTEMS[int(rng.integers(len(SYSTEMS)))]
    one = unit(name, int(rng.integers(units)))
    hidden: list[Hidden] = []
    if kind == "single":
        effect = list(SIZES)[seed % len(SIZES)]
        course = str(rng.choice(list(COURSES), p=list(COURSES.values())))
        hidden = [Hidden(effect, course, draw_size(rng, name, effect))]
    elif kind == "pair":
        two = rng.choice(list(SIZES), 2, replace=False)
        hidden = [Hidden(str(e), "constant", draw_size(rng, name, str(e), 0.4)) for e in two]
    elif kind == "unlisted":
        effect = list(UNLISTED)[seed % len(UNLISTED)]
        hidden = [Hidden(effect, "constant", draw_size(rng, name, effect))]
    faults = [fault(rng, one.plc, what) for what in hidden]
    return one, hidden, recorded(one.plc, CYCLES - 1, int(rng.integers(1 << 30)), faults)


def judge_single(answer: Mapping[str, Any], hidden: Sequence[Hidden], tally: Tally) -> str:
    """A single effect: in the first cause's set of at most three, alone, size, course."""
    (truth,) = hidden
    sets = [[cause["effect"], *cause["not_separable_from"]] for cause in answer["causes"]]
    mine = next((one for one in answer["causes"] if one["effect"] == truth.effect), None)
    named = bool(sets) and truth.effect in sets[0] and len(sets[0]) <= 3
    tally.count(
        named=named,
        alone=sets == [[truth.effect]],
        wrong=answer["verdict"] == "explained" and not any(truth.effect in one for one in sets),
        course=None if mine is None else mine["course"] == truth.course,
        covered=None if mine is None else _covers(mine, truth),
    )
    return "ok" if named else "MISSED"


def _covers(cause: Mapping[str, Any], truth: Hidden) -> bool | None:
    """Whether the interval of the first parameter holds the true size; None if of another kind."""
    if not cause["parameters"] or cause["course"] != truth.course:
        return None
    found = next(iter(cause["parameters"].values()))
    of = "at_end_" if truth.course == "ramp" else ""
    return bool(found[f"{of}low95"] <= truth.size <= found[f"{of}high95"])


def judge_pair(answer: Mapping[str, Any], hidden: Sequence[Hidden], tally: Tally) -> str:
    """Two effects at once: each in the set of one of the causes."""
    sets = [{cause["effect"], *cause["not_separable_from"]} for cause in answer["causes"]]
    named = all(any(truth.effect in one for one in sets) for truth in hidden)
    tally.count(pairs=named)
    return "ok" if named else "MISSED"


def judge_healthy(answer: Mapping[str, Any], _hidden: Sequence[Hidden], tally: Tally) -> str:
    """A healthy record: consistent."""
    tally.count(consistent=answer["verdict"] == "consistent")
    return "ok" if answer["verdict"] == "consistent" else "FALSE ALARM"


def judge_unlisted(answer: Mapping[str, Any], _hidden: Sequence[Hidden], tally: Tally) -> str:
    """An effect outside the table: unlisted."""
    tally.count(unlisted=answer["verdict"] == "unlisted")
    return "ok" if answer["verdict"] == "unlisted" else "EXPLAINED AWAY"


KINDS = {
    "single": (152, judge_single),
    "pair": (20, judge_pair),
    "healthy": (30, judge_healthy),
    "unlisted": (20, judge_unlisted),
}


def run(kind: str, seeds: range, units: int, tally: Tally) -> Iterator[str]:
    """Run the cases of a kind; give a line for each."""
    for seed in seeds:
        one, hidden, samples = case(kind, seed, units)
        begin = time.perf_counter()
        try:
            answer = diagnose(one.config, [samples], "battery", _quiet).json
        except TwinError as error:
            yield f"FAILED {kind} {seed}: {error}"
            tally.count(**{FOUND[kind]: False})
            tally.cases.append(Case(kind, seed, one.name, hidden, None, found=False))
            continue
        outcome = KINDS[kind][1](answer, hidden, tally)
        found = Case(kind, seed, one.name, hidden, answer, found=outcome == "ok")
        tally.cases.append(found)
        if answer["verdict"] == "explained":
            tally.count(
                left=answer["extended"]["leftover_sigma"] <= MOST_LEFT,
                gain=answer["gain"]["share_of_achievable_pct"] / 100.0,
            )
        spent = time.perf_counter() - begin
        gained = answer["gain"]["share_of_achievable_pct"] if answer["gain"] else 0.0
        told = " + ".join(map(str, hidden)) or "healthy"
        told = f"{kind} {seed} {one.name}: {told} -> {found.verdict} {found.named}"
        yield f"{outcome:<14} {told} (left {found.left}, gain {gained:.0f} %) {spent:.0f} s"


def main() -> int:
    """Run the battery; give its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for kind, (count, _) in KINDS.items():
        parser.add_argument(f"--{kind}", type=int, default=count)
    parser.add_argument("--first", type=int, help="seed of the first case of each kind")
    parser.add_argument("--units", type=int, default=10, help="rigs of each system")
    parser.add_argument("--write", type=Path, metavar="FILE", help="page whose tables to replace")
    asked = parser.parse_args()
    first = secrets.randbelow(SEEDS) if asked.first is None else asked.first
    when, measured = time.strftime("%Y-%m-%d"), commit()  # others may commit while it runs
    tally = Tally()
    for kind in KINDS:
        for line in run(kind, range(first, first + getattr(asked, kind)), asked.units, tally):
            print(line, flush=True)
    if not tally.cases:
        return 0
    line, found = summary(tally, when, measured), tables(tally)
    print(f"\n{line}\n\n{found}")
    if asked.write is not None:
        page = asked.write.read_text(encoding="utf-8")
        asked.write.write_text(with_run(page, line, found), encoding="utf-8")
    return 0 if tally.all_kept else 1


if __name__ == "__main__":
    sys.exit(main())
