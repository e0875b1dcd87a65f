"""What healthy cycles of one unit are like: a calibration learns it and stores it with the data."""

import math
from collections.abc import Mapping
from typing import Self

from pydantic import Field, model_validator

from twin.settings import Settings

MEETS_MS = 3.0  # one sigma of when cups come upon a part, unless it was learned. Chosen
UNSEEN_LEVEL_MBAR = 3.0  # one sigma of a switching level that no cycle shows and somebody told
SURE = 0.9  # that a scatter is no larger than is told of it
NOT_COMMISSIONED = "not commissioned: causes are not named"


class Scatter(Settings):
    """What one figure was in some healthy cycles: its mean, and how it scatters; in its unit."""

    mean: float
    sigma: float = Field(gt=0.0)  # one standard deviation, which is SURE not to be exceeded
    cycles: int = Field(12, ge=2)  # that showed it

    @property
    def estimate(self) -> float:
        """One standard deviation as these cycles had it."""
        return self.sigma / sure(self.cycles)


def sure(cycles: int) -> float:
    """How many times its estimate from so many cycles a sigma may be, with SURE."""
    from scipy.special import chdtri  # noqa: PLC0415 - SciPy would come with each configuration

    return math.sqrt((cycles - 1) / float(chdtri(cycles - 1, SURE)))


class ModelError(Settings):
    """How far the calibrated model is off in healthy cycles, over time since a switching.

    One value per knot: as much in all cycles alike, and differently from cycle to cycle.
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
    """What healthy cycles are like.

    ``figures`` of a cycle; the model's ``error`` by kind of stretch; what differs from cycle to
    cycle (``scatter``: effect to one sigma of its size); in which ways the data set is
    ``uncertain`` (the lower Cholesky factor of its covariance, a row for each value).
    ``unseen_level_mbar`` is one sigma of a switching level that no healthy cycle shows, and
    ``meets_ms`` of the time at which cups come upon the part, if that is after suction began.
    ``rounding_mbar`` is one sigma of what rounding leaves in a mean of many readings.
    ``key_figures`` are those that have limits, in their own units.
    """

    figures: Mapping[str, Scatter] = Field(default_factory=dict)
    error: Mapping[str, ModelError] = Field(default_factory=dict)
    scatter: Mapping[str, float] = Field(default_factory=dict)
    leftover: float = Field(1.0, gt=0.0)  # sigmas, by all this, that healthy cycles have
    uncertain: Mapping[str, tuple[float, ...]] = Field(default_factory=dict)
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
