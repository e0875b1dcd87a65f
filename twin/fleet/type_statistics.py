"""A type's data anew, from its calibrated units: the mean of each value, and how units differ.

The founding paper takes the mean of ten ejectors for the object-specific data of a type. Here a
unit counts by how well its log determines the value: between units that differ by a scatter τ and
are each known to within s, the weights are 1 / (τ² + s²), with τ² by DerSimonian and Laird (1986).
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.assets.record import Record, holding
from twin.calibration.parameters import FREE, Free

FEWEST_UNITS = 2
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """One value of a type's data set, from its units."""

    parameter: str
    unit: str
    units: int  # whose logs determine it
    mean: float
    sigma: float  # of the mean
    spread: float  # from unit to unit, one sigma
    type_has: float | None


def estimates(records: Sequence[Record], at_ns: int) -> dict[str, list[Estimate]]:
    """For each type with calibrated units, the values that enough of them determine."""
    units: dict[str, list[Record]] = defaultdict(list)
    for name in dict.fromkeys(one.name for one in records if one.kind == "instance"):
        mine = [one for one in records if one.kind == "instance" and one.name == name]
        here = holding(mine, at_ns)
        if here is not None and "covariance" in here.arrays:
            units[here.type].append(here)
    found = {}
    for kind, mine in units.items():
        base = holding([r for r in records if r.kind == "type" and r.name == kind], at_ns)
        every = [_estimate(free, mine, base) for free in FREE]
        found[kind] = [one for one in every if one is not None]
    return found


def _estimate(free: Free, units: Sequence[Record], base: Record | None) -> Estimate | None:
    known = [_known(free, unit) for unit in units]
    values = np.array([one for one in known if one is not None])
    if len(values) < FEWEST_UNITS:
        return None
    mean, sigma, spread = _pooled(*values.T)
    has = None if base is None else base.data.get(free.table, {}).get(free.key)
    return Estimate(free.name, free.unit, len(values), mean, sigma, spread, has)


def _known(free: Free, unit: Record) -> tuple[float, float] | None:
    """A unit's value and its sigma, if its log determines it."""
    names: Sequence[str] = unit.provenance.get("parameters", ())
    if free.name not in unit.provenance.get("determined", ()) or free.name not in names:
        return None
    number = names.index(free.name)
    table: Mapping[str, float] = unit.data.get(free.table, {})
    return float(table[free.key]), float(np.sqrt(unit.arrays["covariance"][number, number]))


def _pooled(values: Floats, sigmas: Floats) -> tuple[float, float, float]:
    """Mean, its sigma, and the scatter between units."""
    own = 1.0 / np.maximum(sigmas, 1e-12) ** 2
    fixed = float(np.average(values, weights=own))
    excess = float(np.sum(own * (values - fixed) ** 2)) - (len(values) - 1)
    between = max(excess / float(own.sum() - np.sum(own**2) / own.sum()), 0.0)
    weights = 1.0 / (between + sigmas**2)
    mean = float(np.average(values, weights=weights))
    return mean, float(1.0 / np.sqrt(weights.sum())), float(np.sqrt(between))
