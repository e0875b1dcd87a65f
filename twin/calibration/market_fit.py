"""A fit within what all ejectors on the market differ by, and its verdict on the record."""

from collections.abc import Callable, Sequence

import numpy as np
from pydantic import ValidationError

from twin.calibration.cycles import Cycles
from twin.calibration.fit import Fitted, fit_from_afar
from twin.calibration.parameters import Free
from twin.calibration.verdict import Verdict, judge
from twin.errors import ConfigError
from twin.model.dataset import DataSet
from twin.signals import Samples


def market_fit(
    samples: Samples,
    guesses: Sequence[DataSet],
    free: tuple[Free, ...],
    progress: Callable[[str], None],
) -> Fitted:
    """The best fit from ``guesses``; ConfigError if it ends at values that no ejector has."""
    try:
        return fit_from_afar(samples, guesses, progress, free)
    except (ValidationError, np.linalg.LinAlgError) as error:
        raise ConfigError(
            "the fit ends at values that no ejector has: this is no record of the parts that"
            " [data.system] lists, or of more than one unit",
            "check volumes, tubes and the sensor's place; use a record of one unit",
        ) from error


def judged(
    samples: Samples, noise: float, fitted: Fitted, progress: Callable[[str], None]
) -> tuple[Fitted, Cycles, Verdict]:
    """A fit, the cycles as it sees them, and how well it follows them."""
    progress("judging the fit")
    cycles = Cycles.found(samples, fitted.data)
    return fitted, cycles, judge(cycles, fitted.data, noise)
