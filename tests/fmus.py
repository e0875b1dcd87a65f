"""FMUs of the shipped configurations in FMPy: simulated whole, or stepped by hand."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import numpy.typing as npt
import rigs
from fmpy.fmi2 import FMU2Slave, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE
from fmpy.fmi3 import FMU3Slave

from twin.exchange.fmu import Fmu, make_fmu
from twin.exchange.variables import Component, Where
from twin.model import kernel
from twin.model.dataset import DataSet
from twin.model.theta import Theta
from twin.signals import MS, Command

Rows = npt.NDArray[np.float64]
Commands = npt.NDArray[np.uint8]
PROGRAM = {"test_rig": (2300, 300, 600), "gripper": (1200, 200, 600)}  # suction, blow-off, idle


@cache
def made(name: str, version: int = 3, where: Where = "inside") -> Fmu:
    """The FMU of a configuration, with a binary."""
    return of_data(rigs.config(name).data, version, where)


def of_data(data: DataSet, version: int = 3, where: Where = "inside") -> Fmu:
    return make_fmu(Component.of(data, where), "cell 1", "a test", "tests", version, compiled=True)


@contextmanager
def as_file(fmu: Fmu) -> Iterator[str]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / fmu.name
        path.write_bytes(fmu.content)
        yield str(path)


def cycles(name: str, count: int) -> Commands:
    """Rows of commands, one each ms: idle for a while, then cycles."""
    each = [int(Command.SUCTION), int(Command.BLOW_OFF), 0]
    one = np.repeat(np.array(each, np.uint8), PROGRAM[name])
    return np.concatenate([np.zeros(50, np.uint8), *[one] * count])


def by_twin(theta: Theta, commands: Commands) -> Rows:
    """What the twin's own kernel expects, row by row, from rest."""
    dt = np.full(len(commands), MS)
    dt[0] = 0.0
    phase, expected = np.empty(len(dt), np.uint8), np.empty(len(dt))
    kernel.simulate(kernel.at_rest(theta), theta, dt, commands, phase, expected)
    return expected


def simulated(fmu: Fmu, commands: Commands, values: Mapping[str, float]) -> Rows:
    """What FMPy's own simulation gives, row by row."""
    given: list[tuple[str, Any]] = [("time", float), ("command.suction", bool)]
    rows = np.zeros(len(commands), [*given, ("command.blow_off", bool)])
    rows["time"] = np.arange(len(commands)) * MS
    rows["command.suction"] = commands & Command.SUCTION
    rows["command.blow_off"] = commands & Command.BLOW_OFF
    with as_file(fmu) as path:
        result = fmpy.simulate_fmu(
            path,
            stop_time=rows["time"][-1],
            step_size=MS,
            output_interval=MS,
            input=rows,
            start_values=dict(values),
            output=["sensor.pressure"],
        )
    pressure: Rows = result["sensor.pressure"]
    return pressure


class Stepped:
    """An instance that is stepped by hand, its variables by name, in either version."""

    def __init__(self, path: str, folder: str) -> None:
        described = fmpy.read_model_description(path)
        self._variables = {variable.name: variable for variable in described.modelVariables}
        self.said: list[str] = []
        self.version = int(described.fmiVersion[0])
        known = {
            "guid": described.guid,
            "unzipDirectory": folder,
            "modelIdentifier": described.coSimulation.modelIdentifier,
            "instanceName": "one",
        }
        self.time = 0.0
        if self.version == 3:
            self.fmu = FMU3Slave(**known)
            self.fmu.instantiate(loggingOn=True, logMessage=self._heard3)
        else:
            self.fmu = FMU2Slave(**known)
            self._callbacks = fmi2CallbackFunctions()
            self._callbacks.logger = fmi2CallbackLoggerTYPE(self._heard2)
            self.fmu.instantiate(callbacks=self._callbacks, loggingOn=True)

    def _heard3(self, _environment: Any, _status: Any, _category: Any, message: bytes) -> None:
        self.said.append(message.decode())

    def _heard2(
        self, _environment: Any, _name: Any, _status: Any, _category: Any, message: bytes
    ) -> None:
        self.said.append(message.decode())

    def begin(self, **values: float) -> None:
        """Initialize with values, dots as double underscores."""
        if self.version == 2:
            self.fmu.setupExperiment()
        self.set(**values)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def set(self, **values: float) -> None:
        for name, value in values.items():
            one = self._variables[name.replace("__", ".")]
            kind = {"Float64": "Float64", "Enumeration": "Int64"}.get(one.type, one.type)
            if self.version == 2:
                kind = {"Enumeration": "Integer"}.get(one.type, one.type)
            getattr(self.fmu, f"set{kind}")([one.valueReference], [value])

    def get(self, name: str) -> float:
        one = self._variables[name]
        kind = one.type
        if kind == "Enumeration":
            kind = "Integer" if self.version == 2 else "Int64"
        return float(getattr(self.fmu, f"get{kind}")([one.valueReference])[0])

    def saved(self) -> bytes:
        """The whole state as bytes."""
        name = "State" if self.version == 3 else "state"
        state = getattr(self.fmu, f"getFMU{name}")()
        saved: bytes = getattr(self.fmu, f"serializeFMU{name}")(state)
        getattr(self.fmu, f"freeFMU{name}")(state)
        return saved

    def restore(self, saved: bytes, time: float) -> None:
        """Go on from a state as it was at a time."""
        name, back = ("State", "deserialize") if self.version == 3 else ("state", "deSerialize")
        state = getattr(self.fmu, f"{back}FMU{name}")(saved)
        getattr(self.fmu, f"setFMU{name}")(state)
        getattr(self.fmu, f"freeFMU{name}")(state)
        self.time = time

    def step(self, seconds: float) -> None:
        self.fmu.doStep(self.time, seconds)
        self.time += seconds

    def run(self, commands: Commands, rows: int = 1) -> Rows:
        """Pressures at the sensor after every step of so many rows."""
        seen = []
        for told in commands[::rows]:
            suction, blow_off = bool(told & Command.SUCTION), bool(told & Command.BLOW_OFF)
            self.set(command__suction=suction, command__blow_off=blow_off)
            self.step(rows * MS)
            seen.append(self.get("sensor.pressure"))
        return np.array(seen)


@contextmanager
def stepped(fmu: Fmu, count: int = 1) -> Iterator[Sequence[Stepped]]:
    """Instances of an FMU in one process."""
    with as_file(fmu) as path, tempfile.TemporaryDirectory() as folder:
        fmpy.extract(path, folder)
        instances = [Stepped(path, folder) for _ in range(count)]
        yield instances
        for instance in instances:
            instance.fmu.freeInstance()
