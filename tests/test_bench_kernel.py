"""What the bench compares the model with is the same scheme: it says so only where it is run."""

import importlib
from pathlib import Path

import numpy as np
import pytest
import rigs
from stepping import phase_rows

from twin.model import kernel
from twin.model import theta as c
from twin.signals import MBAR, MS, Phase

TOOLS = Path(__file__).parent.parent / "tools"
IDLE, SUCTION, HOLD, BLOW_OFF = Phase
PHASES = [(IDLE, 30), (SUCTION, 400), (HOLD, 90), (SUCTION, 60), (BLOW_OFF, 100), (IDLE, 120)]


@pytest.mark.slow
@pytest.mark.needs("cc")
@pytest.mark.parametrize("name", rigs.NAMES)
def test_the_benchs_c_gives_the_models_bits(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))
    native = importlib.import_module("benchmarks.kernel").in_c(tmp_path)
    assert native is not None
    theta, phase = rigs.theta(name), phase_rows(PHASES)
    dt, level = np.full(len(phase), MS), np.full(len(phase), np.nan)
    dt[[200, 550]] = 7 * MS, 0.0
    level[[10, 430, 600]] = theta[c.AMBIENT] - np.array([0.0, 450.0, 300.0]) * MBAR
    found = []
    for advance in (kernel.advance, native):
        expected, signals = np.empty(len(phase)), np.empty(len(phase), "u1")
        advance(kernel.new_state(), theta, dt, phase, level, expected, signals)
        found.append((expected, signals))
    (ours, handed), (theirs, told) = found
    np.testing.assert_array_equal(theirs, ours)
    np.testing.assert_array_equal(told, handed)
    assert np.isfinite(ours[10:]).all()


def test_the_benchs_scipy_solves_the_models_equations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))
    run = importlib.import_module("benchmarks.figures").Run(
        long=False, folder=tmp_path, tell=lambda _: None
    )
    (measured,) = importlib.import_module("benchmarks.solver").evacuation(run)
    assert measured.values
