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
SEEDS = 1_000_000  # among which a run that is given none begins
CYCLE_S = {"test_rig": 3.2, "gripper": 2.3}  # at most
BEGINS, LASTS = 18, 12  # cycles: the first of a fault, and how many are watched
MODEST, GROSS = (0.5, 5.0), (5.0, 25.0)  # times typical
SIGNED = ("sensor_offset", "sensor_gain", "ambient_pressure", "threshold_drift")
MOST = {  # of each fault, in its unit: beyond, the rig has no cycles any more
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
ANY = 300.0  # the same of all others
LEAST = -150.0
STRANGE = 2  # of the turns, beside one for each effect, are effects that nobody listed
ROWS = 50  # of a second world's record that come at once


@dataclass(frozen=True)
class Watched:
    """What was hidden in a run, and the names that its alarm had, one after the other."""

    world: str
    system: str
    seed: int
    fault: str
    effect: str
    alarms: int  # told, with a name or without
    names: Sequence[str]
    probabilities: Sequence[float]  # told with each name

    @property
    def changes(self) -> int:
        """How often the name was replaced by another one."""
        return sum(one != other for one, other in pairwise(self.names))

    @property
    def stated(self) -> list[tuple[float, bool]]:
        """Probability that came with the first name, and whether that acts; empty without one."""
        told = zip(self.probabilities, self.names, strict=True)
        return [(p, name == self.effect) for p, name in told][:1]


# --- the first world ------------------------------------------------------------------------------


def watched(seed: int, sizes: tuple[float, float], ramp_s: float) -> Watched:
    """One run: effect by turns, size, sign and time drawn by seed."""
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
    if effect == "heat_exchange":  # replaces what the rig has
        size += rig.rig.vessel_film
    begin_s = CYCLE_S[system] * (BEGINS + rng.random())
    fault = f"{effect}={size:.5g}@{begin_s:.4f}" + (f"/ramp:{ramp_s:g}" if ramp_s else "")
    seconds = begin_s + ramp_s + LASTS * CYCLE_S[system]
    rows = blocks(rig, seconds, [parse_fault(fault)], seed)
    return _watched("first", system, seed, fault, effect, _deviations(config, rows))


def _turn(number: int, listed: Sequence[str], outside: Sequence[str]) -> str:
    """The effect whose turn it is: each of those listed, then some that nobody listed."""
    around, turn = divmod(number, len(listed) + STRANGE)
    if turn < len(listed):
        return listed[turn]
    return outside[(around * STRANGE + turn - len(listed)) % len(outside)]


# --- the second world -----------------------------------------------------------------------------


def watched_rig(seed: int, faults: int) -> list[Watched]:
    """Faults by turns on one rig, each in a record of its own; none if it is not commissioned."""
    met = battery_second.drawn(seed, battery_second.CADENCES)
    assert met is not None
    ready = battery_second.with_unit(met, battery_second.commissioned(met))
    if ready is None or ready.unit is None:
        return []
    found = []
    for number in range(seed * faults, (seed + 1) * faults):
        rng = np.random.default_rng([seed, number, 15])
        listed = [one for one in battery_second.SIZES if battery_second.applies(met.rig, one)]
        outside = [one for one in battery_second.OUTSIDE if battery_second.applies(met.rig, one)]
        effect = _turn(number, listed, outside)
        hidden = Hidden(effect, "step", battery_second.draw_size(rng, met.rig, effect))
        logged = battery_second.stepped(met, hidden, SEEDS + number, (BEGINS, LASTS), rng)
        rows = met.person.samples(logged)
        parts = (rows[at : at + ROWS] for at in range(0, len(rows), ROWS))
        told = _deviations(ready.unit, parts)
        found.append(_watched("second", met.name, seed, str(hidden), effect, told))
    return found


# --- both -----------------------------------------------------------------------------------------


class _Alarms:
    """A sink that keeps the alarms, with a name or without."""

    def __init__(self) -> None:
        self.raised = list[Event]()

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Keep those among ``events``."""
        self.raised += [event for event in events if event.kind is Kind.DEVIATION]

    def close(self) -> None:
        """Nothing is open."""


def _deviations(config: Config, parts: Iterable[Samples]) -> list[Event]:
    """The alarms that rows make a commissioned twin raise."""
    alarms = _Alarms()
    isolation = Isolation.of(config.data, config.monitor.healthy, config.monitor.false_alarm_days)
    monitor = Monitor(config.monitor, coefficients(config.data), isolation=isolation)
    run(parts, Twin.of(config.data), monitor, [alarms])
    return alarms.raised


def _watched(
    world: str, system: str, seed: int, fault: str, effect: str, told: Sequence[Event]
) -> Watched:
    named = [event.data for event in told if event.data["effect"] != UNKNOWN]
    names = [str(one["effect"]) for one in named]
    shares = [round(float(one["share"]), 4) for one in named]
    return Watched(world, system, seed, fault, effect, len(told), names, shares)


def _found(asked: argparse.Namespace) -> Iterator[Watched]:
    """Each run, on all processors, in order."""
    first = secrets.randbelow(SEEDS) if asked.first is None else asked.first
    with ProcessPoolExecutor(None, get_context("spawn")) as workers:
        if asked.world == "second":
            each_rig = partial(watched_rig, faults=asked.faults)
            for some in workers.map(each_rig, range(first, first + asked.rigs)):
                yield from some
        else:
            sizes = GROSS if asked.gross else MODEST
            each = partial(watched, sizes=sizes, ramp_s=asked.ramp)
            yield from workers.map(each, range(first, first + asked.draws))


def main() -> None:
    """Print each run whose name changes, and how many of all do."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--world", choices=("first", "second"), default="first")
    parser.add_argument("--draws", type=int, default=6 * (len(EFFECTS) + STRANGE))
    parser.add_argument("--rigs", type=int, default=10)
    parser.add_argument("--faults", type=int, default=20)
    parser.add_argument("--first", type=int, metavar="SEED")
    parser.add_argument("--gross", action="store_true")
    parser.add_argument("--ramp", type=float, default=0.0, metavar="SECONDS")
    parser.add_argument("--keep", type=Path, metavar="FILE.jsonl")
    asked = parser.parse_args()
    found = []
    for one in _found(asked):
        found.append(one)
        if one.changes:
            print(f"{one.system}: {one.fault}: {', '.join(one.names)}", flush=True)
        if asked.keep:
            with asked.keep.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"commit": commit(), **asdict(one)}) + "\n")
    named = [one for one in found if one.names]
    print(
        f"{len(found)} draws: {sum(one.alarms > 0 for one in found)} with an alarm,"
        f" {len(named)} named, {sum(one.names[0] == one.effect for one in named)} rightly at first"
        f" and {sum(one.names[-1] == one.effect for one in named)} at last;"
        f" the name changed in {sum(one.changes > 0 for one in found)}"
    )


if __name__ == "__main__":
    main()
