"""The binary of an FMU, where a C compiler is at hand."""

import platform
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from twin.errors import TwinError

COMPILERS = ("cc", "gcc", "clang")  # the first one that is there
FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden")


class Binary(NamedTuple):
    """A shared library and its place in the FMU."""

    path: str
    content: bytes


def binary(sources: Mapping[str, str], main: str, identifier: str, version: int) -> Binary | None:
    """Compile ``main`` of the sources for this machine; None without a compiler.

    TwinError with the compiler's first complaint if it does not take them.
    """
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    place = _place(version)
    if compiler is None or place is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        for name, text in sources.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        output = Path(folder) / f"{identifier}.so"
        command = [compiler, *FLAGS, "-o", str(output), main, "-lm"]
        done = subprocess.run(  # noqa: S603 - found on the path, our own sources
            command, cwd=folder, capture_output=True, text=True, check=False
        )
        if done.returncode != 0:
            said = (done.stderr.strip().splitlines() or ["no reason given"])[0]
            raise TwinError(
                f"{compiler} does not compile the FMU: {said}",
                "leave the binary out with --sources-only; the importing tool may compile it",
            )
        return Binary(f"binaries/{place}/{output.name}", output.read_bytes())


def _place(version: int) -> str | None:
    """The folder of this platform: FMI 3.0 has names for more of them than FMI 2.0."""
    machine = platform.machine().lower()
    if platform.system() != "Linux":
        return None
    if version == 2:
        return "linux64" if machine == "x86_64" else None
    return f"{machine}-linux" if machine in ("x86_64", "aarch64") else None
