"""Reads from an FMU what a shell says about it."""

import zipfile
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] - without types

from twin.errors import ConfigError, SourceError
from twin.files import unzipped_within_budget

DESCRIPTION = "modelDescription.xml"
MEDIA_TYPE = "application/x-fmu-sharedlibrary"
_MODES = {"CoSimulation": "Co-Simulation", "ModelExchange": "Model Exchange"}


@dataclass(frozen=True)
class Fmu:
    """An FMU and facts from its description."""

    name: str  # of its file
    content: bytes
    version: str  # of the model, empty if not given
    fmi: str  # version of the standard
    ways: tuple[str, ...]  # modes in which it can run

    @property
    def kind(self) -> str:
        """The kind in the template's form: FMI 2.0, Co-Simulation."""
        return ", ".join([f"FMI {self.fmi}", *self.ways])


def read_fmu(path: Path) -> Fmu:
    """An FMU from a file; SourceError if it cannot be read, ConfigError if it is no FMU."""
    try:
        content = path.read_bytes()
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
        raise SourceError(message, "check the path") from error
    # The file may come from anywhere, so no entity in it is resolved.
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:
            unzipped_within_budget(archive)
            root = etree.fromstring(archive.read(DESCRIPTION), parser)
        fmi = root.attrib["fmiVersion"]
    except (zipfile.BadZipFile, KeyError, etree.XMLSyntaxError, OSError, ValueError) as error:
        hint = "take what twin export-fmu, or another program that exports FMUs, has written"
        raise ConfigError(f"{path}: not an FMU: {error}", hint) from error
    modes = tuple(mode for tag, mode in _MODES.items() if root.find(tag) is not None)
    return Fmu(path.name, content, root.get("version", ""), fmi, modes)
