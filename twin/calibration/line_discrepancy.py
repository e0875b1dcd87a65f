"""Discrepancy of the model of a line: coefficients with the effects that it omits.

A calibration confuses these effects with its parameters. That shift of the parameters is a bias:
more cycles do not reduce it. So the intervals must include it.
"""

from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.model.parts import lumped
from twin.model.theta import Theta


def with_left_out(data: DataSet) -> list[Theta]:
    """Coefficients of ``data``, then the same with each omitted effect in turn.

    The gas in a line too short to oscillate still has inertia, which pushes while a jet or a
    blow-off sets in. And the model counts the wall of a tube's far end as the vessel's, film
    included.
    """
    theta = coefficients(data)
    total = lumped(data.system.parts, theta[c.SUCTION], theta[c.AMBIENT], theta[c.TEMPERATURE])
    pushed, bare = theta.copy(), theta.copy()
    inertance = data.system.line_inertia_factor * total.inertance
    pushed[c.INERTANCE] = inertance - theta[c.NEAR_INERTANCE]
    bare[c.AREA] = total.vessel_area
    return [theta, pushed, bare]
