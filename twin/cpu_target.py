"""Sets the processor features that numba compiles for; import it before anything is compiled.

For processors with vectors of 512 bits, LLVM leaves a loop over hypotheses scalar, which takes
three times as long. With vectors of four it works on all processors.
"""

import numba
from numba.core.codegen import get_host_cpu_features

_features = get_host_cpu_features().replace("+avx512", "-avx512")  # type: ignore[no-untyped-call]
numba.config.CPU_FEATURES = _features  # type: ignore[attr-defined]
njit = numba.njit
