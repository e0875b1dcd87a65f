"""Run as a program: says what is compiled while the loop of a configuration runs, if anything."""

import gc
import sys

import rigs
from numba.core.dispatcher import Dispatcher

from twin.cli.setup import pair_of


def compiled() -> dict[str, int]:
    """For how many kinds of arguments each function is."""
    found = [entry for entry in gc.get_objects() if isinstance(entry, Dispatcher)]
    return {dispatcher.py_func.__qualname__: len(dispatcher.signatures) for dispatcher in found}


def main(name: str) -> None:
    """Run it over cycles with a gross fault, which brings everything about that can happen."""
    samples, _ = rigs.recorded(name, 30.0, ("leakage=3@c6",), 3)
    twin, monitor = pair_of(rigs.config(name))
    before = compiled()
    for block in rigs.cut(samples, 50):
        monitor.update(*twin.advance(block))
    assert monitor.active
    sys.stdout.write(
        str({what: count for what, count in compiled().items() if count != before.get(what)})
    )


main(sys.argv[1])
