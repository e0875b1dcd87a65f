"""Change detection over cycles: delay compared with an optimal CUSUM.

Healthy cycles of the simulated rig go through twin, bank and isolation as in the loop. Then a shift
(sigmas) is added to scores of these cycles, drawn at random. The effect's own score gets all of it,
other scores get it times the cosine of their signatures. The change begins either in settled sums,
after RUN_IN healthy cycles, or in fresh sums. The optimum is computed for the same case.
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
DEVICES, LONG_DEVICES, CYCLES = 4, 40, 2600  # cycles of each device
SETTLED = 200  # cycles after which a device's scores are stationary
MONTH = 30 * 86_400.0 / 3.0  # cycles to a false alarm: 30 days of 3 s cycles
SHIFTS = (0.5, 1.0, 2.0)  # sigmas a cycle
EFFECTS = ("leakage", "suction_loss", "filter_clogging", "threshold_drift", "sensor_lag")
DRAWS = 1000
RUN_IN = 300  # healthy cycles after which sums are stationary
APART = 20  # healthy cycles between the beginnings of two changes
NEVER = 4000  # cycles


def sums(run: Run) -> Sequence[Measured]:
    """Delays for three sizes, beside the optimum.

    First the delays of settled sums, then those of sums that begin with the change.
    """
    devices = LONG_DEVICES if run.long else DEVICES
    scores, cosines = _simulated(run, devices)
    pool = np.concatenate([device_scores[SETTLED:] for device_scores in scores])
    run.tell("detection: delays")
    running, fresh = _running(pool, cosines), [_changes(cosines)] * DRAWS
    late = [_late(pool, cosines, shift, running, RUN_IN) for shift in SHIFTS]
    later = [_late(pool, cosines, shift, fresh, 0) for shift in SHIFTS]
    return (*late, *later)


def _simulated(run: Run, devices: int) -> tuple[list[Floats], Floats]:
    """Standard normal scores of each device's cycles, and the cosines between signatures."""
    results = []
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as workers:
        for result in workers.map(_device, range(devices)):
            results.append(result)
            run.tell(f"detection: {len(results)} of {devices} devices")
    return [scores for scores, _ in results], results[0][1]


def _device(seed: int) -> tuple[Floats, Floats]:
    """Scores of one device's cycles, (cycles, suspects), and the cosines of the last cycle."""
    document = Document.read(CONFIG)
    config, rig = Config.of(document), document.section(PlcSettings, "plc")
    rig = rig.model_copy(update={"program": rig.program.model_copy(update=PROGRAM)})
    scores, cosines = [], np.eye(len(SUSPECTS))
    for residual, normal in heard(config, rig, CYCLES * CYCLE_S, seed):
        scores.append(normal)
        cosines = residual.alike()
    return np.array(scores), cosines


def _changes(cosines: Floats) -> ChangeDetector:
    detector = looked_for()
    detector.weigh(cosines)
    return detector


def _running(pool: Floats, cosines: Floats) -> list[ChangeDetector]:
    """Settled sums of healthy cycles at which a change may begin; an alarm restarts the sums."""
    detector, detectors, rng = _changes(cosines), [], np.random.default_rng(0)
    for cycle in range(1, RUN_IN + APART * DRAWS):
        detector.take(pool[rng.integers(len(pool))])
        if detector.log_sum >= limit(MONTH):
            detector.begin()
        if cycle >= RUN_IN and (cycle - RUN_IN) % APART == 0:
            detectors.append(deepcopy(detector))
    return detectors


def _late(
    pool: Floats, cosines: Floats, shift: float, begins: Sequence[ChangeDetector], healthy: int
) -> Measured:
    """Mean of the effects' median delays, with the mean delay of a CUSUM for one known effect."""
    names = [suspect.effect for suspect in SUSPECTS]
    medians = []
    for effect in EFFECTS:
        added = shift * cosines[names.index(effect)]
        rng = np.random.default_rng(names.index(effect))
        delays = [_delay(pool, deepcopy(begin), added, rng) for begin in begins]
        medians.append(float(np.median(delays)))
    note = f"({', '.join(f'{median:g}' for median in medians)})"
    return Measured([float(np.mean(medians))], [_optimum(shift, healthy)], note=note)


def _delay(pool: Floats, detector: ChangeDetector, added: Floats, rng: np.random.Generator) -> int:
    for cycle in range(1, NEVER):
        detector.take(pool[rng.integers(len(pool))] + added)
        if detector.log_sum >= limit(MONTH):
            return cycle
    return NEVER


def _optimum(shift: float, healthy: int) -> float:
    """Mean delay of a one-sided CUSUM for a known shift, with its limit after Siegmund."""
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
    """Cumulative sums of steps that start at zero and are reset to zero when negative."""
    total = np.concatenate([[0.0], np.cumsum(steps)])
    result: Floats = total - np.minimum.accumulate(total)
    return result


def _run_length(k: float, height: float) -> float:
    """Cycles to a false alarm of a CUSUM with reference value k and limit ``height`` (Siegmund)."""
    b = height + 1.166
    return float((np.exp(2 * k * b) - 2 * k * b - 1) / (2 * k * k))
