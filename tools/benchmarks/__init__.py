"""What ``tools/bench.py`` measures, and the floors it measures beside it."""

import os

# As the command line has it, read when NumPy is imported: on the one core that the twin's part is
# measured on, threads of OpenBLAS would wait for each other most of the time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
