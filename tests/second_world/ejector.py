"""An ejector stage by its momentum balance; no curve of suction capacity is put in.

The primary jet and the sucked air mix in a tube of constant area (Keenan, Neumann, Lustwerk 1950):

    p_c·A + J = p_b·A + k·(ṁ_total)²/(ρ·A)

`J` is the momentum of the jet, `p_c` and `p_b` the pressures before and behind, `k` holds wall
friction and what the diffuser regains. The entrainment ratio follows, and drops to zero at one
compression ratio. The plateau is Fabri's: the sucked air chokes in the ring that the expanding jet
leaves open. A second stage takes the mixed stream of the first one as its jet.
"""

import math

from second_world.compiled import compiled
from second_world.constants import CHOKED, GAMMA, R_AIR

SOFT_ROOT = 400.0  # Pa; the root of the momentum balance is linear within this of zero
CHOKED_BACK = 0.472  # share of the pressure behind above which backward flow is choked
ROUNDING = 0.06  # width of the change from momentum-limited to choked, share of the choked flow


@compiled
def jet(p_nozzle, p_chamber, t_supply, flow, velocity_coefficient):
    """Momentum (N) and area (m²) of the primary jet once it has expanded to the chamber."""
    if p_nozzle <= p_chamber or flow <= 0.0:
        return 0.0, 0.0
    cold = (p_chamber / p_nozzle) ** ((GAMMA - 1.0) / GAMMA)
    ideal = math.sqrt(2.0 * GAMMA / (GAMMA - 1.0) * R_AIR * t_supply * (1.0 - cold))
    speed = max(ideal * velocity_coefficient, 1.0)
    return flow * speed, flow * R_AIR * t_supply * cold / (p_chamber * speed)


@compiled
def stage(  # noqa: PLR0917
    p_chamber, t_chamber, p_behind, t_mixed, momentum, primary, jet_area, area, losses
):
    """Air sucked in kg/s (negative: it flows back) and its slope with chamber pressure."""
    drive = p_chamber - p_behind + momentum / area
    drive = max(drive, -CHOKED_BACK * p_behind)
    scale = area * math.sqrt(p_behind / (R_AIR * t_mixed * losses))
    soft = math.sqrt(math.sqrt(drive * drive + SOFT_ROOT * SOFT_ROOT))
    by_momentum = scale * drive / soft - primary
    ring = max(area - jet_area, 0.01 * area)
    by_choking = ring * CHOKED * p_chamber / math.sqrt(t_chamber)
    width = ROUNDING * by_choking
    gap = by_momentum - by_choking
    spread = math.sqrt(gap * gap + width * width)
    sucked = 0.5 * (by_momentum + by_choking - spread)
    share = 0.5 * (1.0 - gap / spread)
    return sucked, share * 0.5 * scale / soft + (1.0 - share) * by_choking / p_chamber
