"""Ambient pressure and temperature by a barometer and a thermometer; only this module follows them.

A data set has their values at the calibration of its unit. Measured values change the model's
surroundings and nothing else, as the effect ``ambient_pressure`` does. The twin takes them over at
each suction edge, the monitor at each cycle, a diagnosis once per log.
"""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import numpy.typing as npt

from twin.model import theta as c
from twin.model.compiled import compiled
from twin.model.dataset import DataSet
from twin.model.theta import Theta
from twin.monitor.breakpoints import renewed_every
from twin.quality import UNUSABLE
from twin.signals import MBAR, ZERO_C, Command, Phase, Samples, Ticks, sampling_ms

COLUMNS = (("ambient", c.AMBIENT), ("temperature", c.TEMPERATURE))


@compiled
def are_told(samples: Samples) -> bool:
    """Whether any row has a measured ambient pressure or temperature."""
    for row in range(len(samples)):
        if samples[row].ambient > 0.0 or samples[row].temperature > 0.0:
            return True
    return False


def told(samples: Samples) -> dict[str, float]:
    """Medians (Pa, K) of the measured surroundings by column; unmeasured columns are left out."""
    return medians_of([samples])


def medians_of(blocks: Iterable[Samples]) -> dict[str, float]:
    """``told`` for a stream; only measured values are kept in memory."""
    values: dict[str, list[npt.NDArray[np.float32]]] = {column: [] for column, _ in COLUMNS}
    for samples in blocks:
        if are_told(samples):
            for column, measured in values.items():
                measured.append(samples[column][samples[column] > 0.0])
    joined = {column: np.concatenate(measured) for column, measured in values.items() if measured}
    return {column: float(np.median(all_of)) for column, all_of in joined.items() if len(all_of)}


def following(theta: Theta, samples: Samples) -> Theta:
    """Coefficients with the surroundings measured in ``samples``; ``theta`` itself if none are."""
    return surrounded(theta, told(samples)) if are_told(samples) else theta


def surrounded(theta: Theta, medians: Mapping[str, float]) -> Theta:
    """Coefficients in surroundings from ``told``; ``theta`` itself if ``medians`` is empty."""
    if not medians:
        return theta
    theta = theta.copy()
    for column, coefficient in COLUMNS:
        theta[coefficient] = medians.get(column, theta[coefficient])
    return theta


def taken_in(data: DataSet, samples: Samples) -> DataSet:
    """A data set with the sampling of a record, and with its surroundings if measured.

    If rows repeat readings, its ``renewed_ms`` is set to the interval of new ones.
    """
    medians, ambient = told(samples), data.ambient
    if "ambient" in medians:
        ambient = ambient.model_copy(update={"pressure_mbar": round(medians["ambient"] / MBAR, 1)})
    if "temperature" in medians:
        celsius = round(medians["temperature"] - ZERO_C, 1)
        ambient = ambient.model_copy(update={"temperature_c": celsius})
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(samples["pressure"])
    sucks = (samples["commands"] == Command.SUCTION)[usable]
    repeats = renewed_every(samples["pressure"][usable].astype(np.float64), sucks)
    sampling = sampling_ms(samples)
    sensor = data.sensor.model_copy(
        update={"sampling_ms": sampling, "renewed_ms": repeats * sampling}
    )
    updated = data.model_copy(update={"ambient": ambient, "sensor": sensor})
    return DataSet.model_validate(updated.model_dump())


def stretches(samples: Samples, ticks: Ticks, before: int) -> Iterator[tuple[slice, Samples]]:
    """Slices of rows with constant surroundings, and the row that measured them.

    A slice begins at a suction edge, with that row. The first slice continues the surroundings of
    the rows before, so it has no such row; ``before`` is the phase of the last of these.
    """
    phase = np.concatenate([[np.uint8(before)], ticks["phase"]])
    before_suction = np.isin(phase[:-1], (Phase.IDLE, Phase.BLOW_OFF))
    edges = np.flatnonzero((phase[1:] == Phase.SUCTION) & before_suction).tolist()
    for first, last in zip([0, *edges], [*edges, len(samples)], strict=True):
        if last > first or not edges:
            yield slice(first, last), samples[first : first + 1] if first in edges else samples[:0]
