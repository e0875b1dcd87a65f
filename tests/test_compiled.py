"""What is compiled once is loaded by those that come later, and nothing else with it."""

import subprocess
import sys

LOADING = """
import sys
import numpy as np
from twin.monitor.clock import line
x = np.arange(5.0)
assert line(x, 2.0 * x) == (2.0, 8.0)
print(sorted({"numba.typed.typeddict", "numba.np.polynomial"} & sys.modules.keys()))
"""


def test_a_start_with_all_compiled_gets_no_compiler_ready() -> None:
    for _ in range(2):  # the first one may have to compile it
        command = [sys.executable, "-c", LOADING]
        said = subprocess.run(command, check=True, capture_output=True, text=True, timeout=100)
    assert said.stdout.strip() == "[]"
