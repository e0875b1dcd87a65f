"""Linear screening: the gain of every effect with every course, alone and in pairs.

The signature of each effect in each cycle is one whitened column; a course is a weight for each
cycle. So thousands of combinations need only products of small matrices.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations

import numpy as np

from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis
from twin.diagnosis.hypotheses import price, sized
from twin.diagnosis.residual_covariance import ResidualWhitener, levels
from twin.inference.sensitivities import derivatives
from twin.model.catalogue import has_room
from twin.model.courses import Cause, Course
from twin.model.effects import Parameter, effect_of
from twin.monitor.bins import Floats, Ints

# Sizes at which an effect's signature is taken, over the typical one. A delay shifts edges: the
# signature of a small one differs from that of a large one.
SHARES = (0.5,)
SHARES_OF_TIMES = (0.5, 1.5, 3.0)
LEAST_POWER = 1e-9  # of a signature, in sigmas squared: a weaker one counts as this
ALIKE = 1e-6  # determinant over the product of powers, below which two columns are collinear


@dataclass(frozen=True)
class Columns:
    """Products of whitened signatures of every parameter in every cycle; sizes in typical ones."""

    names: list[tuple[Cause, Parameter]]  # effect, its law, parameter; again for each share
    signs: list[float]  # -1 or 1 if only smaller or greater than neutral is possible, else 0
    normal_matrix: Floats  # (parameters, cycles, parameters, cycles)
    gradient: Floats  # (parameters, cycles), projections of the residual

    def spread(self, number: int, weights: Floats) -> Floats:
        """A parameter with its weights of cycles, as one row over all columns."""
        row = np.zeros(self.gradient.shape)
        row[number] = weights
        return row.reshape(-1)

    def allowed(self, number: int, size: float) -> bool:
        """Whether a parameter can have a size of this sign."""
        return size * self.signs[number] >= 0.0


@dataclass(frozen=True)
class ScreenedCandidate:
    """A hypothesis with its gain in chi-square by the linear model, less its penalty."""

    hypothesis: Hypothesis
    gain: float
    number: int = -1  # of the signature, if it is a single cause


@dataclass(frozen=True)
class _Option:
    """One parameter with one course."""

    number: int  # of the parameter
    cause: Cause
    weights: Floats  # of each cycle


@dataclass(frozen=True)
class _Gain:
    """Gain of an option at its best size in the linear model (chi-square less penalty)."""

    gain: float
    size: float
    option: _Option


@dataclass(frozen=True)
class Signatures:
    """Derivatives of pressure and switching levels (mbar) by the parameters of all effects."""

    names: list[tuple[Cause, Parameter]]
    healthy: Floats  # deviation of the hypothesis about which they are taken, (bins,)
    off: Floats  # (bins, parameters)
    usual: Floats  # as ``healthy``, for levels
    level: Floats  # as ``off``, for levels


def signatures(
    evidence: Evidence, cycles: Sequence[int], about: Hypothesis = HEALTHY
) -> Signatures:
    """Simulate a hypothesis with each parameter changed in turn, the same in all cycles."""
    variants = [
        (Cause(effect.name, law), p, share)
        for effect in evidence.effects
        for law in effect.laws()
        for p in effect.parameters
        if not p.shapes
        for share in (SHARES_OF_TIMES if p.is_time else SHARES)
    ]
    names, shares = (
        [(cause, p) for cause, p, _ in variants],
        np.array([share for *_, share in variants]),
    )
    moved = [(*about, _with_size(evidence, cause, p, x)) for cause, p, x in variants]
    hypotheses = [about, *moved]
    healthy, off = derivatives(evidence.off(hypotheses), shares)
    usual, level = derivatives(levels(evidence, cycles, hypotheses), shares)
    return Signatures(names, healthy, off, usual, level)


def columns(evidence: Evidence, weights: ResidualWhitener, moved: Signatures) -> Columns:
    """Whitened signatures, cycle by cycle."""
    names, off, level = moved.names, moved.off, moved.level
    base = weights.white(moved.healthy[:, None], moved.usual[:, None])[:, 0]
    size = (len(names), len(weights.cycles))
    signatures = np.empty((len(base), *size))  # (residuals, parameters, cycles)
    for number, cycle in enumerate(weights.cycles):
        inside = (evidence.bins.cycle == cycle)[:, None]
        of_cycle = level * (weights.level_cycles == cycle)[:, None]
        signatures[:, :, number] = weights.white(off * inside, of_cycle)
    flat = signatures.reshape(len(base), -1)
    normal_matrix, gradient = flat.T @ flat, -(flat.T @ base)
    signs = [_sign(evidence, p) for _, p in names]
    return Columns(names, signs, normal_matrix.reshape(*size, *size), gradient.reshape(size))


def _sign(evidence: Evidence, p: Parameter) -> float:
    neutral = p.neutral(evidence.theta)
    return float(p.high > neutral) - float(p.low < neutral)


def linear_gains(
    evidence: Evidence, weights: ResidualWhitener, linear: Columns, each: int
) -> list[ScreenedCandidate]:
    """The best courses (``each`` of them) of every parameter, the largest gain first."""
    best: dict[tuple[str, str], dict[Course, _Gain]] = {}
    shares = list(_shares(evidence, weights))
    for number, (cause, p) in enumerate(linear.names):
        best_by_course = best.setdefault((cause.effect, p.name), {})
        for option in _options(evidence, weights, linear, number, shares):
            gain = _gain(evidence, linear, option)
            previous = best_by_course.get(option.cause.course)
            if previous is None or gain.gain > previous.gain:
                best_by_course[option.cause.course] = gain
    chosen = chain.from_iterable(
        sorted(by_course.values(), key=lambda gain: -gain.gain)[:each]
        for by_course in best.values()
    )
    return sorted((_screened(evidence, linear, gain) for gain in chosen), key=_loss)


def _loss(candidate: ScreenedCandidate) -> float:
    return -candidate.gain


def pairs(
    evidence: Evidence,
    weights: ResidualWhitener,
    linear: Columns,
    singles: Sequence[ScreenedCandidate],
) -> list[ScreenedCandidate]:
    """Pairs of promises with both sizes fitted, the largest gain first."""
    options = [
        _Option(single.number, cause, share_of_cycles(evidence, weights, cause))
        for single in singles
        for cause in single.hypothesis
    ]
    rows = np.stack([linear.spread(option.number, option.weights) for option in options])
    size = linear.gradient.size
    normal_matrix = rows @ linear.normal_matrix.reshape(size, size) @ rows.T
    gradient = rows @ linear.gradient.reshape(size)
    result = []
    for pair in combinations(range(len(options)), 2):
        first, second = (options[i] for i in pair)
        square = normal_matrix[np.ix_(pair, pair)]
        determinant = square[0, 0] * square[1, 1] - square[0, 1] ** 2
        effects = first.cause.effect, second.cause.effect
        if effects[0] == effects[1] or not has_room(evidence.theta, effects):
            continue
        if determinant <= ALIKE * square[0, 0] * square[1, 1]:
            continue
        sizes = np.linalg.solve(square, gradient[list(pair)])
        if linear.allowed(first.number, sizes[0]) and linear.allowed(second.number, sizes[1]):
            hypothesis = tuple(
                _with_size(evidence, option.cause, linear.names[option.number][1], float(times))
                for option, times in zip((first, second), sizes, strict=True)
            )
            result.append(
                ScreenedCandidate(
                    hypothesis, float(gradient[list(pair)] @ sizes) - price(evidence, hypothesis)
                )
            )
    return sorted(result, key=_loss)


def _gain(evidence: Evidence, linear: Columns, option: _Option) -> _Gain:
    """Gain of one parameter with one course."""
    power = option.weights @ linear.normal_matrix[option.number, :, option.number] @ option.weights
    gradient = float(option.weights @ linear.gradient[option.number])
    size = gradient / max(float(power), LEAST_POWER)
    if not linear.allowed(option.number, size):
        size = 0.0
    return _Gain(size * gradient - price(evidence, (option.cause,)), size, option)


def _screened(evidence: Evidence, linear: Columns, gain: _Gain) -> ScreenedCandidate:
    p = linear.names[gain.option.number][1]
    hypothesis = (_with_size(evidence, gain.option.cause, p, gain.size),)
    return ScreenedCandidate(hypothesis, gain.gain, gain.option.number)


def _shares(
    evidence: Evidence, weights: ResidualWhitener
) -> Iterator[tuple[Course, float, Floats]]:
    """Course, onset and weights of cycles, for all courses except intermittent ones."""
    courses = [(Course.CONSTANT, 0.0), (Course.RAMP, 0.0)]
    for onset in evidence.seconds[evidence.starts[np.array(weights.cycles)[1:]]]:
        courses += [(Course.STEP, float(onset)), (Course.RAMP, float(onset))]
    for course, onset in courses:
        yield course, onset, share_of_cycles(evidence, weights, Cause("", {}, course, onset))


def _options(
    evidence: Evidence,
    weights: ResidualWhitener,
    linear: Columns,
    number: int,
    shares: Iterable[tuple[Course, float, Floats]],
) -> Iterator[_Option]:
    """All distinguishable courses of a parameter."""
    base_cause = linear.names[number][0]
    for course, onset, share in shares:
        yield _Option(number, replace(base_cause, course=course, onset_s=onset), share)
    cycles = np.array(weights.cycles)
    for chosen in _striking(linear, number):
        struck = frozenset(int(n) for n in evidence.numbers[cycles[chosen]])
        cause = replace(base_cause, course=Course.INTERMITTENT, cycles=struck)
        yield _Option(number, cause, share_of_cycles(evidence, weights, cause))


def _striking(linear: Columns, number: int) -> Iterator[Ints]:
    """Sets of cycles in which an intermittent effect may act: those where it is largest.

    Sizes of all cycles are estimated together. The uncertain data set absorbs what cycles have in
    common, so a cycle without the effect would otherwise seem to have a negative one.
    """
    square = linear.normal_matrix[number, :, number]
    cycles = len(square)
    steady = max(1e-3 * np.trace(square) / cycles, LEAST_POWER) * np.eye(cycles)
    sizes = np.linalg.solve(square + steady, linear.gradient[number])
    for sign in (1.0, -1.0):
        if not linear.allowed(number, sign):
            continue
        order = np.argsort(-sign * sizes)
        for count in range(1, cycles):
            chosen = np.sort(order[:count])
            if chosen[0] != cycles - count:  # the last cycles alone would be a step
                yield chosen


def share_of_cycles(evidence: Evidence, weights: ResidualWhitener, cause: Cause) -> Floats:
    """Share of a cause's size in each cycle; a ramp's size is that at the end of the log."""
    cycles = np.array(weights.cycles)
    begins = evidence.seconds[evidence.starts[cycles]]
    ends = evidence.seconds[evidence.starts[cycles + 1] - 1]
    last = float(evidence.seconds[-1])
    match cause.course:
        case Course.STEP:
            share: Floats = np.clip((ends - cause.onset_s) / (ends - begins), 0.0, 1.0)
            return share
        case Course.RAMP:
            past: Floats = np.maximum((begins + ends) / 2.0 - cause.onset_s, 0.0)
            return past / max(last - cause.onset_s, 1e-3)
        case Course.INTERMITTENT:
            return np.isin(evidence.numbers[cycles], list(cause.cycles)).astype(float)
    return np.ones(len(cycles))


def _with_size(evidence: Evidence, cause: Cause, parameter: Parameter, size: float) -> Cause:
    """A cause with one of its parameters at ``size`` typical sizes from neutral."""
    effect = effect_of(cause.effect)
    x = np.array([size if p is parameter else 0.0 for p in effect.parameters])
    (sized_cause,) = sized(evidence, (cause,), x)
    return replace(
        sized_cause,
        values={**sized_cause.law(), parameter.name: sized_cause.values[parameter.name]},
    )
