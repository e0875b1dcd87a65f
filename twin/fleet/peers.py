"""Units beside others like them: who is far from the rest, in what, and who is moving.

Every unit differs from its type a little. What stands out is what is far outside of how the others
of the type scatter, by median and median deviation: a few bad ones among them hide nothing. A unit
with earlier logs is compared with what it was itself, and that change with the changes of others,
which the weather and the years have made as well.
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

FEWEST_PEERS = 8  # of a type, by which the others are judged
FEWEST_LOGS = 6  # of a unit, in which a drift can be seen
DAY_NS = 86_400e9
LEAST_SCATTER = 0.3  # sigmas a cycle: no fleet is more alike than that
SIGMA = 0.683  # of all, within one sigma
DRIFTS = 4.0  # sigmas, from which on a unit is said to drift
STEPS = 8.0  # and to have stepped: that may be in any effect and between any two logs

_MOST = {  # the largest size that it can have
    name_of(one): max(abs(one.parameter.low), abs(one.parameter.high)) for one in SUSPECTS
}
_ONE_WAY = {name_of(one) for one in SUSPECTS if not one.both_ways}

Unit = tuple[str, str]  # type, ID


@dataclass(frozen=True)
class Standing:
    """How far one unit is from those like it, in the effect in which it is furthest."""

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

    A step has no rate: ``per_day`` is None, ``step`` how much it is, and ``step_ns`` when the first
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
    """Every unit with logs that were watched (in the order of time), the furthest out first."""
    logs: dict[Unit, list[Result]] = defaultdict(list)
    for one in watched:
        if one.answer["effects"]:
            logs[one.type, one.id].append(one)
    says = {unit: _says(mine) for unit, mine in logs.items()}
    peers: dict[tuple[str, bool], list[Values]] = defaultdict(list)
    for unit, mine in logs.items():
        peers[unit[0], len(mine) > 1].append(says[unit])
    usual = {group: _Usual.of(every) for group, every in peers.items()}
    found = [
        _standing(mine, says[unit], usual[unit[0], len(mine) > 1]) for unit, mine in logs.items()
    ]
    return sorted(found, key=lambda one: -one.beyond)


@dataclass(frozen=True)
class _Value:
    """One effect in one unit: sigmas a cycle, by how much they are uncertain, and the size."""

    sigmas: float
    known: float
    size: float


Values = Mapping[str, _Value]


def _says(mine: Sequence[Result]) -> Values:
    """What a unit's newest log says of every effect, less what its earlier ones did."""
    *earlier, newest = ({n: _value(one) for n, one in r.answer["effects"].items()} for r in mine)
    return {
        name: _less(one, [e[name] for e in earlier if name in e]) for name, one in newest.items()
    }


def _value(one: Mapping[str, Any]) -> _Value:
    scatter = 1.0 if one["scatter"] is None else one["scatter"]
    return _Value(one["sigmas"], scatter / math.sqrt(one["cycles"]), one["size"])


def _less(one: _Value, earlier: Sequence[_Value]) -> _Value:
    if not earlier:
        return one
    sigmas, known, size = np.median([(e.sigmas, e.known, e.size) for e in earlier], axis=0).tolist()
    return _Value(one.sigmas - sigmas, math.hypot(one.known, known), one.size - size)


@dataclass(frozen=True)
class _Usual:
    """Of units like each other: how many, and of every effect the middle and the scatter."""

    peers: int
    middle: Mapping[str, tuple[float, float]]  # sigmas a cycle, and size
    scatter: Mapping[str, float]  # sigmas a cycle

    @classmethod
    def of(cls, units: Sequence[Values]) -> "_Usual":
        """Of few units nothing is usual but the calibrated twin."""
        names = {name for one in units for name in one}
        if len(units) < FEWEST_PEERS:
            return cls(len(units), dict.fromkeys(names, (0.0, 0.0)), dict.fromkeys(names, 1.0))
        said = {n: [(u[n].sigmas, u[n].size) for u in units if n in u] for n in names}
        middle = {n: tuple(np.median(some, axis=0).tolist()) for n, some in said.items()}
        scatter = {
            n: median_abs_deviation(np.array(x)[:, 0], scale="normal") for n, x in said.items()
        }
        return cls(
            len(units), middle, {n: max(float(one), LEAST_SCATTER) for n, one in scatter.items()}
        )

    def beyond(self, name: str, one: _Value) -> float:
        """Sigmas of the others' scatter, and of what its logs do not know, from their middle."""
        far = (one.sigmas - self.middle[name][0]) / math.hypot(self.scatter[name], one.known)
        return far if name in _ONE_WAY else abs(far)


def _reported(name: str, size: float) -> float | None:
    """A size as it is told; None where it has left what the effect can be."""
    return size if abs(size) < _MOST[name] else None


def _standing(mine: Sequence[Result], says: Values, usual: _Usual) -> Standing:
    last, beyond = mine[-1], {name: usual.beyond(name, one) for name, one in says.items()}
    first = max(beyond, key=lambda name: beyond[name])
    return Standing(
        last.type,
        last.id,
        last.batch,
        beyond[first],
        first,
        _reported(first, says[first].size - usual.middle[first][1]),
        last.answer["effects"][first]["unit"],
        usual.peers,
        _drifts(mine),
        last.log,
    )


def _drifts(mine: Sequence[Result]) -> tuple[Drift, ...]:
    """What moves from log to log, by the median of the slopes between any two of them."""
    if len(mine) < FEWEST_LOGS:
        return ()
    day = (np.array([one.begin_ns for one in mine]) - mine[0].begin_ns) / DAY_NS
    if day[-1] < LEAST_SPAN:
        return ()
    found = [_drift(name, day, mine) for name in mine[-1].answer["effects"]]
    drifting = [one for one in found if one is not None]
    return tuple(sorted(drifting, key=lambda one: -one.sigmas))


def _drift(name: str, day: npt.NDArray[np.float64], mine: Sequence[Result]) -> Drift | None:
    effects = [one.answer["effects"].get(name) for one in mine]
    shown = np.array([one is not None for one in effects])
    if shown.sum() < FEWEST_LOGS:
        return None
    sizes = np.array([one["size"] for one in effects if one is not None])
    line = theilslopes(sizes, day[shown], alpha=SIGMA)
    sigma = max(0.5 * float(line.high_slope - line.low_slope), 1e-12)
    unit = mine[-1].answer["effects"][name]["unit"]
    drift = Drift(name, float(line.slope), unit, abs(float(line.slope)) / sigma, float(day[-1]))
    step = trend_of(np.array([one.begin_ns for one in mine])[shown], sizes).step
    if step is None:
        return drift if drift.sigmas >= DRIFTS else None
    size = step.after - step.before
    sigmas = 2.0 * abs(size) / math.hypot(step.before_half, step.after_half)
    if sigmas < STEPS:
        return None
    return replace(drift, per_day=None, sigmas=sigmas, step=size, step_ns=step.host_ns)
