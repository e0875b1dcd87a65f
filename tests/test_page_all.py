"""The page over all ejectors: what a broker tells, who is worst, and a real browser before it."""

import json
import re
import subprocess
import sys
import threading
import time
import tomllib
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import rigs
import tomli_w
from accessible import violations_light_and_dark
from command_line import twin
from mosquitto import Broker, broker
from page_site import config, write_config
from playwright.sync_api import Browser, expect
from plc_process import start_plc
from starlette.testclient import TestClient
from test_alarms_loop import LEAK
from test_page_browser import Server, _is_fit
from user_files import authenticator_of, quick_users

from twin.assets.unit import Unit
from twin.files import json_text
from twin.notifications.message import Message, asset_of, beside, of_status
from twin.notifications.mqtt import Mqtt
from twin.notifications.settings import MqttSettings
from twin.page import plant_overview as hall_module
from twin.page.app import Access, Page
from twin.page.chart_library import chart_library
from twin.page.ejector import Ejector
from twin.page.plant_overview import PlantOverview
from twin.page.plant_overview_client import listening
from twin.page.plant_overview_text import counted, details, of_one, overview
from twin.page.server import Place, address, listen, make_server
from twin.page.sessions import Sessions

TYPE = "compact-ejector-35"
NOW = 1_800_000_000.0
OURS = "http://127.0.0.1:8420"


def alarm(unit: Unit, **more: Any) -> str:
    body = {
        "format": "ejector-twin-alarm/1",
        "id": "a",
        "asset": unit._asdict(),
        "alarm": LEAK,
        "time": "2027-01-15T07:59:00.000000Z",
        "state": "unacknowledged",
        "active": True,
        "acknowledged": False,
        "since": "2027-01-15T07:59:00.000000Z",
        "priority": "medium",
        "consequence": "Parts may be lost.",
        "action": "Look at hoses, fittings and cups.",
        "evidence": {"words": "hold: +52 mbar from healthy", "guess": "leakage"},
    }
    return json.dumps(body | more)


def cycle(unit: Unit, number: int, at: float = NOW, **more: Any) -> Message:
    figures = {"cycle": number, "t0_measured": 189.0 + number, "t0_expected": 190.0}
    told = figures | {"leakage_measured": 71.5, "leakage_expected": None} | more
    return beside("ejector-twin-cycle/1", asset_of(unit, "B7"), round(at * 1e9), told)


def values(unit: Unit, at: float = NOW, rows: int = 5, high: float = 750.0) -> Message:
    made = [
        {
            "time_ns": round((at - rows + 1 + number) * 1e9),
            "measured_mbar": {"low": 0.5, "mean": 300.0 + number, "high": high},
            "expected_mbar": {"low": 0.0, "mean": 301.0, "high": 751.0},
        }
        for number in range(rows)
    ]
    told = {"period_s": 1.0, "rows": made}
    return beside("ejector-twin-values/1", asset_of(unit, "B7"), round(at * 1e9), told)


class Told:
    """A hall that is told things at a time of the test."""

    def __init__(self) -> None:
        self.now = NOW
        self.hall = PlantOverview(lambda: self.now)
        self.hall.connected()

    def tell(self, name: str, topic: str, body: str, *, kept: bool = False) -> None:
        self.hall.take([TYPE, name, *topic.split("/")], body.encode(), kept=kept)

    def status(self, name: str, status: str, since: float | None = NOW - 60) -> None:
        since_ns = None if since is None else round(since * 1e9)
        self.tell(
            name, "status", of_status(asset_of(Unit(TYPE, name), "B7"), status, since_ns, "p")
        )

    def lines(self) -> dict[str, dict[str, Any]]:
        told = self.hall.look(lambda heard, why, since: overview(heard, why, since, self.now))
        return {ejector["name"]: ejector for ejector in told["ejectors"]}

    def one(self, name: str) -> dict[str, Any]:
        found: dict[str, Any] = self.hall.look(
            lambda heard, why, _since: details(
                of_one(heard, Unit(TYPE, name)),  # type: ignore[arg-type]
                why,
                self.now,
            )
        )
        return found


@pytest.fixture
def told() -> Told:
    return Told()


def test_the_worst_comes_first_and_unknown_is_never_green(told: Told) -> None:
    for name in ("fine", "leaks", "seen", "died", "stopped", "silent"):
        told.status(name, "online")
    told.tell("leaks", f"alarm/{LEAK}", alarm(Unit(TYPE, "leaks")))
    quiet = {"state": "acknowledged", "acknowledged": True}
    told.tell("seen", f"alarm/{LEAK}", alarm(Unit(TYPE, "seen"), **quiet))
    told.tell("silent", "values", values(Unit(TYPE, "silent")).body)
    normal = {"state": "normal", "active": False, "acknowledged": True, "since": None}
    told.tell("fine", f"alarm/{LEAK}", alarm(Unit(TYPE, "fine"), **normal))
    told.now += 31.0
    told.status("died", "offline", None)
    told.status("stopped", "offline", NOW + 5)
    lines = told.lines()
    lights = {name: (one["light"], one["words"]) for name, one in lines.items()}
    assert lights == {
        "leaks": ("red", "Alarm"),
        "silent": ("grey", "Silent"),
        "stopped": ("grey", "Offline"),
        "died": ("grey", "Offline"),
        "seen": ("yellow", "Look after it"),
        "fine": ("green", "All right"),
    }
    assert next(iter(lights)) == "leaks"
    assert [*lights][-2:] == ["seen", "fine"]
    assert {name: lines[name]["what"] for name in lights} == {
        "leaks": "Leakage",
        "silent": "no values come",
        "stopped": "stopped",
        "died": "connection lost",
        "seen": "Leakage",
        "fine": "no alarm",
    }
    assert lines["died"]["since"] == NOW + 31.0, "when the broker told it"
    assert lines["stopped"]["since"] == NOW + 5
    assert counted([*lines.values()]) == {"red": 1, "grey": 3, "yellow": 1, "green": 1}


def test_without_the_broker_nothing_is_known(told: Told) -> None:
    told.status("fine", "online")
    told.now += 5.0
    told.hall.lost("MQTT broker h: the connection is lost")
    told.now += 5.0
    told.hall.lost("MQTT broker h cannot be reached")
    assert told.lines()["fine"]["light"] == "grey"
    assert told.hall.look(lambda _heard, why, since: (why, since)) == (
        "MQTT broker h cannot be reached",
        NOW + 5.0,
    )
    told.hall.connected()
    assert told.lines()["fine"]["light"] == "green"


def test_an_alarm_speaks_louder_than_silence(told: Told) -> None:
    told.status("a", "online")
    told.tell("a", "values", values(Unit(TYPE, "a")).body)
    told.tell("a", "alarm/plc_stale", alarm(Unit(TYPE, "a"), alarm="plc_stale", priority="high"))
    told.now += 100.0
    assert told.lines()["a"]["light"] == "red"
    assert told.lines()["a"]["what"] == "PLC stale"


def test_figures_vacuum_and_what_comes_late(told: Told) -> None:
    unit = Unit(TYPE, "a")
    told.status("a", "online")
    once = cycle(unit, 1)
    for message in (once, once, cycle(unit, 2, leakage_measured=None)):
        told.tell("a", "cycle", message.body)
    told.tell("a", "values", values(unit, NOW - 600.0, rows=400).body)
    line, one = told.lines()["a"], told.one("a")
    assert line["batch"] == "B7"
    assert line["figures"] == [
        {"name": "t0", "title": "t0", "unit": "ms", "measured": 191.0, "expected": 190.0},
        {
            "name": "leakage",
            "title": "leakage",
            "unit": "mbar/s",
            "measured": 71.5,
            "expected": None,
        },
    ]
    assert (line["spark"]["low"][0], line["spark"]["high"][-1]) == (0, 750)
    assert len(line["spark"]["low"]) == 60
    assert line["behind"] is None, "of a message with so many periods that is no delay"
    told.tell("a", "values", values(unit, NOW - 600.0).body)
    assert told.lines()["a"]["behind"] == 600.0
    assert [trend["name"] for trend in one["trends"]] == ["t0", "leakage"]
    assert one["trends"][0]["measured"] == [190.0, 191.0], "once, though it came twice"
    assert one["rows"]["mean"][:2] == [300.0, 301.0]


def test_what_the_broker_keeps_was_not_seen_now(told: Told) -> None:
    told.tell("a", "cycle", cycle(Unit(TYPE, "a"), 1, NOW - 500.0).body, kept=True)
    assert told.lines()["a"]["seen"] == NOW - 500.0
    told.tell("a", "cycle", cycle(Unit(TYPE, "a"), 2, NOW + 500.0).body, kept=True)
    assert told.lines()["a"]["seen"] == NOW, "a clock that goes before ours"


def test_what_the_broker_forgets_is_forgotten(told: Told) -> None:
    told.status("a", "online")
    told.tell("a", f"alarm/{LEAK}", alarm(Unit(TYPE, "a")))
    told.tell("a", f"alarm/{LEAK}", "")
    assert told.lines()["a"]["light"] == "green"
    told.tell("a", "status", "")
    assert told.lines() == {}


NONSENSE = [
    ("status", "no JSON"),
    ("status", '{"format": "ejector-twin-status/1", "status": "red"}'),
    ("status", "[" * 60_000),
    ("status", "[]"),
    ("cycle", '{"format": "ejector-twin-cycle/1", "time_ns": NaN, "cycle": 1, "id": "1"}'),
    ("values", '{"format": "ejector-twin-values/1", "rows": [], "period_s": 1}'),
    ("values", values(Unit(TYPE, "a")).body.replace("750.0", '"high"')),
    ("values", values(Unit(TYPE, "a")).body + " " * 70_000),
    (f"alarm/{LEAK}", alarm(Unit(TYPE, "a"), evidence=[])),
    (f"alarm/{LEAK}", alarm(Unit(TYPE, "a"), action="\ud800")),
    ("other", "{}"),
]


@pytest.mark.parametrize(("topic", "body"), NONSENSE)
def test_nonsense_from_a_broker_is_left_and_counted(told: Told, topic: str, body: str) -> None:
    told.tell("a", topic, body)
    assert told.lines() == {}
    assert told.hall.not_understood == 1


@pytest.mark.parametrize(
    "more",
    [
        {"evidence": {"parameters": {"a": 1}, "probability": "x"}},
        {"priority": {"a": 1}, "state": None, "active": "yes"},
        {"state": float("nan"), "alarm": "<b>", "since": None},
    ],
)
def test_odd_alarms_are_shown_as_far_as_they_go(told: Told, more: dict[str, Any]) -> None:
    told.status("a", "online")
    told.tell("a", f"alarm/{LEAK}", alarm(Unit(TYPE, "a"), **more))
    assert told.lines()["a"]["light"] in ("red", "yellow")
    json_text(told.one("a"))
    json.dumps(told.one("a"), allow_nan=False)


def test_memory_is_bounded(told: Told, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hall_module, "MOST", 2)
    monkeypatch.setattr(hall_module, "MOST_ALARMS", 2)
    for name in "abc":
        told.status(name, "online")
        for number in range(3):
            told.tell(name, "alarm/x", alarm(Unit(TYPE, name), alarm=f"x{number}"))
    assert set(told.lines()) == {"a", "b"}
    assert told.lines()["a"]["alarms_count"] == 2
    for number in range(1100):
        told.tell("a", "cycle", cycle(Unit(TYPE, "a"), number).body)
    assert len(told.one("a")["trends"][0]["time"]) == 1000


def test_odd_names_are_as_they_were(told: Told) -> None:
    ours = Mqtt(MqttSettings(host="h"), Unit("a/b+c", ""), Path(), pytest.fail)
    levels = ours.topic("status").split("/")[1:]
    body = of_status(asset_of(Unit("x", "y"), ""), "online", 0, "p")
    told.hall.take(levels, body.encode(), kept=False)
    (line,) = told.lines().values()
    assert (line["type"], line["id"], line["name"]) == ("a/b+c", "", "a/b+c")


# --- who may see --------------------------------------------------------------------------------


@contextmanager
def client(
    folder: Path, hall: PlantOverview | None, *configs: Path, **access: Any
) -> Iterator[TestClient]:
    users = quick_users(folder / "users.toml")
    ejectors = [Ejector(config(path)) for path in configs]
    page = Page(ejectors, authenticator_of(users), Sessions(users), Access(**access), hall)
    with TestClient(page.app(), OURS, follow_redirects=False) as made:
        yield made


def test_it_is_seen_by_whom_the_other_page_is(tmp_path: Path, told: Told) -> None:
    told.status("a", "online")
    with client(tmp_path, told.hall) as open_:
        assert open_.get("/").headers["location"] == "/all"
        assert "All ejectors" in open_.get("/all").text
        assert open_.get("/api/all").json()["ejectors"][0]["name"] == "a"
        assert (
            open_.get("/api/all/one", params={"type": TYPE, "id": "a"}).json()["light"] == "green"
        )
        assert open_.get("/api/all/one", params={"type": TYPE, "id": "b"}).status_code == 404
        assert open_.get("/api/me").json()["all"] is True
    with client(tmp_path, told.hall, open_to_see=False) as closed:
        assert closed.get("/all").headers["location"] == "/login"
        assert closed.get("/api/all").status_code == 401
        assert closed.get("/api/all/one", params={"type": TYPE, "id": "a"}).status_code == 401
    with client(tmp_path, None, write_config(tmp_path)) as without:
        assert without.get("/all").status_code == 404
        assert without.get("/api/me").json()["all"] is False


# --- in a browser -------------------------------------------------------------------------------


@contextmanager
def site(folder: Path, port: int) -> Iterator[str]:
    users, place, hall = quick_users(folder / "users.toml"), Place("127.0.0.1", 0), PlantOverview()
    inner = make_server(
        Page([], authenticator_of(users), Sessions(users), Access(), hall, chart_library()).app(),
        place,
    )
    wanted = MqttSettings(host="127.0.0.1", port=port)
    with listening(wanted, folder, hall, pytest.fail), listen(place) as socket:
        sockets = {"sockets": [socket]}
        server = Server(inner, threading.Thread(target=inner.run, kwargs=sockets, name="page"))
        server.thread.start()
        try:
            yield address(place, socket)
        finally:
            server.stop()


def publishers(running: Broker, count: int, closing: ExitStack) -> list[Mqtt]:
    """As many edges: the program's own channels, a connection and a last will each."""
    wanted, made = MqttSettings(host="127.0.0.1", port=running.port), list[Mqtt]()
    for number in range(count):
        unit = Unit(TYPE, f"cell-{number:02d}")
        ours = Mqtt(wanted, unit, Path(), pytest.fail, batch="B7")
        closing.callback(ours.hang_up)
        ours.open()
        at = time.time()
        ours.send([cycle(unit, number, at - 60 + number) for number in range(20)], "cycle")
        ours.send([values(unit, at, 40, 700.0 + number)], "values")
        made.append(ours)
    return made


@pytest.mark.slow
@pytest.mark.needs("mosquitto", "uplot")
def test_forty_ejectors_and_one_that_dies(tmp_path: Path, browser: Browser) -> None:
    leak = Message("1", LEAK, alarm(Unit(TYPE, "cell-17")))
    with ExitStack() as closing:
        running = closing.enter_context(broker(tmp_path))
        edges = publishers(running, 40, closing)
        edges[17].send([leak])
        url = closing.enter_context(site(tmp_path, running.port))
        context = browser.new_context(viewport={"width": 1280, "height": 800})
        closing.callback(context.close)
        said, asked = list[str](), list[str]()
        page = context.new_page()
        page.on("console", lambda one: said.append(one.text))
        page.on("pageerror", lambda one: said.append(str(one)))
        context.on("request", lambda one: asked.append(one.url))
        page.goto(url)
        lines = page.locator("#all-rows tr")
        expect(lines).to_have_count(40)
        expect(lines.first).to_have_attribute("data-light", "red")
        expect(lines.first).to_contain_text("cell-17")
        expect(lines.first).to_contain_text("Leakage")
        expect(page.locator("#counts")).to_have_text("1 with an alarm, 39 all right")
        edges[5].hang_up()  # without a goodbye
        expect(page.locator("tr[data-name=cell-05]")).to_have_attribute("data-light", "grey")
        expect(lines.nth(1)).to_contain_text("connection lost")
        expect(lines.nth(1)).to_contain_text("cell-05")
        page.fill("#search", "cell-2 b7")
        expect(lines).to_have_count(10)
        expect(lines.first.locator(".figures")).to_contain_text("t0 208 (190) ms")
        assert lines.first.locator(".spark path").get_attribute("d")
        page.fill("#search", "")
        page.get_by_role("link", name="cell-17").click()
        card = page.locator("#one-alarms article")
        expect(card).to_contain_text("Look at hoses, fittings and cups")
        expect(card).to_contain_text("hold: +52 mbar from healthy")
        expect(page.locator("#figure-plot canvas")).to_be_visible()
        expect(page.locator("#one-plot canvas")).to_be_visible()
        page.select_option("#figure", "leakage")
        expect(page.locator("#figure-what")).to_contain_text("mbar/s")
        page.go_back()
        expect(lines).to_have_count(40)
        running.kill()
        expect(page.locator("#banner")).to_contain_text("What follows is as it was then")
        expect(page.locator("#counts")).to_have_text("40 not known")
        assert said == []
        assert [address for address in asked if not address.startswith(url)] == []


@pytest.mark.slow
@pytest.mark.needs("axe", "mosquitto", "uplot")
def test_axe_finds_no_violation_and_a_german_browser_reads_german(
    tmp_path: Path, browser: Browser
) -> None:
    with ExitStack() as closing:
        running = closing.enter_context(broker(tmp_path))
        edges = publishers(running, 2, closing)
        edges[1].send([Message("1", LEAK, alarm(Unit(TYPE, "cell-01")))])
        url = closing.enter_context(site(tmp_path, running.port))
        context = browser.new_context(locale="de-DE", bypass_csp=True)
        page = context.new_page()
        page.goto(url)
        expect(page.locator("#all-rows tr")).to_have_count(2)
        expect(page.locator("tr[data-name=cell-01]")).to_contain_text("Leckage")
        assert violations_light_and_dark(page) == []
        page.locator("tr[data-name=cell-01] td").nth(1).click()
        card = page.locator("#one-alarms article")
        expect(card).to_contain_text("Leckage")
        expect(card).to_contain_text("unquittiert")
        assert violations_light_and_dark(page) == []
        context.close()


@pytest.mark.slow
@pytest.mark.needs("mosquitto", "uplot")
def test_it_is_fit_for_gloves_on_every_screen(
    tmp_path: Path,
    browser: Browser,
) -> None:
    with ExitStack() as closing:
        running = closing.enter_context(broker(tmp_path))
        edges = publishers(running, 6, closing)
        edges[1].send([Message("1", LEAK, alarm(Unit(TYPE, "cell-01"), text="<img src=x>"))])
        edges[2].hang_up()
        url = closing.enter_context(site(tmp_path, running.port))
        for width, height in ((1280, 800), (1024, 768), (768, 1024), (390, 844)):
            context = browser.new_context(
                viewport={"width": width, "height": height}, has_touch=True
            )
            page = context.new_page()
            page.goto(url)
            expect(page.locator("#all-rows tr")).to_have_count(6)
            _is_fit(page)
            heads = [head.is_visible() for head in page.get_by_text("Key figures (expected)").all()]
            assert heads == ([False, *[True] * 6] if width < 600 else [True, *[False] * 6])
            page.locator("tr[data-name=cell-01] td").nth(1).click()
            expect(page.locator("#one-alarms article")).to_have_count(1)
            _is_fit(page)
            context.close()


# --- on the command line ------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.needs("mosquitto", "uplot")
def test_twin_run_is_on_the_page_of_twin_serve(tmp_path: Path) -> None:
    """A real PLC's process, the edge's, the broker's and the page's; the edge is killed."""
    tables = tomllib.loads(rigs.path_of("gripper").read_text(encoding="utf-8"))
    with broker(tmp_path) as running:
        # Three programs start on this machine: a PLC that is late by that is no alarm here.
        tables |= {"alarms": {"keep": True}, "monitor": {"stale_ms": 10_000.0}}
        tables["asset"]["batch"] = "2026-07"
        at = {"host": "127.0.0.1", "port": running.port}
        tables["mqtt"] = at | {"cycles": True, "values": {"period_s": 0.2}}
        edge, hall = tmp_path / "edge.toml", tmp_path / "hall.toml"
        edge.write_text(tomli_w.dumps(tables), encoding="utf-8")
        hall.write_text(tomli_w.dumps({"mqtt": at}), encoding="utf-8")
        with (
            start_plc(edge) as plc,
            started("run", edge, "--address", f"127.0.0.1:{plc.port}") as run,
            started("serve", "--broker", hall, "--port", "0") as served,
        ):
            assert served.stdout is not None
            url = served.stdout.readline().removeprefix("the page is at ").strip()

            def line() -> dict[str, Any]:
                with urllib.request.urlopen(f"{url}api/all") as answer:
                    ejectors = json.load(answer)["ejectors"]
                return ejectors[0] if ejectors else {"light": "", "figures": [], "spark": {}}

            until(lambda: line()["figures"] and line()["spark"]["high"])
            found = line()
            assert (found["name"], found["light"], found["batch"]) == (
                "gripper-01",
                "green",
                "2026-07",
            )
            assert found["figures"][0]["measured"] == pytest.approx(189.0, abs=15.0)
            assert max(found["spark"]["high"]) > 500
            run.kill()
            until(lambda: line()["what"] == "connection lost")


def until(is_so: Callable[[], Any]) -> None:
    end = time.monotonic() + 60.0
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.1)


@contextmanager
def started(*words: object) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-m", "twin.cli", *map(str, words)]
    with subprocess.Popen(command, cwd=rigs.ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[data]", r"no \[mqtt\] in it"),
        ("[mqtt]\nport = 1", r"\[mqtt\] has no host"),
        ("[mqqt]\nport = 1", r"unknown table \[mqqt\]"),
    ],
)
def test_a_configuration_without_a_broker_is_refused(
    tmp_path: Path,
    text: str,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "hall.toml"
    path.write_text(text, encoding="utf-8")
    assert twin(monkeypatch, "serve", "--broker", path, "--port", "0") == 2
    assert re.search(said, capsys.readouterr().err)
    path.write_text('[mqtt]\nhost = "127.0.0.1"', encoding="utf-8")
    assert twin(monkeypatch, "serve", "--broker", path, "--host", "0.0.0.0") == 2
    assert "it has no users" in capsys.readouterr().err
