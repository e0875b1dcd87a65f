"""The twin's own part of a configuration: which asset, its data set, when to raise an alarm."""

from dataclasses import dataclass

from pydantic import Field

from twin.model.dataset import DataSet
from twin.monitor.detect import MonitorSettings
from twin.settings import Document, Settings

TABLES = {"asset", "data", "driver", "log", "monitor", "plc"}


class Asset(Settings):
    """The ejector: its type (object-specific data) and the one unit (instance-specific data)."""

    type: str = "unknown"
    id: str = "unknown"


class LogSettings(Settings):
    """How logs are kept."""

    rotate_mb: float = Field(64.0, gt=0.0)  # a new part begins beyond this size


@dataclass(frozen=True)
class Config:
    """A checked configuration, with the document it was read from."""

    document: Document
    asset: Asset
    data: DataSet
    monitor: MonitorSettings
    log: LogSettings

    @classmethod
    def of(cls, document: Document) -> "Config":
        """Check all of the twin's tables; ConfigError names file, line and key."""
        document.refuse_unknown_tables(TABLES)
        return cls(
            document,
            document.section(Asset, "asset"),
            document.section(DataSet, "data"),
            document.section(MonitorSettings, "monitor"),
            document.section(LogSettings, "log"),
        )
