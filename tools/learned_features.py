"""What a learned classifier sees of a record: numbers at fixed places, and what was hidden.

The deviation of the measurement from the calibrated twin in each cycle, over its sigma and whitened
as the diagnosis does it, is averaged over PLACES of each kind of stretch. Over the cycles of a
record each place has a mean, a spread, a contrast of late with early cycles, and its value in the
cycle that is off most. Nothing here knows what is hidden.
"""

import json
import time
import warnings
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tools.battery_cases import Hidden
from tools.battery_first import Unit, drawn_case
from tools.calibration_coverage import SYSTEMS
from twin.diagnosis.covariance import covariance
from twin.diagnosis.evidence import HEALTHY, Evidence, collect
from twin.inference.covariance import Covariance
from twin.model.term import KINDS
from twin.monitor.bins import warped
from twin.monitor.healthy import UNSEEN_LEVEL_MBAR, Scatter
from twin.monitor.statistics import LEVELS
from twin.signals import Samples

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

# Seconds since a stretch began at which its places begin; the last one goes on to its end.
BEGINS = (0.0, 0.005, 0.01, 0.02, 0.035, 0.06, 0.1, 0.15, 0.22, 0.3, 0.45, 0.7, 1.1, 2.0)
PLACES = len(KINDS) * len(BEGINS)
FIRST_SEED = 2_000_000  # of training cases; those of the battery are below
FIRST_UNIT = 1_000  # of the rigs they are drawn from; the battery's are below
KEPT_EVERY = 25  # new records


@dataclass(frozen=True)
class Record:
    """A case of the battery or of the training, its features and what they took."""

    kind: str
    seed: int
    units: int  # rigs of each system that its own was drawn from
    hidden: Sequence[Hidden]  # one at most
    rig: float  # its calibrated suction capacity (sl/min): no two have the same
    features: Floats
    seconds: float  # of the processor

    @property
    def trains(self) -> bool:
        """Whether it may be learned from; the others are judged."""
        return self.seed >= FIRST_SEED


class RecordFile:
    """Records by kind, seed and units; those that a file keeps are not drawn again."""

    def __init__(self, path: Path | None) -> None:
        self._path, self._new = path, 0
        self._records = dict[tuple[str, int, int], Record]()
        if path is not None and path.exists():
            with np.load(path) as kept:
                columns = [kept[one.name] for one in fields(Record)]
            for kind, seed, units, hidden, *rest in zip(*columns, strict=True):
                known = [Hidden(**each) for each in json.loads(str(hidden))]
                one = Record(str(kind), int(seed), int(units), known, *rest)
                self._records[one.kind, one.seed, one.units] = one

    def get(self, kind: str, seed: int, units: int) -> Record:
        """A record of the file, or drawn now: of a rig to learn from, if the seed is of these."""
        key = kind, seed, units
        if key not in self._records:
            begin = time.process_time()
            first = FIRST_UNIT if seed >= FIRST_SEED else 0
            unit, hidden, samples = drawn_case(kind, seed, units, first)
            rig, values = unit.config.data.ejector.suction_capacity_sl_min, features(unit, samples)
            spent = time.process_time() - begin
            self._records[key] = Record(kind, seed, units, hidden, rig, values, spent)
            self._new += 1
            if self._new % KEPT_EVERY == 0:
                self.write()
        return self._records[key]

    def write(self) -> None:
        """Keep all in the file."""
        if self._path is None or not self._new:
            return
        records = self._records.values()
        columns = {
            one.name: np.array([getattr(each, one.name) for each in records])
            for one in fields(Record)
            if one.name != "hidden"
        }
        hidden = np.array([json.dumps([asdict(each) for each in one.hidden]) for one in records])
        np.savez_compressed(self._path, hidden=hidden, **columns)


def training_keys(counts: Mapping[str, int]) -> list[tuple[str, int]]:
    """Kind and seed of each training case, so mixed that any number of the first ones will do."""
    keys = [
        (number / many, kind, FIRST_SEED + number)
        for kind, many in counts.items()
        for number in range(many)
    ]
    return [(kind, seed) for _, kind, seed in sorted(keys)]


def features(unit: Unit, samples: Samples) -> Floats:
    """What a learned classifier sees of a record."""
    evidence = collect(unit.config, [samples])
    cycles = np.hstack([in_places(evidence), levels_and_time(evidence)])
    return np.append(of_record(cycles), SYSTEMS.index(unit.name))


def in_places(evidence: Evidence) -> Floats:
    """Deviation of each judged cycle over its sigma, then whitened, (cycles, 2 · PLACES).

    NaN where a cycle shows nothing of a place.
    """
    (off,) = evidence.off([HEALTHY]).T
    # What a calibration leaves open differs from rig to rig: the training cases show it. Three
    # quarters of the time would go into it.
    known, bins = covariance(replace(evidence, uncertain=())), evidence.bins
    place = np.searchsorted(warped(np.array(BEGINS)), bins.time, "right") - 1
    place += bins.kind * len(BEGINS)
    rows = []
    for cycle in evidence.judged:
        weights = known.of([cycle])
        here, count = weights.bins, len(weights.bins)
        factor = weights.covariance.factor[:count, :count]
        over_sigma = off[here] / np.sqrt(np.sum(factor**2, axis=1))
        (white,) = Covariance(factor).white(off[here, None]).T
        rows.append([mean_at(place[here], one) for one in (over_sigma, white)])
    return np.array(rows).reshape(len(rows), 2 * PLACES)


def mean_at(place: Ints, values: Floats) -> Floats:
    """Mean of the values at each of PLACES; NaN where there is none."""
    count, total = np.bincount(place, None, PLACES), np.bincount(place, values, PLACES)
    found: Floats = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return found


def levels_and_time(evidence: Evidence) -> Floats:
    """Switching levels in sigmas and evacuation time in ms of each judged cycle, less expected.

    Shape (cycles, 3); NaN for what a cycle does not show.
    """
    expected, healthy = evidence.seen(evidence.theta).levels, evidence.healthy.figures
    known = [
        healthy.get(name) or Scatter(mean=level, sigma=UNSEEN_LEVEL_MBAR)
        for name, level in zip(LEVELS, expected, strict=True)
    ]
    rows = []
    for cycle in evidence.judged:
        shown = defaultdict(lambda: np.nan, evidence.figures[cycle])
        levels = [
            (shown[name] - one.mean) / one.sigma for name, one in zip(LEVELS, known, strict=True)
        ]
        rows.append([*levels, shown["t0_measured"] - shown["t0_expected"]])
    return np.array(rows)


def of_record(cycles: Floats) -> Floats:
    """Four numbers for each column of the cycles, those that no cycle shows included (NaN)."""
    third = max(len(cycles) // 3, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # places that no cycle shows
        mean, spread = np.nanmean(cycles, axis=0), np.nanstd(cycles, axis=0)
        drift = np.nanmean(cycles[-third:], axis=0) - np.nanmean(cycles[:third], axis=0)
        most = cycles[np.argmax(np.nanmean(cycles**2, axis=1))]
    return np.concatenate([mean, spread, drift, most])
