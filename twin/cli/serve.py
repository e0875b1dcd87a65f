"""``twin serve``: the technician's page, beside ``twin run`` or without it."""

import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli.app import read_config
from twin.cli.console import complain
from twin.errors import ConfigError
from twin.extras import install_hint

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

    A process of its own: it shows what twin run leaves, and stays when that ends. To acknowledge
    needs a login (twin users), and so does everything where others reach it. With --broker
    it shows what all ejectors publish, beside those of --config or alone.
    """
    _require_extra()
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
    place, known = Place(host, port, certificate, key), Users(users or first.parent / FILE)
    _require_users(place, known)
    settings = [Config.of(Document.read(one), assets) for one in configs or []]
    with _heard_of(broker) as hall:
        _serve(place, settings, known, names or [], hall)


@contextmanager
def _heard_of(broker: Path | None) -> "Iterator[PlantOverview | None]":
    """What all ejectors publish, while it is listened to; None without a broker."""
    if broker is None:
        yield None
        return
    from twin.config import TABLES
    from twin.notifications.settings import chosen
    from twin.page.plant_overview import PlantOverview
    from twin.page.plant_overview_client import listening

    document, hall = read_config(broker), PlantOverview()
    document.refuse_unknown_tables(TABLES)
    mqtt, _ = chosen(document)
    if not mqtt.host:
        raise ConfigError(f"{broker}: no [mqtt] in it", 'say where the broker is: host = "..."')
    with listening(mqtt, broker.parent, hall, complain):
        yield hall


def _serve(
    place: "Place",
    settings: "list[Config]",
    users: "Users",
    names: list[str],
    hall: "PlantOverview | None",
) -> None:
    import socket

    from twin.audit import Audit
    from twin.login import Authenticator
    from twin.page.app import Access, Page
    from twin.page.ejector import Ejector
    from twin.page.server import address, listen, make_server
    from twin.page.sessions import Sessions

    ours = {one.lower() for one in (*names, place.host, socket.gethostname()) if one}
    access = Access(frozenset(ours), place.scheme == "https", place.is_loopback)
    authenticator = Authenticator(users, Audit(users.path.parent, "page", complain))
    ejectors = [Ejector(one) for one in settings]
    page = Page(ejectors, authenticator, Sessions(users), access, hall)
    server = make_server(page.app(), place)
    with listen(place) as listening:
        print(f"the page is at {address(place, listening)}", flush=True)
        server.run(sockets=[listening])


def _require_extra() -> None:
    """ConfigError where the page's libraries are not installed."""
    try:
        import babel  # noqa: F401
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
        import websockets  # noqa: F401
    except ImportError as error:
        raise ConfigError(f"twin serve needs {error.name}", install_hint("serve")) from error


def _require_users(place: "Place", users: "Users") -> None:
    """ConfigError where the network would reach a page without users."""
    if place.is_loopback:
        return
    if not users.names:
        raise ConfigError(
            f"{place.host}: others would reach the page, and it has no users",
            "make one first: twin users add NAME --config CONFIG",
        )
    if place.certificate is None:
        complain("without --certificate others on the network can read passwords on their way")


# --- for the loop -------------------------------------------------------------------------------


def live_rows_of(
    settings: "Config", say: "Callable[[str], None]"
) -> "Callable[[], LiveRows] | None":
    """What opens the sink that leaves live rows, where ``[page]`` asks for it; or None."""
    from twin.page.ring import LiveRows
    from twin.page.settings import RING, PageSettings, folder_of
    from twin.signals import MBAR

    if not settings.document.section(PageSettings, "page").keep:
        return None
    path = folder_of(settings.document, settings.asset) / RING
    ambient = settings.data.ambient.pressure_mbar * MBAR
    return lambda: LiveRows(path, ambient, say, time.time_ns)


def reports_of(settings: "Config") -> Path | None:
    """The folder for reports of live diagnoses, where ``[page]`` asks for them; or None."""
    from twin.page.settings import REPORTS, PageSettings, folder_of

    if not settings.document.section(PageSettings, "page").keep:
        return None
    return folder_of(settings.document, settings.asset) / REPORTS
