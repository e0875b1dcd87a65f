"""Runs several loops in one process, a thread each; an error in one does not affect the others.

The kernel runs without the interpreter's lock, and the rest of a loop is a few per cent of a core.
"""

import threading
import traceback
from collections.abc import Callable, Mapping

from twin.errors import TwinError

Reporter = Callable[[str, str], None]  # takes the loop's name and a text


def run_together(loops: Mapping[str, Callable[[], None]], report: Reporter) -> list[str]:
    """Run every named loop to its end; returns the names of those that failed.

    ``report`` gets the reason of a failure at once, in the loop's thread.
    """
    failed: list[str] = []

    def guarded(name: str, loop: Callable[[], None]) -> None:
        try:
            loop()
        except TwinError as error:
            failed.append(name)
            report(name, f"{error}\n  {error.hint}" if error.hint else str(error))
        except Exception:  # a programming error in one loop must not end the others
            failed.append(name)
            report(name, traceback.format_exc())

    threads = [
        threading.Thread(target=guarded, args=(name, loop), name=f"loop of {name}")
        for name, loop in loops.items()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return failed
