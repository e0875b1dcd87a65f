"""Ambient pressure and temperature as a barometer and a thermometer tell them: followed here alone.

A data set has what they were when its unit was calibrated. What they are now changes the model's
surroundings and nothing else, as the effect ``ambient_pressure`` does. The twin follows at each
suction edge, the monitor cycle by cycle, a diagnosis log by log.
"""

from collections.abc import Iterator

import numpy as np

from twin.model import theta as c
from twin.model.compiled import compiled
from twin.model.dataset import DataSet
from twin.model.theta import Theta
from twin.signals import MBAR, ZERO_C, Phase, Samples, Ticks, sampling_ms

COLUMNS = (("ambient", c.AMBIENT), ("temperature", c.TEMPERATURE))


@compiled
def are_told(samples):  # type: ignore[no-untyped-def]
    """Whether any row tells of the surroundings; nearly always none does."""
    for row in range(len(samples)):
        if samples[row].ambient > 0.0 or samples[row].temperature > 0.0:
            return True
    return False


def told(samples: Samples) -> dict[str, float]:
    """Medians (Pa, K) of what is told, by column; what nobody tells is left out."""
    found = {}
    for column, _ in COLUMNS:
        values = samples[column][samples[column] > 0.0]
        if len(values):
            found[column] = float(np.median(values))
    return found


def following(theta: Theta, samples: Samples) -> Theta:
    """Coefficients with the surroundings that rows tell of; the same ones where they tell none."""
    if not are_told(samples):
        return theta
    found = told(samples)
    theta = theta.copy()
    for column, coefficient in COLUMNS:
        theta[coefficient] = found.get(column, theta[coefficient])
    return theta


def taken_in(data: DataSet, samples: Samples) -> DataSet:
    """A data set as a record was taken: how often, and in which surroundings if it tells them."""
    found, ambient = told(samples), data.ambient
    if "ambient" in found:
        ambient = ambient.model_copy(update={"pressure_mbar": round(found["ambient"] / MBAR, 1)})
    if "temperature" in found:
        celsius = round(found["temperature"] - ZERO_C, 1)
        ambient = ambient.model_copy(update={"temperature_c": celsius})
    sensor = data.sensor.model_copy(update={"sampling_ms": sampling_ms(samples)})
    taken = data.model_copy(update={"ambient": ambient, "sensor": sensor})
    return DataSet.model_validate(taken.model_dump())


def stretches(samples: Samples, ticks: Ticks, before: int) -> Iterator[tuple[slice, Samples]]:
    """Rows in which the surroundings are taken not to change, and those that tell them.

    They begin at a suction edge, with the row that tells them; the first ones go on as the rows
    before did, of which the last had the phase ``before``, and nothing tells them anew.
    """
    phase = np.concatenate([[np.uint8(before)], ticks["phase"]])
    before_suction = np.isin(phase[:-1], (Phase.IDLE, Phase.BLOW_OFF))
    edges = np.flatnonzero((phase[1:] == Phase.SUCTION) & before_suction).tolist()
    for first, last in zip([0, *edges], [*edges, len(samples)], strict=True):
        if last > first or not edges:
            yield slice(first, last), samples[first : first + 1] if first in edges else samples[:0]
