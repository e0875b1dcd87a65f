"""The table ``[hil]`` beside an OPC UA ``[driver]``."""

from typing import Self

from pydantic import Field, model_validator

from drivers.opcua.settings import NodeName, NodePressure
from drivers.outputs.writer import refuse_empty, refuse_no_range
from twin.settings import Settings


class Signal(Settings):
    """A signal that is written, as the type of its node: a Boolean, or 0 and 1."""

    node: NodeName  # node as for other tags


class Counter(Settings):
    """The watchdog: counts up with each block, and from the high end on from the low one."""

    node: NodeName  # node as for other tags
    range: tuple[int, int] = (0, 32_767)  # first and last count; the first follows the last

    @model_validator(mode="after")
    def _counts(self) -> Self:
        refuse_empty(self.range)
        return self


class WrittenPressure(NodePressure):
    """The pressure as the PLC expects it, within ``range``."""

    @model_validator(mode="after")
    def _can_be_written(self) -> Self:
        refuse_no_range(self.range)
        return self


class HilTags(Settings):
    """Tags that are written; no other tag ever is."""

    pressure: WrittenPressure | None = None
    part_present: Signal | None = None  # H2
    air_saving: Signal | None = None  # H1
    watchdog: Counter | None = None


class HilSettings(Settings):
    """The ``[hil]`` table beside an OPC UA ``[driver]``."""

    min_interval_ms: float = Field(default=10.0, ge=1, le=1000)  # shortest time between two writes
    tags: HilTags
