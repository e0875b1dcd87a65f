"""The nozzle as a whole log shows it, and the twin of a diagnosis that is told so."""

import numpy as np
import numpy.typing as npt
import pytest
import rigs
from hypothesis import given, settings
from hypothesis import strategies as st
from test_reported_nozzle import NEAR, off_by, silent, simulated, switched

from twin.model.dataset import coefficients
from twin.monitor.detector_window import detector_of
from twin.monitor.offline_switching import noise_of
from twin.monitor.smoothed_nozzle import _pieces, _Search, smoothed
from twin.monitor.switching_detector import PhaseFinder, commanded
from twin.quality import Quality
from twin.signals import SAMPLE, Command, Phase, Reported, Samples

Bytes = npt.NDArray[np.uint8]
KNOWN, ON = int(Reported.NOZZLE_KNOWN), int(Reported.NOZZLE_KNOWN | Reported.NOZZLE)


def nozzle(samples: Samples, name: str = "gripper") -> Bytes:
    told = smoothed(rigs.theta(name), rigs.detector(name), [samples])[1]
    assert told is not None
    return told


def phases(samples: Samples, size: int = 5000, name: str = "gripper") -> Bytes:
    finder = PhaseFinder(*smoothed(rigs.theta(name), rigs.detector(name), [samples]))
    parts = [finder.push(block)[1] for block in rigs.cut(samples, size)]
    return np.concatenate([*parts, finder.flush()[1]])


def test_a_log_shows_what_is_too_quick_for_the_live_detector() -> None:
    samples, moved = simulated("gripper", 0.0, small=True)
    found = switched(phases(silent(samples)))
    assert np.abs(off_by(found, moved)).max() <= 3
    suction = np.pad(samples["commands"] == Command.SUCTION, 2 * NEAR)
    well_within = suction[found] & suction[found + 4 * NEAR] & (found < moved[-1] + NEAR)
    assert np.abs(off_by(moved, found[well_within])).max() <= 3


@pytest.mark.parametrize("name", ["gripper", "test_rig"])
def test_the_valve_acts_where_it_did_not_where_it_shows(name: str) -> None:
    samples, moved = simulated(name, 0.0, small=False)
    told = nozzle(silent(samples), name)
    switches = np.flatnonzero((told[1:] == KNOWN) & (told[:-1] == ON)) + 1
    assert np.abs(off_by(switches, moved)).max() <= 2


@pytest.mark.parametrize("size", [1, 64])
def test_it_is_the_same_however_the_stream_is_cut(size: int) -> None:
    samples = silent(simulated("gripper", 0.0, small=True)[0])[:6000]
    assert (phases(samples, size) == phases(samples)).all()


def test_pieces_of_a_long_log_show_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = silent(simulated("gripper", 0.0, small=False)[0])
    whole = nozzle(samples)
    monkeypatch.setattr("twin.monitor.smoothed_nozzle.PIECE", 4000)
    finder_settings = rigs.theta("gripper"), rigs.detector("gripper")
    in_pieces = smoothed(*finder_settings, list(rigs.cut(samples, 700)))[1]
    assert in_pieces is not None
    assert np.count_nonzero(in_pieces != whole) < 20  # a few rows earlier or later


def test_a_suction_without_its_beginning_is_not_known() -> None:
    samples = silent(simulated("gripper", 0.0, small=False)[0])
    suction = samples["commands"] == Command.SUCTION
    first = int(suction.argmax())
    end = first + int((~suction[first:]).argmax())
    told = nozzle(samples[first + 300 :])
    assert not told[: end - first - 300].any()
    second = slice(end - first - 300 + int(suction[end:].argmax()), None)
    assert told[second][0] == ON
    gap = samples.copy()
    gap["quality"][first + 300] |= np.uint8(Quality.RESTART)
    assert nozzle(gap)[first + 200] == ON
    assert not nozzle(gap)[first + 300 : end].any()


def test_nothing_is_known_of_an_ejector_that_saves_no_air() -> None:
    data = rigs.config("gripper").data
    off = data.model_copy(update={"ejector": data.ejector.model_copy(update={"air_saving": "off"})})
    samples, _ = simulated("gripper", 0.0, small=False)
    assert smoothed(coefficients(off), detector_of(off), [samples])[1] is None


def test_a_switching_too_near_the_end_to_show_is_decided_by_level() -> None:
    samples, moved = simulated("gripper", 0.0, small=False)
    samples = silent(samples)
    last = int(moved[moved > 8000][0])
    samples["commands"][last + 6 : last + 400] = 0
    found = switched(phases(samples))
    assert np.abs(found - last).min() <= 4


def test_a_nozzle_that_goes_on_just_before_suction_ends_is_seen() -> None:
    samples = silent(rigs.recorded("gripper", 20.0, faults=("leakage=4.0",))[0])
    finder = PhaseFinder(rigs.detector("gripper"))
    live = np.concatenate([finder.push(samples)[1], finder.flush()[1]])
    detector = switched(live)
    on = int(detector[live[detector] == Phase.SUCTION][3])
    samples["commands"][on + 30 : on + 300] = 0
    assert np.abs(switched(phases(samples)) - on).min() <= 3


def test_an_ejector_that_reports_its_nozzle_needs_no_search() -> None:
    samples, _ = simulated("gripper", 20.0, small=True)
    detector = rigs.detector("gripper")
    assert smoothed(rigs.theta("gripper"), detector, [samples]) == (detector, None)


def test_what_is_told_decides() -> None:
    samples = silent(simulated("gripper", 0.0, small=False)[0])
    never = np.full(len(samples), ON, np.uint8)
    finder = PhaseFinder(rigs.detector("gripper"), never)
    assert not (np.concatenate([finder.push(samples)[1], finder.flush()[1]]) == Phase.HOLD).any()


def test_a_reading_that_cannot_be_used_decides_nothing() -> None:
    samples, moved = simulated("gripper", 0.0, small=False)
    samples = silent(samples)
    end = int(moved[0]) - 100  # the nozzle is on
    samples["commands"][end : moved[0] + 400] = 0
    samples["pressure"][end - 1], samples["quality"][end - 1] = 0.0, int(Quality.BAD)
    assert nozzle(samples)[end - 1] == ON


def test_a_valve_that_would_act_after_the_log_ends_leaves_it_whole() -> None:
    samples = silent(simulated("gripper", 0.0, small=False)[0])
    samples, phase, _ = commanded(samples, (0.0, 0.0))
    early = _Search(noise_of(samples, phase), np.nan, (-1e3, -1e3))
    assert len(early.nozzle(samples, phase)) == len(samples)


def test_a_hold_of_a_night_is_cut() -> None:
    """Memory is for some pieces, however long a part is held."""
    blocks = []
    for number in range(40):
        block = np.zeros(100, SAMPLE)
        block["commands"] = Command.SUCTION if number else 0
        blocks.append(block)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twin.monitor.smoothed_nozzle.PIECE", 300)
        patch.setattr("twin.monitor.smoothed_nozzle.LONGEST_PIECE", 1000)
        pieces = [len(piece) for piece in _pieces(blocks)]
    assert sum(pieces) == 4000
    assert max(pieces) <= 1000


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_log_keeps_its_rows(seed: int) -> None:
    """Readings and commands may be missing, at random, or all the same; clocks may jump."""
    rng = np.random.default_rng(seed)
    samples = silent(simulated("gripper", 0.0, small=False)[0])
    first, count = rng.integers(0, 10_000), rng.choice([0, 1, 2, 5, 30, 300, 5000])
    samples = samples[first : first + count].copy()
    if count and rng.random() < 0.5:
        samples["pressure"][rng.random(count) < rng.choice([0.01, 0.3, 1.0])] = np.nan
    if count and rng.random() < 0.4:
        marks = np.uint8(rng.choice(list(Quality)))
        samples["quality"][rng.integers(0, count, 1 + count // 50)] |= marks
    if rng.random() < 0.3:
        samples["time_ns"] = rng.choice([samples["time_ns"], rng.permutation(samples["time_ns"])])
    if rng.random() < 0.3:
        samples["commands"] = rng.choice([0, 1, 2, 3], count)
    if rng.random() < 0.2:
        samples["pressure"] = 101_300.0
    if rng.random() < 0.1:
        samples["commands"], samples["time_ns"] = Command.SUCTION, 0
    blocks = rigs.cut(samples, 1 + count // 9)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twin.monitor.smoothed_nozzle.PIECE", 2000)
        finder = PhaseFinder(*smoothed(rigs.theta("gripper"), rigs.detector("gripper"), blocks))
    assert finder.nozzle is not None
    assert len(finder.nozzle) == count
    assert len(finder.push(samples)[0]) + len(finder.flush()[0]) == count
