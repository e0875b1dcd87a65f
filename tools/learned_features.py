"""Features of a record for a learned classifier: numbers at fixed places; and hidden causes.

The deviation from the calibrated twin in each cycle is averaged over PLACES of each kind of
stretch: over its sigma, and whitened as in the diagnosis. Over the cycles of a record each place
has four numbers: mean, spread, contrast of late with early cycles, and value in the cycle with the
largest deviation. Features do not depend on the hidden causes.
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
from twin.diagnosis.evidence import HEALTHY, Evidence, collect
from twin.diagnosis.residual_covariance import covariance
from twin.model.term import KINDS
from twin.monitor.bins import warped
from twin.monitor.healthy import UNSEEN_LEVEL_MBAR, Scatter
from twin.monitor.statistics import LEVELS
from twin.signals import Samples

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

# Seconds since a stretch began at which its places begin; the last one lasts to its end.
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
    rig: float  # its calibrated suction capacity (sl/min), which is unique
    features: Floats
    seconds: float  # of the processor

    @property
    def trains(self) -> bool:
        """Whether it is for training; the others are judged."""
        return self.seed >= FIRST_SEED


class RecordFile:
    """Records by kind, seed and units; those in the file are not drawn again."""

    def __init__(self, path: Path | None) -> None:
        self._path, self._new = path, 0
        self._records = dict[tuple[str, int, int], Record]()
        if path is not None and path.exists():
            with np.load(path) as stored:
                columns = [stored[column.name] for column in fields(Record)]
            for kind, seed, units, hidden, *rest in zip(*columns, strict=True):
                causes = [Hidden(**cause) for cause in json.loads(str(hidden))]
                record = Record(str(kind), int(seed), int(units), causes, *rest)
                self._records[record.kind, record.seed, record.units] = record

    def get(self, kind: str, seed: int, units: int) -> Record:
        """A record of the file, or a new one: of a training rig if the seed is for training."""
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
        """Write all records to the file."""
        if self._path is None or not self._new:
            return
        records = self._records.values()
        columns = {
            column.name: np.array([getattr(record, column.name) for record in records])
            for column in fields(Record)
            if column.name != "hidden"
        }
        hidden = np.array(
            [json.dumps([asdict(cause) for cause in record.hidden]) for record in records]
        )
        np.savez_compressed(self._path, hidden=hidden, **columns)


def training_keys(counts: Mapping[str, int]) -> list[tuple[str, int]]:
    """Kind and seed of each training case, mixed so that any number of the first is balanced."""
    keys = [
        (number / count, kind, FIRST_SEED + number)
        for kind, count in counts.items()
        for number in range(count)
    ]
    return [(kind, seed) for _, kind, seed in sorted(keys)]


def features(unit: Unit, samples: Samples) -> Floats:
    """Features of a record."""
    evidence = collect(unit.config, [samples])
    cycles = np.hstack([in_places(evidence), levels_and_time(evidence)])
    return np.append(of_record(cycles), SYSTEMS.index(unit.name))


def in_places(evidence: Evidence) -> Floats:
    """Deviation of each judged cycle over its sigma, then whitened, (cycles, 2 · PLACES).

    NaN where a cycle shows nothing of a place.
    """
    (off,) = evidence.off([HEALTHY]).T
    # The uncertainty of a calibration is left out: training cases of many rigs show it. It would
    # take three quarters of the time.
    model, bins = covariance(replace(evidence, uncertain=())), evidence.bins
    places = np.searchsorted(warped(np.array(BEGINS)), bins.time, "right") - 1
    places += bins.kind * len(BEGINS)
    rows = []
    for cycle in evidence.judged:
        weights = model.of([cycle])
        cycle_bins, of_bins = weights.bins, weights.covariance.own[0]
        over_sigma = off[cycle_bins] / np.sqrt(np.sum(of_bins.factor**2, axis=1))
        (white,) = of_bins.white(off[cycle_bins, None]).T
        rows.append([mean_at(places[cycle_bins], values) for values in (over_sigma, white)])
    return np.array(rows).reshape(len(rows), 2 * PLACES)


def mean_at(places: Ints, values: Floats) -> Floats:
    """Mean of the values at each of PLACES; NaN without one."""
    count, total = np.bincount(places, None, PLACES), np.bincount(places, values, PLACES)
    means: Floats = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return means


def levels_and_time(evidence: Evidence) -> Floats:
    """Switching levels in sigmas and evacuation time in ms of each judged cycle, less expected.

    Shape (cycles, 3); NaN for what a cycle does not show.
    """
    expected, healthy = evidence.detected_switching(evidence.theta).levels, evidence.healthy.figures
    healthy_levels = [
        healthy.get(name) or Scatter(mean=level, sigma=UNSEEN_LEVEL_MBAR)
        for name, level in zip(LEVELS, expected, strict=True)
    ]
    rows = []
    for cycle in evidence.judged:
        shown = defaultdict(lambda: np.nan, evidence.figures[cycle])
        levels = [
            (shown[name] - healthy_level.mean) / healthy_level.sigma
            for name, healthy_level in zip(LEVELS, healthy_levels, strict=True)
        ]
        rows.append([*levels, shown["t0_measured"] - shown["t0_expected"]])
    return np.array(rows)


def of_record(cycles: Floats) -> Floats:
    """Four numbers for each column of the cycles; NaN if no cycle shows it."""
    third = max(len(cycles) // 3, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # places that no cycle shows
        mean, spread = np.nanmean(cycles, axis=0), np.nanstd(cycles, axis=0)
        drift = np.nanmean(cycles[-third:], axis=0) - np.nanmean(cycles[:third], axis=0)
        worst = cycles[np.argmax(np.nanmean(cycles**2, axis=1))]
    return np.concatenate([mean, spread, drift, worst])
