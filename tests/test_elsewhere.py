"""On other systems modules can be imported; what only Linux has is asked for where it is used."""

import subprocess
import sys

import pytest
import rigs

LACKS = """
import os, signal, sys
import asyncio, multiprocessing.connection, subprocess
sys.modules["fcntl"] = None
del signal.SIGUSR1, signal.SIGUSR2, os.getuid, os.getpriority, os.setpriority
"""
MODULES = ["twin.cli", "twin.page.ring", "twin.model.compiled", "drivers.plc.live"]
MODULES += [
    "drivers.outputs.results",
    "drivers.modbus.driver",
    "drivers.sources",
    "twin.diagnosis.process",
]


@pytest.mark.slow
@pytest.mark.parametrize("module", MODULES)
def test_a_module_comes_without_what_only_linux_has(module: str) -> None:
    code = f"{LACKS}import {module}"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=rigs.ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_live_rows_say_that_they_need_linux() -> None:
    code = f"""{LACKS}
from pathlib import Path
from twin.errors import SourceError
from twin.page.ring import LiveRows
try:
    LiveRows(Path("rows"), 1e5, print)
except SourceError as error:
    print(error)
"""
    said = subprocess.check_output([sys.executable, "-c", code], cwd=rigs.ROOT, text=True)
    assert said == "rows: live rows are written on Linux only\n"
