"""What people do with the program in their first hour, in a real terminal and a real browser.

Each journey begins in a fresh folder, uses the commands of the README, and asserts what the person
sees. Two ejectors, their run and their page are shared: one leaks after some cycles, the PLC of the
other one boots when a journey asks for it.
"""

import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import datetime, timedelta
from pathlib import Path

import pytest
import rigs
from accessible import violations
from openpyxl import Workbook
from playwright.sync_api import Browser, Locator, Page, expect
from terminal import Program, typed

from twin.signals import Command

WORD = "correct horse battery"
KEEP = "\n[alarms]\nkeep = true\n\n[figures]\nkeep = true\n\n[page]\nkeep = true\n"
LEAK_S = 8  # after the PLC's start
LEAKS, BOOTS = "gripper-01", "gripper-02"
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True}
PATIENCE_MS = 120e3
RUNS = re.compile("All right|Look after it")  # where a busy machine was late it says so


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def write_cell(folder: Path, unit: str, port: int) -> Path:
    """The configuration of a cell: the shipped gripper, at a port that is free here."""
    text = rigs.path_of("gripper").read_text()
    text = text.replace(f'"{LEAKS}"', f'"{unit}"', 1).replace("port = 5021", f"port = {port}")
    path = folder / f"{unit}.toml"
    path.write_text(text + KEEP)
    return path


class Cell:
    """Two ejectors with their PLCs, one ``twin run`` and one ``twin serve`` in one folder."""

    def __init__(self, folder: Path, closing: ExitStack) -> None:
        self.folder, self._closing = folder, closing
        self.ports = free_port(), free_port()
        self.configs = [
            write_cell(folder, unit, port)
            for unit, port in zip((LEAKS, BOOTS), self.ports, strict=True)
        ]
        add = ("users", "add", "ann", "--role", "acknowledge", "--config", self.configs[0])
        typed(folder, *add, lines=(WORD, WORD))
        self.boot(self.configs[0], "--fault", f"leakage=2.0@{LEAK_S}")
        self.run = closing.enter_context(Program(folder, "run", *self.configs))
        shown = [part for config in self.configs for part in ("--config", config)]
        self.serve = closing.enter_context(Program(folder, "serve", *shown, "--port", "0"))
        self.url = self.serve.until(r"the page is at (\S+)")

    def boot(self, config: Path, *fault: str) -> Program:
        plc = self._closing.enter_context(Program(self.folder, "plc", config, *fault))
        plc.until("listening on")
        return plc


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    with ExitStack() as closing:
        yield Cell(tmp_path_factory.mktemp("cell"), closing)


@pytest.fixture
def page(cell: Cell, browser: Browser) -> Iterator[Page]:
    """A tab at a desk."""
    yield opened(cell, browser)
    for context in browser.contexts:
        context.close()


def opened(cell: Cell, browser: Browser, **options: object) -> Page:
    context = browser.new_context(bypass_csp=True, **options)  # type: ignore[arg-type]  # for axe
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.goto(cell.url)
    return page


@pytest.fixture(scope="module")
def second(cell: Cell, browser: Browser) -> Program:
    """The PLC of the second ejector; it boots after the twin, which says so until then."""
    cell.run.until(f"(?s){BOOTS}: [^\n]*no connection.*it is tried until it answers")
    page = opened(cell, browser)
    seen(light(page, BOOTS), "Not running")
    page.context.close()
    return cell.boot(cell.configs[1])


def light(page: Page, unit: str) -> Locator:
    return page.locator("#ejectors button").filter(has_text=unit)


def leak_card(page: Page) -> Locator:
    return page.locator("article.alarm[data-alarm=deviation_leakage]")


def seen(what: Locator, text: str | re.Pattern[str]) -> None:
    expect(what).to_contain_text(text, timeout=PATIENCE_MS)


# --- the plant ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("second")
def test_a_plc_boots_after_the_twin(cell: Cell, page: Page) -> None:
    cell.run.until(f"{BOOTS}: the PLC answers")
    cell.run.until(f"{BOOTS} .*cycle 1: evacuated to H2 in")
    seen(light(page, BOOTS), RUNS)


@pytest.mark.slow
@pytest.mark.needs("axe")
def test_a_leak_is_found_on_the_screen_and_on_the_page(cell: Cell, page: Page) -> None:
    cell.run.until(f"{LEAKS} .*deviation_leakage")
    seen(light(page, LEAKS), "Alarm")
    seen(leak_card(page), "Leakage")
    seen(leak_card(page), "Look at hoses, fittings and cups")
    listed = typed(cell.folder, "alarms", "list", "--config", cell.configs[0])
    assert re.search(r"medium +deviation_leakage +unacknowledged, since ", listed)
    cell.run.until(f"{LEAKS} .*diagnosis .*leak")
    leak_card(page).get_by_role("button", name="See diagnosis").click()
    seen(page.frame_locator("#report-frame").locator("body"), "sl/min")
    href = page.get_by_role("link", name="Open by itself").get_attribute("href") or ""
    report = page.context.new_page()  # nothing runs in a served report, so axe looks at a copy
    report.set_content(page.request.get(cell.url + href.lstrip("/")).text())
    assert violations(report) == []


@pytest.mark.slow
def test_an_alarm_is_acknowledged_on_a_phone(cell: Cell, browser: Browser, page: Page) -> None:
    phone = opened(cell, browser, **PHONE)
    leak_card(phone).get_by_role("link", name="Log in to acknowledge").tap()
    phone.get_by_label("Name").fill("ann")
    phone.get_by_label("Password").fill(WORD)
    phone.get_by_role("button", name="Log in").tap()
    leak_card(phone).get_by_role("button", name="Acknowledge").tap()
    for where in (phone, page):  # the desk sees it, too
        seen(leak_card(where), "by ann")
    assert phone.evaluate("document.documentElement.scrollWidth <= innerWidth")
    cell.run.until(f"{LEAKS} .*deviation_leakage acknowledged by ann")


@pytest.mark.slow
def test_a_german_browser_shows_a_german_page(cell: Cell, browser: Browser, page: Page) -> None:
    german = opened(cell, browser, locale="de-DE")
    seen(leak_card(german), "Leckage")
    seen(leak_card(german), "Prüfen: Schläuche, Verschraubungen und Sauger")
    expect(german.get_by_role("tab", name="Verlauf")).to_be_visible()
    german.get_by_role("tab", name="Grenzwerte").click()
    seen(german.locator("#limits"), "Längstes t1")
    seen(leak_card(page), "Leakage")  # every browser has its own language


@pytest.mark.slow
def test_of_two_ejectors_one_goes_stale(cell: Cell, second: Program, page: Page) -> None:
    """It is the last one here: it ends what the others share."""
    seen(light(page, BOOTS), RUNS)
    second.process.kill()
    cell.run.until(f"{BOOTS} .*plc_stale")
    seen(light(page, BOOTS), "Alarm")
    seen(page.locator("#alarms article").first, "PLC stale")  # of high priority: before the leak
    seen(page.locator("#alarms article").first, BOOTS)
    seen(leak_card(page), LEAKS)
    cell.run.interrupt()
    assert cell.run.end() == 130
    seen(page.locator("#banner"), "Not running since")


# --- at a desk ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_wrong_word_order_is_named_and_put_right(tmp_path: Path) -> None:
    config = write_cell(tmp_path, LEAKS, free_port())
    right = config.read_text()
    with Program(tmp_path, "plc", config) as plc:
        plc.until("listening on")
        config.write_text(right.replace("[driver.tags]", 'word_order = "little"\n[driver.tags]'))
        said = typed(tmp_path, "probe", config, code=3)
        assert 'set word_order = "big" in [driver]' in said
        config.write_text(config.read_text().replace('"little"', '"big"'))
        said = typed(tmp_path, "probe", config, code=None)  # a busy machine is slow to answer
        assert re.search("(?m)^ok +word order +big, by the test registers", said)
        assert re.search("(?m)^ok +trace records", said)
        assert "set word_order" not in said


HEADER = ["Zeitstempel", "Unterdruck [kPa]", "Saugen", "Abblasen"]
COLUMNS = """
[import]
time_zone = "Europe/Berlin"

[import.columns]
time = "Zeitstempel"
vacuum = "Unterdruck [kPa]"
suction = "Saugen"
blow_off = "Abblasen"
"""


@pytest.mark.slow
def test_a_german_excel_trace_becomes_a_log(tmp_path: Path) -> None:
    config = write_cell(tmp_path, LEAKS, free_port())
    book = Workbook()
    sheet = book.active
    assert sheet is not None
    sheet.append(["Anlage 4, Greifer links"])
    sheet.append(HEADER)
    rows = rigs.recorded("gripper", 6.0)[0][::10]
    begin = datetime(2026, 3, 1, 12, 0, 0)
    for number, row in enumerate(rows):
        bits = int(row["commands"])
        commands = [bool(bits & command) for command in (Command.SUCTION, Command.BLOW_OFF)]
        vacuum = (101_300.0 - float(row["pressure"])) / 1e3
        sheet.append([begin + timedelta(milliseconds=10 * number), round(vacuum, 3), *commands])
    book.save(tmp_path / "Messung.xlsx")
    asked = typed(tmp_path, "import", "Messung.xlsx", "--config", config, "--dry-run", code=3)
    assert "by their names and cells these may be" in asked
    answered = asked.partition("[import]\n")[2].replace('time_zone = "..."', COLUMNS.split("\n")[2])
    assert all(line in answered for line in COLUMNS.split("\n")[2:])
    config.write_text(config.read_text() + COLUMNS)
    shown = typed(tmp_path, "import", "Messung.xlsx", "--config", config, "--dry-run")
    assert "600 rows, 5.990 s, every 10 ms" in shown
    done = typed(tmp_path, "import", "Messung.xlsx", "--config", config, "-o", "Messung.mcap")
    assert "Messung.mcap is written; next: twin diagnose Messung.mcap" in done
    figures = typed(tmp_path, "figures", "show", "Messung.mcap")
    assert "t0" in figures
    assert typed(tmp_path, "log", "check", "Messung.mcap")


READ_OFF = """
--id unit-9 --type unknown --address none --unit mbar --reference absolute --range 0,1500
--hose-mm 100 --diameter-mm 6 --end vessel --volume-ml 800 --sensor unknown --released no
--supply-bar 5
"""


@pytest.mark.slow
def test_an_unknown_rig_is_commissioned(tmp_path: Path) -> None:
    rows = rigs.recorded("test_rig", 36.0)[0][::4]
    trace = [
        f"{(row['time_ns'] - rows['time_ns'][0]) / 1e6:.0f},{row['commands'] & 1},"
        f"{row['commands'] >> 1 & 1},{row['pressure'] / 100.0:.2f}\n"
        for row in rows
    ]
    header = "time_ms,suction,blow_off,pressure_mbar\n"
    (tmp_path / "trace.csv").write_text(header + "".join(trace))
    written = typed(tmp_path, "init", "cell.toml", *READ_OFF.split())
    assert "twin commission healthy.mcap --config cell.toml" in written
    typed(tmp_path, "import", "trace.csv", "--config", "cell.toml", "-o", "healthy.mcap")
    told = typed(tmp_path, "commission", "healthy.mcap", "--config", "cell.toml", "--id", "unit-9")
    assert re.search(r"(?m)^(good|usable)\b", told)
    assert "unit-9" in typed(tmp_path, "assets", "list", "--assets", "sqlite:///assets.sqlite")
