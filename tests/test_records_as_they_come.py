"""Records that begin and end anywhere, and cycles of 0.3 s and of 60 s, up to the fit."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from calibrations import log_of, rig, typed
from test_doubts import as_if_fitted
from test_second_signals import fitted_on
from written_pages import commissioned

from tools.calibration_coverage import recorded
from twin.calibration.calibrate import complete
from twin.calibration.commission import Commissioned
from twin.calibration.readings import read, rows_by_phase
from twin.calibration.wiring import refuse_miswired
from twin.languages.catalogues import Catalogues
from twin.languages.texts import speaking
from twin.monitor.cycles import FEWEST_ROWS
from twin.monitor.healthy import Healthy
from twin.signals import MBAR, Command, Phase, Samples

NAME = "gripper"
# Suction, blow-off and idle of a cycle (ms).
QUICK, SLOW = (150.0, 60.0, 90.0), (40_000.0, 2_000.0, 18_000.0)


@cache
def of_cycles(times: tuple[float, float, float], each: int = 1) -> Samples:
    """A record of nine cycles of these times, of which every ``each``th row is left."""
    suction, blow_off, idle = times
    program = {"suction_ms": suction, "blow_off_ms": blow_off, "idle_ms": idle}
    settings = rig(NAME).model_copy(
        update={"program": rig(NAME).program.model_copy(update=program)}
    )
    rows = recorded(settings, 8, 3)[::each].copy()
    rows["sequence"] = np.arange(len(rows))
    return rows


def edges_of_suction(samples: Samples) -> list[int]:
    on = (samples["commands"] & Command.SUCTION) != 0
    return [int(row) for row in np.flatnonzero(on[1:] & ~on[:-1]) + 1]


@pytest.mark.parametrize("begin", [300, 900, 1195, 1250])
@pytest.mark.parametrize("end", [1, 25, 300, 900, 1250])
def test_a_record_may_begin_and_end_in_mid_cycle(
    begin: int, end: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In suction or in blow-off, which then counts for no cycle and changes no reading."""
    whole = log_of(NAME)
    edges = edges_of_suction(whole)
    part = whole[edges[0] + begin : edges[-1] + end].copy()
    found, usual = read(part), read(whole)
    assert (found.opened, found.saves_air) == (usual.opened, usual.saves_air)
    assert found.off == pytest.approx(usual.off, abs=2.0 * MBAR)
    refuse_miswired(part, found, typed(NAME).data.ambient.pressure_mbar * MBAR)
    used = fitted_on(monkeypatch, typed(NAME), part).samples
    assert used["time_ns"][-1] <= whole["time_ns"][edges[-1] - 1], "the cycle that is cut"


@pytest.mark.parametrize("each", [1, 10])
def test_cycles_of_a_third_of_a_second_come_to_the_fit(
    each: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples = of_cycles(QUICK, each)
    assert not read(samples).rises_in_suction
    assert len(fitted_on(monkeypatch, typed(NAME), samples).samples) > 0.8 * len(samples)


def test_cycles_of_a_minute_come_to_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = of_cycles(SLOW, 10)
    assert read(samples).opened
    assert len(complete(typed(NAME).data, samples)) == 8
    assert len(fitted_on(monkeypatch, typed(NAME), samples).samples) > 0.8 * len(samples)


def seen(samples: Samples) -> Commissioned:
    found = commissioned("good")
    return replace(found, samples=samples, readings=replace(found.readings, period=0.001))


def test_phases_too_short_for_alarms_are_told() -> None:
    short = "idle, suction and blow-off have fewer than 20 rows in a cycle: no alarm judges so"
    assert seen(of_cycles(QUICK, 10)).unseen.startswith(short)
    assert seen(of_cycles(QUICK)).unseen == ""
    assert seen(log_of(NAME)).unseen == ""
    (only,) = [seen(of_cycles((1000.0, 60.0, 500.0), 10)).unseen]
    assert only.startswith("blow-off has fewer than 20 rows in a cycle")
    coarse = commissioned("good")  # a row each 8 ms
    both = replace(coarse, samples=of_cycles(QUICK, 10)).unseen
    assert "smaller delays are not told apart; idle, suction" in both
    with speaking(Catalogues().languages["de"]):
        assert "weniger als 20 Zeilen" in seen(of_cycles(QUICK, 10)).unseen


def test_a_phase_is_as_long_as_in_most_cycles() -> None:
    rows = rows_by_phase(of_cycles(QUICK, 10)["commands"])
    assert rows == {Phase.IDLE: 9.0, Phase.SUCTION: 15.0, Phase.BLOW_OFF: 6.0}
    assert max(rows.values()) < FEWEST_ROWS


def test_a_unit_whose_suction_is_too_short_is_commissioned_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing else than its commissioning would be proposed to its owner again and again."""
    healthy = as_if_fitted(of_cycles(QUICK, 10), monkeypatch).calibration.healthy
    assert "suction_rms" not in healthy.figures
    assert healthy.is_known
    assert not Healthy().is_known
