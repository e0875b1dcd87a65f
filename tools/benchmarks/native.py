"""Compiles and loads the floors that are written in C."""

import ctypes
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parent
PLAIN = ("-O2",)


def library(
    name: str, folder: Path, options: Sequence[str] = PLAIN, libraries: Sequence[str] = ()
) -> ctypes.CDLL | None:
    """Compile ``name``.c into ``folder`` and load it; None without a compiler.

    Libraries to link must be installed.
    """
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return None
    target = folder / f"{name}{len(list(folder.glob(f'{name}*.so')))}.so"  # none that is loaded
    always = ["-ffp-contract=off", "-shared", "-fPIC", "-o", target]
    sources = [HERE / f"{name}.c", *libraries, "-lm"]
    subprocess.run([compiler, *options, *always, *sources], check=True)
    return ctypes.CDLL(str(target))
