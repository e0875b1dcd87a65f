"""Compiles the binary of an FMU, if a C compiler is available."""

import platform
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from twin.errors import TwinError

COMPILERS = ("cc", "gcc", "clang")  # the first available one is used
FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden")


class Binary(NamedTuple):
    """A shared library and its place in the FMU."""

    path: str
    content: bytes


def binary(sources: Mapping[str, str], main: str, identifier: str, version: int) -> Binary | None:
    """Compile ``main`` of the sources for this machine; None without a compiler.

    TwinError with the compiler's first error if it rejects them.
    """
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    platform_folder = _platform_folder(version)
    if compiler is None or platform_folder is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        for name, text in sources.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        output = Path(folder) / f"{identifier}.so"
        command = [compiler, *FLAGS, "-o", str(output), main, "-lm"]
        result = subprocess.run(  # noqa: S603 - found on the path, our own sources
            command, cwd=folder, capture_output=True, text=True, check=False
        )
        if result.returncode != 0:
            complaint = (result.stderr.strip().splitlines() or ["no reason given"])[0]
            raise TwinError(
                f"{compiler} does not compile the FMU: {complaint}",
                "leave the binary out with --sources-only; the importing tool may compile it",
            )
        return Binary(f"binaries/{platform_folder}/{output.name}", output.read_bytes())


def _platform_folder(version: int) -> str | None:
    """The folder of this platform in an FMU; FMI 3.0 names more platforms than FMI 2.0."""
    machine = platform.machine().lower()
    if platform.system() != "Linux":
        return None
    if version == 2:
        return "linux64" if machine == "x86_64" else None
    return f"{machine}-linux" if machine in ("x86_64", "aarch64") else None
