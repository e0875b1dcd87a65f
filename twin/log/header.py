"""The head of a log. It holds all that a replay needs."""

import hashlib
import json
from dataclasses import dataclass, field

from twin.errors import ConfigError

FORMAT = "ejector-twin-log/2"
UNCHECKED = "ejector-twin-log/1"  # the same without a checksum of the head
CHECKSUM = "sha256"
HIL, DERIVED = "hil", "derived_commands"  # free metadata: parts of the rows that nobody measured
RECORDED, RECOVERED = "recorded_by", "recovered_from"  # free metadata: origin of the rows


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
        """Whether ``twin run`` wrote it beside a PLC; a recovered copy does not count."""
        return RECORDED in self.metadata and RECOVERED not in self.metadata

    def require_commands(self, log: str) -> None:
        """ConfigError if nobody recorded the commands: no twin can be fitted to such a log."""
        if self.derived:
            raise ConfigError(
                f"{log}: {self.derived}. A twin needs to know when valves were told",
                "record suction and blow-off beside the pressure, a row each 2 ms or faster;"
                " what needs no twin: twin figures show LOG, twin compare A B",
            )

    @property
    def unmeasured(self) -> dict[str, str]:
        """Metadata about unmeasured parts of the rows; copies of the rows keep it."""
        return {name: self.metadata[name] for name in (HIL, DERIVED) if name in self.metadata}


@dataclass(frozen=True)
class Identity:
    """Which piece of which recording a file is."""

    series: str  # the same in all parts of one recording, different in any other
    part: int  # 0 is the file named by the user


def to_metadata(header: LogHeader, identity: Identity) -> dict[str, str]:
    """The header as MCAP metadata, without the configuration's text and the free metadata.

    The checksum covers all three, since MCAP has no checksum for metadata.
    """
    fields = {
        "format": FORMAT,
        "series": identity.series,
        "part": str(identity.part),
        "asset_type": header.asset_type,
        "asset_id": header.asset_id,
        "config_name": header.config_name,
        "ambient_pa": repr(header.ambient),
    }
    return fields | {CHECKSUM: _checksum(fields, header.config_text, header.metadata)}


def from_metadata(
    stored: dict[str, str], config_text: str, metadata: dict[str, str]
) -> tuple[LogHeader, Identity, bool]:
    """Reverse ``to_metadata``; the last element says whether there was a checksum.

    KeyError or ValueError if ``to_metadata`` did not write it, or if it has changed since.
    """
    if stored["format"] not in (FORMAT, UNCHECKED):
        raise ValueError(f"its format is {stored['format']!r}, not {FORMAT!r}")
    is_checked = stored["format"] == FORMAT or CHECKSUM in stored
    if is_checked:
        fields = {key: value for key, value in stored.items() if key != CHECKSUM}
        if stored[CHECKSUM] != _checksum(fields, config_text, metadata):
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


def _checksum(fields: dict[str, str], config_text: str, metadata: dict[str, str]) -> str:
    content = json.dumps([fields, metadata, config_text], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()
