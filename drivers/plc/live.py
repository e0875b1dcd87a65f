"""The simulated PLC in real time: its scans run with the clock, its servers stand around them."""

import asyncio
import signal
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from drivers.plc.faults import Fault
from drivers.plc.registers import Registers
from drivers.plc.scan import PERIOD_NS, Task
from drivers.plc.server import listening
from drivers.plc.settings import PlcSettings

if TYPE_CHECKING:
    from drivers.plc.opcua import Serving

PERIOD_S = 0.01  # of the timer that keeps the scans up while nobody asks


def run_plc(
    settings: PlcSettings,
    faults: Sequence[Fault] = (),
    seed: int = 0,
    duration_s: float | None = None,
    ready: Callable[[str, int], None] | None = None,
) -> None:
    """Run the PLC until SIGINT, SIGTERM or ``duration_s``; call it in the main thread.

    ``ready(host, port)`` is called once when it listens, by Modbus and, where there is a table
    for it, by OPC UA. Raises SourceError where it cannot.
    """
    asyncio.run(_run(Task(settings, faults, seed), duration_s, ready or announce))


def announce(host: str, port: int) -> None:
    """Say on stdout where the PLC listens, for people and for programs that start one."""
    print(f"listening on {host}:{port}", flush=True)  # noqa: T201 - it is the command's output


async def _run(task: Task, duration_s: float | None, ready: Callable[[str, int], None]) -> None:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    Task(task.settings).compute(1)  # compiles the rig before the clock runs
    start_ns, first_ns = time.time_ns(), time.monotonic_ns()

    def catch_up() -> None:
        task.advance_to((time.monotonic_ns() - first_ns) // PERIOD_NS + 1)

    memory = Registers(task, start_ns, boot=start_ns // 10_000_000 & 0xFFFF)
    async with listening(memory, catch_up) as port, _opcua(memory, catch_up) as opcua:
        ready(task.settings.server.host, port)
        if opcua:
            print(f"OPC UA on {opcua.url}", flush=True)  # noqa: T201 - as above
        end_ns = first_ns + (duration_s or float("inf")) * 1e9
        while not stop.is_set() and time.monotonic_ns() < end_ns:
            catch_up()
            if opcua:
                opcua.sample()
            await asyncio.sleep(PERIOD_S)


@asynccontextmanager
async def _opcua(
    memory: Registers, catch_up: Callable[[], None]
) -> AsyncIterator["Serving | None"]:
    """Serve OPC UA too, where it is wanted."""
    settings = memory.task.settings.opcua
    if settings is None:
        yield None
        return
    from drivers.plc.opcua import serving  # noqa: PLC0415 - the library takes its time

    async with serving(memory, settings, catch_up) as opcua:
        yield opcua
