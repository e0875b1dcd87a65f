"""What is compiled for is the same whoever comes first: a notebook's rig, or the model."""

import subprocess
import sys
from itertools import permutations

import pytest

MODULES = ("drivers.plc.rig", "twin.model.kernel")
TARGET = """
from numba.core.registry import cpu_target
print(cpu_target.target_context.codegen().magic_tuple()[2])
"""


@pytest.mark.parametrize("order", list(permutations(MODULES)))
def test_no_vectors_of_512_bits_whatever_is_imported_first(order: tuple[str, ...]) -> None:
    code = "".join(f"import {module}\n" for module in order) + TARGET
    said = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60
    )
    assert said.stdout.strip()
    assert "+avx512" not in said.stdout
