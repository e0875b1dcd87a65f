"""The page in a real Chromium: what a technician sees and does."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import uvicorn
from page_site import LEAK, Run, S, config, write_config
from playwright.sync_api import Browser, Locator, Page, expect

from twin.alarms import keeper as keeper_module
from twin.assets.unit import Unit
from twin.events import Kind
from twin.figures.store import open_store
from twin.page.app import Access
from twin.page.app import Page as Served
from twin.page.ejector import Ejector
from twin.page.server import Place, address, listen, make_server
from twin.page.sessions import Sessions
from twin.page.users import Users

WORD = "correct horse"
PATIENCE_S = 30.0
SIZES = {"desktop": (1280, 800), "landscape": (1024, 768), "portrait": (768, 1024)}
DAY = 86_400 * S


@dataclass
class Site:
    """A served page and a browser; the runs are this process's own."""

    url: str
    browser: Browser
    runs: list[Run]
    server: "Server"

    @property
    def run(self) -> Run:
        return self.runs[0]

    def open(self, path: str = "", size: str = "landscape", **options: object) -> Page:
        """A new tab of somebody else: nothing is shared but the server."""
        width, height = SIZES[size]
        context = self.browser.new_context(
            viewport={"width": width, "height": height},
            **options,  # type: ignore[arg-type]
        )
        page = context.new_page()
        page.set_default_timeout(PATIENCE_S * 1e3)
        page.goto(self.url + path)
        return page

    def log_in(self, page: Page) -> None:
        page.goto(self.url + "login")
        page.fill("[name=name]", "ann")
        page.fill("[name=password]", WORD)
        page.click("button:has-text('Log in')")
        expect(page.locator("#who")).to_have_text("ann")

    def until(self, page: Page, true: Callable[[], bool], vacuum_mbar: float | None = None) -> None:
        """The loops go on until something is so, at rest or with a vacuum that stands."""
        end = time.monotonic() + PATIENCE_S
        while not true():
            assert time.monotonic() < end
            for run in self.runs:
                if vacuum_mbar is None:
                    run.rest()
                else:
                    run.suck(0.1, vacuum_mbar)
            page.wait_for_timeout(50)

    def until_light(self, page: Page, light: str, number: int = 0) -> None:
        lights = page.locator("#ejectors button")
        self.until(
            page,
            lambda: (
                lights.count() > number and lights.nth(number).get_attribute("data-light") == light
            ),
        )


@dataclass
class Server:
    """The page's server in a thread, as ``twin serve`` has it."""

    inner: uvicorn.Server
    thread: threading.Thread

    def stop(self) -> None:
        self.inner.should_exit = True
        self.thread.join()


@contextmanager
def serving(configs: list[Path]) -> Iterator[tuple[str, Server]]:
    users, place = Users(configs[0].parent / "users.toml"), Place("127.0.0.1", 0)
    ejectors = [Ejector(config(one)) for one in configs]
    inner = make_server(Served(ejectors, users, Sessions(users), Access()).app(), place)
    with listen(place) as listening:
        sockets = {"sockets": [listening]}
        server = Server(inner, threading.Thread(target=inner.run, kwargs=sockets, name="page"))
        server.thread.start()
        try:
            yield address(place, listening), server
        finally:
            server.stop()


@pytest.fixture
def site(
    tmp_path: Path,
    browser: Browser,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> Iterator[Site]:
    """A page of one ejector that runs; of more by ``parametrize("site", [2], indirect=True)``."""
    monkeypatch.setattr(keeper_module, "POLL_S", 0.02)
    units = [f"gripper-0{number + 1}" for number in range(getattr(request, "param", 1))]
    paths = [write_config(tmp_path, unit) for unit in units]
    Users(tmp_path / "users.toml").add("ann", WORD)
    runs = [Run(config(one), time.time_ns) for one in paths]
    with serving(paths) as (url, server):
        yield Site(url, browser, runs, server)
        for context in browser.contexts:
            context.close()
    for run in runs:
        run.close()


def card(page: Page, alarm: str = LEAK) -> Locator:
    return page.locator(f"article.alarm[data-alarm={alarm}]")


def test_the_light_follows_the_alarm_and_every_tab_sees_who_took_care(site: Site) -> None:
    mine, theirs = site.open(), site.open()
    site.log_in(mine)
    for page in (mine, theirs):
        site.until_light(page, "green")
        expect(page.locator("#ejectors button")).to_contain_text("All right")
        expect(page.locator("#alarms")).to_have_text("No alarm stands.")
    site.run.leak("hold: +52 mbar from healthy")
    for page in (mine, theirs):
        site.until_light(page, "red")
        expect(page.locator("#ejectors button")).to_contain_text("Alarm")
        expect(card(page)).to_contain_text("Leakage")
        expect(card(page)).to_contain_text("Look at hoses, fittings and cups")
        expect(card(page)).to_contain_text("gripper-01: hoses, fittings and cups")
        expect(card(page)).to_contain_text("not acknowledged")
    card(theirs).locator("summary").click()
    expect(card(theirs)).to_contain_text("hold: +52 mbar from healthy")
    card(mine).get_by_role("button", name="Acknowledge").click()
    for page in (mine, theirs):
        site.until_light(page, "yellow")
        expect(card(page).locator(".state")).to_have_text("acknowledged")
    expect(card(theirs)).to_contain_text("by ann")  # still open
    expect(card(mine).get_by_role("button", name="Acknowledge")).to_have_count(0)


def test_what_is_kept_quiet_says_until_when_and_can_speak_again(site: Site) -> None:
    page = site.open()
    site.log_in(page)
    site.run.leak()
    site.until_light(page, "red")
    card(page).get_by_role("button", name="Keep quiet").click()
    page.get_by_role("button", name="1 hour").click()
    site.until_light(page, "yellow")
    expect(card(page)).to_contain_text("quiet until")
    page.select_option("#which", "urgent")
    expect(card(page)).to_have_count(0)
    page.select_option("#which", "quiet")
    card(page).get_by_role("button", name="Let it speak").click()
    site.until_light(page, "red")
    expect(card(page)).to_have_count(0)
    page.select_option("#which", "all")
    expect(card(page)).to_contain_text("not acknowledged")


def test_without_login_there_is_nothing_to_press(site: Site) -> None:
    page = site.open()
    site.run.leak()
    site.until_light(page, "red")
    expect(card(page).get_by_role("button")).to_have_count(0)
    card(page).get_by_role("link", name="Log in to acknowledge").click()
    page.fill("[name=name]", "ann")
    page.fill("[name=password]", "wrong horse")
    page.click("button")
    expect(page.get_by_role("alert")).to_have_text("Name or password is wrong.")
    site.log_in(page)
    expect(card(page).get_by_role("button", name="Acknowledge")).to_be_visible()
    page.get_by_role("button", name="Log out").click()
    expect(card(page).get_by_role("button")).to_have_count(0)


def test_a_request_waits_for_a_run_and_the_page_says_so(site: Site) -> None:
    page = site.open()
    site.log_in(page)
    site.run.leak()
    site.until_light(page, "red")
    site.run.close()
    expect(page.locator("#banner")).to_contain_text("Not running since")
    expect(page.locator("#ejectors button")).to_have_attribute("data-light", "grey")
    card(page).get_by_role("button", name="Acknowledge").click()
    expect(card(page)).to_contain_text("waits for the next run (ann)")
    site.runs[:] = [Run(site.run.config, time.time_ns)]
    site.until_light(page, "yellow")
    expect(page.locator("#banner")).to_be_hidden()


def test_vacuum_is_drawn_as_it_comes(site: Site) -> None:
    page = site.open()
    site.run.suck(5.0, vacuum_mbar=600.0, expected=650.0)
    expect(page.locator("#measured")).to_have_text("600")
    expect(page.locator("#expected")).to_have_text("650")
    expect(page.locator("#difference")).to_have_text("−50.0")
    expect(page.locator("#phase")).to_have_text("suction")
    site.until(page, lambda: _highest(page, "--orange") > 0.9 > _highest(page, "--blue") > 0.8, 600)
    site.until(page, lambda: _highest(page, "--blue") > 0.9 > _highest(page, "--orange") > 0.8, 700)


def _highest(page: Page, colour: str) -> float:
    """How high a line of one of the page's colours is drawn: 1 at the top of the plot; -1: none."""
    height = page.evaluate(
        """(name) => {
          const wanted = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
          const [r, g, b] = [1, 3, 5].map((at) => parseInt(wanted.slice(at, at + 2), 16));
          const { left, top, width, height } = live.plot.bbox;
          const { data } = live.plot.ctx.getImageData(left, top, width, height);
          for (let i = 0; i < data.length; i += 4)
            if (data[i] === r && data[i + 1] === g && data[i + 2] === b)
              return 1 - Math.floor(i / 4 / width) / height;
          return -1;
        }""",
        colour,
    )
    return float(height)


@pytest.mark.parametrize("site", [2], indirect=True)
def test_each_ejector_has_its_own_light_alarms_and_vacuum(site: Site) -> None:
    page = site.open()
    site.runs[1].leak()
    site.runs[0].suck(1.0, vacuum_mbar=300.0)
    site.runs[1].suck(1.0, vacuum_mbar=500.0)
    site.until_light(page, "red", 1)
    site.until_light(page, "green", 0)
    expect(page.locator("#measured")).to_have_text("300")
    expect(card(page)).to_have_count(0)
    page.locator("#ejectors button").nth(1).click()
    expect(page.locator("#measured")).to_have_text("500")
    expect(card(page)).to_have_count(1)


def test_nothing_leaves_the_page_and_nothing_complains(site: Site) -> None:
    context = site.browser.new_context()
    page, asked, said = context.new_page(), list[str](), list[str]()
    context.on("request", lambda one: asked.append(one.url))
    page.on("websocket", lambda one: asked.append(one.url.replace("ws:", "http:")))
    page.on("console", lambda one: said.append(one.text))
    page.on("pageerror", lambda one: said.append(str(one)))
    _kept_figures(site)
    site.run.suck(2.0)
    site.log_in(page)
    for tab in ("Trends", "History", "Now"):
        page.get_by_role("tab", name=tab).click()
    expect(page.locator("#measured")).to_have_text("600")
    assert len(asked) > 8
    assert [one for one in asked if not one.startswith(site.url)] == []
    assert said == []


def test_trends_say_when_a_limit_is_reached(site: Site) -> None:
    _kept_figures(site)
    page = site.open()
    page.get_by_role("tab", name="Trends").click()
    expect(page.locator("#trend-words")).to_contain_text("its limit of 250 mbar/s in")
    expect(page.locator("#trend-plot canvas")).to_be_visible()
    page.select_option("#figure", "t1")
    expect(page.locator("#trend-words")).to_contain_text("not enough to say")
    page.select_option("#trend-days", "1")
    page.select_option("#figure", "leakage")
    expect(page.locator("#trend-words")).to_contain_text("leakage:")


def _kept_figures(site: Site) -> None:
    """A leakage that has grown for six days."""
    asset = site.run.config.asset
    begin, random = time.time_ns() - 6 * DAY, np.random.default_rng(1)
    cycles = [
        {
            "cycle": number,
            "begin_ns": number,
            "host_ns": begin + number * DAY // 100,
            "warnings": [],
            "leakage_measured": 100.0 + number / 6.0 + random.normal(0.0, 5.0),
            "leakage_expected": 70.0,
        }
        for number in range(600)
    ]
    path = Path(site.run.config.document.name).parent / "figures.sqlite"
    with open_store(path) as store:
        store.add(Unit(asset.type, asset.id), "hash", "live", cycles)


def test_history_is_searched(site: Site) -> None:
    page = site.open()
    site.run.leak()
    site.run.say(Kind.DEVIATION_CLEARED)
    site.run.say(Kind.PLC_STALE)
    site.until_light(page, "red")
    page.get_by_role("tab", name="History").click()
    episodes = page.locator("#episodes article")
    expect(episodes).to_have_count(2)
    expect(episodes.first).to_contain_text("PLC stale")
    page.fill("#search", "leak")
    expect(episodes).to_have_count(1)
    expect(episodes).to_contain_text("Leakage")
    page.fill("#search", "")
    page.select_option("#priority", "high")
    expect(episodes).to_have_count(1)
    expect(episodes).to_contain_text("still active")


def test_text_from_outside_is_text(site: Site) -> None:
    page = site.open()
    site.run.leak("<img src=x onerror=\"document.title='taken'\">")
    site.until_light(page, "red")
    card(page).locator("summary").click()
    expect(card(page)).to_contain_text("<img src=x")
    assert page.locator("main img").count() == 0


def test_without_its_server_the_page_does_not_stay_green(site: Site) -> None:
    page = site.open()
    site.until_light(page, "green")
    site.server.stop()
    expect(page.locator("#connection")).to_contain_text("No connection")
    expect(page.locator("#ejectors button")).to_have_attribute("data-light", "grey")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_gloves_find_everything_on_every_screen(site: Site, scheme: str) -> None:
    site.run.leak()
    site.run.suck(2.0)
    for size in SIZES:
        page = site.open("login", size, color_scheme=scheme, has_touch=True)
        _is_fit(page)
        site.log_in(page)
        site.until_light(page, "red")
        for tab in ("Now", "Trends", "History"):
            page.get_by_role("tab", name=tab).click()
            _is_fit(page)
        page.get_by_role("tab", name="Now").click()
        card(page).get_by_role("button", name="Keep quiet").click()
        _is_fit(page)
        page.context.close()


def _is_fit(page: Page) -> None:
    """All there is to press is 44 pixels high and wide, and nothing is beside the screen."""
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    small = page.evaluate(
        """() => [...document.querySelectorAll("button, a, input, select, summary")]
          .filter((one) => one.offsetParent !== null)
          .map((one) => [one.outerHTML.slice(0, 80), one.getBoundingClientRect()])
          .filter(([, box]) => box.width < 44 || box.height < 44)
          .map(([what, box]) => `${what}: ${box.width} × ${box.height}`)"""
    )
    assert small == []
