"""Ambient pressure and temperature of a stream of rows; only this module follows them.

A data set has their values at the calibration of its unit. Measured values change the model's
surroundings and nothing else, as the effect ``ambient_pressure`` does. The twin takes them over at
each suction edge, the monitor at each cycle, a diagnosis once per log. Twin and monitor also follow
an absolute sensor in an opened idle, if there is no barometer: at the pace of weather, and no
faster, since a reading that changes faster is a fault.
"""

import math
import re
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.model import theta as c
from twin.model.compiled import compiled
from twin.model.dataset import DataSet
from twin.model.theta import Theta
from twin.monitor.breakpoints import renewed_every
from twin.quality import UNUSABLE
from twin.signals import (
    MBAR,
    NS,
    ZERO_C,
    Command,
    Phase,
    Samples,
    Ticks,
    joined,
    sampling_ms,
)

COLUMNS = (("ambient", c.AMBIENT), ("temperature", c.TEMPERATURE))
# Pa/s, fastest change of ambient pressure by weather. Forecasts for shipping call more than 6 hPa
# in 3 hours "very rapidly" (Met Office, Marine forecasts glossary); this is twice as fast.
PACE = 4.0 * MBAR / 3600.0
# Pa, farthest weather from that of the calibration: 2.7 sigmas of the prior's 15 mbar.
RANGE = 40.0 * MBAR
# Pa, by which an idle of a healthy rig may differ from the followed ambient pressure. Commissioning
# calls a system opened if its idles are within 2 mbar.
APART = 1.0 * MBAR
SIGMAS = 4.0  # the same, of the noise of an idle's mean
STILL = 0.5 * MBAR  # Pa, largest move between the halves of a settled idle's last rows
REST_ROWS = 40  # these last rows: two periods of the mains in rows 1 ms apart
# Phases as bytes are searched in a microsecond, as NumPy does not in a short block.
_IDLE = b"%c" % Phase.IDLE
_BEFORE_SUCTION = re.compile(b"[%c%c](?=%c)" % (Phase.IDLE, Phase.BLOW_OFF, Phase.SUCTION))


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


@dataclass
class OpenedIdle:
    """Ambient pressure (Pa) by the readings of an absolute sensor in the idles of an opened system.

    It follows the changes of the idle as fast as weather can change. What is faster is no weather,
    and stays so: it is left to the sensor, whatever time passes. Nothing is followed until one idle
    agrees with the calibration, since the age of that is unknown.
    """

    calibrated: float
    ambient: float  # followed
    _left: float | None = None  # Pa of the reading that are no weather; None: no idle agreed yet
    _last_ns: int = 0  # time of the last idle

    def take(self, reading: float, noise: float, now_ns: int) -> None:
        """Follow the next idle: its mean (Pa, less the sensor's known offset) and sigma of that."""
        apart, left = APART + SIGMAS * noise, self._left
        if left is None:
            if abs(reading - self.ambient) <= apart:  # a first idle as the calibration left it
                self._left = 0.0 if self._last_ns else reading - self.ambient
            self._last_ns = now_ns
            return
        most = PACE * max(now_ns - self._last_ns, 0) * NS
        moved = self.ambient + min(max(reading - left - self.ambient, -most), most)
        self.ambient = min(max(moved, self.calibrated - RANGE), self.calibrated + RANGE)
        if abs(reading - left - self.ambient) > apart:
            self._left = reading - self.ambient
        self._last_ns = now_ns


class Surroundings:
    """Coefficients in the surroundings of a stream, taken over at each suction edge.

    With ``idle`` they follow an opened idle, if the sensor is absolute, parts are released, and no
    barometer is seen.
    """

    def __init__(self, theta: Theta, *, idle: bool = True) -> None:
        self._theta = theta
        self._idle: OpenedIdle | None = None
        if idle and not theta[c.GAUGE] and math.isfinite(theta[c.RELEASE]):
            self._idle = OpenedIdle(float(theta[c.AMBIENT]), float(theta[c.AMBIENT]))
        self._phase = _IDLE  # of the newest row
        self._tail = deque[Samples]()  # the newest rows in parts, if they are idle

    def over(self, samples: Samples, ticks: Ticks) -> list[tuple[slice, Theta]]:
        """Slices of the next rows, with the coefficients in each."""
        slices, first = [], 0
        phases = self._phase + ticks["phase"].tobytes()  # of the row before, and of these
        if are_told(samples) or self._idle:  # asked first, so that it is compiled with the twin
            for found in _BEFORE_SUCTION.finditer(phases):
                edge = found.start()
                if edge > first:
                    slices.append((slice(first, edge), self._theta))
                self._take(samples[edge : edge + 1], self._rest(samples, phases, edge))
                first = edge
            self._keep(samples, len(phases.rstrip(_IDLE)) - 1)
        self._phase = phases[-1:]
        return [*slices, (slice(first, len(samples)), self._theta)]

    def _rest(self, samples: Samples, phases: bytes, edge: int) -> Samples:
        """The last rows of idle before an edge; none if they are too few."""
        first = max(edge - REST_ROWS, 0)
        if phases.count(_IDLE, first + 1, edge + 1) < edge - first:
            return samples[:0]
        rest = samples[first:edge]
        return rest if edge >= REST_ROWS else joined(*self._tail, rest)[-REST_ROWS:]

    def _keep(self, samples: Samples, first: int) -> None:
        """Keep the newest rows: those from ``first`` on are idle, all of them at −1."""
        if first >= 0:
            self._tail.clear()
        if max(first, 0) < len(samples):
            self._tail.append(samples[max(first, 0) :])
            while sum(map(len, self._tail)) - len(self._tail[0]) >= REST_ROWS:
                self._tail.popleft()

    def _take(self, edge: Samples, rest: Samples) -> None:
        """Take over what the row of a suction edge measures, or the last rows of idle before."""
        self._theta = following(self._theta, edge)
        if edge["ambient"][0] > 0.0:
            self._idle = None
        if self._idle is None or len(rest) < REST_ROWS or rest["quality"].any():
            return
        readings = rest["pressure"].astype(np.float64)
        halves = readings.reshape(2, -1).mean(axis=1)
        if not abs(halves[1] - halves[0]) <= STILL:  # or one is NaN
            return
        noise = float(readings.std()) / math.sqrt(REST_ROWS)
        reading = float(readings.mean() - self._theta[c.SENSOR_OFFSET])
        self._idle.take(reading, noise, int(rest["host_ns"][-1]))
        self._theta = self._theta.copy()
        self._theta[c.AMBIENT] = self._idle.ambient
