"""Starting points of mechanisms in a rhythm of their own, from the residuals of a log.

The pressure answers a short pulse in each part of a cycle otherwise, and blow-off interrupts its
answer. So the model runs with short pulses, one in a cycle, until each part of the log has had one.
Their answers add up to that to any rhythm: every period is tried by linear algebra. A rhythm that
is on and off is found as a planet is that passes its star: by least squares of boxes over the
residuals, folded by each period.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from twin.diagnosis.evidence import Evidence, Hypothesis
from twin.diagnosis.fit import white
from twin.diagnosis.residual_covariance import ResidualWhitener
from twin.model.courses import Cause
from twin.model.mechanism import MECHANISMS, PLACES, PULSED, RHYTHMIC, WHENS, Mechanism, Place
from twin.monitor.bins import Floats, Ints

# Least share of the squared deviation (mbar) that differs from cycle to cycle, for a search for
# rhythms. Chosen: a swinging supply has 0.3 to 0.8; leaks, vapour and ice up to 0.06.
DIFFERS = 0.1
# The periodogram has frequencies half a line width (1 / duration) apart: a fit that begins farther
# from a line does not reach it. MOST_FREQUENCIES bounds the computing time; on a log of more than
# 200 s the fastest rhythms are then not searched. A frequency takes 0.6 ms with 480 pulses, as in a
# log of 24 s, and 10 ms with 2000.
PER_LINE, MOST_FREQUENCIES, PEAKS = 2.0, 2000, 3
# Peaks of a box that are refined; the best PEAKS of them are starts. Its line is narrower than that
# of a wave, so the peak may lie beside it: of cycles spread over 150 s, the right one was not among
# the highest three.
REFINED = 12
SHORTEST = 0.05  # s, of a pulse
MOST_PULSES = 48  # in a cycle: each is on for more of it than the least duty of a mechanism
# Share of the judged cycles that are no longer than the typical one. The others may have waited.
TYPICAL = 0.75
BOUNDS = {p.name: (p.low, p.high) for p in WHENS["pulsed"].parameters}  # s, duty in %
PHASES = 24  # parts of a period: a box begins and ends between two of them
EARLIEST = 0.25  # periods: a first period that begins later leaves the fit room on both sides
# Share of the information of all phases below which that of a box is rounding: no bin hears it. The
# cycles of a long log may all miss the same phases of a period.
UNHEARD = 1e-9
ENOUGH, ITERATIONS = 0.01, 300  # chi-square to which a box is refined; at most


def rhythmic_starts(
    evidence: Evidence, weights: ResidualWhitener, causes: Hypothesis
) -> list[tuple[Mechanism, tuple[float, ...]]]:
    """Mechanisms with a rhythm, with values of their parameters other than sizes.

    There is none if the deviation is the same in each cycle, or if a cycle with one pulse more is
    longer than any period: then pulses cannot come once in a cycle.
    """
    typical = _typical_cycle(evidence)
    is_too_long = typical * (1.0 + 1.0 / MOST_PULSES) > BOUNDS["period"][1]
    if is_too_long or _differs(evidence, weights, causes) <= DIFFERS:
        return []
    mechanisms = [one for one in MECHANISMS.values() if one.when.code in RHYTHMIC]
    duration = float(evidence.seconds[-1] - evidence.seconds[0])
    starts = list[tuple[Mechanism, tuple[float, ...]]]()
    for place in PLACES.values():
        of_place = [one for one in mechanisms if one.place is place]
        if of_place:
            answers = _Answers.of(evidence, weights, causes, place, typical)
            period = of_place[0].when.parameters[0]
            spectra = _spectra(answers, _frequencies_of(duration, period.low, period.high))
            for one in of_place:
                pulsed = one.when.code == PULSED
                shapes = _pulses(answers, spectra) if pulsed else _swings(spectra)
                starts += [(one, _within(one, shape)) for shape in shapes]
    return starts


def _typical_cycle(evidence: Evidence) -> float:
    """Duration (s) of a typical judged cycle. What lies between cycles does not count."""
    judged = np.array(evidence.judged, np.int64)
    first, last = evidence.starts[judged], evidence.starts[judged + 1] - 1
    durations = evidence.clock[last] - evidence.clock[first]
    return float(np.quantile(durations, TYPICAL, method="lower"))


def _differs(evidence: Evidence, weights: ResidualWhitener, causes: Hypothesis) -> float:
    """Share of the squared deviation (mbar) that is not the same in each cycle, 0 to 1."""
    off, count = evidence.off([causes])[weights.bins, 0], evidence.bins.count[weights.bins]
    _, place = np.unique(evidence.bins.place[weights.bins], return_inverse=True)
    mean = np.bincount(place, off * count) / np.bincount(place, count)
    return float(np.sum(count * (off - mean[place]) ** 2) / max(np.sum(count * off**2), 1e-9))


def _frequencies_of(duration: float, shortest: float, longest: float) -> Floats:
    """Frequencies (Hz) that a log of some duration (s) tells apart, between two periods (s)."""
    slowest, step = 1.0 / min(duration, longest), 1.0 / (PER_LINE * duration)
    fastest = min(1.0 / shortest, slowest + step * MOST_FREQUENCIES)
    return np.arange(slowest, fastest, step)


# --- answers to short pulses ----------------------------------------------------------------------


@dataclass(frozen=True)
class _Answers:
    """Answers of the whitened residuals to one typical size of a place in each short pulse."""

    residuals: Floats
    answers: Floats  # (residuals, pulses)
    begins: Floats  # s, of each pulse, by the clock of the kernel
    width: float  # s, of a pulse

    @classmethod
    def of(
        cls,
        evidence: Evidence,
        weights: ResidualWhitener,
        causes: Hypothesis,
        place: Place,
        typical: float,
    ) -> "_Answers":
        """Run the model with one pulse in a cycle, as often as pulses fit into a typical one.

        ``typical`` (s) is the duration of that cycle. In a longer one, the answer to a pulse ends
        where the next pulse begins.
        """
        width = max(SHORTEST, typical / MOST_PULSES)
        count = int(np.ceil(typical / width))
        period = count * width
        (size,) = place.parameters
        duty = 100.0 * width / period
        pulse = {size.name: size.typical, "period": period, "duty": duty}
        name = Mechanism(place, WHENS["pulsed"]).name
        tried = [(*causes, Cause(name, {**pulse, "shift": i * width})) for i in range(count)]
        off = evidence.off([causes, *tried])
        parts, pulses = _divided(
            off[:, 1:] - off[:, :1], evidence.bins.mean(evidence.clock), period, weights.bins
        )
        begins = width * pulses.astype(np.float64)
        answers = weights.white(parts)
        seen = answers.any(axis=0)
        residuals = white(evidence, weights, [causes])[:, 0]
        return cls(residuals, answers[:, seen], begins[seen], width)

    def of_rhythm(self, period: float, duty: float, shift: float) -> Floats:
        """Answer to a rhythm that is on for a share ``duty`` of its period, from ``shift`` on."""
        ends = np.array([self.begins, self.begins + self.width]) - shift
        begun, over = _on(ends / period, duty)
        moved: Floats = self.answers @ ((over - begun) * period / self.width)
        return moved


def _divided(answers: Floats, time: Floats, period: float, bins: Ints) -> tuple[Floats, Ints]:
    """Answers to repeated pulses by pulse, (bins of the deviation, pulses), and each one's number.

    A column of ``answers`` has pulses one ``period`` (s) apart; each is over when the next begins.
    Pulses that none of the ``bins`` follows are left out: a long log has gaps without bins.
    """
    count = answers.shape[1]
    begins = (np.arange(count) - 1) * period / count
    turns = np.floor((time[bins, None] - begins) / period).astype(np.int64)
    row, run = np.nonzero(turns >= 0)
    numbers, column = np.unique(run + count * turns[row, run], return_inverse=True)
    divided = np.zeros((len(answers), len(numbers)))
    divided[bins[row], column] = answers[bins[row], run]
    return divided, numbers


def _on(periods: Floats, duty: float) -> Floats:
    """Sum (in periods) of the time until ``periods`` for which a rhythm is on."""
    whole = np.floor(periods)
    on: Floats = whole * duty + np.minimum(periods - whole, duty)
    return on


# --- periods --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Spectra:
    """What is gained in chi-square at each frequency, by a wave and by the best box."""

    frequencies: Floats
    of_wave: Floats
    wave_shift: Floats  # periods
    of_box: Floats
    box: Ints  # (frequencies, first and number of phases)


def _spectra(answers: _Answers, frequencies: Floats) -> _Spectra:
    edges = np.arange(PHASES + 1) / PHASES
    angles = 2.0 * np.pi * (edges[:-1] + 0.5 / PHASES)
    waves = np.column_stack([np.sin(angles), -np.cos(angles)])
    of_wave, shift, of_box = (np.empty(len(frequencies)) for _ in range(3))
    box = np.empty((len(frequencies), 2), np.int64)
    for i, frequency in enumerate(frequencies):
        folded = _folded(answers, float(frequency), edges)
        information, gradient = folded.T @ folded, -folded.T @ answers.residuals
        moved = waves.T @ gradient
        sine, cosine = np.linalg.lstsq(waves.T @ information @ waves, moved, rcond=None)[0]
        of_wave[i] = moved @ (sine, cosine)
        shift[i] = np.arctan2(cosine, sine) % (2.0 * np.pi) / (2.0 * np.pi)
        gains = _box_gains(information, gradient)
        first, number = np.unravel_index(int(np.argmax(gains)), gains.shape)
        of_box[i], box[i] = gains[first, number], (first, number + 1)
    return _Spectra(frequencies, of_wave, shift, of_box, box)


def _folded(answers: _Answers, frequency: float, edges: Floats) -> Floats:
    """Answers to each phase of a period, (residuals, phases)."""
    ends = np.array([answers.begins, answers.begins + answers.width]) * frequency
    whole = np.floor(ends)[..., None]
    before = np.clip(ends[..., None] - whole - edges[:-1], 0.0, 1.0 / PHASES) + whole / PHASES
    shares = (before[1] - before[0]) / (answers.width * frequency)
    folded: Floats = answers.answers @ shares
    return folded


def _box_gains(information: Floats, gradient: Floats) -> Floats:
    """Gain of each box in chi-square, (first phase, number of phases - 1); boxes may wrap."""
    sums = np.zeros((2 * PHASES + 1, 2 * PHASES + 1))
    sums[1:, 1:] = np.tile(information, (2, 2)).cumsum(0).cumsum(1)
    pulls = np.concatenate([[0.0], np.cumsum(np.tile(gradient, 2))])
    first = np.arange(PHASES)[:, None]
    last = first + np.arange(1, PHASES)
    squares = sums[last, last] - sums[first, last] - sums[last, first] + sums[first, first]
    least = UNHEARD * float(np.trace(information))
    gains: Floats = (pulls[last] - pulls[first]) ** 2 / np.maximum(squares, least)
    return gains


def _peaks(gains: Floats, count: int = PEAKS) -> Ints:
    """Where the highest peaks are, the highest first; ``count`` at most."""
    around = np.pad(gains, 1, constant_values=-np.inf)
    peaks = np.flatnonzero((gains >= around[:-2]) & (gains >= around[2:]))
    return peaks[np.argsort(-gains[peaks])[:count]]


def _swings(spectra: _Spectra) -> list[tuple[float, ...]]:
    """Period and shift (s) at the highest peaks of a wave."""
    return [
        (1.0 / float(spectra.frequencies[i]), float(spectra.wave_shift[i] / spectra.frequencies[i]))
        for i in _peaks(spectra.of_wave)
    ]


def _pulses(answers: _Answers, spectra: _Spectra) -> list[tuple[float, ...]]:
    """Period (s), duty (%) and shift (s) of the best boxes, refined from the highest peaks.

    A box is shifted in the middle of the log, so that another period does not move it.
    """
    middle = float(np.mean(answers.begins))
    lowest, highest = spectra.frequencies[[0, -1]]
    duties = np.array(BOUNDS["duty"]) / 100.0

    def shape(x: Floats) -> tuple[float, float, float]:
        period = 1.0 / float(np.clip(x[0], lowest, highest))
        return period, float(np.clip(x[1], *duties)), middle + float(x[2]) * period

    def misfit(x: Floats) -> float:
        moved = answers.of_rhythm(*shape(x))
        pull = float(moved @ answers.residuals)
        return -(pull**2) / max(float(moved @ moved), np.finfo(float).tiny)

    found = list[tuple[float, tuple[float, ...]]]()
    for i in _peaks(spectra.of_box, REFINED):
        frequency, (first, number) = float(spectra.frequencies[i]), spectra.box[i]
        phase = first / PHASES - middle * frequency % 1.0
        start: Floats = np.array([frequency, number / PHASES, phase], np.float64)
        step = (spectra.frequencies[1] - spectra.frequencies[0]) / 2.0
        simplex = start + np.vstack([np.zeros(3), np.diag([step, 1.0 / PHASES, 1.0 / PHASES])])
        best = minimize(
            misfit,
            start,
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "fatol": ENOUGH, "maxiter": ITERATIONS},
        )
        period, duty, shift = shape(best.x)
        earliest = EARLIEST * period
        refined = period, 100.0 * duty, earliest + (shift - earliest) % period
        found.append((float(best.fun), refined))
    return [refined for _, refined in sorted(found)[:PEAKS]]


def _within(mechanism: Mechanism, shape: tuple[float, ...]) -> tuple[float, ...]:
    """A shape within the bounds of the parameters; a shift beyond its own is a period less."""
    table = mechanism.when.parameters
    values = {p.name: value for p, value in zip(table, shape, strict=True)}
    if values["shift"] > BOUNDS["shift"][1]:
        values["shift"] -= values["period"]
    return tuple(float(np.clip(values[p.name], p.low, p.high)) for p in table)
