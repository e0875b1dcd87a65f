"""Several loops in one process, a thread each: one that ends in an error leaves the others alone.

The kernel runs without the interpreter's lock, and the rest of a loop is a few per cent of a core.
"""

import threading
import traceback
from collections.abc import Callable, Mapping

from twin.errors import TwinError

Told = Callable[[str, str], None]  # whose loop, and what it says


def run_together(loops: Mapping[str, Callable[[], None]], told: Told) -> list[str]:
    """Run every loop to its end, by its name; gives the names of those that failed.

    Why one failed goes to ``told`` at once, from the thread it ran in.
    """
    failed: list[str] = []

    def guarded(name: str, loop: Callable[[], None]) -> None:
        try:
            loop()
        except TwinError as error:
            failed.append(name)
            told(name, f"{error}\n  {error.hint}" if error.hint else str(error))
        except Exception:  # a mistake of ours in one loop is no reason to end the others
            failed.append(name)
            told(name, traceback.format_exc())

    threads = [
        threading.Thread(target=guarded, args=(name, loop), name=f"loop of {name}")
        for name, loop in loops.items()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return failed
