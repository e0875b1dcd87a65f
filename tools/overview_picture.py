"""Draw the page over all ejectors as a browser shows it, into a small PNG.

    python tools/overview_picture.py PICTURE.png

Forty simulated grippers run. Three have a fault, one of these is acknowledged, and two others go
offline. What they publish reaches the page without a broker. The page's clock stands at ``NOW_NS``,
so that the same program draws the same picture. Needs Chromium on the path.
"""

import json
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from page_picture import SIZE, shrink
from playwright.sync_api import sync_playwright

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import EPOCH_NS, blocks
from twin.alarms.loop import Alarms
from twin.alarms.settings import board_rules
from twin.assets.unit import Unit
from twin.audit import Audit
from twin.cli.console import complain
from twin.cli.setup import pair_of
from twin.config import Config
from twin.events import Event
from twin.files import json_text
from twin.live import run
from twin.login import Authenticator
from twin.notifications.data import CYCLE, VALUES, Cycles, Values
from twin.notifications.message import asset_of, of_event, of_status
from twin.notifications.sender import ALARM
from twin.page.app import Access, Page
from twin.page.chart_library import chart_library
from twin.page.plant_overview import STATUS, PlantOverview
from twin.page.plant_overview_app import ALL
from twin.page.server import Place, address, listen, make_server
from twin.page.sessions import Sessions
from twin.settings import Document
from twin.signals import MBAR, Samples, Ticks
from twin.users import Users

CONFIG = Path(__file__).parent.parent / "configs" / "gripper.toml"
NOW_NS = round(time.mktime((2026, 11, 30, 9, 30, 0, 0, 0, -1))) * 10**9  # half past nine anywhere
BATCH, PROGRAM = "2026-07", "picture"
COUNT = 40
HEALTHY_S, FAULTY_S = 20.0, 45.0  # of a run that are simulated
FAULTS: Mapping[int, str] = {
    8: "filter_clogging=60@12",  # mbar at s
    17: "leakage=1@12",  # sl/min
    23: "supply_pressure_drop=1@15",  # bar
}
SHOWN_S, PERIOD_S = 10.0, 0.2  # of vacuum, for a few cycles that can be told apart
STARTED_NS = NOW_NS - 7 * 1800 * 10**9
SEEN_BY_A_PERSON = 8
ACKNOWLEDGED = {"state": "acknowledged", "acknowledged": True}
GONE, STOPPED = 5, 6
OFFLINE_S = 190.0  # since those two were heard


class Edge:
    """Gives the overview what an ejector publishes (a sink of the loop)."""

    def __init__(self, plant: PlantOverview, config: Config, number: int, end_ns: int) -> None:
        self._plant, self._shown_ns = plant, end_ns - round(1e9 * SHOWN_S)
        self._unit = Unit(config.asset.type, f"hall-7/cell-{number:02d}")
        self._alarm_changes = ACKNOWLEDGED if number == SEEN_BY_A_PERSON else {}
        self.asset = asset_of(self._unit, BATCH)
        ambient = config.data.ambient.pressure_mbar * MBAR
        self._values, self._cycles = Values(self.asset, PERIOD_S, ambient), Cycles(self.asset)

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Publish key figures, alarms and the newest values."""
        is_shown = samples["host_ns"] >= self._shown_ns
        for message in self._values.tell(samples[is_shown], ticks[is_shown], events):
            self.publish(message.body, VALUES)
        for message in self._cycles.tell(samples, ticks, events):
            self.publish(message.body, CYCLE)
        for message in (message for event in events for message in of_event(self._unit, event)):
            body = json.loads(message.body)
            changes = self._alarm_changes if body["active"] else {}
            self.publish(json_text(body | changes), ALARM, message.alarm)

    def close(self) -> None:
        """Publish the last values."""
        for message in self._values.rest():
            self.publish(message.body, VALUES)

    def publish(self, body: str, *topic: str) -> None:
        """Publish one message; it counts as retained, so that its own time is taken."""
        self._plant.take([*self._unit, *topic], body.encode(), kept=True)


def main(picture: Path) -> None:
    """Let the ejectors run, and take the picture."""
    with serving(plant()) as url, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"))
        page = chromium.new_page(viewport=SIZE, color_scheme="light", locale="en-GB")
        page.goto(url)
        page.locator("#all-rows tr").nth(COUNT - 1).wait_for()
        picture.write_bytes(shrink(page.screenshot()))
        chromium.close()


def plant() -> PlantOverview:
    """The overview of all ejectors; its clock stands still."""
    overview = PlantOverview(lambda: NOW_NS / 1e9)
    overview.connected()
    config = Config.of(Document.read(CONFIG))
    for number in range(COUNT):
        simulate(overview, config, number)
    return overview


def simulate(overview: PlantOverview, config: Config, number: int) -> None:
    """Run one ejector up to now, or until it went offline."""
    is_online = number not in (GONE, STOPPED)
    end_ns = NOW_NS - round(1e9 * (number % 5 if is_online else OFFLINE_S))
    edge = Edge(overview, config, number, end_ns)
    alarms = Alarms(board_rules(config.document), None)
    run(received(config, number, end_ns), *pair_of(config), [edge], advisers=[alarms])
    status, since_ns = ("online", STARTED_NS) if is_online else ("offline", end_ns)
    said_ns = None if number == GONE else since_ns  # a last will has no time
    edge.publish(of_status(edge.asset, status, said_ns, PROGRAM), STATUS)


def received(config: Config, number: int, end_ns: int) -> Iterator[Samples]:
    """The rows of an ejector, of which the last one is received at ``end_ns``."""
    plc = config.document.section(PlcSettings, "plc")
    seconds = FAULTY_S if number in FAULTS else HEALTHY_S
    faults = [parse_fault(FAULTS[number])] if number in FAULTS else []
    for samples in blocks(plc, seconds, faults, seed=number):
        samples["host_ns"] += end_ns - round(1e9 * seconds) - EPOCH_NS
        yield samples


@contextmanager
def serving(overview: PlantOverview) -> Iterator[str]:
    """The URL of the overview's page, on loopback."""
    place = Place("127.0.0.1", 0)
    with TemporaryDirectory() as folder, listen(place) as listening:
        users = Users(Path(folder) / "users.toml")
        authenticator = Authenticator(users, Audit(users.path.parent, "page", complain))
        page = Page([], authenticator, Sessions(users), Access(), overview, chart_library())
        server = make_server(page.app(), place)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            yield address(place, listening).rstrip("/") + ALL
        finally:
            server.should_exit = True
            thread.join()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
