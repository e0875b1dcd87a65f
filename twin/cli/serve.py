"""``twin serve``: the technician's page, beside ``twin run`` or without it."""

import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli.app import read_config
from twin.cli.console import complain
from twin.errors import ConfigError
from twin.extras import require

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from twin.config import Config
    from twin.page.plant_overview import PlantOverview
    from twin.page.ring import LiveRows
    from twin.page.server import Place
    from twin.users import Users

PORT = 8420


def serve(
    *,
    configs: Annotated[
        list[Path] | None, typer.Option("--config", metavar="CONFIG", help="One for each ejector.")
    ] = None,
    broker: Annotated[
        Path | None,
        typer.Option(
            metavar="CONFIG", help="Show all ejectors of the broker that its [mqtt] names."
        ),
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen on; others reach it there.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(help="0 takes any free.")] = PORT,
    names: Annotated[
        list[str] | None,
        typer.Option("--name", metavar="NAME", help="Name by which browsers reach this machine."),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option(metavar="F.pem", help="Certificate for HTTPS, with its chain.")
    ] = None,
    key: Annotated[
        Path | None, typer.Option(metavar="F.pem", help="Private key of the certificate.")
    ] = None,
    users: Annotated[
        Path | None,
        typer.Option(
            "--users", metavar="FILE", help="Default: users.toml beside the first CONFIG."
        ),
    ] = None,
    assets: Annotated[
        str, typer.Option(metavar="URL", help="Asset database, instead of the configured.")
    ] = "",
) -> None:
    """Show traffic light, alarms, live pressure and trends in a browser; Ctrl-C ends it.

    It is a process of its own: it shows what twin run writes, and goes on after twin run ends. To
    acknowledge needs a login (twin users), and so does everything where others reach it. With
    --broker it shows what all ejectors publish, beside those of --config or alone.
    """
    require("serve", "twin serve")
    from twin.config import Config
    from twin.page.server import Place
    from twin.settings import Document
    from twin.users import FILE, Users

    first = configs[0] if configs else broker
    if first is None:
        hint = "name its configuration: --config CONFIG, or that of a broker: --broker CONFIG"
        raise ConfigError("no ejector to show", hint)
    if (certificate is None) != (key is None):
        raise ConfigError("--certificate and --key belong together", "give both, as PEM files")
    endpoint, registered = Place(host, port, certificate, key), Users(users or first.parent / FILE)
    _require_users(endpoint, registered)
    settings = [Config.of(Document.read(path), assets) for path in configs or []]
    with _plant_overview_of(broker) as plant_overview:
        _serve(endpoint, settings, registered, names or [], plant_overview)


@contextmanager
def _plant_overview_of(broker: Path | None) -> "Iterator[PlantOverview | None]":
    """The overview of all ejectors of a broker while its messages are read; None without one."""
    if broker is None:
        yield None
        return
    from twin.config import TABLES
    from twin.notifications.settings import chosen
    from twin.page.plant_overview import PlantOverview
    from twin.page.plant_overview_client import listening

    document, plant_overview = read_config(broker), PlantOverview()
    document.refuse_unknown_tables(TABLES)
    mqtt, _ = chosen(document)
    if not mqtt.host:
        raise ConfigError(f"{broker}: no [mqtt] in it", 'say where the broker is: host = "..."')
    with listening(mqtt, broker.parent, plant_overview, complain):
        yield plant_overview


def _serve(
    endpoint: "Place",
    settings: "list[Config]",
    users: "Users",
    names: list[str],
    plant_overview: "PlantOverview | None",
) -> None:
    import socket

    from twin.audit import Audit
    from twin.login import Authenticator
    from twin.page.app import Access, Page
    from twin.page.chart_library import chart_library
    from twin.page.ejector import Ejector
    from twin.page.server import address, listen, make_server
    from twin.page.sessions import Sessions

    library = chart_library()
    host_names = {name.lower() for name in (*names, endpoint.host, socket.gethostname()) if name}
    access = Access(frozenset(host_names), endpoint.scheme == "https", endpoint.is_loopback)
    authenticator = Authenticator(users, Audit(users.path.parent, "page", complain))
    ejectors = [Ejector(config) for config in settings]
    page = Page(ejectors, authenticator, Sessions(users), access, plant_overview, library)
    server = make_server(page.app(), endpoint)
    with listen(endpoint) as listening:
        print(f"the page is at {address(endpoint, listening)}", flush=True)
        server.run(sockets=[listening])


def _require_users(endpoint: "Place", users: "Users") -> None:
    """ConfigError if a page without users would be reachable from the network."""
    if endpoint.is_loopback:
        return
    if not users.names:
        raise ConfigError(
            f"{endpoint.host}: others would reach the page, and it has no users",
            "make one first: twin users add NAME --config CONFIG",
        )
    if endpoint.certificate is None:
        complain("without --certificate others on the network can read passwords on their way")


# --- for the loop -------------------------------------------------------------------------------


def live_rows_of(
    settings: "Config", say: "Callable[[str], None]", log: Path | None = None
) -> "Callable[[], LiveRows] | None":
    """A function that opens the sink of live rows; None unless ``[page]`` asks for it.

    It leaves word where the file ``log`` lies, so that the page finds what is older.
    """
    from twin.page.log_folders import remember
    from twin.page.ring import LiveRows
    from twin.page.settings import RING, PageSettings, folder_of
    from twin.signals import MBAR

    if not settings.document.section(PageSettings, "page").keep:
        return None
    folder = folder_of(settings.document, settings.asset)
    ambient = settings.data.ambient.pressure_mbar * MBAR

    def opened() -> LiveRows:
        live_rows = LiveRows(folder / RING, ambient, say, time.time_ns)
        try:
            if log is not None:
                remember(folder, log.parent)
        except OSError as error:
            say(f"the page will not find the log: {folder}: {error.strerror}")
        return live_rows

    return opened


def reports_of(settings: "Config", say: "Callable[[str], None]") -> Path | None:
    """The folder for reports of live diagnoses; None unless ``[page]`` asks for them.

    Without the extra for reports the run goes on without them, and says so.
    """
    from twin.page.settings import REPORTS, PageSettings, folder_of

    if not settings.document.section(PageSettings, "page").keep:
        return None
    try:
        require("reports", "a report of a live diagnosis")
    except ConfigError as missing:
        say(f"{missing}\n  {missing.hint}")
        return None
    return folder_of(settings.document, settings.asset) / REPORTS
