"""The model beside SciPy's solver, the usual alternative, with the same equations."""

import runpy
import time
from collections.abc import Sequence

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.figures import Measured, Run
from benchmarks.kernel import Floats
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.processes import CONFIG, ROOT
from benchmarks.recording import new_twin
from twin.config import Config
from twin.model import kernel
from twin.model import theta as c
from twin.model.theta import Theta
from twin.settings import Document
from twin.signals import MS, Phase

EQUATIONS = ROOT / "tests" / "radau.py"  # a second implementation, for the tests
ROWS = 300  # of suction from rest, before the air saving switches
REPEATS = 3
RELATIVE = 1e-6  # tolerance at which SciPy is as accurate as the model
AGREE_PA = 5.0


def evacuation(run: Run) -> Sequence[Measured]:
    """Processor time (ns) of a row of 1 ms by Radau, and by the compiled model."""
    run.tell("solver")
    theta = new_twin(Config.of(Document.read(CONFIG))).theta
    equations = runpy.run_path(str(EQUATIONS))
    _by_model(theta)  # compiles first
    with on_core(TWIN_CORE):
        pairs = [(_by_scipy(theta, equations), _by_model(theta)) for _ in range(REPEATS)]
    (_, expected), (_, by_scipy) = pairs[0][1], pairs[0][0]
    difference = float(np.max(np.abs(by_scipy - expected)))
    assert difference < AGREE_PA, f"SciPy solves other equations: {difference:.3g} Pa"
    ours = [model[0] for _, model in pairs]
    theirs = [scipy[0] for scipy, _ in pairs]
    return (Measured(theirs, ours, note=f"within {difference:.1g} Pa of it"),)


def _by_model(theta: Theta) -> tuple[float, Floats]:
    state, expected = kernel.at_rest(theta), np.empty(ROWS + 1)
    dt, level = np.full(ROWS + 1, MS), np.full(ROWS + 1, np.nan)
    dt[0] = 0.0
    phase = np.full(ROWS + 1, Phase.SUCTION, np.uint8)
    begin = time.thread_time()
    kernel.advance(state, theta, dt, phase, level, expected)
    return 1e9 * (time.thread_time() - begin) / ROWS, expected[1:]


def _by_scipy(theta: Theta, equations: dict[str, object]) -> tuple[float, Floats]:
    """Two parts: the valve opens one response delay after the command."""
    times, y, rows = np.arange(1, ROWS + 1) * MS, equations["at_rest"](theta), []
    opens = float(theta[c.RESPONSE])
    begin = time.thread_time()
    for nozzle, first, last in ((0.0, 0.0, opens), (1.0, opens, times[-1])):
        valves = equations["Valves"](first, nozzle, 0.0, 0.0)
        wanted = np.unique(np.append(times[(times > first) & (times <= last)], last))
        solution = solve_ivp(
            equations["rates"],
            (first, last),
            y,
            "Radau",
            wanted,
            rtol=RELATIVE,
            atol=RELATIVE * equations["SIZES"],
            args=(theta, valves),
        )
        assert solution.success
        rows += [values for t, values in zip(solution.t, solution.y.T, strict=True) if t in times]
        y = solution.y[:, -1]
    spent = 1e9 * (time.thread_time() - begin) / ROWS
    return spent, np.array(rows)[:, -1]
