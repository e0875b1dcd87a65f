"""What a log's evidence holds beside its cycles."""

import tracemalloc
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import rigs

from twin.diagnosis.evidence import HEALTHY, collect, read_cycles, thinned
from twin.diagnosis.residual_covariance import covariance
from twin.live import Twin
from twin.model import theta as c
from twin.model.courses import Cause
from twin.model.dataset import coefficients
from twin.monitor.cycles import whole
from twin.monitor.detector_window import detector_of
from twin.monitor.smoothed_nozzle import smoothed
from twin.signals import Phase, Samples

SECONDS = 60.0
MOST_BYTES = 8  # of a row that is kept; one of SAMPLE and TICK has 61


def test_a_value_that_is_open_by_more_than_itself_keeps_to_its_bounds() -> None:
    """A sigma less than a flow that hardly shows is no negative one, which has no pressure."""
    config = rigs.config("test_rig")
    relief = config.data.ejector.relief_sl_min
    healthy = config.monitor.healthy.model_copy(
        update={"uncertain": {"ejector.relief_sl_min": (3.0 * relief,)}}
    )
    monitor = config.monitor.model_copy(update={"healthy": healthy})
    samples, _ = rigs.recorded("test_rig", 12.0)
    evidence = collect(replace(config, monitor=monitor), [samples])
    healthy_relief = coefficients(config.data)[c.RELIEF]
    up, down, *_ = evidence.uncertain[-1]
    assert up[c.RELIEF] == pytest.approx(4.0 * healthy_relief)
    assert 0.0 < down[c.RELIEF] < healthy_relief


def test_what_a_record_ties_together_moves_healthy_cycles_by_its_slope() -> None:
    """A whole sigma of it bends away; what moves one value alone keeps its whole sigma."""
    samples, _ = rigs.recorded("test_rig", 12.0)
    evidence = collect(rigs.config("test_rig"), [samples])
    tied = np.array([shift.tied for shift in evidence.uncertain])
    assert 0 < tied.sum() < len(tied)
    healthy = covariance(evidence)
    first = healthy.beyond[:, : len(tied)]
    assert np.abs(first[:, tied]).max() < 1e-3  # mbar
    assert (healthy.parameter_sensitivity[:, ~tied] == 0.0).all()
    bases = [evidence.theta]
    bases += [evidence.theta + 0.05 * (shift.up - evidence.theta) for shift in evidence.uncertain]
    off = evidence.off([HEALTHY] * len(bases), bases)
    slopes = (off[:, 1:] - off[:, :1]) / 0.05
    for way in np.flatnonzero(tied):
        apart = np.linalg.norm(healthy.parameter_sensitivity[:, way] - slopes[:, way])
        assert apart < 0.1 * np.linalg.norm(slopes[:, way])
    about = covariance(evidence, (Cause("suction_loss", {"loss": 5.0}),))
    assert (about.parameter_sensitivity == healthy.parameter_sensitivity).all()
    assert np.abs(about.beyond[:, : len(tied)][:, tied]).max() > 0.1


def test_a_valve_can_act_before_its_command_is_seen() -> None:
    """Commands that come a row late leave what a delay shorter by that row makes of it."""
    samples, _ = rigs.recorded("test_rig", 12.0)
    evidence = collect(rigs.config("test_rig"), [samples])
    row, ms = 1e-3, 1e-3
    delays = [c.RESPONSE, c.RESPONSE_OFF, c.BLOW_OFF_RESPONSE, c.BLOW_OFF_RESPONSE_OFF]
    soon = evidence.theta.copy()
    soon[delays] = [0.4 * ms, 0.7 * ms, 0.2 * ms, 0.9 * ms]
    before_command = soon.copy()
    before_command[delays] -= row
    late = evidence.ticks.copy()
    suction = np.isin(late["phase"], (Phase.SUCTION, Phase.HOLD))
    commands = np.where(suction, Phase.SUCTION, late["phase"])
    for edge in np.flatnonzero(np.diff(commands)) + 1:
        late["phase"][edge] = evidence.ticks["phase"][edge - 1]
        late["level"][[edge, edge + 1]] = np.nan, evidence.ticks["level"][edge]
    off = evidence.off([HEALTHY], [soon])
    off_late = replace(evidence, ticks=late).off([HEALTHY], [before_command])
    assert off_late == pytest.approx(off, abs=1e-3)
    unlike = replace(evidence, ticks=late).off([HEALTHY], [soon])
    assert np.abs(unlike - off).max() > 0.5


class Reread:
    """Blocks of a log, ``again`` times, made anew by each iteration, as those of a file are."""

    def __init__(self, again: int = 1) -> None:
        self.again = again

    def __iter__(self) -> Iterator[Samples]:
        samples, _ = rigs.recorded("test_rig", SECONDS)
        for number in range(self.again):
            for block in rigs.cut(samples, 1000):
                later = block.copy()
                later["sequence"] += number * len(samples)
                later["time_ns"] += number * (samples["time_ns"][-1] - samples["time_ns"][0])
                yield later


@pytest.mark.parametrize("piece", [100_000, 700])
def test_rows_of_a_log_are_kept_compressed_and_come_back_to_the_bit(
    piece: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.diagnosis.evidence.PIECE", piece)
    config = rigs.config("test_rig")
    log, theta = read_cycles(config, Reread()), coefficients(config.data)
    settings = smoothed(theta, detector_of(config.data), Reread())
    cycles = whole(Twin(theta, settings[0], config.data.terms, settings[1]).over(Reread()))
    assert log.cycles == len(cycles) > 15
    for number, cycle in enumerate(cycles):
        for kept, given in zip(log.rows(number), (cycle.samples, cycle.ticks), strict=True):
            assert kept.tobytes() == given.tobytes()
    rows = sum(len(cycle.samples) for cycle in cycles)
    assert sum(len(part) for parts in log.packed for part in parts) < MOST_BYTES * rows
    assert log.saturated == 0.0


def test_reading_a_log_takes_no_memory_for_all_its_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of a piece, of one cycle and of some blocks at a time, in several passes."""
    monkeypatch.setattr("twin.monitor.smoothed_nozzle.PIECE", 2_000)
    read_cycles(rigs.config("test_rig"), Reread())  # compiles first
    most = []
    for again in (1, 3):
        tracemalloc.start()
        read_cycles(rigs.config("test_rig"), Reread(again))
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    samples, _ = rigs.recorded("test_rig", SECONDS)
    assert most[1] - most[0] < samples.nbytes  # of twice as many more rows


def test_evidence_of_some_cycles_is_that_of_all_cut_down() -> None:
    config = rigs.config("test_rig")
    log, everything = read_cycles(config, Reread()), collect(config, iter(Reread()))
    assert everything.judged == log.judged
    np.testing.assert_array_equal(everything.seconds[everything.starts[:-1]], log.begins)
    for source in (log, everything):
        part = thinned(source, source.judged, 6)
        assert len(part.judged) == 6
        assert part.figures == [log.figures[number] for number in part.numbers]
        rows = [log.rows(int(number)) for number in part.numbers]
        assert part.samples.tobytes() == b"".join(samples.tobytes() for samples, _ in rows)
        assert part.ticks.tobytes() == b"".join(ticks.tobytes() for _, ticks in rows)
