"""The command that installs an optional extra, for this installation."""

import shlex
import sys
from importlib.metadata import requires
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]


def install_hint(extra: str, root: Path = _ROOT) -> str:
    """The command that installs an extra, for this Python.

    In a checkout (``root`` has the project file) it installs the project with the extra. For a
    wheel it names the packages, since the wheel's origin is unknown.
    """
    if (root / "pyproject.toml").is_file():
        packages = ["-e", f"{root}[{extra}]"]
    else:
        packages = [
            package.strip()
            for package, _, marker in (
                requirement.partition(";") for requirement in requires("ejector-twin") or ()
            )
            if marker.replace('"', "'").strip() == f"extra == '{extra}'"
        ]
    return shlex.join([sys.executable, "-m", "pip", "install", *packages])
