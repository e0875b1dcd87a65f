"""How predictions change with parameters: finite differences, all of them in one run.

Coordinates are multiples of a parameter's size: of a change worth an alarm, or of one sigma.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from twin.model.effects import apply, effect_of
from twin.model.theta import Theta

Floats = npt.NDArray[np.float64]
Predict = Callable[[Floats], Floats]  # points (parameters, n) to predictions (rows, n)
Change = tuple[str, Mapping[str, float]]  # of an effect: its parameters' changes from neutral

# Of a size, for a derivative. On a gripper it is within 3 % of what tiny steps give, and 13 % where
# something acts later; twice as large, it is twice as far off.
STEP = 0.05


def inside(x: Floats, high: Floats, step: float = STEP) -> Floats:
    """One step for each parameter: backwards where forwards would pass ``high``."""
    return np.where(x + step <= high, step, -step)


def points(x: Floats, steps: Floats) -> Floats:
    """``x``, then with one parameter after the other moved, (parameters, 1 + parameters)."""
    return np.column_stack([x, x[:, None] + np.diag(steps)])


def derivatives(values: Floats, steps: Floats | float = 1.0) -> tuple[Floats, Floats]:
    """Predictions (rows,) and their derivatives (rows, parameters), from those at ``points``."""
    return values[:, 0], (values[:, 1:] - values[:, :1]) / steps


def central(plus: Floats, minus: Floats) -> tuple[Floats, Floats]:
    """What one sigma of a normal variable moves, and what its square does.

    From the changes of predictions with each variable one sigma up, and down.
    """
    return (plus - minus) / 2.0, (plus + minus) / math.sqrt(2.0)


def sensitivities(predict: Predict, x: Floats, steps: Floats) -> tuple[Floats, Floats]:
    """Predictions at ``x`` and their derivatives, over ``steps``, from one call of ``predict``."""
    return derivatives(predict(points(x, steps)), steps)


def coefficients_at(theta: Theta, changes: Sequence[Change], at: Floats) -> Floats:
    """Coefficients (coefficients, n) with so many times each change, ``at`` is (changes, n).

    Raises ConfigError where that is out of an effect's bounds.
    """
    columns = []
    for point in at.T.tolist():
        here = theta
        for (name, sizes), times in zip(changes, point, strict=True):
            here = _changed(here, name, sizes, times) if times else here
        columns.append(here)
    return np.stack(columns, axis=1)


def _changed(theta: Theta, name: str, sizes: Mapping[str, float], times: float) -> Theta:
    parameters = [p for p in effect_of(name).parameters if p.name in sizes]
    values = {p.name: p.neutral(theta) + times * sizes[p.name] for p in parameters}
    return apply(theta, name, values)
