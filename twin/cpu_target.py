"""What numba compiles for: it has to be said before whoever comes first compiles anything.

Where a processor has vectors of 512 bits, LLVM leaves a loop over hypotheses scalar, and each takes
three times as long; four at a time it runs everywhere.
"""

import numba
from numba.core.codegen import get_host_cpu_features

_features = get_host_cpu_features().replace("+avx512", "-avx512")  # type: ignore[no-untyped-call]
numba.config.CPU_FEATURES = _features  # type: ignore[attr-defined]
njit = numba.njit
