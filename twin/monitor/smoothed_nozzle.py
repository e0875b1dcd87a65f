"""The nozzle in each row of a log as the whole log shows it.

While monitoring, a switching is found from the rows up to now and a few later ones. A log has them
all, and other suctions that show where the nozzle switches. So a diagnosis learns from the whole
log which switchings there are, and when. The detector, whose errors free runs of the model have as
well, finds the breakpoint of each and no others; where it finds none, the valve acts as the log
shows.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from twin.model import theta as c
from twin.model.theta import Theta
from twin.monitor.breakpoints import Floats, Noise
from twin.monitor.detector_window import NEVER, free_runs
from twin.monitor.offline_switching import noise_of, shows_suction, switchings
from twin.monitor.simulated_switching import shows_late
from twin.monitor.switching_detector import BEYOND, SIGNIFICANT, DetectorSettings, commanded
from twin.quality import BREAK, UNUSABLE
from twin.signals import MS, NS, SAMPLE, Command, Phase, Reported, Samples, joined

PIECE = 500_000  # rows that are searched at once, with the rest of their cycle
LONGEST_PIECE = 4 * PIECE  # also if suction lasts on
ABOUT = 20.0 * MS  # s, from the switching that the log shows to the detector's breakpoint
SHOWS = 40.0 * MS  # s before suction ends: a later switching does not show in the slope
Bytes = npt.NDArray[np.uint8]
_KNOWN, _ON = np.uint8(Reported.NOZZLE_KNOWN), np.uint8(Reported.NOZZLE)


def smoothed(
    theta: Theta, detector: DetectorSettings, blocks: Iterable[Samples]
) -> tuple[DetectorSettings, Bytes | None]:
    """Settings of the detector for a whole log, and bits of ``Reported`` for each of its rows.

    The nozzle is not known where suction is not commanded, where the beginning of suction is
    missing, and where it may go on again just before the end. Without air saving there is nothing
    to know; an ejector that reports its nozzle needs no search. A switching shows as late after the
    valve's action as in free runs of the model with coefficients ``theta``. ``blocks`` are read
    once more.
    """
    if detector.settled == NEVER or theta[c.AIR_SAVING] == c.OFF:
        return detector, None
    search, nozzles = None, [np.empty(0, np.uint8)]
    for piece in _pieces(blocks):
        samples, phase, _ = commanded(piece, detector.blow_off)
        if (samples["reported"] & _KNOWN).any():
            return detector, None
        if not shows_suction(samples, phase):
            nozzles.append(np.zeros(len(samples), np.uint8))
            continue
        samples = _timed_forwards(samples)
        search = search or _Search.of(theta, detector, noise_of(samples, phase))
        nozzles.append(search.nozzle(samples, phase))
    apart = max(detector.off_shift, detector.on_shift) + max(
        detector.window // 2, round(ABOUT / detector.period)
    )
    return replace(detector, about=apart, acts=(0, 0)), np.concatenate(nozzles)


def _pieces(blocks: Iterable[Samples]) -> Iterator[Samples]:
    """Rows of a log in pieces that end without suction, so that a long log needs little memory."""
    kept, count = list[Samples](), 0
    for block in blocks:
        kept.append(block)
        count += len(block)
        ends = np.flatnonzero((block["commands"] & Command.SUCTION) == 0)
        if count < PIECE or (not len(ends) and count < LONGEST_PIECE):
            continue
        end = int(ends[-1]) if len(ends) else len(block)
        yield joined(*kept[:-1], block[:end])
        kept, count = [block[end:]], len(block) - end
    yield joined(np.empty(0, SAMPLE), *kept)


def _timed_forwards(samples: Samples) -> Samples:
    """Rows whose time always runs on: where a clock was set back, a second passes."""
    steps = np.diff(samples["time_ns"])
    if (steps > 0).all():
        return samples
    samples = samples.copy()
    samples["time_ns"][1:] = samples["time_ns"][0] + np.cumsum(np.where(steps > 0, steps, 10**9))
    return samples


@dataclass(frozen=True)
class _Search:
    """A search for switchings in the pieces of a log."""

    noise: Noise
    goes_off: float  # Pa
    late: tuple[float, float]  # s, from the valve's action until its closing and its opening show

    @classmethod
    def of(cls, theta: Theta, detector: DetectorSettings, noise: Noise) -> "_Search":
        leaky, rows = free_runs(theta, detector.period)
        as_sampled = replace(noise, period=detector.period)
        off = shows_late(theta, rows, as_sampled, Phase.HOLD)
        on = shows_late(leaky, rows, as_sampled, Phase.SUCTION)
        return cls(noise, detector.goes_off, (off, on))

    def nozzle(self, samples: Samples, phase: Bytes) -> Bytes:
        """The bits of a piece."""
        nozzle = np.zeros(len(samples), np.uint8)
        found = switchings(samples, phase, self.noise, self.goes_off)
        shown = np.array([switching.row for switching in found], np.int64)
        on = np.array([switching.on for switching in found], np.bool_)
        times = np.array([switching.time - self.late[switching.on] for switching in found])
        seconds = (samples["time_ns"] - samples["time_ns"][0]) * NS + 0.5 * self.noise.period
        acts = np.minimum(np.searchsorted(seconds, times), len(samples) - 1) + 1
        unusable = (samples["quality"] & UNUSABLE) != 0
        pressure = np.where(unusable, np.nan, samples["pressure"].astype(np.float64))
        levels = pressure[acts[~on] - 1]
        levels = levels[np.isfinite(levels)]
        off_level = float(np.median(levels)) if len(levels) else -np.inf
        for first, last in _suctions(phase, (samples["quality"] & BREAK) != 0):
            nozzle[first:last] = _KNOWN | _ON
            for number in range(*np.searchsorted(shown, (first, last))):
                row = min(max(int(acts[number]), first + 1), last)
                nozzle[row:last] = _KNOWN | _ON * np.uint8(on[number])
            end = slice(max(last - round(SHOWS / self.noise.period), first + 1), last)
            if not (nozzle[end] & _ON).any():
                nozzle[end] = 0  # it may go on again
            elif nozzle[last - 1] & _ON:
                nozzle[last - self._off_by_level(pressure[first:last], off_level) : last] = _KNOWN
        return nozzle

    def _off_by_level(self, pressure: Floats, off_level: float) -> int:
        """Rows at the end of a suction for which the nozzle must be off: it fell below a level."""
        pressure = pressure[-max(round(SHOWS / self.noise.period), 1) :]
        if not pressure[-1] < off_level - max(BEYOND, SIGNIFICANT * self.noise.single):
            return 0
        return int((pressure[::-1] > off_level).argmax())  # none if it was below for longer


def _suctions(phase: Bytes, breaks: npt.NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Rows of suctions from their beginning to their end, or to a break."""
    ends = np.flatnonzero((np.diff(phase, prepend=np.uint8(Phase.SUCTION)) != 0) | breaks)
    for first, last in pairwise([*ends.tolist(), len(phase)]):
        if phase[first] == Phase.SUCTION and not breaks[first]:
            yield first, last
