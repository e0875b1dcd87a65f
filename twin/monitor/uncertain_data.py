"""The data set of a unit as it may be: shifted by one sigma, drawn, or as cycles scatter."""

import math
from collections.abc import Iterator, Mapping

import numpy as np
from pydantic.fields import FieldInfo

from twin.model.dataset import DataSet, coefficients
from twin.model.effects import apply, effect_of
from twin.model.theta import Theta
from twin.monitor.healthy import Healthy

# How suction and end pressure follow the supply is the type's; of its value, one sigma.
SUPPLY_UNKNOWN = {"end_pressure_slope": 0.5, "curvature": 0.5, "optimum_bar": 0.03}
OF_THE_WAY = 0.9  # to its bound, at most, an uncertain value is moved
_BOUNDS = ("ge", "gt", "le", "lt")


def shifted(data: DataSet, healthy: Healthy) -> Iterator[tuple[Theta, Theta]]:
    """Coefficients one sigma to either side, each way that calibration left the data set open.

    And each that calibration says nothing about: only one supply was ever measured.
    """
    for key, share in SUPPLY_UNKNOWN.items():
        value = getattr(data.supply, key)
        yield _both_sides(data, {f"supply.{key}": share * value})
    rows = healthy.uncertain
    for way in range(len(rows)):
        yield _both_sides(data, {name: row[way] for name, row in list(rows.items())[way:]})


def drawn(data: DataSet, healthy: Healthy, rng: np.random.Generator) -> Theta:
    """Coefficients drawn from all ways of ``shifted`` at once, which scatter as cycles do."""
    rows = list(healthy.uncertain.items())
    sigmas = rng.standard_normal(len(rows))
    changes = {name: float(np.dot(row, sigmas[: len(row)])) for name, row in rows}
    for key, share in SUPPLY_UNKNOWN.items():
        value = getattr(data.supply, key)
        changes[f"supply.{key}"] = share * value * float(rng.standard_normal())
    return scattered(coefficients(_changed(data, changes, 1.0)), healthy, rng)


def scattered(theta: Theta, healthy: Healthy, rng: np.random.Generator) -> Theta:
    """Coefficients of one cycle, drawn from how healthy ones scatter.

    Effects have one sign only. Here they act either way, in proportion to their coefficients, and
    none of these gets negative that is not so already.
    """
    for name, sigma in healthy.scatter.items():
        parameter = effect_of(name).parameters[0]
        moved = apply(theta, name, {parameter.name: parameter.neutral(theta) + sigma}) - theta
        changed = theta + float(rng.standard_normal()) * moved
        theta = np.where(theta >= 0.0, np.maximum(changed, 0.0), changed)
    return theta


def _both_sides(data: DataSet, changes: Mapping[str, float]) -> tuple[Theta, Theta]:
    """Coefficients with values (``table.key``) changed by so much, and by as much less."""
    up, down = (_changed(data, changes, sign) for sign in (1.0, -1.0))
    return coefficients(up), coefficients(down)


def _changed(data: DataSet, changes: Mapping[str, float], sign: float) -> DataSet:
    """A data set, unchecked as a whole: it need be no ejector. Each value keeps to its bounds."""
    for name, change in changes.items():
        table, key = name.split(".")
        part = getattr(data, table)
        value = _within(type(part).model_fields[key], getattr(part, key), sign * change)
        data = data.model_copy(update={table: part.model_copy(update={key: value})})
    return data


def _within(field_info: FieldInfo, value: float, change: float) -> float:
    """A value changed, but at most by OF_THE_WAY to a bound: no flow or volume is negative."""
    bounds = (getattr(one, name, None) for one in field_info.metadata for name in _BOUNDS)
    for bound in (one for one in bounds if one is not None):
        if (bound - value) * change > 0.0:
            change = math.copysign(min(abs(change), OF_THE_WAY * abs(bound - value)), change)
    return value + change
