"""How functions are compiled that only compiled code calls; Python reaches them by `py_func`.

Division does not raise, and nothing is counted: no function allocates. Runs three times as fast.
"""

from numba import njit

compiled = njit(error_model="numpy", no_cfunc_wrapper=True, _nrt=False)
