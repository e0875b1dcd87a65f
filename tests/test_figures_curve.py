"""Figures read off the curve, against curves whose figures are known, and graded leaks."""

import math
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import rigs
from test_derive import coarse, cycle, known, with_derived

from twin.compare.compare import chance
from twin.figures.curve import CURVE, Reading, Stretch, flow_behind, readings, stretches
from twin.figures.cycle import KeyFigures
from twin.monitor.cycles import cut
from twin.quality import Quality
from twin.signals import MBAR, ML, SL_MIN, Command, Samples

# Levels (mbar) with time constant and length (s): idle, an open cup, a part, a slow leak, a vent.
PARTS = (
    (1013.0, 0.002, 0.5),
    (980.0, 0.01, 0.6),
    (300.0, 0.2, 2.0),
    (900.0, 20.0, 1.2),
    (1013.0, 0.1, 1.0),
)
TOP = 713.0  # mbar
OPEN = 33.0
DECAY = 600.0 / 20.0  # mbar/s, as it begins
STEPS = [0.001, 0.01, 0.0256]


def commanded(step: float, noise: float = 0.5) -> Samples:
    """The curve with suction from the open cup to the vent."""
    samples = cycle(PARTS, noise, step)
    time = np.arange(len(samples)) * step
    samples["commands"][(time > 0.5) & (time <= 4.3)] = Command.SUCTION
    return samples


def read(samples: Samples, evacuated: float = math.nan) -> dict[str, Reading]:
    (one,) = stretches([samples], evacuated)
    return readings(one)


@pytest.mark.parametrize("step", STEPS)
def test_known_figures_lie_within_their_intervals(step: float) -> None:
    found = read(commanded(step))
    known = {
        "highest": TOP,
        "open_cup": OPEN,
        "evacuation": 1e3 * 0.2 * math.log(9.0),
        "decay": DECAY * math.exp(-0.6 / 20.0),  # in the middle of its second
        "last": TOP - 600.0 * (1.0 - math.exp(-1.2 / 20.0)),
        "release": 1e3 * 0.1 * math.log(9.0),
    }
    for name, value in known.items():
        reading = found[name]
        assert not reading.why, (name, reading)
        half = reading.half + (2.0 if name in {"highest", "last"} else 0.0)  # what a row moves by
        assert abs(reading.value - value) < 1.5 * half, (name, reading, value)
    assert found["evacuation"].half == pytest.approx(1e3 * step, rel=0.01)


def test_a_rate_gives_the_flow_where_the_volume_is_known() -> None:
    found = read(commanded(0.001), 500.0 * ML)
    # Between 10 and 33 % of the way down from 980 to 300 mbar, e-fold 0.2 s.
    low, high = (980.0 - share * 680.0 for share in (0.1, 0.33))
    passed = 0.2 * math.log(0.9 / 0.67)
    rate = math.log(low / high) / passed
    assert found["rate"].value == pytest.approx(rate, rel=0.02)
    flow = flow_behind(found["rate"].value, 500.0 * ML, 1013.0 * MBAR, 293.15) / SL_MIN
    assert found["flow"].value == pytest.approx(flow, rel=1e-3)
    assert found["flow"].half >= 0.2 * found["flow"].value
    assert "volume is not known" in read(commanded(0.001))["flow"].why


def test_a_peak_that_a_slow_logger_misses_lies_in_its_interval() -> None:
    true = [
        CURVE["highest"].of(stretch) for stretch in stretches([known("gripper")]) if stretch.ended
    ]
    slow = [
        CURVE["highest"].of(stretch)
        for stretch in stretches([coarse(known("gripper"))])
        if stretch.ended
    ]
    for one, other in zip(true, slow, strict=True):
        assert abs(one.value - other.value) < max(1.5 * other.half, 3.0)
        assert other.half < 60.0


def test_what_is_not_told_has_its_reason() -> None:
    samples = commanded(0.0256)
    whole = read(samples)
    assert whole["rate"].why.startswith("too few readings in the evacuation")
    on = np.flatnonzero(samples["commands"])
    inside = read(samples[on[0] + 60 : on[-1] - 10])
    assert {figure.why for figure in inside.values()} == {
        "the record has no idle, from which vacuum counts"
    }
    begins = read(samples[on[0] + 60 :])
    assert begins["evacuation"].why == "the record begins in the vacuum"
    cut = read(samples[: on[-1] - 10])
    assert cut["highest"].why == cut["last"].why == cut["release"].why == "the record ends before"
    assert read(samples[: on[-1] + 3])["release"].why == "the record ends before"
    holed = commanded(0.001)
    holed["quality"][1100:1200] = Quality.BAD.value
    assert read(holed)["evacuation"].why == "readings are missing there"
    for reading in (*whole.values(), *cut.values()):
        assert math.isnan(reading.value) == bool(reading.why)


def test_an_offset_changes_no_vacuum() -> None:
    samples = commanded(0.01)
    before = read(samples)
    samples["pressure"] -= 50.0 * MBAR
    after = read(samples)
    for name in ("highest", "open_cup", "evacuation", "decay", "last", "release"):
        assert after[name].value == pytest.approx(before[name].value, rel=1e-3), name


def test_an_air_saving_is_no_decay() -> None:
    swings = [(450.0, 0.3, 0.3), (300.0, 0.1, 0.3)] * 4
    samples = cycle([PARTS[0], PARTS[2], *swings, PARTS[-1]], 0.5, 0.01)
    samples["commands"][51:490] = Command.SUCTION
    assert read(samples)["decay"].why == "the vacuum swings, as an air saving lets it"


# --- graded leaks, as a slow logger without commands sees them ----------------------------------

GRADES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # sl/min


@cache
def graded(leak: float) -> list[Stretch]:
    faults = (f"leakage={leak}@0",) if leak else ()
    samples, _ = rigs.recorded("gripper", 30.0, faults, seed=int(100 * leak) + 3)
    found = stretches([with_derived(coarse(samples))])
    return [stretch for stretch in found if stretch.ended][1:]


def figure(leak: float, name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    found = [CURVE[name].of(stretch) for stretch in graded(leak)]
    return np.array([figure.value for figure in found if not figure.why])


def test_neighbouring_grades_of_a_leak_are_told_apart() -> None:
    names = ("evacuation", "decay", "highest")
    for less, more in pairwise(GRADES):
        chances = [chance(figure(less, name), figure(more, name)) for name in names]
        assert np.nanmin(chances) < 0.05 / len(CURVE), (less, more, chances)
    means = [figure(leak, "evacuation").mean() for leak in GRADES]
    assert means == sorted(means)


def test_a_slow_cadence_keeps_the_key_figures_that_no_switching_changes() -> None:
    told = []
    key_figure_source = KeyFigures(rigs.config("gripper").data)
    for piece in cut(rigs.twin("gripper").over([coarse(known("gripper"))])):
        if (one := key_figure_source.take(piece)) is not None and one.complete:
            told.append(one.measured)
    assert len(told) >= 8
    for measured in told[1:]:
        assert measured["max_vacuum"] == pytest.approx(740.0, abs=30.0)  # a peak between two
        assert measured["t0"] == pytest.approx(189.0, abs=33.0)  # a row, which may come late
        assert measured["h1_not_reached"] in {0.0, 1.0}
        for name in ("t1", "leakage", "nozzle_share", "air", "switchings"):
            assert math.isnan(measured[name]), name
