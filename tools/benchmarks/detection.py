"""Detection by sums over cycles: how often wrong, and how late beside a CUSUM that knows more.

Healthy cycles of the simulated rig go through twin, bank and isolation as they do in the loop. A
change of so many sigmas is put into the scores of the same cycles, drawn at random: into an
effect's own, and by the cosine of their signatures into those of the others. It is put in after so
many healthy cycles that the sums are what they usually are, and into sums that begin with it; the
optimum is told of the same.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from copy import deepcopy
from multiprocessing import get_context

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

from benchmarks.figures import Measured, Run
from benchmarks.isolation import heard
from benchmarks.processes import ROOT
from drivers.plc.settings import PlcSettings
from twin.config import Config
from twin.monitor.change_detection import ChangeDetector, limit
from twin.monitor.isolation import looked_for
from twin.monitor.model_bank import SUSPECTS
from twin.settings import Document

Floats = npt.NDArray[np.float64]

CONFIG = ROOT / "configs" / "gripper.toml"
PROGRAM = {"suction_ms": 900.0, "blow_off_ms": 150.0, "idle_ms": 250.0}  # short, for many cycles
CYCLE_S = 1.3
DEVICES, LONG_DEVICES, CYCLES = 4, 40, 2600  # of each device
SETTLED = 200  # cycles after which a device's scores are what they stay
ASKED = (1000.0, 10_000.0)  # cycles to a false alarm
MONTH = 30 * 86_400.0 / 3.0  # the same in 30 days of 3 s cycles
SHIFTS = (0.5, 1.0, 2.0)  # sigmas a cycle
EFFECTS = ("leakage", "suction_loss", "filter_clogging", "threshold_drift", "sensor_lag")
DRAWS = 1000
RUN_IN = 300  # healthy cycles, after which sums are what they usually are
APART = 20  # further ones between the beginnings of two changes
NEVER = 4000  # cycles


def sums(run: Run) -> Sequence[Measured]:
    """False alarms at two wanted rates, and delays for three sizes, beside the optimum.

    Delays are told of sums that run already first, then of such that begin with the change.
    """
    devices = LONG_DEVICES if run.long else DEVICES
    scores, alike = _simulated(run, devices)
    false = [_false_alarms(scores, alike, cycles) for cycles in ASKED]
    pool = np.concatenate([one[SETTLED:] for one in scores])
    run.tell("detection: delays")
    running, fresh = _running(pool, alike), [_changes(alike)] * DRAWS
    late = [_late(pool, alike, shift, running, RUN_IN) for shift in SHIFTS]
    later = [_late(pool, alike, shift, fresh, 0) for shift in SHIFTS]
    return (*false, *late, *later)


def _simulated(run: Run, devices: int) -> tuple[list[Floats], Floats]:
    """Standard normal scores of each device's cycles, and the cosines between signatures."""
    found = []
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as workers:
        for one in workers.map(_device, range(devices)):
            found.append(one)
            run.tell(f"detection: {len(found)} of {devices} devices")
    return [scores for scores, _ in found], found[0][1]


def _device(seed: int) -> tuple[Floats, Floats]:
    """Scores of one device's cycles, (cycles, suspects), and the cosines of the last one."""
    document = Document.read(CONFIG)
    config, rig = Config.of(document), document.section(PlcSettings, "plc")
    rig = rig.model_copy(update={"program": rig.program.model_copy(update=PROGRAM)})
    scores, alike = [], np.eye(len(SUSPECTS))
    for said, normal in heard(config, rig, CYCLES * CYCLE_S, seed):
        scores.append(normal)
        alike = said.alike()
    return np.array(scores), alike


def _changes(alike: Floats) -> ChangeDetector:
    changes = looked_for()
    changes.weigh(alike)
    return changes


def _false_alarms(devices: Sequence[Floats], alike: Floats, asked: float) -> Measured:
    """False alarms over those that were asked for."""
    alarms, cycles = 0, 0
    for scores in devices:
        changes = _changes(alike)
        for normal in scores:
            changes.take(normal)
            if changes.log_sum >= limit(asked):
                alarms += 1
                changes.begin()
        cycles += len(scores)
    note = f"({alarms} in {cycles:,} cycles)"
    return Measured([alarms * asked / cycles], note=note)


def _running(pool: Floats, alike: Floats) -> list[ChangeDetector]:
    """Sums in healthy cycles, as they are when a change begins; an alarm begins them anew."""
    changes, found, rng = _changes(alike), [], np.random.default_rng(0)
    for cycle in range(1, RUN_IN + APART * DRAWS):
        changes.take(pool[rng.integers(len(pool))])
        if changes.log_sum >= limit(MONTH):
            changes.begin()
        if cycle >= RUN_IN and (cycle - RUN_IN) % APART == 0:
            found.append(deepcopy(changes))
    return found


def _late(
    pool: Floats, alike: Floats, shift: float, begins: Sequence[ChangeDetector], healthy: int
) -> Measured:
    """Mean of the effects' median delays, and the mean delay of a CUSUM for one of them alone."""
    names = [one.effect for one in SUSPECTS]
    medians = []
    for effect in EFFECTS:
        added = shift * alike[names.index(effect)]
        rng = np.random.default_rng(names.index(effect))
        delays = [_delay(pool, deepcopy(begin), added, rng) for begin in begins]
        medians.append(float(np.median(delays)))
    note = f"({', '.join(f'{one:g}' for one in medians)})"
    return Measured([float(np.mean(medians))], [_optimum(shift, healthy)], note=note)


def _delay(pool: Floats, changes: ChangeDetector, added: Floats, rng: np.random.Generator) -> int:
    for cycle in range(1, NEVER):
        changes.take(pool[rng.integers(len(pool))] + added)
        if changes.log_sum >= limit(MONTH):
            return cycle
    return NEVER


def _optimum(shift: float, healthy: int) -> float:
    """Mean delay of the CUSUM for one known shift, upwards; its limit after Siegmund."""
    k = 0.5 * shift
    height = brentq(lambda h: _run_length(k, h) - MONTH, 0.1, 100.0)
    rng, delays = np.random.default_rng(1), []
    for _ in range(4 * DRAWS):
        before = _above(rng.normal(-k, 1.0, healthy)) if healthy else np.zeros(1)
        steps = rng.normal(k, 1.0, NEVER)
        steps[0] += before[-1]
        delays.append(int(np.argmax(_above(steps) >= height)))
    return float(np.mean(delays))


def _above(steps: Floats) -> Floats:
    """The sums of steps, from zero on and never below it."""
    total = np.concatenate([[0.0], np.cumsum(steps)])
    result: Floats = total - np.minimum.accumulate(total)
    return result


def _run_length(k: float, height: float) -> float:
    """Cycles to a false alarm (Siegmund): of a CUSUM with reference value k and this limit."""
    b = height + 1.166
    return float((np.exp(2 * k * b) - 2 * k * b - 1) / (2 * k * k))
