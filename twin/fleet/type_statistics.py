"""Estimates a type's data from its calibrated units: mean and spread of each value.

The founding paper takes the mean of ten ejectors for the object-specific data of a type. Here a
unit counts by how well its log determines the value. With the scatter τ between units and the
uncertainty s of each, the weights are 1 / (τ² + s²). τ² is after DerSimonian and Laird (1986).
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
    """Estimates for each type with calibrated units, of values that enough units determine."""
    units: dict[str, list[Record]] = defaultdict(list)
    for name in dict.fromkeys(record.name for record in records if record.kind == "instance"):
        unit_records = [
            record for record in records if record.kind == "instance" and record.name == name
        ]
        current = holding(unit_records, at_ns)
        if current is not None and "covariance" in current.arrays:
            units[current.type].append(current)
    by_type = {}
    for kind, unit_records in units.items():
        base = holding(
            [record for record in records if record.kind == "type" and record.name == kind], at_ns
        )
        all_estimates = [_estimate(free, unit_records, base) for free in FREE]
        by_type[kind] = [record for record in all_estimates if record is not None]
    return by_type


def _estimate(free: Free, units: Sequence[Record], base: Record | None) -> Estimate | None:
    pairs = [_determined_value(free, unit) for unit in units]
    values = np.array([pair for pair in pairs if pair is not None])
    if len(values) < FEWEST_UNITS:
        return None
    mean, sigma, spread = _pooled(*values.T)
    type_value = None if base is None else base.data.get(free.table, {}).get(free.key)
    return Estimate(free.name, free.unit, len(values), mean, sigma, spread, type_value)


def _determined_value(free: Free, unit: Record) -> tuple[float, float] | None:
    """A unit's value and its sigma, if its log determines it."""
    names: Sequence[str] = unit.provenance.get("parameters", ())
    if free.name not in unit.provenance.get("determined", ()) or free.name not in names:
        return None
    number = names.index(free.name)
    table: Mapping[str, float] = unit.data.get(free.table, {})
    return float(table[free.key]), float(np.sqrt(unit.arrays["covariance"][number, number]))


def _pooled(values: Floats, sigmas: Floats) -> tuple[float, float, float]:
    """Mean, its sigma, and the scatter between units."""
    fixed_weights = 1.0 / np.maximum(sigmas, 1e-12) ** 2
    fixed = float(np.average(values, weights=fixed_weights))
    excess = float(np.sum(fixed_weights * (values - fixed) ** 2)) - (len(values) - 1)
    between = max(
        excess / float(fixed_weights.sum() - np.sum(fixed_weights**2) / fixed_weights.sum()), 0.0
    )
    weights = 1.0 / (between + sigmas**2)
    mean = float(np.average(values, weights=weights))
    return mean, float(1.0 / np.sqrt(weights.sum())), float(np.sqrt(between))
