"""Output of a running command: events to stdout, remarks on its work to stderr."""

import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO, TypeVar

from twin.events import Event, Severity
from twin.instants import stamp
from twin.printer import Printer

if TYPE_CHECKING:
    from twin.signals import Samples, Ticks


class Console:
    """A sink that prints events, one line each, with the loop's name.

    ``say`` prints several lines in one piece, since other loops may be printing too.
    """

    def __init__(self, name: str = "", say: Callable[[str], None] | None = None) -> None:
        self.alarmed = False  # all it keeps: a loop runs for months
        self._name = f"{name}  " if name else ""
        self._say = say or _print

    def write(self, _samples: "Samples", _ticks: "Ticks", events: Sequence[Event]) -> None:
        """Print the events; an alarm does not repeat the text of its evidence."""
        texts, lines = {event.text for event in events}, ""
        for event in events:
            self.alarmed |= event.severity is Severity.ALARM
            line = f"{event.severity:<7}  {event.kind:<17}  {_short(event, texts)}"
            lines += f"{stamp(event.time_ns)}  {self._name}{line}\n"
        if lines:
            self._say(lines)

    def close(self) -> None:
        """Nothing to finish."""


def _short(event: Event, texts: Collection[str]) -> str:
    """The text of an event; for an alarm without its evidence if that is among ``texts``."""
    evidence = event.data.get("evidence", {}).get("words")
    return event.text.replace(f": {evidence}", "", 1) if evidence in texts else event.text


class EventRecorder:
    """A sink that keeps events in the form of JSON."""

    def __init__(self) -> None:
        self.events: list[dict[str, object]] = []

    def write(self, _samples: "Samples", _ticks: "Ticks", events: Sequence[Event]) -> None:
        """Keep the events."""
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
    """Give a printer to stdout and a function that complains on stderr; neither waits."""
    printer, talk = Printer(sys.stdout), Printer(sys.stderr)
    try:
        yield printer, lambda text: talk.say(f"twin: {text}\n")
    finally:
        if unread := printer.close():
            talk.say(f"twin: output lost: {unread} pieces of text were not read in time\n")
        talk.close()


def _print(text: str) -> None:
    try:
        print(text, end="", flush=True)
    except OSError:  # a pipe that nobody reads any more, a terminal that was closed
        _mute(sys.stdout)


def complain(text: str) -> None:
    """Print a complaint in one piece, since other loops may be printing too."""
    try:
        print(f"twin: {text}\n", end="", file=sys.stderr, flush=True)
    except OSError:
        _mute(sys.stderr)


def hint(say: Callable[[str], None], text: str) -> None:
    """Tell a person at a terminal what to do next; a program that reads stderr gets nothing."""
    if sys.stderr.isatty():
        say(text)


def _mute(stream: TextIO) -> None:
    """Send further output of a stream without a reader to nowhere: each write would fail."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


Block = TypeVar("Block")


def progress(
    source: Iterable[Block],
    label: str,
    samples: Callable[[Block], int] = len,  # type: ignore[assignment]
) -> Iterator[Block]:
    """Show a count of samples on a terminal, nothing in a pipe.

    ``samples`` gives the number of samples in a block.
    """
    if not sys.stderr.isatty():
        yield from source
        return
    from rich.console import Console as Terminal
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    count = TextColumn("{task.description}: {task.completed:,.0f} rows,")
    columns = (SpinnerColumn(), count, TimeElapsedColumn())
    with Progress(*columns, console=Terminal(stderr=True), transient=True) as progress:
        task = progress.add_task(label, total=None)
        for block in source:
            progress.advance(task, samples(block))
            yield block


def rows_progress(
    source: "Iterable[tuple[Samples, Ticks]]", label: str
) -> "Iterator[tuple[Samples, Ticks]]":
    """As ``progress``, for samples with their ticks."""
    return progress(source, label, lambda rows: len(rows[0]))


@contextmanager
def status() -> Iterator[Callable[[str], None]]:
    """Give a function that shows what is being done on a terminal, and nothing in a pipe."""
    if not sys.stderr.isatty():
        with no_status() as say:
            yield say
        return
    from rich.console import Console as Terminal

    with Terminal(stderr=True).status("") as status:
        yield status.update


@contextmanager
def no_status() -> Iterator[Callable[[str], None]]:
    """As ``status``, but silent: for loops that would show it at the same time."""
    yield lambda _text: None
