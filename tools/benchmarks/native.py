"""The floors written in C, compiled when they are needed."""

import ctypes
import shutil
import subprocess
from pathlib import Path

HERE = Path(__file__).parent


def library(name: str, folder: Path) -> ctypes.CDLL | None:
    """Compile ``name``.c with -O2 into ``folder`` and load it; None where there is no compiler."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return None
    target = folder / f"{name}.so"
    options = ["-O2", "-ffp-contract=off", "-shared", "-fPIC", "-o", target]
    subprocess.run([compiler, *options, HERE / f"{name}.c", "-lm"], check=True)
    return ctypes.CDLL(str(target))
