"""The curve of any time in a real Chromium: an old alarm's, closer, and back to live."""

import dataclasses
import re
import shutil
import time
from pathlib import Path

import pytest
from accessible import violations_light_and_dark
from page_site import S, config, write_config
from playwright.sync_api import Locator, Page, expect
from test_page_browser import SIZES, Site, _is_fit, site
from test_page_curve import OURS, rows, write_log

from twin.events import Kind
from twin.page.log_folders import remember
from twin.page.settings import folder_of

__all__ = ["site"]
pytestmark = pytest.mark.needs("uplot")
AGO_S = 1500  # since when the log is
LOGGED_S = 600.0
PEAK_MBAR = 950.0


@pytest.fixture(scope="module")
def begin() -> int:
    """When the log began (UTC, ns)."""
    return time.time_ns() - AGO_S * S


@pytest.fixture(scope="module")
def log(begin: int, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten minutes of the ejector of a site, with a peak of one row."""
    folder = tmp_path_factory.mktemp("log")
    asset = config(write_config(folder)).asset
    samples, ticks = rows(LOGGED_S, begin)
    samples["pressure"][301_234] = OURS.ambient - PEAK_MBAR * 100.0
    header = dataclasses.replace(OURS, asset_type=asset.type, asset_id=asset.id)
    return write_log(folder / "run.mcap", (samples, ticks), header)


@pytest.fixture
def logged(site: Site, begin: int, log: Path) -> Site:
    """A site whose run has logged ten minutes, with an alarm of that time that is over."""
    run = site.run
    folder = Path(run.config.document.name).parent
    shutil.copy(log, folder)
    remember(folder_of(run.config.document, run.config.asset), folder)
    shift = [begin + 300 * S]
    run.alarms._clock = lambda: shift[0]
    run.leak()
    shift[0] += 20 * S
    run.say(Kind.DEVIATION_CLEARED)
    run.alarms._clock = time.time_ns
    return site


def back(page: Page) -> Locator:
    return page.get_by_role("button", name="Back to live")


def marks(page: Page) -> list[str]:
    found: list[str] = page.evaluate(
        "past.curve.alarms.flatMap(alarmMarks).map(({ text }) => text)"
    )
    return found


def loaded(page: Page) -> None:
    """Wait until all of the range has been read: of this one, not of a shorter one before it."""
    page.wait_for_function(
        """() => { const { curve } = past; const [from, to] = live.chart.range();
          const [begin, end] = curve.range;
          return curve.share === 1 && Math.abs(end - begin - (to - from)) < 1
            && curve.time.length > 0
            && curve.time[0] >= from - 1 && curve.time.at(-1) <= to + 1; }"""
    )


def span(page: Page) -> float:
    return float(page.evaluate("live.chart.range()[1] - live.chart.range()[0]"))


def highest(page: Page) -> float:
    return float(page.evaluate("Math.max(...past.curve.measured_high)"))


@pytest.mark.slow
def test_an_old_alarm_leads_to_its_curve_closer_and_back_to_live(logged: Site) -> None:
    page = logged.open()
    logged.run.suck(5.0)
    expect(page.locator("#measured")).to_have_text("600")
    page.reload()
    page.get_by_role("tab", name="History").click()
    page.locator("#episodes").get_by_role("button", name="Show its curve").click()
    expect(page.get_by_role("tab", name="Now")).to_have_attribute("aria-selected", "true")
    loaded(page)
    expect(page.locator("#plot-head")).to_have_text(re.compile(r"Vacuum, .+ to .+"))
    expect(page.locator("#plot")).to_be_focused()
    assert marks(page) == ["Leakage", "Leakage: over"]
    assert highest(page) == pytest.approx(PEAK_MBAR)
    (raised,) = page.evaluate("past.curve.alarms.map(({ raised }) => raised)")
    for _ in range(6):
        page.locator("#plot").press("+")
    page.evaluate("raised => live.chart.show(raised - 1, raised + 2)", raised)
    page.wait_for_function(
        "() => past.curve.time.length > 1 && past.curve.time.at(-1) - past.curve.time[0] < 3.5"
    )
    times = page.evaluate("past.curve.time")
    assert len(times) > 500  # finer: a point each few milliseconds
    assert highest(page) == pytest.approx(PEAK_MBAR)
    logged.run.suck(1.0, vacuum_mbar=700.0)
    expect(page.locator("#measured")).to_have_text("700")
    assert page.evaluate("past.on")
    back(page).click()
    expect(page.locator("#plot-head")).to_have_text("Vacuum, the last 10 s")
    expect(back(page)).to_be_disabled()
    expect(page.locator("#window")).to_have_value("10")


@pytest.mark.slow
def test_an_alarm_of_the_list_leads_to_its_curve_with_who_has_acknowledged_it(logged: Site) -> None:
    page = logged.open()
    logged.log_in(page)
    cards = page.locator("article.alarm")
    expect(cards).to_have_count(1)
    cards.get_by_role("button", name="Show its curve").click()
    loaded(page)
    cards.get_by_role("button", name="Acknowledge").click()
    logged.until(page, lambda: cards.count() == 0)
    page.select_option("#window", "3600")
    page.wait_for_function("() => past.curve.alarms.some(({ seen }) => seen)")
    assert marks(page)[-1] == "Leakage: acknowledged"


@pytest.mark.slow
def test_presets_beyond_the_ring_end_now_and_a_gap_is_shown(logged: Site, begin: int) -> None:
    page = logged.open()
    opened = time.time()
    logged.run.suck(2.0)
    expect(page.locator("#measured")).to_have_text("600")
    for value, seconds in (("600", 600), ("3600", 3600), ("28800", 8 * 3600)):
        page.select_option("#window", value)
        assert span(page) == pytest.approx(seconds, abs=0.1)
        expect(page.locator("#window")).to_have_value(value)
    loaded(page)
    *_, (from_, to) = page.evaluate("past.curve.gaps")
    assert from_ == pytest.approx(begin / S + LOGGED_S, abs=0.1)
    assert opened - 2.1 < to < time.time()  # rows of the last two seconds
    assert highest(page) == pytest.approx(PEAK_MBAR)  # of one row, in columns of half a minute
    page.select_option("#window", "today")
    assert page.evaluate("there(live.chart.range()[0]).getHours()") == 0 or span(page) <= 60.1
    page.locator("#plot").press("ArrowLeft")
    expect(page.locator("#window")).to_have_value("")
    page.select_option("#window", "60")
    expect(back(page)).to_be_disabled()
    assert span(page) == pytest.approx(60.0)


@pytest.mark.slow
def test_a_person_types_a_range(logged: Site) -> None:
    page = logged.open()
    logged.run.suck(2.0)
    expect(page.locator("#measured")).to_have_text("600")
    from_, to = page.evaluate(f"[fieldOf(now() - {AGO_S - 60}), fieldOf(now() - {AGO_S - 120})]")
    page.fill("#curve-from", from_)
    assert not page.evaluate("past.on")  # one end is no range
    page.fill("#curve-to", to)
    to = page.input_value("#curve-to")  # without seconds, where they are zero
    page.locator("#curve-to").dispatch_event("change")
    loaded(page)
    assert span(page) == pytest.approx(60.0)
    page.fill("#curve-to", from_)  # ends before it begins
    page.locator("#curve-to").dispatch_event("change")
    expect(page.locator("#curve-to")).to_have_value(to)


def test_a_fresh_page_shows_the_whole_ring(site: Site) -> None:
    for _ in range(60):
        site.run.suck(1.0)
    page = site.open()
    page.select_option("#window", "60")
    page.wait_for_function("() => live.rows.time.at(-1) - live.rows.time[0] > 58")


@pytest.mark.slow
def test_five_minutes_come_from_the_logs_where_the_browser_has_not_seen_them(logged: Site) -> None:
    page = logged.open()
    logged.run.suck(2.0)
    expect(page.locator("#measured")).to_have_text("600")
    page.select_option("#window", "300")
    assert page.evaluate("past.on")
    expect(page.locator("#window")).to_have_value("300")
    assert span(page) == pytest.approx(300.0, abs=0.1)  # rows go on coming


def test_without_logs_the_page_says_how_to_have_some(site: Site) -> None:
    page = site.open()
    site.until_light(page, "green")
    page.select_option("#window", "3600")
    expect(page.locator("#curve-said")).to_contain_text("twin run --log FOLDER")


@pytest.mark.slow
def test_every_screen_has_room_for_an_old_curve(logged: Site) -> None:
    for size in SIZES:
        page = logged.open("", size, has_touch=True)
        page.locator("article.alarm").get_by_role("button", name="Show its curve").click()
        loaded(page)
        _is_fit(page)
        page.context.close()


@pytest.mark.slow
@pytest.mark.needs("axe")
def test_axe_finds_no_violation_beside_an_old_curve(logged: Site) -> None:
    page = logged.open("", "phone", bypass_csp=True)
    page.locator("article.alarm").get_by_role("button", name="Show its curve").click()
    loaded(page)
    assert violations_light_and_dark(page) == []
