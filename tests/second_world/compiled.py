"""How functions are compiled that only compiled code calls: plain division, no way in from Python.

Python reaches them by `py_func`. Both halve what there is to compile, and speed up what runs.
"""

from numba import njit

compiled = njit(error_model="numpy", no_cfunc_wrapper=True, _nrt=False)
