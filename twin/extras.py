"""How to install what an option needs: one line that works for this installation."""

import shlex
import sys
from importlib.metadata import requires
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]


def install_hint(extra: str, root: Path = _ROOT) -> str:
    """The command that installs an extra, for this Python.

    From a checkout (``root`` has the project file) the project itself is installed with the extra.
    From a wheel its packages are named: nobody knows from where the wheel came.
    """
    if (root / "pyproject.toml").is_file():
        wanted = ["-e", f"{root}[{extra}]"]
    else:
        wanted = [
            package.strip()
            for package, _, marker in (one.partition(";") for one in requires("ejector-twin") or ())
            if marker.replace('"', "'").strip() == f"extra == '{extra}'"
        ]
    return shlex.join([sys.executable, "-m", "pip", "install", *wanted])
