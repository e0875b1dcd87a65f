"""Compares units with others of their type: which are far from the rest, in what, and which drift.

Every unit differs a little from its type. A unit stands out if it is far outside the scatter of the
others of its type. Median and median absolute deviation measure that scatter, so a few bad units
hide nothing. A unit with earlier logs is compared with its own past. That change is compared with
the changes of the others, since weather and age act on them too.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import median_abs_deviation, theilslopes

from twin.figures.trend import LEAST_SPAN, trend_of
from twin.fleet.results_database import Result
from twin.fleet.watch import name_of
from twin.monitor.model_bank import SUSPECTS

FEWEST_PEERS = 8  # units of a type that a comparison needs
FEWEST_LOGS = 6  # logs of a unit that a drift needs
DAY_NS = 86_400e9
LEAST_SCATTER = 0.3  # sigmas a cycle: the lower bound of a fleet's scatter
SIGMA = 0.683  # probability within one sigma
DRIFTS = 4.0  # threshold of a drift, in sigmas
STEPS = 8.0  # of a step: higher, as it may be in any effect and between any two logs

_MAX_SIZE = {  # the largest size that it can have
    name_of(suspect): max(abs(suspect.parameter.low), abs(suspect.parameter.high))
    for suspect in SUSPECTS
}
_ONE_SIDED = {name_of(suspect) for suspect in SUSPECTS if not suspect.both_ways}

Unit = tuple[str, str]  # type, ID


@dataclass(frozen=True)
class Standing:
    """How far one unit is from its peers, in the effect in which it is furthest."""

    type: str
    id: str
    batch: str
    beyond: float  # sigmas of the others' scatter
    effect: str
    size: float | None  # more than the others' median; None where it cannot be that much
    unit: str
    peers: int
    drifts: tuple["Drift", ...]
    log: str  # the newest


@dataclass(frozen=True)
class Drift:
    """One effect that grows or shrinks from log to log, or stepped between two of them.

    A step has no rate: ``per_day`` is None, ``step`` is its size, and ``step_ns`` is when the first
    log with it began (UTC).
    """

    effect: str
    per_day: float | None
    unit: str
    sigmas: float
    days: float  # from the first log to the last
    step: float | None = None
    step_ns: int | None = None


def standings(watched: Sequence[Result]) -> list[Standing]:
    """Every unit with results of watched logs (ordered by time), the furthest out first."""
    logs: dict[Unit, list[Result]] = defaultdict(list)
    for result in watched:
        if result.answer["effects"]:
            logs[result.type, result.id].append(result)
    effects = {unit: _effect_changes(results) for unit, results in logs.items()}
    peers: dict[tuple[str, bool], list[Values]] = defaultdict(list)
    for unit, results in logs.items():
        peers[unit[0], len(results) > 1].append(effects[unit])
    statistics = {
        group: _GroupStatistics.of(group_effects) for group, group_effects in peers.items()
    }
    unsorted = [
        _standing(results, effects[unit], statistics[unit[0], len(results) > 1])
        for unit, results in logs.items()
    ]
    return sorted(unsorted, key=lambda standing: -standing.beyond)


@dataclass(frozen=True)
class _Effect:
    """One effect in one unit: sigmas a cycle, their uncertainty, and the size."""

    sigmas: float
    uncertainty: float
    size: float


Values = Mapping[str, _Effect]


def _effect_changes(results: Sequence[Result]) -> Values:
    """Every effect in a unit's newest log, less the median of its earlier logs."""
    *earlier, newest = (
        {name: _effect_of(effect) for name, effect in result.answer["effects"].items()}
        for result in results
    )
    return {
        name: _minus_median(effect, [log[name] for log in earlier if name in log])
        for name, effect in newest.items()
    }


def _effect_of(effect: Mapping[str, Any]) -> _Effect:
    scatter = 1.0 if effect["scatter"] is None else effect["scatter"]
    return _Effect(effect["sigmas"], scatter / math.sqrt(effect["cycles"]), effect["size"])


def _minus_median(latest: _Effect, earlier: Sequence[_Effect]) -> _Effect:
    if not earlier:
        return latest
    sigmas, uncertainty, size = np.median(
        [(effect.sigmas, effect.uncertainty, effect.size) for effect in earlier], axis=0
    ).tolist()
    return _Effect(
        latest.sigmas - sigmas, math.hypot(latest.uncertainty, uncertainty), latest.size - size
    )


@dataclass(frozen=True)
class _GroupStatistics:
    """Statistics of peers: their number, and the median and scatter of every effect."""

    peers: int
    middle: Mapping[str, tuple[float, float]]  # sigmas a cycle, and size
    scatter: Mapping[str, float]  # sigmas a cycle

    @classmethod
    def of(cls, units: Sequence[Values]) -> "_GroupStatistics":
        """Statistics of some units; with too few of them, those of the calibrated twin."""
        names = {name for unit in units for name in unit}
        if len(units) < FEWEST_PEERS:
            return cls(len(units), dict.fromkeys(names, (0.0, 0.0)), dict.fromkeys(names, 1.0))
        pairs = {
            name: [(unit[name].sigmas, unit[name].size) for unit in units if name in unit]
            for name in names
        }
        middle = {name: tuple(np.median(values, axis=0).tolist()) for name, values in pairs.items()}
        scatter = {
            name: median_abs_deviation(np.array(values)[:, 0], scale="normal")
            for name, values in pairs.items()
        }
        bounded = {name: max(float(spread), LEAST_SCATTER) for name, spread in scatter.items()}
        return cls(len(units), middle, bounded)

    def beyond(self, name: str, effect: _Effect) -> float:
        """Distance from the peers' median, in sigmas of their scatter and its own uncertainty."""
        sigmas = (effect.sigmas - self.middle[name][0]) / math.hypot(
            self.scatter[name], effect.uncertainty
        )
        return sigmas if name in _ONE_SIDED else abs(sigmas)


def _reported(name: str, size: float) -> float | None:
    """The size to report; None if it exceeds the effect's bounds."""
    return size if abs(size) < _MAX_SIZE[name] else None


def _standing(results: Sequence[Result], effects: Values, statistics: _GroupStatistics) -> Standing:
    last, beyond = (
        results[-1],
        {name: statistics.beyond(name, effect) for name, effect in effects.items()},
    )
    furthest = max(beyond, key=lambda name: beyond[name])
    return Standing(
        last.type,
        last.id,
        last.batch,
        beyond[furthest],
        furthest,
        _reported(furthest, effects[furthest].size - statistics.middle[furthest][1]),
        last.answer["effects"][furthest]["unit"],
        statistics.peers,
        _drifts(results),
        last.log,
    )


def _drifts(results: Sequence[Result]) -> tuple[Drift, ...]:
    """The effects that move from log to log, by the median slope between any two logs."""
    if len(results) < FEWEST_LOGS:
        return ()
    day = (np.array([result.begin_ns for result in results]) - results[0].begin_ns) / DAY_NS
    if day[-1] < LEAST_SPAN:
        return ()
    candidates = [_drift(name, day, results) for name in results[-1].answer["effects"]]
    drifting = [drift for drift in candidates if drift is not None]
    return tuple(sorted(drifting, key=lambda drift: -drift.sigmas))


def _drift(name: str, day: npt.NDArray[np.float64], results: Sequence[Result]) -> Drift | None:
    effects = [result.answer["effects"].get(name) for result in results]
    shown = np.array([entry is not None for entry in effects])
    if shown.sum() < FEWEST_LOGS:
        return None
    sizes = np.array([entry["size"] for entry in effects if entry is not None])
    line = theilslopes(sizes, day[shown], alpha=SIGMA)
    sigma = max(0.5 * float(line.high_slope - line.low_slope), 1e-12)
    unit = results[-1].answer["effects"][name]["unit"]
    drift = Drift(name, float(line.slope), unit, abs(float(line.slope)) / sigma, float(day[-1]))
    step = trend_of(np.array([result.begin_ns for result in results])[shown], sizes).step
    if step is None:
        return drift if drift.sigmas >= DRIFTS else None
    size = step.after - step.before
    sigmas = 2.0 * abs(size) / math.hypot(step.before_half, step.after_half)
    if sigmas < STEPS:
        return None
    return replace(drift, per_day=None, sigmas=sigmas, step=size, step_ns=step.host_ns)
