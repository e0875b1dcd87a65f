"""The measured supply pressure: at rest, and beside that of the healthy cycles.

A data set has the supply pressure of its calibration. If a gauge was there, what healthy cycles are
like has its mean while the nozzle was on. A gauge of today is compared with that: it is the same
gauge at the same place, so its offset cancels out, and so does what is lost before the nozzle.
"""

import math

import numpy as np
import numpy.typing as npt

from twin.model.dataset import DataSet, Supply
from twin.monitor.healthy import Healthy
from twin.signals import BAR, Command, Phase, Samples, Ticks

SUPPLY = "supply"  # the key figure: mean supply pressure (bar gauge) while the nozzle was on
# bar gauge: the flow of a nozzle into ambient pressure is sonic from 0.9 bar on (critical ratio
# 0.528), and a data set has 10 at most. Elsewhere no ejector is run, so the gauge is wrong.
LEAST, MOST = 0.9, 10.0
STEP = 0.05  # bar; a gauge is not more exact

Floats = npt.NDArray[np.float64]


def lower_by(healthy: Healthy, samples: Samples, ticks: Ticks) -> float:
    """How much less (bar) the gauge reads with the nozzle on than in healthy cycles.

    NaN if it is not measured, or was not in the healthy cycles.
    """
    usual = healthy.key_figures.get(SUPPLY)
    if usual is None:
        return math.nan
    readings = with_nozzle_on(samples, ticks)
    return usual.mean - float(np.mean(readings)) if len(readings) else math.nan


def is_gauge(samples: Samples) -> bool:
    """Whether the supply is measured: a PLC that has no gauge may give a constant instead.

    A gauge that reads the same to the bit over all rows cannot be told from a constant.
    """
    readings = samples["supply"][np.isfinite(samples["supply"])]
    return bool((readings != readings[:1]).any())


def is_known(healthy: Healthy) -> bool:
    """Whether there was a gauge when the unit was calibrated: its data set has what that read."""
    return SUPPLY in healthy.key_figures


def with_nozzle_on(samples: Samples, ticks: Ticks) -> Floats:
    """Readings (bar gauge) while the nozzle was on; empty if it is not measured."""
    readings = samples["supply"][ticks["phase"] == Phase.SUCTION].astype(np.float64) / BAR
    measured: Floats = readings[np.isfinite(readings)]
    return measured


def at_rest(samples: Samples) -> float:
    """Median reading (bar gauge) while nothing is commanded; NaN if it is not measured."""
    idle = (samples["commands"] & (Command.SUCTION | Command.BLOW_OFF)) == 0
    readings = samples["supply"][idle & np.isfinite(samples["supply"])].astype(np.float64)
    return float(np.median(readings)) / BAR if len(readings) else math.nan


def is_possible(supply: float) -> bool:
    """Whether an ejector can be run at a supply (bar gauge); not if it is NaN."""
    return LEAST <= supply <= MOST


def supplied(data: DataSet, samples: Samples) -> DataSet:
    """A data set with the supply pressure that a record has measured at rest, to 0.05 bar.

    An optimum that nobody configured follows, as it would from the configuration. Without a gauge,
    or with one that cannot be right at rest, it is ``data`` itself.
    """
    measured = at_rest(samples)
    if not is_gauge(samples) or not is_possible(measured):
        return data
    measured = round(round(measured / STEP) * STEP, 2)
    if measured <= data.supply.droop_bar:
        return data
    told = data.supply.model_dump(exclude_unset=True) | {"pressure_bar": measured}
    return data.model_copy(update={"supply": Supply.model_validate(told)})
