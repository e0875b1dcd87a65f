"""What the model leaves out of a line, as coefficients that have it in.

A calibration cannot tell it from what it fits. Where that moves the parameters is no error of the
log, so no number of cycles makes it smaller; it belongs into the intervals all the same.
"""

from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.model.system import lumped
from twin.model.theta import Theta


def with_left_out(data: DataSet) -> list[Theta]:
    """Coefficients of ``data`` and then, one by one, with what the model leaves out.

    The gas in a line too short to swing still has inertia, which pushes while a jet or a blow-off
    sets in. And the wall at the far end of a tube is taken for the vessel's, film and all, as far
    out as half of what is not half-way along.
    """
    theta = coefficients(data)
    total = lumped(data.system.parts, theta[c.SUCTION], theta[c.AMBIENT], theta[c.TEMPERATURE])
    pushed, bare = theta.copy(), theta.copy()
    inertance = data.system.line_inertia_factor * total.inertance
    pushed[c.INERTANCE] = inertance - theta[c.NEAR_INERTANCE]
    bare[c.AREA] = total.vessel_area
    return [theta, pushed, bare]
