"""How well a calibrated twin follows the record it was fitted to, phase by phase.

What is left beside the model has two parts. What is the same in all cycles is the model's own
error. What differs from cycle to cycle is noise, quantisation and scatter: no model of this unit
can do better, so it is the floor of the record.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from twin.calibration.cycles import Cycles
from twin.model.dataset import DataSet, coefficients
from twin.model.theta import Theta
from twin.monitor.bins import Floats, Ints
from twin.signals import MBAR, Phase

GOOD, USABLE = 1.5, 2.0  # times the floor
LEAST_FLOOR = 0.3 * MBAR  # Pa; nobody needs a twin nearer than that
ODD = 2.0  # times the middle cycle's rms
FEWEST = 3  # cycles that show one place, to tell what is common from what scatters
WEAKENS = {
    Phase.IDLE: "leaks and heat while nothing is commanded",
    Phase.SUCTION: "suction, end vacuum, volume and valve response",
    Phase.HOLD: "leaks and the check valve",
    Phase.BLOW_OFF: "blow-off",
}


@dataclass(frozen=True)
class Residual:
    """What is left in one phase (Pa rms), the floor of the record there, and where most is left."""

    left: float
    floor: float
    most: float = 0.0  # Pa, measured minus expected in the mean cycle, where it is largest
    at: float = 0.0  # s after the phase began

    @property
    def times(self) -> float:
        """What is left over the floor."""
        return self.left / max(self.floor, LEAST_FLOOR)


@dataclass(frozen=True)
class Verdict:
    """``good``, ``usable`` or ``refused``, with what is left in each phase."""

    residuals: Mapping[Phase, Residual]

    @property
    def word(self) -> str:
        """The verdict in a word: by the worst phase."""
        worst = max(one.times for one in self.residuals.values())
        return "good" if worst <= GOOD else "usable" if worst <= USABLE else "refused"

    @property
    def weak(self) -> list[Phase]:
        """Phases that the twin follows less well than the record allows, the worst first."""
        weak = [phase for phase, one in self.residuals.items() if one.times > GOOD]
        return sorted(weak, key=lambda phase: -self.residuals[phase].times)


def judge(cycles: Cycles, data: DataSet, noise: float) -> Verdict:
    """Judge the twin of ``data`` on ``cycles``; ``noise`` (Pa) is that of single readings."""
    off = _off(cycles, coefficients(data))
    bins = cycles.bins
    places = bins.place_by_turn
    used = (bins.cycle >= 1) & np.isfinite(off)  # the model swings in in the first, as in ``_off``
    found = {}
    for phase in Phase:
        here = used & (_phase_of(bins.kind) == phase)
        if here.any():
            of, place = off[here], places[here]
            left, floor = _left(of, place, bins.cycle[here], bins.count[here], noise)
            since = bins.since[here] * float(np.median(cycles.dt))
            found[phase] = Residual(left, floor, *_most(of, place, since))
    return Verdict(found)


def _most(off: Floats, place: Ints, since: Floats) -> tuple[float, float]:
    """The largest mean (Pa) of places that enough cycles show, and when (s) that is."""
    _, number, many = np.unique(place, return_inverse=True, return_counts=True)
    mean = np.bincount(number, off) / many
    worst = int(np.argmax(np.abs(mean) * (many >= min(FEWEST, many.max()))))
    return float(mean[worst]), float(np.median(since[number == worst]))


def _off(cycles: Cycles, theta: Theta) -> Floats:
    """What is left (Pa) in each bin, with the nozzle switching as early or late as fits best.

    It is seen in the pressure a little off, the same in all cycles. The live twin is set on the
    pressure where it sees it.
    """
    early = range(-cycles.most_early, cycles.most_early + 1)
    off = cycles.off(np.repeat(theta[:, None], len(early), axis=1), early)
    usable = np.isfinite(off).all(axis=1) & (cycles.bins.cycle >= 1)
    left = np.average(off[usable] ** 2, axis=0, weights=cycles.bins.count[usable])
    best: Floats = off[:, int(np.argmin(left))]
    return best


def _phase_of(kind: Ints) -> Ints:
    """Phase of each kind of stretch; suction after a hold is suction."""
    phase: Ints = np.where(kind > max(Phase), int(Phase.SUCTION), kind)
    return phase


def _left(off: Floats, place: Ints, cycle: Ints, count: Ints, noise: float) -> tuple[float, float]:
    """Rms over rows (Pa) of what is left, and of the floor.

    The noise of single readings is added to the means of bins. Both are of the places that enough
    cycles show: where one goes on for longer than others, nobody knows what is scatter.

    A cycle in which something went wrong says little of the model and of the floor: it counts no
    more in either than one that is ODD times as far from the mean as the middle one.
    """
    _, number, many = np.unique(place, return_inverse=True, return_counts=True)
    mean = np.bincount(number, off) / many
    apart = (off - mean[number]) ** 2 * (many / np.maximum(many - 1, 1))[number]
    shown = (many >= FEWEST)[number]
    single = noise**2 * (1.0 - 1.0 / count)  # what averaging over a bin took away
    if not shown.any():
        return float(np.sqrt(np.average(off**2 + single, weights=count))), noise
    _, turn = np.unique(cycle, return_inverse=True)
    rows = np.bincount(turn, count * shown)
    each = np.bincount(turn, count * shown * (apart + single)) / np.maximum(rows, 1)
    middle = np.median(each[rows > 0])
    trust = np.minimum(1.0, ODD**2 * middle / np.maximum(each, middle))
    left = np.sum(trust * np.bincount(turn, count * shown * (off**2 + single))) / np.sum(rows)
    floor = np.mean((trust * each)[rows > 0])
    return float(np.sqrt(left)), float(np.sqrt(floor))
