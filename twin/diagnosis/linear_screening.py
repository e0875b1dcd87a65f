"""The linear search: what every effect with every course would explain, alone and in pairs.

The signature of each effect in each cycle is one whitened column; a course is a weight for each
cycle. So thousands of combinations cost some products of small matrices.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations

import numpy as np

from twin.diagnosis.covariance import Weights, levels
from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis
from twin.diagnosis.hypotheses import price, sized
from twin.inference.sensitivities import derivatives
from twin.model.catalogue import has_room
from twin.model.courses import Cause, Course
from twin.model.effects import Parameter, effect_of
from twin.monitor.bins import Floats, Ints

# Of its typical size, at which an effect's signature is taken. A delay moves what is sharp: a small
# one's signature looks nothing like a great one's.
SHARES = (0.5,)
SHARES_OF_TIMES = (0.5, 1.5, 3.0)
LEAST_POWER = 1e-9  # of a signature, in sigmas squared: less is nothing
ALIKE = 1e-6  # of their lengths' product: two columns are the same


@dataclass(frozen=True)
class Columns:
    """Whitened signatures of every parameter in every cycle, as products; sizes in typical ones."""

    names: list[tuple[Cause, Parameter]]  # effect, its law, parameter; again for each share
    signs: list[float]  # -1 or 1 where only smaller or greater than neutral is possible, else 0
    gram: Floats  # (parameters, cycles, parameters, cycles)
    pull: Floats  # (parameters, cycles), towards what is measured

    def spread(self, number: int, weights: Floats) -> Floats:
        """A parameter with a weight for each cycle as one row over all columns."""
        row = np.zeros(self.pull.shape)
        row[number] = weights
        return row.reshape(-1)

    def allowed(self, number: int, size: float) -> bool:
        """Whether an effect can have a size of that sign."""
        return size * self.signs[number] >= 0.0


@dataclass(frozen=True)
class Promise:
    """A hypothesis of the linear model: what it gains in chi-square, price included."""

    hypothesis: Hypothesis
    gain: float
    number: int = -1  # of the signature, of a single one


@dataclass(frozen=True)
class _Option:
    """One parameter with one course."""

    number: int  # of the parameter
    cause: Cause
    weights: Floats  # of each cycle


@dataclass(frozen=True)
class _Gain:
    """What an option gains in the linear model (chi-square, price included), at its best size."""

    gain: float
    size: float
    option: _Option


@dataclass(frozen=True)
class Signatures:
    """How the parameters of all effects that can act move pressure and switching levels (mbar)."""

    names: list[tuple[Cause, Parameter]]
    healthy: Floats  # what the hypothesis is off by that they are about, (bins,)
    off: Floats  # (bins, parameters)
    usual: Floats  # the same of levels
    level: Floats


def signatures(
    evidence: Evidence, cycles: Sequence[int], about: Hypothesis = HEALTHY
) -> Signatures:
    """Simulate each parameter a little away from a hypothesis, in all cycles alike."""
    taken = [
        (Cause(effect.name, law), p, share)
        for effect in evidence.effects
        for law in effect.laws()
        for p in effect.parameters
        if not p.shapes
        for share in (SHARES_OF_TIMES if p.unit == "ms" else SHARES)
    ]
    names, shares = [(cause, p) for cause, p, _ in taken], np.array([share for *_, share in taken])
    moved = [(*about, _with_size(evidence, cause, p, x)) for cause, p, x in taken]
    hypotheses = [about, *moved]
    healthy, off = derivatives(evidence.off(hypotheses), shares)
    usual, level = derivatives(levels(evidence, cycles, hypotheses), shares)
    return Signatures(names, healthy, off, usual, level)


def columns(evidence: Evidence, weights: Weights, moved: Signatures) -> Columns:
    """Signatures weighed, cycle by cycle."""
    names, off, level = moved.names, moved.off, moved.level
    base = weights.white(moved.healthy[:, None], moved.usual[:, None])[:, 0]
    parts = []
    for cycle in weights.cycles:
        inside = (evidence.bins.cycle == cycle)[:, None]
        parts.append(weights.white(off * inside, level * (weights.level_cycles == cycle)[:, None]))
    signatures = np.stack(parts, axis=2)  # (residuals, parameters, cycles)
    size = signatures.shape[1:]
    flat = signatures.reshape(len(base), -1)
    gram, pull = flat.T @ flat, -(flat.T @ base)
    signs = [_sign(evidence, p) for _, p in names]
    return Columns(names, signs, gram.reshape(*size, *size), pull.reshape(size))


def _sign(evidence: Evidence, p: Parameter) -> float:
    neutral = p.neutral(evidence.theta)
    return float(p.high > neutral) - float(p.low < neutral)


def promises(evidence: Evidence, weights: Weights, found: Columns, each: int) -> list[Promise]:
    """The best courses (``each`` of them) of every parameter, the most promising first."""
    best: dict[tuple[str, str], dict[Course, _Gain]] = {}
    shares = list(_shares(evidence, weights))
    for number, (cause, p) in enumerate(found.names):
        mine = best.setdefault((cause.effect, p.name), {})
        for option in _options(evidence, weights, found, number, shares):
            gain = _gain(evidence, found, option)
            before = mine.get(option.cause.course)
            if before is None or gain.gain > before.gain:
                mine[option.cause.course] = gain
    chosen = chain.from_iterable(
        sorted(one.values(), key=lambda gain: -gain.gain)[:each] for one in best.values()
    )
    return sorted((_promised(evidence, found, one) for one in chosen), key=_loss)


def _loss(promise: Promise) -> float:
    return -promise.gain


def pairs(
    evidence: Evidence, weights: Weights, found: Columns, singles: Sequence[Promise]
) -> list[Promise]:
    """Pairs of promises that explain more together, both sizes fitted, the best first."""
    options = [
        _Option(one.number, cause, share_of_cycles(evidence, weights, cause))
        for one in singles
        for cause in one.hypothesis
    ]
    rows = np.stack([found.spread(one.number, one.weights) for one in options])
    size = found.pull.size
    gram = rows @ found.gram.reshape(size, size) @ rows.T
    pull = rows @ found.pull.reshape(size)
    result = []
    for two in combinations(range(len(options)), 2):
        one, other = (options[i] for i in two)
        square = gram[np.ix_(two, two)]
        apart = square[0, 0] * square[1, 1] - square[0, 1] ** 2
        effects = one.cause.effect, other.cause.effect
        if effects[0] == effects[1] or not has_room(evidence.theta, effects):
            continue
        if apart <= ALIKE * square[0, 0] * square[1, 1]:
            continue
        sizes = np.linalg.solve(square, pull[list(two)])
        if found.allowed(one.number, sizes[0]) and found.allowed(other.number, sizes[1]):
            both = tuple(
                _with_size(evidence, option.cause, found.names[option.number][1], float(times))
                for option, times in zip((one, other), sizes, strict=True)
            )
            result.append(Promise(both, float(pull[list(two)] @ sizes) - price(evidence, both)))
    return sorted(result, key=_loss)


def _gain(evidence: Evidence, found: Columns, option: _Option) -> _Gain:
    """What one parameter with one course gains."""
    power = option.weights @ found.gram[option.number, :, option.number] @ option.weights
    pull = float(option.weights @ found.pull[option.number])
    size = pull / max(float(power), LEAST_POWER)
    if not found.allowed(option.number, size):
        size = 0.0
    return _Gain(size * pull - price(evidence, (option.cause,)), size, option)


def _promised(evidence: Evidence, found: Columns, gain: _Gain) -> Promise:
    p = found.names[gain.option.number][1]
    hypothesis = (_with_size(evidence, gain.option.cause, p, gain.size),)
    return Promise(hypothesis, gain.gain, gain.option.number)


def _shares(evidence: Evidence, weights: Weights) -> Iterator[tuple[Course, float, Floats]]:
    """Course, onset and weight of each cycle, of all courses but those in some cycles only."""
    courses = [(Course.CONSTANT, 0.0), (Course.RAMP, 0.0)]
    for onset in evidence.seconds[evidence.starts[np.array(weights.cycles)[1:]]]:
        courses += [(Course.STEP, float(onset)), (Course.RAMP, float(onset))]
    for course, onset in courses:
        yield course, onset, share_of_cycles(evidence, weights, Cause("", {}, course, onset))


def _options(
    evidence: Evidence,
    weights: Weights,
    found: Columns,
    number: int,
    shares: Iterable[tuple[Course, float, Floats]],
) -> Iterator[_Option]:
    """All courses of a parameter that the cycles can tell apart."""
    kind = found.names[number][0]
    for course, onset, share in shares:
        yield _Option(number, replace(kind, course=course, onset_s=onset), share)
    cycles = np.array(weights.cycles)
    for chosen in _striking(found, number):
        struck = frozenset(int(n) for n in evidence.numbers[cycles[chosen]])
        cause = replace(kind, course=Course.INTERMITTENT, cycles=struck)
        yield _Option(number, cause, share_of_cycles(evidence, weights, cause))


def _striking(found: Columns, number: int) -> Iterator[Ints]:
    """Sets of cycles that an intermittent effect may be in: those where it is largest.

    Sizes are estimated together: what cycles have in common is cheap for a data set that is not
    quite sure, so that a cycle without the effect would look like one with less than none.
    """
    square = found.gram[number, :, number]
    cycles = len(square)
    steady = max(1e-3 * np.trace(square) / cycles, LEAST_POWER) * np.eye(cycles)
    sizes = np.linalg.solve(square + steady, found.pull[number])
    for sign in (1.0, -1.0):
        if not found.allowed(number, sign):
            continue
        order = np.argsort(-sign * sizes)
        for count in range(1, cycles):
            chosen = np.sort(order[:count])
            if chosen[0] != cycles - count:  # else it is a step
                yield chosen


def share_of_cycles(evidence: Evidence, weights: Weights, cause: Cause) -> Floats:
    """How much of its size a cause has in each cycle; a ramp's size is what it comes to."""
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
    """A cause with one of its parameters that many typical sizes away from neutral."""
    effect = effect_of(cause.effect)
    x = np.array([size if p is parameter else 0.0 for p in effect.parameters])
    (whole,) = sized(evidence, (cause,), x)
    return replace(whole, values={**whole.law(), parameter.name: whole.values[parameter.name]})
