"""The search for one cause: every effect, as it is and switching on, fitted and ranked.

First every effect's amplitude is estimated in each cycle alone, with the model made linear; how
the amplitudes run over the cycles tells the course. Then the promising ones are fitted in the
non-linear simulation by least squares on the fitted cycles only.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, minimize_scalar

from twin.diagnosis.evidence import Course, Evidence, Floats
from twin.model.effects import EFFECTS, Effect, apply

PROMISING = 8  # effects that are fitted
STEP_GAIN = 15.0  # chi-square a step must gain over a constant course: it has more freedom
PARAMETER_PRICE = 2.0  # chi-square each parameter must be worth (Akaike)
SAME = 10.8  # chi-square up to which a log cannot reject a rival (one in a thousand)


@dataclass(frozen=True)
class Finding:
    """A hypothesis fitted to the evidence."""

    effect: str
    onset: int | None  # row at which it begins; None: it was always there
    values: dict[str, float]
    low95: dict[str, float]
    high95: dict[str, float]
    chi2: float  # over the fitted cycles, price included
    leftover: float  # sigmas left on the fitted cycles; 1 is healthy

    def course(self, evidence: Evidence) -> Course:
        """The coefficients' course under this hypothesis."""
        return course_of(evidence, EFFECTS[self.effect], self.values, self.onset)


@dataclass(frozen=True)
class Screened:
    """What an effect promises in the linear model: gain in chi-square, where it begins, how big."""

    effect: Effect
    gain: float
    first: int  # position among the judged cycles from which on it is there; 0: always
    values: list[float]


def course_of(
    evidence: Evidence, effect: Effect, values: dict[str, float], onset: int | None
) -> Course:
    """The coefficients' course with an effect of some size from a row on."""
    changed = apply(evidence.theta, effect.name, values)
    return [(0, changed)] if onset is None else [(0, evidence.theta), (onset, changed)]


def search(
    evidence: Evidence, fitted: Sequence[int], progress: Callable[[str], None]
) -> list[Finding]:
    """Rank the effects by how well they explain the fitted cycles, best first."""
    progress("screening all effects")
    screened = screen(evidence)
    if not screened:
        return []
    best = screened[0]
    onset = None
    if best.first > 0:
        progress(f"{best.effect.name}: looking for the onset")
        onset = find_onset(evidence, best)
    found = []
    for one in screened[:PROMISING]:
        progress(f"fitting {one.effect.name}")
        for begin in {onset if one.first > 0 else None, None}:
            found.append(fit(evidence, one, begin, fitted))
    found.sort(key=lambda finding: finding.chi2)
    effects_seen: set[str] = set()
    return [f for f in found if not (f.effect in effects_seen or effects_seen.add(f.effect))]  # type: ignore[func-returns-value]


def screen(evidence: Evidence) -> list[Screened]:
    """Estimate every effect's gain with the model made linear about the data set, best first."""
    base = evidence.residuals([(0, evidence.theta)])
    found = []
    for effect in EFFECTS.values():
        sizes, gains = [], []
        for parameter in effect.parameters:
            neutral = parameter.neutral(evidence.theta)
            changed = apply(
                evidence.theta, effect.name, {parameter.name: neutral + parameter.typical}
            )
            moved = evidence.residuals([(0, changed)])
            slopes = [after - before for after, before in zip(moved, base, strict=True)]
            one_sided = parameter.low == neutral
            gain, first, times = _best_course(base, slopes, one_sided=one_sided)
            size = neutral + times * parameter.typical
            sizes.append(float(np.clip(size, parameter.low, parameter.high)))
            gains.append((gain, first))
        gain, first = max(gains)
        found.append(Screened(effect, sum(g for g, _ in gains), first, sizes))
    return sorted(found, key=lambda one: -one.gain)


def _best_course(
    base: list[Floats], slopes: list[Floats], *, one_sided: bool
) -> tuple[float, int, float]:
    """Gain, first cycle and amplitude of the best constant or switched-on amplitude."""
    pull = np.array([-float(s @ b) for s, b in zip(slopes, base, strict=True)])
    power = np.array([float(s @ s) for s in slopes])
    pulls, powers = (np.cumsum(x[::-1])[::-1] for x in (pull, power))  # from cycle i to the end
    if one_sided:
        pulls = np.maximum(pulls, 0.0)
    gains = np.where(powers > 1e-9, pulls**2 / np.maximum(powers, 1e-9), 0.0)
    first = int(np.argmax(gains))
    if gains[first] < gains[0] + STEP_GAIN:
        first = 0
    return float(gains[first]), first, float(pulls[first] / max(powers[first], 1e-9))


def find_onset(evidence: Evidence, one: Screened) -> int:
    """Row at which an effect switches on, to some ten ms where the data can tell."""
    first = evidence.judged[one.first]
    values = _named(one.effect, one.values)
    low = int(evidence.starts[max(first - 1, 1)])
    high = int(evidence.starts[min(first + 1, evidence.cycles)])

    def misfit(row: float) -> float:
        return _chi2(evidence.residuals(course_of(evidence, one.effect, values, int(row))))

    rows = np.linspace(low, high, 13)
    nearest = int(np.argmin([misfit(row) for row in rows]))
    around = (rows[max(nearest - 1, 0)], rows[min(nearest + 1, len(rows) - 1)])
    best = minimize_scalar(misfit, bounds=around, method="bounded", options={"xatol": 5.0})
    return int(best.x)


def fit(evidence: Evidence, one: Screened, onset: int | None, fitted: Sequence[int]) -> Finding:
    """Fit an effect's parameters in the non-linear simulation on the fitted cycles."""
    effect, judged = one.effect, evidence.judged
    scale = np.array([p.typical for p in effect.parameters])
    low = np.array([p.low for p in effect.parameters])
    high = np.array([p.high for p in effect.parameters])

    def residual(x: Floats) -> Floats:
        values = _named(effect, np.clip(x * scale, low, high))
        found = evidence.residuals(course_of(evidence, effect, values, onset))
        return np.concatenate([found[judged.index(cycle)] for cycle in fitted])

    def jacobian(x: Floats) -> Floats:
        at = residual(x)
        steps = np.where((x + 0.02) * scale < high, 0.02, -0.02)
        moves = [(residual(x + move) - at) for move in np.diag(steps)]
        return np.stack(moves, axis=1) / steps

    bounds = (low / scale, high / scale)
    start = np.clip(np.array(one.values) / scale, bounds[0] + 1e-6, bounds[1] - 1e-6)
    best = least_squares(residual, start, jacobian, bounds, max_nfev=12, xtol=1e-4, ftol=1e-5)
    chi2 = float(best.fun @ best.fun)
    left = chi2 / len(best.fun)
    spread = _spread(jacobian(best.x), max(left, 1.0)) * scale
    size = best.x * scale

    def held(numbers: Floats) -> dict[str, float]:  # without those that nothing here depends on
        return {
            p.name: float(n)
            for p, n, s in zip(effect.parameters, numbers, spread, strict=True)
            if np.isfinite(s)
        }

    return Finding(
        effect.name,
        onset,
        held(size),
        held(np.maximum(size - 1.96 * spread, low)),
        held(np.minimum(size + 1.96 * spread, high)),
        chi2 + PARAMETER_PRICE * (len(size) + (onset is not None)),
        float(np.sqrt(left)),
    )


def _spread(jacobian: Floats, variance: float) -> Floats:
    """One standard deviation of each parameter; infinite where the evidence does not hold it."""
    information = jacobian.T @ jacobian
    held = np.diag(information) > 1e-6
    spread = np.full(len(information), np.inf)
    part = information[np.ix_(held, held)]
    spread[held] = np.sqrt(np.diag(np.linalg.pinv(part)) * variance)
    return spread


def _named(effect: Effect, values: Sequence[float] | Floats) -> dict[str, float]:
    return {p.name: float(v) for p, v in zip(effect.parameters, values, strict=True)}


def _chi2(residuals: list[Floats]) -> float:
    return sum(float(part @ part) for part in residuals)
