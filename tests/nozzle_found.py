"""How well the nozzle's switching is found, against the truth of rigs of the second world.

    python tests/nozzle_found.py [--first 9000] [--rigs 6] [--cycles 12] [--old] [--each]
        [--reported MS]

Rigs are drawn by seed, so many of each kind, and each that saves air once more with a larger leak
and another hysteresis, so that its nozzle goes on again. A switching counts where the record goes
on for 40 ms or four rows after it. One that shows in the pressure within 100 ms is found. When it
shows is later than when the valve begins to move, by the same in a rig: the error is from the
median of the rig, and within the limit at 5 ms or one row.
"""

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from second_rigs import config_of, samples_of
from second_world import KINDS, draw_rig, record
from second_world.records import Record
from second_world.rig import Rig

from twin.calibration.commission import guessed
from twin.calibration.readings import read
from twin.model.dataset import coefficients
from twin.monitor.detector_window import expected_detector, select_window
from twin.monitor.offline_switching import noise_of, switchings
from twin.monitor.switching_detector import PhaseFinder
from twin.signals import MS, NS, Phase, Reported, Samples

STAMP = 1.0 * MS  # by which a record's stamps are late
SHOWS_WITHIN = 100.0 * MS  # and three rows
GOES_ON, GOES_ON_ROWS = 40.0 * MS, 4.0
LIMIT = 5.0 * MS
LEAKY = "leaky "
LONGEST = 20.0  # s of suction, with which a leaky rig is simulated
Switch = tuple[float, bool]  # s, and whether the nozzle goes on


@dataclass(frozen=True)
class Score:
    """How well the switchings of one record were found."""

    name: str
    cycles: int
    late: list[Switch]  # each that was found, by so much (s)
    missed: list[Switch]
    false: list[Switch]
    period: float  # s
    seconds: float  # that it took

    @property
    def errors(self) -> npt.NDArray[np.float64]:
        """How far each is (s) from the median of its kind in this rig."""
        parts = [np.array([late for late, on in self.late if on == kind]) for kind in (False, True)]
        return np.concatenate(
            [np.abs(part - np.median(part)) for part in parts if len(part)] or [np.empty(0)]
        )

    @property
    def beyond(self) -> int:
        """How many are further off than the limit."""
        return int(np.count_nonzero(self.errors > max(LIMIT, self.period)))


def told(samples: Samples) -> npt.NDArray[np.uint8]:
    """Phases by commands alone."""
    phases = (Phase.IDLE, Phase.SUCTION, Phase.BLOW_OFF, Phase.BLOW_OFF)
    return np.array(phases, np.uint8)[samples["commands"]]


def leaky(rig: Rig, seed: int) -> Rig | None:
    """The same with its nozzle off for a twentieth to half of the time that suction then lasts."""
    rng = np.random.default_rng([seed, 99])
    if not rig.air_saving.air_saving or rig.program.suction_s > LONGEST:
        return None
    hysteresis = float(rng.uniform(0.08, 0.25)) * rig.air_saving.h1
    rest = max(rig.program.suction_s - rig.evacuation_s, 0.1)
    off = float(np.exp(rng.uniform(np.log(0.05), np.log(0.5)))) * rest
    volume = rig.vessel.rigid_volume + rig.vessel.cup_volume
    leak = volume * hysteresis / (287.05 * rig.surroundings.ambient_temperature) / off
    leak = max(min(leak, 0.25 * rig.nominal_flow), rig.vessel.leak)
    control = replace(rig.air_saving, hysteresis=hysteresis)
    return replace(rig, vessel=replace(rig.vessel, leak=leak), air_saving=control)


def drawn(first: int, rigs: int, cycles: int) -> Iterator[tuple[str, Record]]:
    """Records of so many rigs of each kind."""
    for kind in KINDS:
        for seed in range(first, first + rigs):
            rig = draw_rig(seed, kind)
            yield f"{kind} {seed}", record(rig, seed, cycles)
            if (more := leaky(rig, seed)) is not None:
                yield f"{LEAKY}{kind} {seed}", record(more, seed, cycles)


def found_by_new(samples: Samples, _: Record) -> list[Switch]:
    """Switchings by the finder that knows nothing."""
    phase = told(samples)
    seconds = (samples["time_ns"] - samples["time_ns"][0]) * NS
    noise = noise_of(samples, phase)
    return [
        (float(seconds[switching.row]), switching.on)
        for switching in switchings(samples, phase, noise)
    ]


def found_by_old(samples: Samples, logged: Record) -> list[Switch]:
    """Switchings by the live twin's finder, with the data that a commissioning begins with."""
    readings = read(samples)
    data, _ = guessed(config_of(logged.truth.readable).data, readings)
    detector = select_window(expected_detector(coefficients(data), readings.noise), [samples])
    finder = PhaseFinder(detector)
    phase = np.concatenate([finder.push(samples)[1], finder.flush()[1]])
    seconds = (samples["time_ns"] - samples["time_ns"][0]) * NS
    inside = np.isin(phase, (Phase.SUCTION, Phase.HOLD))
    rows = np.flatnonzero((np.diff(phase) != 0) & inside[1:] & inside[:-1]) + 1
    return [(float(seconds[row]), bool(phase[row] == Phase.SUCTION)) for row in rows]


def true(logged: Record) -> list[tuple[float, bool, float]]:
    """When (s) the nozzle switched by itself, if on, and for how long (s) suction goes on."""
    seconds = (logged.time_ns - logged.time_ns[0]) * NS
    begin = logged.time_ns[0] * NS
    suction = logged.suction & ~logged.blow_off
    edges = np.flatnonzero(np.diff(suction, prepend=False, append=False))
    switches = zip(logged.truth.nozzle_s + STAMP - begin, logged.truth.nozzle_on, strict=True)
    times = [(float(at), bool(on)) for at, on in switches]
    found = []
    for first, last in edges.reshape(-1, 2):
        low, high = float(seconds[first]), float(seconds[last - 1])
        inside = [(at, on, high - at) for at, on in times if low < at < high]
        while inside and inside[0][1]:  # by command
            inside = inside[1:]
        found += inside
    return found


def reporting(samples: Samples, logged: Record, late: float) -> Samples:
    """The same with the nozzle reported, so long (s) after its valve has begun to move."""
    seconds = samples["time_ns"] * NS
    at = np.searchsorted(logged.truth.nozzle_s + STAMP + late, seconds, "right")
    on = np.concatenate([[False], logged.truth.nozzle_on])[at]
    samples["reported"] = Reported.NOZZLE_KNOWN + on * np.uint8(Reported.NOZZLE)
    return samples


def scored(name, logged, finder=found_by_new, late=None) -> Score:  # type: ignore[no-untyped-def]
    """Score a finder on a record; ``late`` (s) is how late reports of the nozzle are, if any."""
    samples = samples_of(logged)
    if late is not None:
        samples = reporting(samples, logged, late)
    began = time.perf_counter()
    left = finder(samples, logged)
    took = time.perf_counter() - began
    period = float(np.median(np.diff(logged.time_ns))) * NS
    late, missed = list[Switch](), list[Switch]()
    for at, on, goes_on in true(logged):
        near = [
            switching
            for switching in left
            if switching[1] == on and abs(switching[0] - at) < SHOWS_WITHIN + 3 * period
        ]
        if near:
            best = min(near, key=lambda switching: abs(switching[0] - at - 2.0 * LIMIT))
            left.remove(best)
            late.append((best[0] - at, on))
        elif goes_on > max(GOES_ON, GOES_ON_ROWS * period):
            missed.append((at, on))
    return Score(name, len(logged.truth.cycles), late, missed, left, period, took)


def table(scores: Sequence[Score]) -> Iterator[str]:
    """A line for each kind, and one for all."""
    yield (
        f"{'kind':22} rigs cycles switchings missed false"
        "  late: median  error: 95 %    most  beyond"
    )
    kinds = dict.fromkeys(score.name.rsplit(" ", 1)[0] for score in scores)
    for kind in [*kinds, ""]:
        some = [score for score in scores if score.name.rsplit(" ", 1)[0] == kind or not kind]
        late = [by for score in some for by, _ in score.late] or [np.nan]
        errors = np.concatenate([score.errors for score in some])
        errors = errors if len(errors) else np.array([np.nan])
        numbers = [
            sum(len(part) for part in parts)
            for parts in zip(*((s.late, s.missed, s.false) for s in some), strict=True)
        ]
        yield (
            f"{kind or 'all':22} {len(some):4} {sum(s.cycles for s in some):6}"
            f" {numbers[0] + numbers[1]:10} {numbers[1]:6} {numbers[2]:5}"
            f" {np.median(late) / MS:10.1f} ms {np.quantile(errors, 0.95) / MS:8.1f} ms"
            f" {errors.max() / MS:5.0f} ms {sum(s.beyond for s in some):7}"
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("--first", 9000), ("--rigs", 6), ("--cycles", 12)):
        parser.add_argument(name, type=int, default=default)
    parser.add_argument("--old", action="store_true", help="the live twin's finder")
    parser.add_argument("--reported", type=float, help="the ejector reports, so many ms late")
    parser.add_argument("--each", action="store_true", help="each rig with something wrong, too")
    asked = parser.parse_args()
    finder = found_by_old if asked.old else found_by_new
    late = None if asked.reported is None else asked.reported * MS
    scores = []
    for name, logged in drawn(asked.first, asked.rigs, asked.cycles):
        scores.append(one := scored(name, logged, finder, late))
        if asked.each and (one.missed or one.false or one.beyond):
            sensor = logged.truth.rig.sensor
            sys.stdout.write(
                f"{name}: {len(one.missed)} missed, {len(one.false)} false, {one.beyond} beyond;"
                f" {sensor.place}, {one.period / MS:.0f} ms, {one.seconds:.1f} s,"
                f" first {[*one.missed, *one.false][:2]}\n",
            )
    sys.stdout.write("\n".join(table(scores)) + "\n")
    slowest = max(scores, key=lambda score: score.seconds)
    sys.stdout.write(f"slowest: {slowest.name}, {slowest.seconds:.1f} s\n")


if __name__ == "__main__":
    main()
