"""Modbus TCP over the trace: pymodbus serves; the registers are filled at each request."""

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import cast

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from drivers.plc import registers
from drivers.plc.registers import Registers
from twin.errors import ConfigError, SourceError

# It logs clients that hang up as errors, with frames; what stops the PLC is raised as well.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

READ_COILS, READ_HOLDING, READ_INPUTS, WRITE_COIL, WRITE_COILS = 1, 3, 4, 5, 15
WRITE_REGISTER, WRITE_REGISTERS = 6, 16


@asynccontextmanager
async def listening(
    memories: Sequence[Registers], catch_up: Callable[[], None]
) -> AsyncIterator[int]:
    """Serve ``memories``, each as its own unit, while the context lasts; gives the port.

    ``catch_up`` is called before each answer, so that it shows the scans up to now. Raises
    SourceError if the address is not available.
    """
    address = memories[0].task.settings.server
    units = {memory.task.settings.server.unit: memory for memory in memories}
    if len(units) < len(memories):
        raise ConfigError("two ejectors have the same unit", "set unit under [plc.server] in each")
    answers = {unit: Answers(memory, catch_up) for unit, memory in units.items()}
    devices = [*(_device(unit, answer) for unit, answer in answers.items()), _absent_units()]
    server = ModbusTcpServer(devices, address=(address.host, address.port))
    try:
        await server.serve_forever(background=True)
    except RuntimeError as error:
        raise SourceError(
            f"cannot listen on {address.host}:{address.port}",
            "take another port, or 0 for any free one",
        ) from error
    try:
        yield cast(asyncio.Server, server.transport).sockets[0].getsockname()[1]
    finally:
        await server.shutdown()  # type: ignore[no-untyped-call]


@dataclass(frozen=True)
class Answers:
    """Called by pymodbus before it answers a request inside the map."""

    memory: Registers
    catch_up: Callable[[], None]

    async def answer(
        self,
        function: int,
        start: int,  # of ``current``
        address: int,
        count: int,
        current: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """Fill the words asked for into ``current``, or refuse."""
        self.catch_up()
        if function in (READ_COILS, WRITE_COIL, WRITE_COILS):
            return self._coils(address, current, values)
        if function in (WRITE_REGISTER, WRITE_REGISTERS):
            if not self.memory.write_hil(address, [int(value) for value in values or ()]):
                return ExcCodes.ILLEGAL_FUNCTION
            function = READ_HOLDING  # the answer shows the registers as they are now
        if function == READ_INPUTS:
            words = self.memory.inputs()[address : address + count]
        elif function == READ_HOLDING:
            words = self.memory.holding(address, count)
        else:
            return ExcCodes.ILLEGAL_FUNCTION
        current[address - start : address - start + count] = words
        return None

    def _coils(
        self, address: int, current: list[int], values: list[int] | list[bool] | None
    ) -> ExcCodes | None:
        if address + len(values or [0]) > registers.COILS:
            return ExcCodes.ILLEGAL_ADDRESS
        if values and not self.memory.write_coils(address, values):
            return ExcCodes.ILLEGAL_FUNCTION  # "the server is in the wrong state", says the norm
        current[0] = self.memory.coils()
        return None


def _words(address: int, count: int) -> SimData:
    return SimData(address, count=count, datatype=DataType.REGISTERS)


def _bits() -> list[SimData]:
    return [SimData(0, values=[False] * registers.COILS, datatype=DataType.BITS)]


def _device(unit: int, answers: Answers) -> SimDevice:
    """Create the map; pymodbus requires discrete inputs too, but nothing answers for them."""
    holding = [
        _words(0, registers.TEST_SIZE),
        _words(registers.HEADER, registers.HEADER_SIZE),
        _words(registers.RING, registers.RING_SIZE),
    ]
    if answers.memory.partner:
        holding.insert(2, _words(registers.HIL, registers.HIL_SIZE))
    extra = registers.VALUES_SIZE if answers.memory.task.settings.reports.values else 0
    inputs = [_words(0, registers.INPUT_SIZE + extra)]
    return SimDevice(unit, simdata=(_bits(), _bits(), holding, inputs), action=answers.answer)


def _absent_units() -> SimDevice:
    """Answer for every other unit that it does not respond."""

    async def answer(*_: object) -> ExcCodes:
        return ExcCodes.GATEWAY_NO_RESPONSE

    return SimDevice(0, simdata=_words(0, 65536), action=answer)
