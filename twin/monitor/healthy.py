"""What healthy cycles of one unit are like: a calibration learns it and stores it with the data."""

from collections.abc import Mapping
from typing import Self

from pydantic import Field, model_validator

from twin.settings import Settings

NOT_COMMISSIONED = "not commissioned: causes are not named"


class Scatter(Settings):
    """What one figure is in healthy cycles: mean and one standard deviation, its unit in mbar."""

    mean: float
    sigma: float = Field(gt=0.0)


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
    """

    figures: Mapping[str, Scatter] = Field(default_factory=dict)
    error: Mapping[str, ModelError] = Field(default_factory=dict)
    scatter: Mapping[str, float] = Field(default_factory=dict)
    leftover: float = Field(1.0, gt=0.0)  # sigmas, by all this, that healthy cycles have
    uncertain: Mapping[str, tuple[float, ...]] = Field(default_factory=dict)

    @property
    def is_known(self) -> bool:
        """Whether the unit is commissioned: its healthy cycles were looked at."""
        return "suction_rms" in self.figures
