"""The files of one log: their names, and what stands at the head of each."""

from pathlib import Path

from twin.log.header import Identity, LogHeader, to_metadata
from twin.log.mcap_file import McapFile
from twin.log.output import Output
from twin.log.schema import CHANNELS

OWN_METADATA = "ejector-twin"
FREE_METADATA = "run"


def part_path(path: Path, number: int) -> Path:
    """Name of a part: run.mcap, run.0001.mcap, run.0002.mcap, ..."""
    return path if number == 0 else path.with_name(f"{path.stem}.{number:04d}{path.suffix}")


def write_head(output: Output, header: LogHeader, identity: Identity) -> McapFile:
    """Begin a file that says all about itself before its first chunk."""
    file = McapFile(output)
    file.add_metadata(OWN_METADATA, to_metadata(header, identity))
    file.add_metadata(FREE_METADATA, header.metadata)
    file.add_attachment(header.config_name, "application/toml", header.config_text.encode())
    for number, channel in CHANNELS.items():
        file.add_channel(number, channel.topic, channel.schema, channel.files)
    return file
