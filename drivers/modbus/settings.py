"""Settings of a Modbus TCP PLC: the ``[driver]`` table."""

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.modbus.tls import PlcTls
from drivers.optional_signals import BITS, refuse_unclear
from drivers.settings import DriverSettings
from drivers.tags import Address, Flow, Place, Pressure, Tag, Temperature, WordOrder
from drivers.trace import COMMAND_BITS, no_effect, refuse_unused
from twin.settings import KeyedError, Settings

STATUS = Address("input", 4)  # in the register map: the bits of a record's status
COILS = Address("coil", 0)  # and the first of the commands as coils, in the same order


class Tags(Settings):
    """The PLC's values that the twin reads."""

    pressure: Pressure
    suction: Tag | None = None
    blow_off: Tag | None = None
    supply: Pressure | None = None
    # Number that changes at every scan; at rest, the PLC's program stands still.
    heartbeat: Tag | None = None
    nozzle: Tag | None = None  # nozzle on, as the ejector reports it
    # Air saving active (instead of nozzle): the nozzle is off under suction.
    air_saving: Tag | None = None
    part_present: Tag | None = None  # part present (H2 reached), as the ejector reports it
    ambient: Pressure | None = None  # a barometer
    temperature: Temperature | None = None  # temperature of the gas or the surroundings
    pressure_2: Pressure | None = None  # second pressure at the other end of the line
    flow: Flow | None = None  # suction flow

    @model_validator(mode="after")
    def _are_what_they_must(self) -> Self:
        for name in ("suction", "blow_off", *BITS):
            tag = getattr(self, name)
            if tag is not None and tag.type != "bit":
                raise ValueError(f"{name} is a bit")
        refuse_unclear(self.nozzle, self.air_saving, self.ambient)
        return self


class Ring(Settings):
    """Where the PLC's trace of its scans lies: header and ring of records."""

    header: Place = Address("holding", 100)  # first register of the header
    records: Place = Address("holding", 1000)  # first register of the ring

    @model_validator(mode="after")
    def _lies_in_words(self) -> Self:
        for address in (self.header, self.records):
            if not address.of_words:
                raise ValueError(f"{address}: the trace lies in holding or input registers")
        return self


class ModbusSettings(DriverSettings):
    """The ``[driver]`` table for a Modbus PLC."""

    kind: Literal["modbus"] = "modbus"  # kind of driver
    host: str  # name or address of the PLC
    port: int = Field(default=502, ge=1, le=65535)  # TCP port of the PLC
    unit: int = Field(default=1, ge=0, le=255)  # unit identifier of the PLC behind a gateway
    # Read a ring that the PLC fills, or poll registers one by one.
    mode: Literal["block", "poll"] = "block"
    interval_ms: float = Field(default=30.0, ge=5, le=100)  # time between blocks
    # Longest time for an answer; a longer one delays staleness.
    timeout_ms: float = Field(default=200.0, ge=10, le=250)
    gap_ms: int = Field(default=20, ge=1)  # polled: fewer missing slots are no gap
    word_order: WordOrder = "big"  # order of a 32-bit value's words: high first, or low first
    # Absolute ambient pressure without a barometer; gauge pressures count from it.
    ambient_mbar: float = Field(default=1013.25, ge=500, le=1200)
    tags: Tags
    ring: Ring = Ring()
    tls: PlcTls | None = None  # Modbus/TCP Security

    @model_validator(mode="after")
    def _tags_fit_the_mode(self) -> Self:
        tags = self.tags
        if self.mode == "poll" and (tags.suction is None or tags.blow_off is None):
            raise ValueError("polling needs the tags suction and blow_off")
        if self.mode == "block" and tags.pressure.size != 2:
            raise ValueError("the ring holds 32-bit pressures: tags.pressure.type must be so too")
        if self.mode == "block" and tags.supply is not None and tags.supply.size != 1:
            raise ValueError("the ring holds a 16-bit supply: tags.supply.type must be so too")
        if self.mode == "block":
            self._refuse_without_effect()
        return self

    def _refuse_without_effect(self) -> None:
        """KeyedError for a tag or setting that block mode does not use."""
        for name, bit in (COMMAND_BITS | BITS).items():
            tag = getattr(self.tags, name)
            same = [(STATUS, bit), *([(COILS + bit, None)] if name in COMMAND_BITS else [])]
            if tag is not None and (tag.address, tag.bit) not in same:
                address = tag.address if tag.bit is None else f"{tag.address} bit {tag.bit}"
                raise no_effect(name, bit, address, "poll")
        if self.tags.heartbeat is not None:
            raise KeyedError(
                "has no effect in block mode: the ring's sequence shows whether the PLC's program "
                'runs. Leave out [driver.tags.heartbeat], or set mode = "poll" in [driver]',
                "tags",
                "heartbeat",
            )
        refuse_unused(self.model_fields_set, ("gap_ms",), "poll")

    def at(self, host: str, port: int) -> "ModbusSettings":
        """Give the same for a PLC at another address."""
        return self.model_copy(update={"host": host, "port": port})

    def below(self, folder: Path) -> "ModbusSettings":
        """Give the same with files looked for in ``folder``, unless their paths are absolute."""
        tls = None if self.tls is None else self.tls.below(folder)
        return self.model_copy(update={"tls": tls})

    @property
    def where(self) -> str:
        """The PLC as messages name it."""
        return f"{self.host}:{self.port}, unit {self.unit}"
