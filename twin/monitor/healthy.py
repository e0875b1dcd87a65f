"""Distribution of a unit's healthy cycles: a calibration learns it and stores it with the data."""

import math
from collections.abc import Mapping
from typing import Self

from pydantic import Field, model_validator

from twin.settings import Settings

MEETS_MS = 3.0  # sigma of the time at which cups meet the part, unless learned. Chosen
UNSEEN_LEVEL_MBAR = 3.0  # sigma of a switching level that a person entered and no cycle shows
SURE = 0.9  # probability that a scatter is not larger than its stored sigma
NOT_COMMISSIONED = "not commissioned: causes are not named"


class Scatter(Settings):
    """Mean and scatter of one figure in some healthy cycles, in the figure's unit."""

    mean: float
    sigma: float = Field(gt=0.0)  # upper limit of the standard deviation, with confidence SURE
    cycles: int = Field(12, ge=2)  # number of cycles that showed the figure

    @property
    def estimate(self) -> float:
        """Standard deviation in these cycles."""
        return self.sigma / sure(self.cycles)


def sure(cycles: int) -> float:
    """Upper limit of a sigma over its estimate from so many cycles, with confidence SURE."""
    from scipy.special import chdtri  # noqa: PLC0415 - else each configuration loads SciPy

    return math.sqrt((cycles - 1) / float(chdtri(cycles - 1, SURE)))


class ModelError(Settings):
    """Error of the calibrated model in healthy cycles, over the time since a switching.

    One sigma per knot (mbar): of an error common to all cycles, and of each cycle's own error.
    """

    after_ms: tuple[float, ...]
    common_mbar: tuple[float, ...]
    alone_mbar: tuple[float, ...]

    @model_validator(mode="after")
    def _as_long(self) -> Self:
        if not len(self.after_ms) == len(self.common_mbar) == len(self.alone_mbar) > 0:
            raise ValueError("after_ms, common_mbar and alone_mbar need as many values each")
        return self


class Healthy(Settings):
    """Distribution of healthy cycles.

    ``figures`` are the mean and scatter of each figure. ``error`` is the model's error by kind of
    stretch. ``scatter`` maps an effect to one sigma of its size from cycle to cycle. ``uncertain``
    is the lower Cholesky factor of the data set's covariance, a row for each value. ``leaky`` are
    changes of values to a larger leak with more suction, if the record fits that as well.
    ``unseen_level_mbar`` is one sigma of a switching level that no healthy cycle shows.
    ``meets_ms`` is one sigma of the time at which cups meet the part, if that is after suction
    began. ``rounding_mbar`` is one sigma of the rounding error in a mean of many readings.
    ``key_figures`` are those that have limits, and the measured supply, in their own units.
    """

    figures: Mapping[str, Scatter] = Field(default_factory=dict)
    error: Mapping[str, ModelError] = Field(default_factory=dict)
    scatter: Mapping[str, float] = Field(default_factory=dict)
    leftover: float = Field(1.0, gt=0.0)  # reduced chi of healthy cycles by this distribution
    uncertain: Mapping[str, tuple[float, ...]] = Field(default_factory=dict)
    leaky: Mapping[str, float] = Field(default_factory=dict)
    unseen_level_mbar: float = Field(UNSEEN_LEVEL_MBAR, gt=0.0)
    meets_ms: float = Field(MEETS_MS, gt=0.0)
    rounding_mbar: float = Field(0.0, ge=0.0)
    key_figures: Mapping[str, Scatter] = Field(default_factory=dict)

    @property
    def is_known(self) -> bool:
        """Whether the unit is commissioned: its healthy cycles were looked at.

        Phases too short to be judged by the monitor have no figures, but errors of the model.
        """
        return bool(self.error) or "suction_rms" in self.figures
