"""Draw faults that begin within a cycle, and count how often the name on their alarm changes.

    python tools/naming_trial.py [--draws 114] [--first SEED] [--gross] [--ramp SECONDS]

Each effect in turn, on both simulated rigs, in a size and from a time drawn by seed, goes through
twin, bank and monitor as in the loop. Sizes are half to five times typical; with ``--gross`` five
to 25 times.
"""

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from twin.config import Config
from twin.events import Event, Kind
from twin.live import Twin
from twin.model.dataset import coefficients
from twin.model.effects import EFFECTS, UNKNOWN
from twin.monitor.isolation import Isolation
from twin.monitor.monitor import Monitor
from twin.settings import Document

ROOT = Path(__file__).parents[1]
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


@dataclass(frozen=True)
class Watched:
    """What was hidden in a run, and the names that its alarm had, one after the other."""

    system: str
    fault: str
    effect: str
    alarms: int  # told, with a name or without
    names: Sequence[str]

    @property
    def changes(self) -> int:
        """How often the name was replaced by another one."""
        return sum(one != other for one, other in pairwise(self.names))


def watched(seed: int, sizes: tuple[float, float], ramp_s: float) -> Watched:
    """One run: effect by turns, size, sign and time drawn by seed."""
    rng = np.random.default_rng(seed)
    system = list(CYCLE_S)[seed % 2]
    effect = list(EFFECTS)[seed // 2 % len(EFFECTS)]
    document = Document.read(ROOT / "configs" / f"{system}.toml")
    config, rig = Config.of(document), document.section(PlcSettings, "plc")
    size = EFFECTS[effect].parameters[0].typical * float(np.exp(rng.uniform(*np.log(sizes))))
    if effect in SIGNED and rng.random() < 0.5:
        size = -size
    size = float(np.clip(size, LEAST, MOST.get(effect, ANY)))
    if effect == "heat_exchange":  # replaces what the rig has
        size += rig.rig.vessel_film
    begin_s = CYCLE_S[system] * (BEGINS + rng.random())
    fault = f"{effect}={size:.5g}@{begin_s:.4f}" + (f"/ramp:{ramp_s:g}" if ramp_s else "")
    seconds = begin_s + ramp_s + LASTS * CYCLE_S[system]
    twin, told = Twin.of(config.data), list[Event]()
    isolation = Isolation.of(config.data, config.monitor.healthy, config.monitor.false_alarm_days)
    monitor = Monitor(config.monitor, coefficients(config.data), isolation=isolation)
    for block in blocks(rig, seconds, [parse_fault(fault)], seed):
        told += monitor.update(*twin.advance(block))
    alarms = [str(event.data["effect"]) for event in told if event.kind is Kind.DEVIATION]
    return Watched(system, fault, effect, len(alarms), [one for one in alarms if one != UNKNOWN])


def main() -> None:
    """Print each run whose name changes, and how many of all do."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=6 * len(EFFECTS))
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("--gross", action="store_true")
    parser.add_argument("--ramp", type=float, default=0.0, metavar="SECONDS")
    asked = parser.parse_args()
    run = partial(watched, sizes=GROSS if asked.gross else MODEST, ramp_s=asked.ramp)
    with ProcessPoolExecutor(None, get_context("spawn")) as workers:
        found = list(workers.map(run, range(asked.first, asked.first + asked.draws)))
    for one in found:
        if one.changes:
            print(f"{one.system}: {one.fault}: {', '.join(one.names)}")
    named = [one for one in found if one.names]
    print(
        f"{len(found)} draws: {sum(one.alarms > 0 for one in found)} with an alarm,"
        f" {len(named)} named, {sum(one.names[-1] == one.effect for one in named)} rightly;"
        f" the name changed in {sum(one.changes > 0 for one in found)}"
    )


if __name__ == "__main__":
    main()
