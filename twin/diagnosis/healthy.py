"""Learn the model's error and the scatter from healthy cycles."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin.diagnosis.evidence import HEALTHY, Evidence
from twin.diagnosis.residual_covariance import (
    MEETS,
    Covariance,
    ResidualWhitener,
    moved,
    scatter,
    split_sensitivity,
)
from twin.model.term import KINDS
from twin.monitor.bins import Bools, Floats, Ints, unwarped
from twin.monitor.healthy import MEETS_MS, Healthy, ModelError
from twin.monitor.scatter_covariance import FIRST_ERROR, SCATTER
from twin.signals import MS

ROUNDS = 3
FEWEST = 6  # cycles, to learn from one half and judge on the other
LEAST_COMMON, LEAST_ALONE = 0.15, 0.1  # mbar
ODD = 3.0  # times the median of cycles' chi-square, at which a cycle's chi-square is clipped
APART = 2.0  # least ratio of mean squares between two groups of cycles
HIDDEN = 1.3  # model error before the fit, over the residual that the fit leaves of it
LEAST_SCATTER, MOST_SCATTER = 0.2, 5.0  # bounds, over the usual size


@dataclass(frozen=True)
class _HealthyDeviation:
    """Deviation of the twin in healthy cycles (mbar), and its changes, (bins, ·)."""

    evidence: Evidence
    off: Floats
    moves: Floats  # by the usual size of each scatter
    parameter_sensitivity: Floats  # by each uncertainty of the data set, as healthy cycles show it
    beyond: Floats  # and what they do not show

    def by(self, healthy: Healthy) -> Covariance:
        """Covariance of bins with the learned error and scatter."""
        evidence = replace(self.evidence, healthy=healthy)
        _, moves, _ = moved(evidence, HEALTHY, scatter(evidence))
        return self.about(evidence, moves)

    def about(self, evidence: Evidence, moves: Floats) -> Covariance:
        """Covariance of bins with these changes by scatter."""
        no_other_day = np.empty((len(self.off), 0))  # healthy cycles are of the calibration's
        nothing = np.zeros_like(self.off)  # neither causes nor the day explain anything
        return Covariance(
            evidence, nothing, moves, self.parameter_sensitivity, self.beyond, no_other_day, nothing
        )


def learned(evidence: Evidence) -> Healthy:
    """``evidence.healthy`` with the model's error and the scatter learned from its cycles."""
    unlearned = evidence.healthy.model_copy(update={"meets_ms": MEETS_MS})
    evidence = replace(evidence, another_day=False, healthy=unlearned)
    uncertain = [(shift.up, shift.down) for shift in evidence.uncertain]
    off, moves, opened = moved(evidence, HEALTHY, SCATTER, uncertain)
    deviation = _HealthyDeviation(evidence, off, moves, *split_sensitivity(evidence, opened))
    judged = evidence.judged
    halves = [(judged[::2], judged[1::2]), (judged[1::2], judged[::2])]
    if len(judged) < FEWEST:
        halves = [(judged, judged)]
    chi2 = [
        _chi2_by_cycle(deviation, _learned(deviation, learned_cycles), judged_cycles)
        for learned_cycles, judged_cycles in halves
    ]
    return _learned(deviation, judged).model_copy(
        update={"leftover": usual_leftover(np.concatenate(chi2))}
    )


def _chi2_by_cycle(deviation: _HealthyDeviation, healthy: Healthy, cycles: Sequence[int]) -> Floats:
    """Chi-square per residual of each cycle, with ``healthy`` learned from others."""
    weights = deviation.by(healthy).of(cycles)
    white = weights.white(deviation.off[:, None])[: len(weights.bins), 0]
    return left_in_each(deviation.evidence, weights, white)


def left_in_each(evidence: Evidence, weights: ResidualWhitener, white: Floats) -> Floats:
    """Chi-square per residual in each cycle of ``weights``, from whitened residuals.

    ``white`` has bins, or bins and then levels.
    """
    cycle = np.concatenate([evidence.bins.cycle[weights.bins], weights.level_cycles])
    cycle, squares = cycle[: len(white)], white**2
    return np.array(  # pyright: ignore[reportReturnType]
        [np.mean(squares[cycle == number]) for number in weights.cycles if number in cycle]
    )


def usual_leftover(chi2: Floats) -> float:
    """Rms of whitened residuals of cycles, from chi-square in each; odd cycles are clipped.

    The final healthy data include the odd cycles as well.
    """
    return float(np.sqrt(np.mean(np.minimum(chi2, ODD * np.median(chi2)))))


def are_odd(chi2: Floats) -> Bools:
    """Odd cycles: those whose chi-square is far above the median."""
    return chi2 > ODD * np.median(chi2)


def apart(squares: Floats) -> Bools:
    """Cycles above the largest gap in ``squares`` that has two or more on either side."""
    ordered = np.sort(squares)
    ratios = ordered[2:-1] / ordered[1:-2]
    if not len(ratios) or ratios.max() < APART:
        return np.zeros(len(squares), bool)
    return np.asarray(squares >= ordered[2 + int(ratios.argmax())], bool)


def _learned(deviation: _HealthyDeviation, cycles: Sequence[int]) -> Healthy:
    """Error and scatter learned from some cycles."""
    evidence = deviation.evidence
    healthy = evidence.healthy.model_copy(
        update={"error": dict.fromkeys(KINDS, FIRST_ERROR), "scatter": {}, "leftover": 1.0}
    )
    for _ in range(ROUNDS):
        amplitudes, spread = _amplitudes(deviation, healthy, cycles)
        residual = deviation.off - np.einsum(
            "bs,bs->b", deviation.moves, amplitudes[evidence.bins.cycle]
        )
        sizes = np.sqrt(amplitudes[cycles].var(axis=0, ddof=1) + spread[cycles].mean(axis=0))
        sizes = np.clip(sizes, LEAST_SCATTER, MOST_SCATTER)
        meets, sizes = sizes[MEETS], sizes[: len(SCATTER)]
        healthy = healthy.model_copy(
            update={
                "error": _errors(evidence, residual, cycles),
                "scatter": {
                    name: float(size * factor)
                    for (name, (_, size)), factor in zip(SCATTER.items(), sizes, strict=True)
                },
                "meets_ms": float(meets * MEETS_MS),
            }
        )
    return healthy


def _amplitudes(
    deviation: _HealthyDeviation, healthy: Healthy, cycles: Sequence[int]
) -> tuple[Floats, Floats]:
    """Amplitude of each scatter in each cycle, in its usual size, and its variance."""
    evidence, moves = replace(deviation.evidence, healthy=healthy), deviation.moves
    size = (evidence.cycles, moves.shape[1])
    amplitudes, spread = np.zeros(size), np.zeros(size)
    model = deviation.about(evidence, moves)
    known_sizes = [healthy.scatter.get(name, size) / size for name, (_, size) in SCATTER.items()]
    prior = np.ones(moves.shape[1])
    prior[: len(known_sizes)] = known_sizes
    prior[MEETS] = healthy.meets_ms / MEETS_MS
    for cycle in cycles:
        weights = model.of([cycle], scattered=False)
        white = weights.white(np.column_stack([deviation.off, moves]))
        information = white[:, 1:].T @ white[:, 1:] + np.diag(prior**-2.0)
        variance = np.linalg.inv(information)
        amplitudes[cycle] = variance @ white[:, 1:].T @ white[:, 0]
        spread[cycle] = np.diag(variance)
    return amplitudes, spread


def _errors(evidence: Evidence, residual: Floats, cycles: Sequence[int]) -> dict[str, ModelError]:
    """The model's error in some cycles, by kind of stretch and time since it began."""
    errors, bins = {}, evidence.bins
    for kind, name in enumerate(KINDS):
        rows = np.flatnonzero((bins.kind == kind) & np.isin(bins.cycle, cycles))
        if len(rows):
            errors[name] = _error(evidence, residual, rows)
    return errors


def _error(evidence: Evidence, residual: Floats, rows: Ints) -> ModelError:
    unit = np.floor(evidence.bins.time[rows]).astype(np.int64)
    noise = evidence.noise**2 / evidence.bins.count[rows]
    after, common, alone = [], [], []
    for step in np.unique(unit):
        step_rows = rows[unit == step]
        parts = _variance_parts(evidence, residual, step_rows)
        after.append(float(unwarped(np.array(step + 0.5)) / MS))
        noise_variance = float(np.mean(noise[unit == step]))
        common.append(float(np.sqrt(max(HIDDEN**2 * (parts[0] - parts[1]), LEAST_COMMON**2))))
        alone.append(float(np.sqrt(max(parts[2] - noise_variance, LEAST_ALONE**2))))
    return ModelError(after_ms=tuple(after), common_mbar=tuple(common), alone_mbar=tuple(alone))


def _variance_parts(evidence: Evidence, residual: Floats, rows: Ints) -> tuple[float, float, float]:
    """Mean square of bins' means over cycles, the part due to chance, and the variance within."""
    place = evidence.bins.place[rows]
    squares, chance, within = [], [], []
    for cell in np.unique(place):
        values = residual[rows[place == cell]]
        variance = float(np.var(values, ddof=1)) if len(values) > 1 else 0.0
        squares.append(float(np.mean(values)) ** 2)
        chance.append(variance / len(values))
        within.append(variance)
    return float(np.mean(squares)), float(np.mean(chance)), float(np.mean(within))
