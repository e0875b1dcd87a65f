"""The documentation's pages: built without a warning, and read from a disk without a network."""

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import rigs
from playwright.sync_api import Browser, Page, expect

PATIENCE_MS = 30_000
pytestmark = pytest.mark.timeout(1200)  # the notebooks are run, and may have to compile first
# What each notebook must show, found by the program as it is.
SHOWN = {
    "commission": ("good: the twin follows this record", "suction capacity", "mbar rms"),
    "find-a-leak": ("Cause found: Air leaks in", "less rms deviation", "'leakage', 'step'"),
    "compare-two-units": ("B against A: ", "Differs beyond chance", "cell-b, 7 cycles"),
    "what-if": ("Simulation of compact-ejector-35", "part present after", "never a part present"),
}


@dataclass
class Reader:
    """A browser's tab on the site, with all that it asks for and complains of."""

    folder: Path
    page: Page
    asked: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def open(self, name: str) -> None:
        self.page.goto((self.folder / name).as_uri())


def make_docs() -> list[str]:
    """The command of ``make docs``, which CI does not run beside these tests."""
    makefile = (rigs.ROOT / "Makefile").read_text(encoding="utf-8")
    (line,) = re.findall(r"\$\(BIN\)/python (-m sphinx .* docs site)\n", makefile)
    return [sys.executable, *line.split()]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command: list[str | Path] = [folder / word if word == "site" else word for word in make_docs()]
    command += ["--doctree-dir", folder / "trees"]
    built = subprocess.run(command, cwd=rigs.ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder / "site"


@pytest.fixture
def reader(site: Path, browser: Browser) -> Iterator[Reader]:
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.set_default_timeout(PATIENCE_MS)
    tab = Reader(site, page)
    page.on("request", lambda request: tab.asked.append(request.url))
    page.on("pageerror", lambda error: tab.complaints.append(str(error)))
    yield tab
    page.context.close()


@pytest.mark.slow
def test_every_page_is_there(site: Path) -> None:
    pages = {path.relative_to(rigs.ROOT / "docs") for path in (rigs.ROOT / "docs").rglob("*.md")}
    assert [page for page in pages if not (site / page).with_suffix(".html").exists()] == []


def test_every_notebook_is_in_the_gallery() -> None:
    notebooks = {path.stem for path in (rigs.ROOT / "docs" / "notebooks").glob("*.md")}
    assert notebooks == set(SHOWN)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHOWN)
def test_a_notebook_was_run_and_shows_what_it_found(name: str, reader: Reader) -> None:
    reader.open(f"notebooks/{name}.html")
    article = reader.page.locator("article")
    for text in SHOWN[name]:
        expect(article).to_contain_text(text)
    expect(article.locator(".twin-summary img").first).to_be_visible()
    expect(article).not_to_contain_text("Traceback")
    pictures = article.locator("img")
    assert pictures.count() > article.locator(".twin-summary").count()  # of plot(), too
    for picture in pictures.all():
        assert " " in str(picture.get_attribute("alt"))  # a text, and no file's name
        assert picture.evaluate("image => image.complete && image.naturalWidth") > 100
    overflow = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
    assert reader.page.evaluate(overflow) <= 0
    assert [url for url in reader.asked if not url.startswith(("file:", "data:"))] == []
    assert reader.complaints == []


def test_pages_ask_for_nothing_but_files(reader: Reader) -> None:
    for name in ("index.html", "tutorial.html", "api.html", "decisions/0008-assets-only-grow.html"):
        reader.open(name)
        expect(reader.page.locator("article h1").first).to_be_visible()
    reader.page.evaluate("document.fonts.ready")
    assert [url for url in reader.asked if not url.startswith(("file:", "data:"))] == []
    assert reader.complaints == []


def test_a_reader_goes_from_the_first_page_to_the_tutorial(reader: Reader) -> None:
    reader.open("index.html")
    reader.page.get_by_role("link", name="From a CSV to a named cause").first.click()
    expect(reader.page.locator("h1")).to_contain_text("in ten minutes")
    expect(reader.page.locator("article img, article pre").first).to_be_visible()


def test_the_reference_has_the_functions_with_what_they_take(reader: Reader) -> None:
    reader.open("api.html")
    for name in ("open", "simulate", "commission", "calibrate", "diagnose"):
        signature = reader.page.locator(f"[id='twin.{name}']")
        expect(signature).to_contain_text(f"twin.{name}(")


def test_the_search_finds_a_page_without_a_server(reader: Reader) -> None:
    reader.page.goto(f"{(reader.folder / 'search.html').as_uri()}?q=outbox")
    expect(reader.page.locator("#search-results li a").first).to_be_visible()
    assert [url for url in reader.asked if not url.startswith(("file:", "data:"))] == []
