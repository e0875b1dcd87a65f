"""The benchmarks of ``tools/bench.py``, and their floors."""

import os

# Same value as on the command line; NumPy reads it on import. The twin's part is measured on one
# core, where threads of OpenBLAS would mostly wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
