"""The PLC's 1 ms task: commands, rig and trace ring, computed up to "now" on request.

Each scan is computed exactly once and in order, whatever the host does. A seed gives the same
samples, however many scans a call computes.
"""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from drivers.plc.courses import Schedule
from drivers.plc.faults import Fault, Rows
from drivers.plc.plant import READING, TRUTH, Record, at_rest, plant, refuse_stiff
from drivers.plc.rig import DT, NOISES, run
from drivers.plc.settings import PlcSettings, Program
from twin.signals import BAR, MBAR, SL_MIN, ZERO_C, Command

PERIOD_NS = 1_000_000
DEPTH = 4096  # scans that the trace ring holds
OVERFLOW = 0x100  # bit of the status word
REPORTED = 2  # place of the first of three bits: nozzle, air saving, part present

SCAN = np.dtype(
    [
        ("sequence", "<i8"),
        ("pressure", "<f4"),  # mbar, absolute, as in the registers
        ("supply", "<i2"),  # mbar, gauge, as in the registers
        ("status", "<u2"),  # command bits, REPORTED and OVERFLOW
        ("ambient", "<i2"),  # 0.1 mbar absolute, as in the registers
        ("temperature", "<i2"),  # 0.1 °C
        ("vessel", "<f4"),  # mbar, absolute
        ("flow", "<f4"),  # sl/min
    ]
)
Scans = npt.NDArray[np.void]  # of SCAN


class Cycles:
    """The program's commands, scan by scan, with jitter on every duration."""

    def __init__(self, program: Program, seed: int) -> None:
        self._program = program
        self._random = np.random.default_rng([seed, 1])
        self._steps = (
            (Command.SUCTION, program.suction_ms),
            (Command.BLOW_OFF, program.blow_off_ms),
            (Command(0), program.idle_ms),
        )
        self._step_index = len(self._steps) - 1
        self._remaining = round(program.start_ms)

    def next(self, n: int) -> npt.NDArray[np.uint8]:
        """Commands of the next ``n`` scans."""
        commands = np.zeros(n, np.uint8)
        filled = 0
        while filled < n:
            while self._remaining == 0:
                self._advance()
            count = min(n - filled, self._remaining)
            commands[filled : filled + count] = self._steps[self._step_index][0]
            self._remaining -= count
            filled += count
        return commands

    def _advance(self) -> None:
        self._step_index = (self._step_index + 1) % len(self._steps)
        nominal = self._steps[self._step_index][1]
        jitter = self._program.jitter_ms * self._random.standard_normal()
        self._remaining = max(round(nominal + jitter), 1) if nominal else 0


class Task:
    """The PLC after its start: its sequence counter begins at 0."""

    def __init__(self, settings: PlcSettings, faults: Sequence[Fault] = (), seed: int = 0) -> None:
        self.settings = settings
        self.commands = Command(0)  # of the newest scan
        self.coils = Command(0)  # asked by a client, where commands come from coils
        self.newest = -1  # sequence of the newest scan
        self.ring = np.zeros(DEPTH, SCAN)
        self.witness: Callable[[Scans], None] = lambda _scans: None  # sees each once
        self._plant = plant(settings)
        refuse_stiff(self._plant, DT)
        self._cycles = Cycles(settings.program, seed)
        self._schedule = Schedule(faults, seed, settings.rig.vessel_film)
        weather = self._schedule.rows(0, np.array([-1]))["ambient_pressure_shift"][0]
        self._state = at_rest(self._plant, settings.rig.ambient_mbar * MBAR + weather)
        self._noise = np.random.default_rng([seed, 0])
        self._scatter = np.random.default_rng([seed, 2])
        self._cycle_scatter = self._scatter.standard_normal((1, 2))  # before the first cycle
        self._reported = np.zeros(
            round(settings.reports.bits_delay_ms), np.uint8
        )  # not yet visible

    def advance_to(self, n_scans: int) -> None:
        """Compute scans until there are ``n_scans`` since the start; this catches up on a stall."""
        while self.newest + 1 < n_scans:
            scans, _ = self.compute(min(n_scans - self.newest - 1, 1000))
            self.ring[scans["sequence"] % DEPTH] = scans
            self.witness(scans)

    def compute(self, n: int) -> tuple[Scans, Record]:
        """Compute the next ``n`` scans without the ring: what the PLC sees, and ``plant.TRUTH``."""
        first = self.newest + 1
        commands = self._commands(n)
        rows = self._rows(first, commands)
        noise = self._noise.standard_normal((n, NOISES))
        readings, truths = np.zeros(n, READING), np.zeros(n, TRUTH)
        run(self._plant, self._state, rows, commands, noise, readings, truths)
        self.newest = first + n - 1
        self.commands = Command(int(commands[-1]))
        scans = np.zeros(n, SCAN)
        scans["sequence"] = np.arange(first, first + n)
        scans["pressure"] = readings["pressure"] / MBAR
        scans["supply"] = np.rint(readings["supply"] / MBAR)
        scans["status"] = commands + OVERFLOW * readings["overflow"].astype(np.uint16)
        if self.settings.reports.bits:
            scans["status"] |= self._delayed(readings["reported"]).astype(np.uint16) << REPORTED
        scans["ambient"] = np.rint(readings["ambient"] / MBAR * 10)
        scans["temperature"] = np.rint((readings["temperature"] - ZERO_C) * 10)
        scans["vessel"], scans["flow"] = readings["vessel"] / MBAR, readings["flow"] / SL_MIN
        return scans, truths

    def _delayed(self, reported: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """The reported bits as the PLC sees them: delayed by IO-Link's cycle."""
        pending = np.concatenate([self._reported, reported])
        delay_scans = round(self.settings.reports.bits_delay_ms)
        self._reported = pending[len(pending) - delay_scans :]
        return pending[: len(reported)]

    def _commands(self, n: int) -> npt.NDArray[np.uint8]:
        if self.settings.program.commands == "coils":
            return np.full(n, self.coils, np.uint8)
        return self._cycles.next(n)

    def _rows(self, first: int, commands: npt.NDArray[np.uint8]) -> Rows:
        """Faults and the cycles' scatter for each scan; a cycle begins with suction."""
        suction = np.concatenate(([self.commands & 1], commands & 1)).astype(np.int8)
        begins = np.diff(suction) == 1
        before = len(self._schedule.cycle_starts)
        starts = (first + np.flatnonzero(begins)).tolist()
        self._schedule.cycle_starts.extend(starts)
        draws = self._scatter.standard_normal((len(starts), 2))
        self._cycle_scatter = np.concatenate((self._cycle_scatter[-1:], draws))
        local = np.cumsum(begins)
        rows = self._schedule.rows(first, before - 1 + local)
        scatter = self.settings.scatter
        rows["supply_scatter"] = scatter.supply_bar * BAR * self._cycle_scatter[local, 0]
        rows["seal_scatter"] = scatter.seal_leak_sl_min * SL_MIN * self._cycle_scatter[local, 1]
        return rows
