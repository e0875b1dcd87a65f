"""Picture of a mechanism: its size over what drives it, as held-out cycles show it.

Values of the driver are divided into groups. In each, the mechanism's place gets a size of its own
beside the law; one linear step for all groups at once fits these to what the law leaves of the
held-out cycles. A pressure remembers the flows before it, so each group alone would be blamed for
what others left.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.diagnosis.drawing import AFTER, BAND, MEASURED, QUIET, Picture, empty, legend
from twin.diagnosis.evidence import Evidence
from twin.diagnosis.mechanism_share import in_bins
from twin.diagnosis.pictures import Found
from twin.diagnosis.residual_covariance import covariance, levels
from twin.diagnosis.text import mechanism_of, spoken
from twin.inference.levels import SIGMAS_95
from twin.languages.texts import tr
from twin.model import kernel
from twin.model import mechanism as m
from twin.model import theta as c
from twin.model.theta import Theta
from twin.monitor.bins import Floats, Ints
from twin.signals import MBAR, Phase

GROUPS, FEWEST = 8, 4  # of the driver's values; bins of held-out cycles in one
POINTS = 60  # of the law
PROBE = 0.2  # of the size: the step of a derivative
UNSEEN = 1e-9  # of the clearest dot's information: a dot with less is not seen at all
LEAST_END = 1.0  # mbar of vacuum at which a relay ends at least, as in the model
SUREST = 0.7  # of the size: one sigma of a dot that still says something


@dataclass(frozen=True)
class RefittedSize:
    """A size over its driver, by law and as held-out cycles show it, in the size's unit."""

    parameter: str
    unit: str
    word: str  # what it is a size of
    value: float
    low: float  # 95 % interval
    high: float
    x: Floats  # of each group
    law: Floats  # mean share there
    y: Floats  # size there, refitted
    sigma: Floats

    @property
    def agrees(self) -> npt.NDArray[np.bool_]:
        """Whether each dot is within 95 % of the law, whose size is uncertain as well."""
        band = self.law * (self.high - self.low) / 2.0
        far = np.abs(self.y - self.law * self.value)
        return far <= np.hypot(SIGMAS_95 * self.sigma, band)


@dataclass(frozen=True)
class Inferred:
    """A mechanism's driver and share in each bin, and its sizes."""

    mechanism: m.Mechanism
    driver: str  # axis label
    x: Floats  # of each bin; NaN where the mechanism is not driven
    share: Floats
    levels: tuple[float, float] | None  # mbar, where it begins and ends, of a relay
    sizes: tuple[RefittedSize, ...]

    @property
    def agreeing(self) -> tuple[int, int]:
        """How many dots are within 95 % of the law, and how many there are."""
        agrees = np.concatenate([size.agrees for size in self.sizes])
        return int(agrees.sum()), len(agrees)


def inferred(diagnosed: Found) -> Inferred:
    """Refit the sizes of an answer's mechanism in groups of its driver's values."""
    evidence, cause = diagnosed.evidence, diagnosed.causes[-1]
    mechanism = m.MECHANISMS[cause.effect]
    x, share, label = _driven(diagnosed, mechanism)
    is_relay = mechanism.when.code == m.ABOVE
    group = _grouped(evidence, x, diagnosed.held_out)
    if is_relay:  # between its levels it acts or not, as the vacuum came there
        group = np.where(group >= 0, 2 * group + (share >= 0.5), -1)
    group = _large_enough(evidence, group, diagnosed.held_out)
    in_law = np.array([share[group == number].mean() for number in range(group.max() + 1)])
    middle = np.array([x[group == number].mean() for number in range(group.max() + 1)])
    answer = mechanism_of(diagnosed.answer)
    assert answer is not None
    sizes = []
    for parameter, coefficient, si, word in zip(
        mechanism.place.parameters,
        mechanism.place.coefficients,
        mechanism.place.si,
        mechanism.place.words,
        strict=True,
    ):
        value, told = cause.values[parameter.name], answer["parameters"][parameter.name]
        probe = PROBE * (abs(value) or parameter.typical)
        more, sigma = _refitted(diagnosed, group, _adder(coefficient, si, value, probe))
        more, sigma = more * probe, sigma * probe
        shown = sigma < SUREST * abs(value)
        low, high = (value if told[end] is None else told[end] for end in ("low95", "high95"))
        y = in_law * value + more
        names = parameter.name, parameter.unit, word
        arrays = (part[shown] for part in (middle, in_law, y, sigma))
        sizes.append(RefittedSize(*names, value, low, high, *arrays))
    begins = cause.values.get("begins", 0.0)
    relay = (begins, max(begins - cause.values["ends_below"], LEAST_END)) if is_relay else None
    return Inferred(mechanism, label, x, share, relay, tuple(sizes))


def _adder(
    coefficient: int, si: Callable[[Theta, float], float], value: float, probe: float
) -> Callable[[Theta], Theta]:
    def changed(theta: Theta) -> Theta:
        more = theta.copy()
        more[coefficient] += si(theta, value + probe) - si(theta, value)
        return more

    return changed


def _refitted(
    diagnosed: Found, group: Ints, change: Callable[[Theta], Theta]
) -> tuple[Floats, Floats]:
    """How many changes each group has beside the law, and one sigma of that."""
    evidence, hypothesis = diagnosed.evidence, diagnosed.causes
    weights = covariance(evidence, hypothesis).of(diagnosed.held_out)
    by_row = _by_row(evidence, group)
    masks = [np.full(len(by_row), fill_value=False)]
    masks += [by_row == number for number in range(group.max() + 1)]
    off = evidence.off_where(hypothesis, masks, change)
    level = levels(evidence, weights.cycles, [hypothesis])
    white = weights.white(off, np.repeat(level, len(masks), axis=1))
    return _least_squares(white[:, 0], white[:, 1:] - white[:, :1])


def _least_squares(residual: Floats, response: Floats) -> tuple[Floats, Floats]:
    """Changes that remove a whitened ``residual`` best, and their sigmas.

    ``response`` is (residuals, changes). The sigma of a change that moves nothing is infinite.
    """
    information = np.sum(response**2, axis=0)
    seen = information > UNSEEN * information.max(initial=0.0)
    more, sigma = np.zeros(len(seen)), np.full(len(seen), np.inf)
    inverse = np.linalg.pinv(response[:, seen].T @ response[:, seen])
    more[seen] = -inverse @ response[:, seen].T @ residual
    left = residual + response @ more
    scale = max(float(left @ left) / max(len(left) - len(more), 1), 1.0)
    sigma[seen] = np.sqrt(np.diag(inverse) * scale)
    return more, sigma


def _grouped(evidence: Evidence, x: Floats, cycles: Sequence[int]) -> Ints:
    """Group of each bin by its value of the driver; -1 without one."""
    held_out = x[np.isin(evidence.bins.cycle, cycles) & np.isfinite(x)]
    if not len(held_out):
        return np.full(len(x), -1)
    edges = np.linspace(held_out.min(), held_out.max(), GROUPS + 1)
    group = np.clip(np.searchsorted(edges, x, "right") - 1, 0, GROUPS - 1)
    return np.where(np.isfinite(x), group, -1)


def _large_enough(evidence: Evidence, group: Ints, cycles: Sequence[int]) -> Ints:
    """Groups counted anew, without those of which the cycles hardly have bins."""
    seen = np.isin(evidence.bins.cycle, cycles) & (group >= 0)
    numbers, count = np.unique(group[seen], return_counts=True)
    again = np.full(2 * GROUPS + 1, -1)  # the last one for -1
    again[numbers[count >= FEWEST]] = np.arange(int((count >= FEWEST).sum()))
    return again[group]


def _by_row(evidence: Evidence, group: Ints) -> Ints:
    """Group of each row; rows without a bin have that of the row before."""
    number = evidence.bins.number
    last = np.maximum.accumulate(np.where(number >= 0, np.arange(len(number)), 0))
    return np.where(number[last] >= 0, group[number[last]], -1)


# --- what drives it -------------------------------------------------------------------------------


def _driven(diagnosed: Found, mechanism: m.Mechanism) -> tuple[Floats, Floats, str]:
    """Value of the driver and share in each bin, and the driver's name with its unit."""
    evidence, hypothesis = diagnosed.evidence, diagnosed.causes
    inside, code = in_bins(evidence, hypothesis), mechanism.when.code
    rows, states, share = inside.rows, inside.states, inside.share
    if code in (m.ABOVE, m.BEYOND):
        vacuum = (float(evidence.theta[c.AMBIENT]) - states[kernel.VESSEL]) / MBAR
        return vacuum, share, tr("vacuum in the vessel (mbar below ambient)")
    if code in m.RHYTHMIC:
        values = hypothesis[-1].values
        phase = (states[kernel.RUN] - values["shift"]) % values["period"]
        return phase, share, tr("time in the rhythm (s)")
    elapsed, label = _elapsed(evidence, code)
    return elapsed[rows], share, label


def _elapsed(evidence: Evidence, code: int) -> tuple[Floats, str]:
    """Time (s) by which a mechanism is driven at each row, NaN elsewhere, and its name."""
    phase = evidence.ticks["phase"]
    every = np.full(len(phase), fill_value=True)
    new_cycle = np.zeros(len(phase), np.bool_)
    new_cycle[evidence.starts[:-1]] = True
    runs, blows = phase == Phase.SUCTION, phase == Phase.BLOW_OFF
    match code:
        case m.NOZZLE_ON | m.GATHERED:
            label = tr("time for which the nozzle has run in the cycle (s)")
            return _counted(evidence, runs, new_cycle), label
        case m.NOZZLE_OFF:
            label = tr("time since the nozzle stopped (s)")
            return _counted(evidence, ~runs, _rises(~runs)), label
        case m.BLOWING:
            return _counted(evidence, blows, _rises(blows)), tr("time since blow-off began (s)")
        case m.USED_UP:
            return _counted(evidence, every, new_cycle), tr("time since the suction edge (s)")
    return _counted(evidence, every, np.zeros_like(every)), tr("time since the log began (s)")


def _rises(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    rises = mask.copy()
    rises[1:] &= ~mask[:-1]
    return rises


def _counted(
    evidence: Evidence, mask: npt.NDArray[np.bool_], anew: npt.NDArray[np.bool_]
) -> Floats:
    """Time (s) in the rows of a mask since the count began ``anew``; NaN in other rows."""
    steps = np.diff(evidence.seconds, prepend=evidence.seconds[:1])
    total = np.cumsum(steps * mask)
    begun = np.maximum.accumulate(np.where(anew, total - steps * mask, 0.0))
    return np.where(mask, total - begun, np.nan)


# --- drawing --------------------------------------------------------------------------------------


def draw_mechanism(found: Inferred, alt: str) -> Picture:
    """Draw each size over the driver: its law with a 95 % band, and what held-out cycles show."""
    with empty("mechanism", 3.6, alt) as figure:
        panels = figure.subplots(1, len(found.sizes), squeeze=False)[0]
        for axes, size in zip(panels, found.sizes, strict=True):
            for x, share, style, label in _laws(found):
                axes.fill_between(
                    x,
                    share * size.low,
                    share * size.high,
                    color=BAND,
                    lw=0,
                    label=tr("95 % of the law"),
                )
                axes.plot(x, share * size.value, style, color=AFTER, lw=1.8, label=label)
            axes.errorbar(
                size.x,
                size.y,
                SIGMAS_95 * size.sigma,
                fmt="o",
                color=MEASURED,
                ms=4,
                lw=1.0,
                label=tr("refitted on held-out cycles (95 %)"),
            )
            axes.axhline(0.0, color=QUIET, lw=0.8)
            axes.set_ylabel(f"{tr(size.word)}:\n{spoken(size.parameter)} ({size.unit})")
        figure.supxlabel(found.driver, fontsize=10)
        legend(figure, panels)
        return figure


def _laws(found: Inferred) -> list[tuple[Floats, Floats, str, str]]:
    """The share over the driver, with style and label: of a relay the way up and the way down."""
    driven = np.isfinite(found.x)
    x, share = found.x[driven], found.share[driven]
    if not len(x):
        return []
    if found.levels is not None:
        begins, ends = found.levels
        low, high = min(0.0, x.min()), max(x.max(), begins)
        step = np.array([0.0, 0.0, 1.0, 1.0])
        return [
            (np.array([low, ends, ends, high]), step, "--", tr("fitted law, vacuum falling")),
            (np.array([low, begins, begins, high]), step, "-", tr("fitted law, vacuum rising")),
        ]
    width = max(float(np.ptp(x)), 1e-9) / POINTS
    place = np.clip(((x - x.min()) / width).astype(np.int64), 0, POINTS - 1)
    count = np.bincount(place, minlength=POINTS)
    some = count > 0
    means = [np.bincount(place, part, POINTS)[some] / count[some] for part in (x, share)]
    return [(means[0], means[1], "-", tr("fitted law"))]
