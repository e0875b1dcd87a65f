"""What a command says while it runs: events to stdout, what it has to say of its work to stderr."""

import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from twin.events import Event, Severity
from twin.instants import stamp
from twin.printer import Printer

if TYPE_CHECKING:
    from twin.signals import Samples, Ticks


class Console:
    """A sink that prints what happens, one line each, with whose loop says it.

    ``say`` prints lines in one piece, since others may be printing too.
    """

    def __init__(self, name: str = "", say: Callable[[str], None] | None = None) -> None:
        self.alarmed = False  # all it keeps: a loop runs for months
        self._name = f"{name}  " if name else ""
        self._say = say or _print

    def write(self, _samples: "Samples", _ticks: "Ticks", events: Sequence[Event]) -> None:
        """Print what happened; an alarm does not say again what it is made of."""
        told, lines = {event.text for event in events}, ""
        for event in events:
            self.alarmed |= event.severity is Severity.ALARM
            what = f"{event.severity:<7}  {event.kind:<17}  {_short(event, told)}"
            lines += f"{stamp(event.time_ns)}  {self._name}{what}\n"
        if lines:
            self._say(lines)

    def close(self) -> None:
        """Nothing to finish."""


def _short(event: Event, told: Collection[str]) -> str:
    """The text of an event; of an alarm without its evidence, where that has been ``told``."""
    words = event.data.get("evidence", {}).get("words")
    return event.text.replace(f": {words}", "", 1) if words in told else event.text


class Kept:
    """A sink that keeps what happens, as JSON has it."""

    def __init__(self) -> None:
        self.events: list[dict[str, object]] = []

    def write(self, _samples: "Samples", _ticks: "Ticks", events: Sequence[Event]) -> None:
        """Keep what happened."""
        self.events += map(_plain, events)

    def close(self) -> None:
        """Nothing to finish."""


def _plain(event: Event) -> dict[str, object]:
    return {
        "time_ns": event.time_ns,
        "kind": str(event.kind),
        "severity": str(event.severity),
        "text": event.text,
        "data": dict(event.data),
    }


@contextmanager
def printers() -> Iterator[tuple[Printer, Callable[[str], None]]]:
    """Give what prints to stdout, and what complains on stderr, without waiting for who reads."""
    printer, talk = Printer(sys.stdout), Printer(sys.stderr)
    try:
        yield printer, lambda what: talk.say(f"twin: {what}\n")
    finally:
        if left := printer.close():
            talk.say(f"twin: nobody took what was said last, in {left} parts\n")
        talk.close()


def _print(text: str) -> None:
    try:
        print(text, end="", flush=True)
    except OSError:  # a pipe that nobody reads any more, a terminal that was closed
        _mute(sys.stdout)


def complain(what: str) -> None:
    """In one piece, since others may be printing too."""
    try:
        print(f"twin: {what}\n", end="", file=sys.stderr, flush=True)
    except OSError:
        _mute(sys.stderr)


def _mute(stream: TextIO) -> None:
    """Have nothing more written to where nobody reads: each write would be an error."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def progress(source: "Iterable[Samples]", what: str) -> "Iterator[Samples]":
    """Count samples on a terminal, say nothing in a pipe."""
    if not sys.stderr.isatty():
        yield from source
        return
    from rich.console import Console as Terminal
    from rich.progress import MofNCompleteColumn, Progress, SpinnerColumn, TextColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), MofNCompleteColumn())
    with Progress(*columns, console=Terminal(stderr=True), transient=True) as progress:
        task = progress.add_task(f"{what} (samples)", total=None)
        for block in source:
            progress.advance(task, len(block))
            yield block


@contextmanager
def status() -> Iterator[Callable[[str], None]]:
    """Give a function that says what is being done: on a terminal, and nothing in a pipe."""
    if not sys.stderr.isatty():
        with unsaid() as say:
            yield say
        return
    from rich.console import Console as Terminal

    with Terminal(stderr=True).status("") as status:
        yield status.update


@contextmanager
def unsaid() -> Iterator[Callable[[str], None]]:
    """As ``status`` where several would say it at once."""
    yield lambda _what: None
