"""What a log says about itself, so that it replays alone."""

import hashlib
import json
from dataclasses import dataclass, field

from twin.errors import ConfigError

FORMAT = "ejector-twin-log/2"
UNCHECKED = "ejector-twin-log/1"  # the same without a checksum of the head
CHECKSUM = "sha256"
HIL, DERIVED = "hil", "derived_commands"  # what of the rows was not measured, in free metadata
RECORDED, RECOVERED = "recorded_by", "recovered_from"  # where the rows come from, there too


@dataclass(frozen=True)
class LogHeader:
    """Whose log it is and the configuration it was made with."""

    asset_type: str
    asset_id: str
    config_name: str
    config_text: str  # TOML, kept as an attachment
    metadata: dict[str, str] = field(default_factory=dict)  # hash of the data set, version, ...
    ambient: float = 101_325.0  # Pa, from which the vacuum in /scalars is counted

    @property
    def derived(self) -> str:
        """How commands were derived from the pressure, in words; empty where they were recorded."""
        return self.metadata.get(DERIVED, "")

    @property
    def is_recorded(self) -> bool:
        """Whether ``twin run`` wrote it beside a PLC; a copy that was recovered is no such log."""
        return RECORDED in self.metadata and RECOVERED not in self.metadata

    def require_commands(self, log: str) -> None:
        """ConfigError where nobody recorded the commands: no twin can be fitted to such a log."""
        if self.derived:
            raise ConfigError(
                f"{log}: {self.derived}. A twin needs to know when valves were told",
                "record suction and blow-off beside the pressure, a row each 2 ms or faster;"
                " what needs no twin: twin figures show LOG, twin compare A B",
            )

    @property
    def unmeasured(self) -> dict[str, str]:
        """What of the rows was not measured, and goes with them into another log."""
        return {name: self.metadata[name] for name in (HIL, DERIVED) if name in self.metadata}


@dataclass(frozen=True)
class Identity:
    """Which piece of which recording a file is."""

    series: str  # the same in all parts of one recording, different in any other
    part: int  # 0 is the file named by the user


def to_metadata(header: LogHeader, identity: Identity) -> dict[str, str]:
    """All but the configuration's text and the free metadata, as MCAP stores it.

    The checksum is over all three: MCAP has none for metadata.
    """
    own = {
        "format": FORMAT,
        "series": identity.series,
        "part": str(identity.part),
        "asset_type": header.asset_type,
        "asset_id": header.asset_id,
        "config_name": header.config_name,
        "ambient_pa": repr(header.ambient),
    }
    return own | {CHECKSUM: _checksum(own, header.config_text, header.metadata)}


def from_metadata(
    stored: dict[str, str], config_text: str, metadata: dict[str, str]
) -> tuple[LogHeader, Identity, bool]:
    """Reverse ``to_metadata``; whether there was a checksum stands last.

    KeyError or ValueError where it was not written by it, or is no longer as it was written.
    """
    if stored["format"] not in (FORMAT, UNCHECKED):
        raise ValueError(f"its format is {stored['format']!r}, not {FORMAT!r}")
    is_checked = stored["format"] == FORMAT or CHECKSUM in stored
    if is_checked:
        own = {key: value for key, value in stored.items() if key != CHECKSUM}
        if stored[CHECKSUM] != _checksum(own, config_text, metadata):
            raise ValueError("its checksum is wrong: not all in it is as it was written")
    header = LogHeader(
        asset_type=stored["asset_type"],
        asset_id=stored["asset_id"],
        config_name=stored["config_name"],
        config_text=config_text,
        metadata=metadata,
        ambient=float(stored["ambient_pa"]),
    )
    return header, Identity(stored["series"], int(stored["part"])), is_checked


def _checksum(own: dict[str, str], config_text: str, metadata: dict[str, str]) -> str:
    head = json.dumps([own, metadata, config_text], sort_keys=True)
    return hashlib.sha256(head.encode()).hexdigest()
