"""The files of one log: their names, and what stands at the head of each."""

from pathlib import Path

from twin.errors import ConfigError
from twin.log.header import Identity, LogHeader, to_metadata
from twin.log.output import Output
from twin.log.schema import CHANNELS, LIBRARY
from twin.log.writer import Writer

OWN_METADATA = "ejector-twin"
FREE_METADATA = "run"
SUFFIX = ".mcap"
CLOCK_METADATA = "clock"  # at the end: the PLC's clock against the one here


def part_path(path: Path, number: int) -> Path:
    """Name of a part: run.mcap, run.0001.mcap, run.0002.mcap, ..."""
    return path if number == 0 else path.with_name(f"{path.stem}.{number:04d}{path.suffix}")


def refuse_other_suffix(path: Path) -> None:
    """ConfigError for a new log with a name that says it is something else."""
    if path.suffix != SUFFIX:
        raise ConfigError(
            f"{path}: a log is an MCAP file, and its name ends in {SUFFIX}",
            f"say -o {path.with_suffix(SUFFIX)}",
        )


def place_of(path: Path) -> tuple[Path, int]:
    """Reverse ``part_path``: the first file's name, and the number of the part."""
    stem, _, number = path.stem.rpartition(".")
    first = path.with_name(f"{stem}{path.suffix}")
    if stem and number.isdecimal() and path == part_path(first, int(number)):
        return first, int(number)
    return path, 0


def first_parts(folder: Path) -> list[Path]:
    """The logs of a folder by their first files, in the order of their names.

    What came before may have been deleted: a log begins with the first part that is there.
    """
    files = sorted(folder.glob(f"*{SUFFIX}"))
    return [path for path in files if not follows(path)]


def follows(path: Path) -> bool:
    """Whether it is a later part of a log of which the part before is there."""
    first, number = place_of(path)
    return number > 0 and part_path(first, number - 1).exists()


def write_head(output: Output, header: LogHeader, identity: Identity) -> Writer:
    """Begin a file that says all about itself before its first chunk."""
    writer = Writer(output, LIBRARY)
    writer.add_metadata(OWN_METADATA, to_metadata(header, identity))
    writer.add_metadata(FREE_METADATA, header.metadata)
    writer.add_attachment(header.config_name, "application/toml", header.config_text.encode())
    for channel in CHANNELS.values():  # numbered from 1
        writer.register_channel(channel.topic, channel.schema, channel.files)
    return writer
