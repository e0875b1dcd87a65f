"""An FMU: description, sources, binary and page in one file."""

import io
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass

from twin.exchange.binary import binary
from twin.exchange.description import Identity, build_description, model_description
from twin.exchange.page import page
from twin.exchange.sources import main_source, sources
from twin.exchange.variables import Component

BEGINNING = (1980, 1, 1, 0, 0, 0)  # fixed time of every file inside: same content, same FMU


@dataclass(frozen=True)
class Fmu:
    """A whole FMU, its file name, and the path of its binary, if it has one."""

    name: str
    content: bytes
    binary: str


def make_fmu(
    component: Component, name: str, origin: str, program: str, version: int, *, compiled: bool
) -> Fmu:
    """The FMU of a component called ``name``, for FMI 3.0 or 2.0.

    Without a compiler, or without ``compiled``, it contains only sources.
    """
    texts, token = sources(component, version)
    identity = Identity(name, identifier(name), origin, program, token)
    main = main_source(version)
    built = binary(texts, main, identity.identifier, version) if compiled else None
    parts = {
        "modelDescription.xml": model_description(component, identity, version, [main]),
        "documentation/index.html": page(component, identity).encode(),
        **{f"sources/{file}": text.encode() for file, text in texts.items()},
    }
    if version == 3:
        parts["sources/buildDescription.xml"] = build_description(identity, [main])
    if built is not None:
        parts[built.path] = built.content
    return Fmu(f"{identity.identifier}.fmu", packed(parts), built.path if built else "")


def identifier(name: str) -> str:
    """A name in a form valid for C and file systems."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return plain if plain[:1].isalpha() else f"ejector_{plain}"


def packed(parts: Mapping[str, bytes]) -> bytes:
    """A ZIP file of the parts, the same to the byte for the same parts."""
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            info = zipfile.ZipInfo(name, BEGINNING)
            info.external_attr = 0o644 << 16
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, content)
    return memory.getvalue()
