"""Run as a program: runs a command; prints its time (s), its peak memory (MB) and its exit code.

A process inherits the memory of its parent as its own peak, so the parent has to be small.
"""

import os
import sys
import time

begin = time.perf_counter()
silent = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
number = os.posix_spawn(sys.argv[1], sys.argv[1:], os.environ, file_actions=silent)
_, status, used = os.wait4(number, 0)
seconds = time.perf_counter() - begin
print(seconds, used.ru_maxrss * 1024 * 1e-6, os.waitstatus_to_exitcode(status))
