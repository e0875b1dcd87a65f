"""The optional extras: what each is for, and the command that installs a missing one."""

import shlex
import sys
from importlib.metadata import requires
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from twin.errors import ConfigError

_ROOT = Path(__file__).resolve().parents[1]


class Extra(NamedTuple):
    """What an extra adds, and the modules that its packages bring."""

    purpose: str
    modules: tuple[str, ...]


EXTRAS = {
    "opcua": Extra(
        "a PLC over OPC UA, results over OPC UA, certificates", ("asyncua", "cryptography")
    ),
    "reports": Extra("reports as pages, pictures, German texts", ("babel", "matplotlib")),
    "tables": Extra(
        "import and export of CSV, Excel and Parquet", ("openpyxl", "pyarrow", "xlsxwriter")
    ),
    "serve": Extra(
        "the technician's page", ("anyio", "babel", "h11", "starlette", "uvicorn", "websockets")
    ),
    "view": Extra("the Rerun view", ("rerun",)),
    "postgres": Extra("databases on a PostgreSQL server", ("psycopg",)),
    "fleet": Extra("work on many logs, on all cores", ("matplotlib", "pebble")),
    "dask": Extra("work on many logs, on a Dask cluster", ("distributed", "matplotlib", "pebble")),
    "aas": Extra("Asset Administration Shells", ("basyx.aas", "lxml")),
    "notebook": Extra(
        "`import twin` in notebooks",
        ("babel", "matplotlib", "openpyxl", "pandas", "pyarrow", "xlsxwriter"),
    ),
}


def require(extra: str, user: str, *modules: str) -> None:
    """ConfigError unless the extra that ``user`` needs is installed; the hint installs it.

    ``modules`` are those of its modules that are needed; default: all. Call it before the work, and
    before the import.
    """
    for module in modules or EXTRAS[extra].modules:
        if not _is_installed(module):
            message = f"{user} needs the extra [{extra}]: {module} is not installed"
            raise ConfigError(message, install_hint(extra))


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ImportError:  # its parent is not installed
        return False


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
