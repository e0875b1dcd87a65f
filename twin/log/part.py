"""The files of one log: their names, and the head of each."""

from pathlib import Path

from twin.errors import ConfigError
from twin.log.disk_file import Output
from twin.log.header import Identity, LogHeader, to_metadata
from twin.log.schema import CHANNELS, LIBRARY
from twin.log.writer import Writer

OWN_METADATA = "ejector-twin"
FREE_METADATA = "run"
SUFFIX = ".mcap"
CLOCK_METADATA = "clock"  # at the end of a file: the PLC's clock against the host's


def part_path(path: Path, number: int) -> Path:
    """Name of a part: run.mcap, run.0001.mcap, run.0002.mcap, ..."""
    return path if number == 0 else path.with_name(f"{path.stem}.{number:04d}{path.suffix}")


def refuse_other_suffix(path: Path, option: str = "-o") -> None:
    """ConfigError for a new log of ``option`` whose name has another suffix than a log's."""
    if path.suffix != SUFFIX:
        raise ConfigError(
            f"{path}: a log is an MCAP file, and its name ends in {SUFFIX}",
            f"say {option} {path.with_suffix(SUFFIX)}",
        )


def place_of(path: Path) -> tuple[Path, int]:
    """Reverse ``part_path``: the first file's name, and the number of the part."""
    stem, _, number = path.stem.rpartition(".")
    first = path.with_name(f"{stem}{path.suffix}")
    if stem and number.isdecimal() and path == part_path(first, int(number)):
        return first, int(number)
    return path, 0


def first_parts(folder: Path) -> list[Path]:
    """The first file of each log in a folder, sorted by name.

    Earlier parts may have been deleted: a log begins with its first existing part.
    """
    files = sorted(folder.glob(f"*{SUFFIX}"))
    return [path for path in files if not follows(path)]


def follows(path: Path) -> bool:
    """Whether the file is a later part of a log and the part before it exists."""
    first, number = place_of(path)
    return number > 0 and part_path(first, number - 1).exists()


def write_head(output: Output, header: LogHeader, identity: Identity) -> Writer:
    """Begin a file with its whole head before the first chunk."""
    writer = Writer(output, LIBRARY)
    writer.add_metadata(OWN_METADATA, to_metadata(header, identity))
    writer.add_metadata(FREE_METADATA, header.metadata)
    writer.add_attachment(header.config_name, "application/toml", header.config_text.encode())
    for channel in CHANNELS.values():  # numbered from 1
        writer.register_channel(channel.topic, channel.schema, channel.files)
    return writer
