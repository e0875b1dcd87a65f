"""Quick, slow, jittered, thinned and coarse records of the second world, commissioned to the end.

Each has one thing set of a rig that is drawn from a seed. Rows are as ``twin import`` reads them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from calibrations import quiet
from second_world.draw import draw_rig
from second_world.records import record

from tools.battery_second import Met, Person
from twin.calibration.commission import commission
from twin.calibration.verdict import USABLE
from twin.signals import MS, NS, Command, Samples

JITTER = 0.3 * MS  # s, one sigma; a row is at most 0.4 ms early or late
QUICK = {"suction_s": 0.15, "pause_s": 0.0, "blow_off_s": 0.06, "idle_s": 0.09, "varied": False}
SLOW = {"suction_s": 40.0, "pause_s": 0.0, "blow_off_s": 2.0, "idle_s": 18.0, "varied": False}


@dataclass(frozen=True)
class Rhythm:
    """A kind of rig, the seed of it and of its record, and what is set of both."""

    kind: str
    seed: int
    cycles: int
    cadence_ms: int
    jitter_s: float = 0.0
    missing: float = 0.0
    program: Mapping[str, Any] = field(default_factory=dict)

    def met(self) -> tuple[Met, Samples]:
        """The rig as a person meets it, and its healthy record."""
        rig = draw_rig(self.seed, self.kind)
        changed = {"stamp_jitter": self.jitter_s, "missing": self.missing}
        sensor = replace(rig.sensor, cadence_ms=self.cadence_ms, **changed)
        rig = replace(rig, sensor=sensor, program=replace(rig.program, **self.program))
        readable = record(rig, self.seed, 1).truth.readable
        met = Met(self.seed, rig, Person.at(readable, f"{self.kind}-{self.seed}"))
        return met, met.person.samples(record(rig, self.seed, self.cycles))


RHYTHMS = {
    "cycles of 0.3 s": Rhythm("micro", 7101, 12, 1, program=QUICK),
    "cycles of a minute": Rhythm("closed_tank", 7106, 6, 10, program=SLOW),
    "jitter": Rhythm("gripper", 7104, 9, 1, jitter_s=JITTER),
    "missing rows": Rhythm("gripper", 7104, 9, 1, missing=0.05),
    "a row each 10 ms": Rhythm("gripper", 7105, 12, 10),
}


def cycle_s(samples: Samples) -> float:
    """Median time (s) from one suction to the next."""
    suction = (samples["commands"] & Command.SUCTION) != 0
    begins = np.flatnonzero(suction[1:] & ~suction[:-1]) + 1
    return float(np.median(np.diff(samples["time_ns"][begins]))) * NS


@pytest.mark.slow
@pytest.mark.timeout(900)  # one or two minutes, on a computer that does other things beside
@pytest.mark.parametrize("name", RHYTHMS)
def test_a_record_of_unusual_rhythm_is_commissioned_within_twice_its_floor(name: str) -> None:
    """None of them is too coarse, so none may be refused."""
    rhythm = RHYTHMS[name]
    met, samples = rhythm.met()
    intervals = np.diff(samples["time_ns"]) * NS
    assert np.median(intervals) == pytest.approx(rhythm.cadence_ms * MS, rel=0.1)
    assert np.std(intervals) >= rhythm.jitter_s
    assert np.mean(intervals > 1.5 * rhythm.cadence_ms * MS) >= 0.8 * rhythm.missing
    if rhythm.program:
        asked = sum(rhythm.program[key] for key in ("suction_s", "blow_off_s", "idle_s"))
        assert cycle_s(samples) == pytest.approx(asked, rel=0.1)
    found = commission(met.person.config, [samples], quiet)
    assert found.verdict.word in ("good", "usable"), found.verdict
    assert all(residual.times <= USABLE for residual in found.verdict.residuals.values())
    assert (f"{rhythm.cadence_ms} ms" in found.unseen) == (rhythm.cadence_ms == 10)
