"""A line that chokes, hidden in a record by the plain equations: a commissioning finds how."""

from functools import cache

import numpy as np
import pytest
import radau
from radau import Valves

from twin.calibration.fit import Fitted, fit_from_afar
from twin.calibration.parameters import FREE_IN_MARKET
from twin.model import kernel
from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.signals import MBAR, MS, SAMPLE, Command, Samples

CRITICAL = "system.line_critical_ratio"
TRUE, TYPICAL = 0.35, 0.0
CYCLES, NOISE = 4, 0.3 * MBAR
SUCTION, HOLD, BLOW_OFF, IDLE, END = 100, 700, 750, 1000, 1300  # ms, begins of phases


def data_of(diameter_mm: float, critical: float) -> DataSet:
    """A vessel behind a metre of tube."""
    tube = {"kind": "tube", "length_mm": 1000.0, "diameter_mm": diameter_mm}
    parts = (tube, {"kind": "vessel", "volume_ml": 150.0})
    return DataSet.model_validate(
        {
            "ejector": {"air_saving": "off"},
            "sensor": {"noise_mbar": NOISE / MBAR},
            "system": {"parts": parts, "line_critical_ratio": critical},
        }
    )


@cache
def recorded(diameter_mm: float) -> tuple[Samples, float]:
    """Some cycles with noise, and the least pressure ratio of the line in suction."""
    theta = coefficients(data_of(diameter_mm, TRUE))
    delays = theta[[c.RESPONSE, c.RESPONSE_OFF, c.BLOW_OFF_RESPONSE, c.BLOW_OFF_RESPONSE_OFF]]
    acts = np.array([SUCTION, HOLD, BLOW_OFF, IDLE]) * MS + MS + delays
    positions = ((1, 0), (0, 0), (0, 1), (0, 0))
    moves = [Valves(0.0, 0, 0, 0)]
    for begin in np.arange(CYCLES) * END * MS:
        moves += [Valves(begin + at, *both) for at, both in zip(acts, positions, strict=True)]
    exact = radau.reference(theta, moves, np.arange(1, CYCLES * END + 1) * MS)
    rows = np.zeros(len(exact), SAMPLE)
    rows["sequence"] = np.arange(len(rows))
    rows["time_ns"] = rows["host_ns"] = rows["sequence"] * 1_000_000
    at = rows["sequence"] % END
    rows["commands"][(at >= SUCTION) & (at < HOLD)] = Command.SUCTION
    rows["commands"][(at >= BLOW_OFF) & (at < IDLE)] = Command.BLOW_OFF
    rows["pressure"] = exact[:, kernel.SENSED]
    rows["pressure"] += np.random.default_rng(1).normal(0.0, NOISE, len(rows))
    suction = exact[rows["commands"] == Command.SUCTION]
    return rows, float((suction[:, 0] / suction[:, 2]).min())


@cache
def fitted(diameter_mm: float) -> Fitted:
    guess = data_of(diameter_mm, TYPICAL)
    return fit_from_afar(recorded(diameter_mm)[0], [guess], lambda _: None)


@pytest.mark.slow
def test_how_a_narrow_line_chokes_is_found_from_another_guess() -> None:
    found = fitted(1.6)
    assert recorded(1.6)[1] < TRUE  # it chokes
    number = [free.name for free in FREE_IN_MARKET].index(CRITICAL)
    assert found.determined[number]
    low, high = found.interval(CRITICAL)
    assert low < TRUE < high
    assert low > TYPICAL


@pytest.mark.slow
def test_where_a_line_drops_little_it_stays_at_the_guess_with_its_width() -> None:
    found = fitted(8.0)
    assert recorded(8.0)[1] > 0.9
    number = [free.name for free in FREE_IN_MARKET].index(CRITICAL)
    assert not found.determined[number]
    assert found.data.system.line_critical_ratio == pytest.approx(TYPICAL, abs=0.05)
    assert found.spread[number] > 0.8 * found.prior[number]
