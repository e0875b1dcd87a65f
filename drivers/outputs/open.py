"""Open a configuration's outputs: the writer to its PLC, and the server of its results."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.connection_pool import ConnectionPool
from drivers.outputs.settings import ResultsSettings
from drivers.outputs.writer import Writer
from drivers.sources import driver_of
from twin.errors import ConfigError
from twin.extras import require
from twin.settings import Document

if TYPE_CHECKING:
    from drivers.outputs.state import Results


def open_writer(
    document: Document, address: str = "", pool: ConnectionPool | None = None
) -> Writer:
    """The writer of what ``[hil]`` lists, to the PLC that ``[driver]`` names.

    Raises ConfigError if nothing is listed or the driver only reads, SourceError if the PLC does
    not answer.
    """
    if not document.tables.get("hil", {}).get("tags"):
        raise ConfigError(
            f"{document.name}: nothing is listed under [hil.tags]",
            "list what may be written; docs/hil.md has an example",
        )
    return driver_of(document, address, pool).writer(document)


@contextmanager
def open_results(
    documents: Sequence[Document], units_of_figures: Callable[[], Mapping[str, str]]
) -> Iterator["Callable[..., Results] | None"]:
    """Serve the results of all configurations that ask for it by one server; None if none does.

    Gives ``ResultsServer.sink``, which makes an asset's sink. ConfigError if two configurations
    differ in their settings; for other errors see ``ResultsServer``.
    """
    settings = _agreed_settings(documents)
    if settings is None:
        yield None
        return
    require("opcua", "[results] over OPC UA")
    from drivers.outputs.results import ResultsServer  # noqa: PLC0415 - the library takes its time

    with ResultsServer(settings, units_of_figures()) as server:
        yield server.sink


def _agreed_settings(documents: Sequence[Document]) -> ResultsSettings | None:
    """The settings that all configurations with results share; None if there are no such ones."""
    first: tuple[str, ResultsSettings] | None = None
    for document in documents:
        folder = Path(document.name).parent  # files lie there, wherever the program was started
        settings = document.section(ResultsSettings, "results").below(folder)
        if not settings.opcua:
            continue
        if first is not None and first[1] != settings:
            raise ConfigError(
                f"{first[0]} and {document.name} serve their results differently under [results]",
                "one server stands for all ejectors of a process: write the same in both",
            )
        first = document.name, settings
    return first[1] if first else None
