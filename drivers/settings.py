"""What every ``[driver]`` table has, whatever the kind of driver."""

from pathlib import Path
from typing import Self

from twin.errors import ConfigError
from twin.settings import Settings


class DriverSettings(Settings):
    """The ``[driver]`` table of one kind of driver; keys are fields, with bounds and comments."""

    kind: str  # kind of driver

    def at(self, host: str, port: int) -> Self:
        """The same for a PLC at another address, as ``--address`` gives it.

        ConfigError unless a driver overrides it.
        """
        raise ConfigError(
            f"a driver of kind {self.kind!r} takes no --address", "change [driver] instead"
        )

    def below(self, folder: Path) -> Self:
        """The same with files looked for in a folder, unless their paths are absolute.

        A driver whose settings name files overrides it.
        """
        return self
