"""The model as an FMU, simulated by FMPy, beside the twin's own kernel."""

import shutil
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from io import StringIO

import fmpy
import numpy as np

from benchmarks.figures import Measured, Run
from benchmarks.kernel import Bytes, Floats
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.processes import CONFIG
from twin.config import Config
from twin.exchange.fmu import make_fmu
from twin.exchange.variables import Component
from twin.model import kernel
from twin.model.dataset import DataSet, coefficients
from twin.settings import Document
from twin.signals import MS, Command

CYCLE = {Command.SUCTION: 2300, Command.BLOW_OFF: 300, Command(0): 600}  # rows of 1 ms
CYCLES = 6
REPEATS = 5
AGREE_PA = 0.1


def in_fmpy(run: Run) -> Sequence[Measured]:
    """Processor time (ns) of a row of 1 ms in FMPy, and by the compiled model."""
    run.tell("FMU")
    data = Config.of(Document.read(CONFIG)).data
    if shutil.which("cc") is None:
        return (Measured([_by_model(data)[0]], note="the model alone: no C compiler"),)
    made = make_fmu(Component.of(data, "inside"), "bench", "its data", "bench", 3, compiled=True)
    path = run.folder / made.name
    path.write_bytes(made.content)
    folder = fmpy.extract(str(path), str(run.folder / "fmu"))
    _by_model(data)  # compiles first
    with on_core(TWIN_CORE):
        pairs = [(_by_fmpy(folder), _by_model(data)) for _ in range(REPEATS)]
    (_, from_fmu), (_, expected) = pairs[0]
    difference = float(np.max(np.abs(from_fmu - expected)))
    assert difference < AGREE_PA, f"the FMU is another model: {difference:.3g} Pa"
    theirs, ours = ([result[0] for result in column] for column in zip(*pairs, strict=True))
    return (Measured(theirs, ours, note=f"within {difference:.1g} Pa of it"),)


def _commands() -> Bytes:
    return np.tile(np.repeat(np.array([*CYCLE], np.uint8), [*CYCLE.values()]), CYCLES)


def _by_model(data: DataSet) -> tuple[float, Floats]:
    theta, commands = coefficients(data), _commands()
    dt, phase = np.full(len(commands), MS), np.empty(len(commands), np.uint8)
    dt[0], expected = 0.0, np.empty(len(commands))
    begin = time.thread_time()
    kernel.simulate(kernel.at_rest(theta), theta, dt, commands, phase, expected)
    return 1e9 * (time.thread_time() - begin) / len(commands), expected


def _by_fmpy(folder: str) -> tuple[float, Floats]:
    commands = _commands()
    names = {"command.suction": Command.SUCTION, "command.blow_off": Command.BLOW_OFF}
    rows = np.zeros(len(commands), [("time", float), *((name, bool) for name in names)])
    rows["time"] = np.arange(len(commands)) * MS
    for name, command in names.items():
        rows[name] = commands & command
    # FMPy prints which inputs keep their start values. As columns they would double the time.
    with redirect_stdout(StringIO()) as output:
        begin = time.thread_time()
        result = fmpy.simulate_fmu(
            folder,
            stop_time=rows["time"][-1],
            step_size=MS,
            output_interval=MS,
            input=rows,
            output=["sensor.pressure"],
        )
        spent = 1e9 * (time.thread_time() - begin) / len(commands)
    complaints = [line for line in output.getvalue().splitlines() if "missing input" not in line]
    assert not complaints, f"FMPy says: {complaints}"
    return spent, result["sensor.pressure"]
