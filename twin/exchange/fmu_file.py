"""A simulation model as an FMU, as far as a shell says what it is."""

import zipfile
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from lxml import etree

from twin.errors import ConfigError, SourceError
from twin.files import unzipped_within_budget

DESCRIPTION = "modelDescription.xml"
MEDIA_TYPE = "application/x-fmu-sharedlibrary"
_WAYS = {"CoSimulation": "Co-Simulation", "ModelExchange": "Model Exchange"}


@dataclass(frozen=True)
class Fmu:
    """An FMU and what it says of itself."""

    name: str  # of its file
    content: bytes
    version: str  # of the model, empty where it does not say
    fmi: str  # version of the standard
    ways: tuple[str, ...]  # in which it can be run

    @property
    def kind(self) -> str:
        """As the template has it: FMI 2.0, Co-Simulation."""
        return ", ".join([f"FMI {self.fmi}", *self.ways])


def read_fmu(path: Path) -> Fmu:
    """An FMU from a file; SourceError where it cannot be read, ConfigError where it is none."""
    try:
        content = path.read_bytes()
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
        raise SourceError(message, "check the path") from error
    # Whatever stands in the file, no entity of it is resolved.
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:
            unzipped_within_budget(archive)
            root = etree.fromstring(archive.read(DESCRIPTION), parser)
        fmi = root.attrib["fmiVersion"]
    except (zipfile.BadZipFile, KeyError, etree.XMLSyntaxError, OSError, ValueError) as error:
        hint = "take what twin export-fmu, or another program that exports FMUs, has written"
        raise ConfigError(f"{path}: not an FMU: {error}", hint) from error
    ways = tuple(words for tag, words in _WAYS.items() if root.find(tag) is not None)
    return Fmu(path.name, content, root.get("version", ""), fmi, ways)
