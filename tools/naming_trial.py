"""Draw faults that begin within a cycle, and see what the alarms of the running loop call them.

    python -m tools.naming_trial [--world first] [--draws 126] [--first SEED] [--gross]
        [--ramp SECONDS] [--keep FILE.jsonl]
    python -m tools.naming_trial --world second [--rigs 10] [--faults 20] [--first SEED]
        [--keep FILE.jsonl]

Each fault, in a size and from a time drawn by seed, goes through twin, bank and monitor as in the
loop. About one in ten is an effect that nobody listed. In the first world sizes are half to five
times typical (with ``--gross`` five to 25 times), on both simulated rigs. In the second world each
rig is commissioned first, and sizes are those of the battery. Prints the alarms whose name changes,
and how many there are. ``--keep`` adds a JSON line for each run, for ``tools.reliability``.
"""

import argparse
import json
import secrets
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from tools import battery_second
from tools.battery_cases import Hidden
from tools.battery_first import UNLISTED
from tools.version import commit
from twin.config import Config
from twin.events import Event, Kind
from twin.live import Twin, run
from twin.model.dataset import coefficients
from twin.model.effects import EFFECTS, UNKNOWN
from twin.monitor.isolation import Isolation
from twin.monitor.monitor import Monitor
from twin.settings import Document
from twin.signals import Samples, Ticks

ROOT = Path(__file__).parents[1]
SEEDS = 1_000_000  # without --first, the first seed is drawn below this
CYCLE_S = {"test_rig": 3.2, "gripper": 2.3}  # at most
BEGINS, LASTS = 18, 12  # cycles: the first with the fault, and how many from there on
MODEST, GROSS = (0.5, 5.0), (5.0, 25.0)  # times typical
SIGNED = ("sensor_offset", "sensor_gain", "ambient_pressure", "threshold_drift")
MOST = {  # largest size of each fault, in its unit: beyond it the rig completes no cycle
    "ambient_pressure": 60.0,
    "threshold_drift": 60.0,
    "sensor_gain": 25.0,
    "sensor_offset": 150.0,
    "leakage": 45.0,
    "porous_leakage": 45.0,
    "check_valve_leak": 45.0,
    "suction_loss": 80.0,
    "weak_blow_off": 85.0,
    "supply_pressure_drop": 3.5,
    "cup_compliance": 90.0,
}
ANY = 300.0  # the same for all other faults
LEAST = -150.0
STRANGE = 2  # turns of unlisted effects, in addition to one turn for each listed effect
ROWS = 50  # rows of a second world's record in one block


@dataclass(frozen=True)
class Watched:
    """The fault of a run, and the names that its alarms gave, in order."""

    world: str
    system: str
    seed: int
    fault: str
    effect: str
    alarms: int  # raised, with a name or without
    names: Sequence[str]
    probabilities: Sequence[float]  # of each name

    @property
    def changes(self) -> int:
        """How often the name changed."""
        return sum(name != next_name for name, next_name in pairwise(self.names))

    @property
    def stated(self) -> list[tuple[float, bool]]:
        """Probability of the first name, and whether that effect acts; empty without a name."""
        named = zip(self.probabilities, self.names, strict=True)
        return [(p, name == self.effect) for p, name in named][:1]


# --- the first world ------------------------------------------------------------------------------


def watched(seed: int, sizes: tuple[float, float], ramp_s: float) -> Watched:
    """One run: effects take turns; size, sign and time are drawn by seed."""
    rng = np.random.default_rng(seed)
    system = list(CYCLE_S)[seed % 2]
    effect = _turn(seed // 2, list(EFFECTS), list(UNLISTED))
    document = Document.read(ROOT / "configs" / f"{system}.toml")
    config, rig = Config.of(document), document.section(PlcSettings, "plc")
    if effect in UNLISTED:
        size = float(np.exp(rng.uniform(*np.log(UNLISTED[effect]))))
    else:
        size = EFFECTS[effect].parameters[0].typical * float(np.exp(rng.uniform(*np.log(sizes))))
    if effect in SIGNED and rng.random() < 0.5:
        size = -size
    size = float(np.clip(size, LEAST, MOST.get(effect, ANY)))
    if effect == "heat_exchange":  # the fault replaces the rig's own value
        size += rig.rig.vessel_film
    begin_s = CYCLE_S[system] * (BEGINS + rng.random())
    fault = f"{effect}={size:.5g}@{begin_s:.4f}" + (f"/ramp:{ramp_s:g}" if ramp_s else "")
    seconds = begin_s + ramp_s + LASTS * CYCLE_S[system]
    rows = blocks(rig, seconds, [parse_fault(fault)], seed)
    return _watched("first", system, seed, fault, effect, _deviations(config, rows))


def _turn(number: int, listed: Sequence[str], outside: Sequence[str]) -> str:
    """The effect for a number: each listed effect in turn, then STRANGE unlisted ones."""
    round_number, turn = divmod(number, len(listed) + STRANGE)
    if turn < len(listed):
        return listed[turn]
    return outside[(round_number * STRANGE + turn - len(listed)) % len(outside)]


# --- the second world -----------------------------------------------------------------------------


def watched_rig(seed: int, faults: int) -> list[Watched]:
    """One run for each fault on one rig, each with its own record; none if it is refused."""
    drawn = battery_second.drawn(seed, battery_second.CADENCES)
    assert drawn is not None
    commissioned = battery_second.with_unit(drawn, battery_second.commissioned(drawn))
    if commissioned is None or commissioned.unit is None:
        return []
    runs = []
    for number in range(seed * faults, (seed + 1) * faults):
        rng = np.random.default_rng([seed, number, 15])
        listed = [
            effect for effect in battery_second.SIZES if battery_second.applies(drawn.rig, effect)
        ]
        outside = [
            effect for effect in battery_second.OUTSIDE if battery_second.applies(drawn.rig, effect)
        ]
        effect = _turn(number, listed, outside)
        hidden = Hidden(effect, "step", battery_second.draw_size(rng, drawn.rig, effect))
        logged = battery_second.stepped(drawn, hidden, SEEDS + number, (BEGINS, LASTS), rng)
        rows = drawn.person.samples(logged)
        parts = (rows[at : at + ROWS] for at in range(0, len(rows), ROWS))
        alarms = _deviations(commissioned.unit, parts)
        runs.append(_watched("second", drawn.name, seed, str(hidden), effect, alarms))
    return runs


# --- both -----------------------------------------------------------------------------------------


class _Alarms:
    """An output that keeps alarms, with a name or without."""

    def __init__(self) -> None:
        self.raised = list[Event]()

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Keep the alarms among ``events``."""
        self.raised += [event for event in events if event.kind is Kind.DEVIATION]

    def close(self) -> None:
        """Do nothing: nothing is open."""


def _deviations(config: Config, parts: Iterable[Samples]) -> list[Event]:
    """The alarms that a commissioned twin raises on these rows."""
    alarms = _Alarms()
    isolation = Isolation.of(config.data, config.monitor.healthy, config.monitor.false_alarm_days)
    monitor = Monitor(config.monitor, coefficients(config.data), isolation=isolation)
    run(parts, Twin.of(config.data), monitor, [alarms])
    return alarms.raised


def _watched(
    world: str, system: str, seed: int, fault: str, effect: str, alarms: Sequence[Event]
) -> Watched:
    named = [event.data for event in alarms if event.data["effect"] != UNKNOWN]
    names = [str(data["effect"]) for data in named]
    shares = [round(float(data["share"]), 4) for data in named]
    return Watched(world, system, seed, fault, effect, len(alarms), names, shares)


def _found(arguments: argparse.Namespace) -> Iterator[Watched]:
    """All runs in order, computed on all processors."""
    first = secrets.randbelow(SEEDS) if arguments.first is None else arguments.first
    with ProcessPoolExecutor(None, get_context("spawn")) as workers:
        if arguments.world == "second":
            watch_rig = partial(watched_rig, faults=arguments.faults)
            for runs in workers.map(watch_rig, range(first, first + arguments.rigs)):
                yield from runs
        else:
            sizes = GROSS if arguments.gross else MODEST
            watch = partial(watched, sizes=sizes, ramp_s=arguments.ramp)
            yield from workers.map(watch, range(first, first + arguments.draws))


def main() -> None:
    """Print each run whose name changes, and how many do."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--world", choices=("first", "second"), default="first")
    parser.add_argument("--draws", type=int, default=6 * (len(EFFECTS) + STRANGE))
    parser.add_argument("--rigs", type=int, default=10)
    parser.add_argument("--faults", type=int, default=20)
    parser.add_argument("--first", type=int, metavar="SEED")
    parser.add_argument("--gross", action="store_true")
    parser.add_argument("--ramp", type=float, default=0.0, metavar="SECONDS")
    parser.add_argument("--keep", type=Path, metavar="FILE.jsonl")
    arguments = parser.parse_args()
    trials = []
    for trial in _found(arguments):
        trials.append(trial)
        if trial.changes:
            print(f"{trial.system}: {trial.fault}: {', '.join(trial.names)}", flush=True)
        if arguments.keep:
            with arguments.keep.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"commit": commit(), **asdict(trial)}) + "\n")
    named = [trial for trial in trials if trial.names]
    print(
        f"{len(trials)} draws: {sum(trial.alarms > 0 for trial in trials)} with an alarm,"
        f" {len(named)} named,"
        f" {sum(trial.names[0] == trial.effect for trial in named)} rightly at first"
        f" and {sum(trial.names[-1] == trial.effect for trial in named)} at last;"
        f" the name changed in {sum(trial.changes > 0 for trial in trials)}"
    )


if __name__ == "__main__":
    main()
