"""Uncertainty of a unit's data set: shifted by one sigma, drawn, or scattered as cycles are."""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from pydantic.fields import FieldInfo

from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.model.effects import apply, effect_of
from twin.model.theta import Theta
from twin.monitor.healthy import Healthy
from twin.monitor.scatter_covariance import ON_THE_PART_S, comes_on_part
from twin.signals import MS

# Values by which suction and end pressure follow the supply: coefficient and relative sigma. They
# are the type's, since a unit is measured at one supply only.
SUPPLY_LAW: Mapping[str, tuple[int, float]] = {
    "end_pressure_slope": (c.END_SLOPE, 0.5),
    "curvature": (c.SUPPLY_CURVATURE, 0.5),
    "optimum_bar": (c.SUPPLY_OPTIMUM, 0.03),
}
# Share of a value's sigma by which a way must move it to tie it to others. Chosen: what a record
# shows of a value, it shows of its neighbours as well; what it does not, stands alone.
TIES = 0.3
OF_THE_WAY = 0.9  # largest share of the way to its bound by which a value is moved
_BOUNDS = ("ge", "gt", "le", "lt")


class Shift(NamedTuple):
    """Coefficients one sigma to either side, by one independent uncertainty of a data set."""

    up: Theta
    down: Theta
    tied: bool = False  # several values move together, as only the calibration's record tells
    is_far: bool = False  # another explanation of that record, with nothing between

    def near(self, theta: Theta, share: float) -> Theta:
        """Coefficients a share of the way up from ``theta``; those themselves if it is far."""
        return theta if self.is_far else theta + share * (self.up - theta)


def shifted(data: DataSet, healthy: Healthy) -> Iterator[Shift]:
    """Each independent uncertainty of the data set.

    Those of calibration come with those of SUPPLY_LAW, since only one supply was measured.
    """
    for key, (_, share) in SUPPLY_LAW.items():
        value = getattr(data.supply, key)
        yield Shift(*_coefficients(both_sides(data, {f"supply.{key}": share * value})))
    rows = list(healthy.uncertain.items())
    for way in range(len(rows)):
        tied = any(abs(row[way]) > TIES * math.hypot(*row) for _, row in rows[way + 1 :])
        sides = both_sides(data, {name: row[way] for name, row in rows[way:]})
        yield Shift(*_coefficients(sides), tied)
    if healthy.leaky:
        leaky, _ = both_sides(data, healthy.leaky)
        yield Shift(coefficients(leaky), coefficients(data), tied=True, is_far=True)


def drawn(data: DataSet, healthy: Healthy, rng: np.random.Generator) -> Theta:
    """Coefficients drawn from all uncertainties of ``shifted`` at once, scattered as a cycle."""
    rows = list(healthy.uncertain.items())
    sigmas = rng.standard_normal(len(rows))
    changes = {name: float(np.dot(row, sigmas[: len(row)])) for name, row in rows}
    for key, (_, share) in SUPPLY_LAW.items():
        value = getattr(data.supply, key)
        changes[f"supply.{key}"] = share * value * float(rng.standard_normal())
    return scattered(coefficients(_changed(data, changes, 1.0)), healthy, rng)


def scattered(theta: Theta, healthy: Healthy, rng: np.random.Generator) -> Theta:
    """Coefficients of one cycle, drawn from the scatter of healthy cycles.

    Effects have one sign only. Here they act in both directions, linearly in the coefficients. No
    coefficient turns negative.
    """
    for name, sigma in healthy.scatter.items():
        parameter = effect_of(name).parameters[0]
        moved = apply(theta, name, {parameter.name: parameter.neutral(theta) + sigma}) - theta
        changed = theta + float(rng.standard_normal()) * moved
        theta = np.where(theta >= 0.0, np.maximum(changed, 0.0), changed)
    if comes_on_part(theta):
        theta = theta.copy()
        later = float(rng.standard_normal()) * healthy.meets_ms * MS
        theta[c.CONTACT] = max(theta[c.CONTACT] + later, ON_THE_PART_S)
    return theta


def both_sides(data: DataSet, changes: Mapping[str, float]) -> tuple[DataSet, DataSet]:
    """Data sets with values (``table.key``) changed by ``changes``, and by their negatives."""
    return _changed(data, changes, 1.0), _changed(data, changes, -1.0)


def _coefficients(sides: tuple[DataSet, DataSet]) -> tuple[Theta, Theta]:
    up, down = sides
    return coefficients(up), coefficients(down)


def _changed(data: DataSet, changes: Mapping[str, float], sign: float) -> DataSet:
    """A changed data set; each value keeps its bounds, but the whole is not validated."""
    for name, change in changes.items():
        table, key = name.split(".")
        part = getattr(data, table)
        value = _within(type(part).model_fields[key], getattr(part, key), sign * change)
        data = data.model_copy(update={table: part.model_copy(update={key: value})})
    return data


def _within(field_info: FieldInfo, value: float, change: float) -> float:
    """The changed value, at most OF_THE_WAY towards a bound: no flow or volume turns negative."""
    bounds = (
        getattr(constraint, name, None) for constraint in field_info.metadata for name in _BOUNDS
    )
    for bound in (limit for limit in bounds if limit is not None):
        if (bound - value) * change > 0.0:
            change = math.copysign(min(abs(change), OF_THE_WAY * abs(bound - value)), change)
    return value + change
