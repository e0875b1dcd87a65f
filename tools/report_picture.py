"""Draw a report that ``twin diagnose --report`` wrote as a browser shows it, into a small PNG.

    python tools/report_picture.py REPORT.html PICTURE.png

``make demo`` leaves one in ``demo/report.html``. Needs Chromium on the path.
"""

import shutil
import sys
from pathlib import Path

from page_picture import shrink
from playwright.sync_api import sync_playwright

SIZE = {"width": 1024, "height": 800}


def main(report: Path, picture: Path) -> None:
    """Open the page, and take a picture of all of it."""
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"))
        page = chromium.new_page(viewport=SIZE, color_scheme="light")
        page.goto(report.resolve().as_uri())
        picture.write_bytes(shrink(page.screenshot(full_page=True)))
        chromium.close()


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
