"""The simulated PLC in real time: its scans follow the clock, and servers answer from them."""

import asyncio
import signal
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drivers.plc.faults import Fault
from drivers.plc.partner import PartnerTask
from drivers.plc.registers import Registers
from drivers.plc.scan import PERIOD_NS, Scans, Task
from drivers.plc.server import listening
from drivers.plc.settings import PlcSettings
from twin.extras import require

if TYPE_CHECKING:
    from drivers.plc.opcua import Serving

SET_NS = 2_000_000_000  # step by which a signal sets the clock ahead or back
WITNESSED = np.dtype(
    [("sequence", "<i8"), ("time_ns", "<i8"), ("pressure", "<f4"), ("status", "<u2")]
)
PERIOD_S = 0.01  # of the timer that computes scans while no client asks


def run_plc(
    settings: PlcSettings | Sequence[PlcSettings],
    faults: Sequence[Fault] = (),
    seed: int = 0,
    duration_s: float | None = None,
    ready: Callable[[str, int], None] | None = None,
    witness: Path | None = None,
) -> None:
    """Run the PLC until SIGINT, SIGTERM or ``duration_s``; call it in the main thread.

    With several ejectors, the first one's settings say where the PLC listens. The others differ in
    their unit and, by OPC UA, in the prefix of their nodes. The faults and the ``seed`` are the
    first one's; each further ejector has the next seed.
    ``ready(host, port)`` is called once the PLC listens, by Modbus and, if there is a table for it,
    by OPC UA. Raises SourceError if it cannot listen. Every scan of the first ejector goes into
    ``witness``, as ``WITNESSED``. On Linux SIGUSR1 and SIGUSR2 set the clock ahead and back by
    ``SET_NS``.
    """
    first, *following = [settings] if isinstance(settings, PlcSettings) else settings
    tasks = [_task(first, faults, seed)]
    tasks += [_task(ejector, (), seed + number) for number, ejector in enumerate(following, 1)]
    asyncio.run(_run(tasks, duration_s, ready or announce, witness))


def _task(settings: PlcSettings, faults: Sequence[Fault], seed: int) -> Task:
    kind = PartnerTask if settings.program.commands == "hil" else Task
    return kind(settings, faults, seed)


def announce(host: str, port: int) -> None:
    """Print where the PLC listens, for people and for programs that start one."""
    print(f"listening on {host}:{port}", flush=True)  # noqa: T201 - it is the command's output


async def _run(
    tasks: Sequence[Task],
    duration_s: float | None,
    ready: Callable[[str, int], None],
    witness: Path | None,
) -> None:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    _task(tasks[0].settings, (), 0).compute(1)  # compiles the rig before the clock runs
    start_ns, first_ns = time.time_ns(), time.monotonic_ns()

    def catch_up() -> None:
        scans = (time.monotonic_ns() - first_ns) // PERIOD_NS + 1
        for task in tasks:
            task.advance_to(scans)

    boot = start_ns // 10_000_000 & 0xFFFF
    memories = [Registers(task, start_ns, boot) for task in tasks]
    _let_clock_be_set(memories)
    async with (
        _witnessed(tasks[0], memories[0], witness),
        listening(memories, catch_up) as port,
        _opcua(memories, catch_up) as opcua,
    ):
        ready(tasks[0].settings.server.host, port)
        if opcua:
            print(f"OPC UA on {opcua.url}", flush=True)  # noqa: T201 - as above
        end_ns = first_ns + (float("inf") if duration_s is None else duration_s) * 1e9
        while not stop.is_set() and time.monotonic_ns() < end_ns:
            catch_up()
            if opcua:
                opcua.sample()
            await asyncio.sleep(PERIOD_S)


def _let_clock_be_set(memories: Sequence[Registers]) -> None:
    def set_by(step_ns: int) -> None:
        for memory in memories:
            memory.start_ns += step_ns

    if not hasattr(signal, "SIGUSR1"):  # it is for tests, on Linux
        return
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGUSR1, set_by, SET_NS)
    loop.add_signal_handler(signal.SIGUSR2, set_by, -SET_NS)


@asynccontextmanager
async def _witnessed(task: Task, memory: Registers, path: Path | None) -> AsyncIterator[None]:
    """Write scans into a file if there is a ``path``; unbuffered, so that a crash loses nothing.

    The last scans come while the servers end, so it closes after them.
    """
    if path is None:
        yield
        return
    with path.open("wb", buffering=0) as file:

        def keep(scans: Scans) -> None:
            rows = np.empty(len(scans), WITNESSED)
            for name in ("sequence", "pressure", "status"):
                rows[name] = scans[name]
            rows["time_ns"] = memory.start_ns + scans["sequence"] * PERIOD_NS
            file.write(rows.tobytes())

        previous, task.witness = task.witness, keep
        try:
            yield
        finally:
            task.witness = previous


@asynccontextmanager
async def _opcua(
    memories: Sequence[Registers], catch_up: Callable[[], None]
) -> AsyncIterator["Serving | None"]:
    """Serve OPC UA too, if it is configured."""
    settings = memories[0].task.settings.opcua
    if settings is None:
        yield None
        return
    require("opcua", "[plc.opcua]")
    from drivers.plc.opcua import serving  # noqa: PLC0415 - the library takes its time

    async with serving(memories, settings, catch_up) as opcua:
        yield opcua
