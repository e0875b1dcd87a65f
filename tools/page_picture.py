"""Draw the technician's page as a browser shows it, into a small PNG.

    python tools/page_picture.py URL PICTURE.png NAME PASSWORD

``twin serve`` must be running, with a leak that ``twin run`` has diagnosed, and a user of that
name with the role acknowledge: the picture has a comment of this user on the alarm. Needs Chromium
on the path.
"""

import io
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

SIZE = {"width": 1280, "height": 800}
COLOURS = 128
PATIENCE_MS = 120e3
COMMENT = "new hose ordered"


def main(url: str, picture: Path, name: str, password: str) -> None:
    """Log in, wait for a diagnosed alarm and for the vacuum, and take the picture."""
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"))
        page = chromium.new_page(viewport=SIZE, color_scheme="light", locale="en-GB")
        page.set_default_timeout(PATIENCE_MS)
        page.goto(f"{url.rstrip('/')}/login")
        page.fill("[name=name]", name)
        page.fill("[name=password]", password)
        page.click("button")
        comment(page)
        page.wait_for_function("document.getElementById('measured').textContent !== '–'")
        page.locator("#plot .u-over").hover()  # the values there are told above the curves
        page.wait_for_timeout(500)
        picture.write_bytes(shrink(page.screenshot()))
        chromium.close()


def comment(page: Page) -> None:
    """Comment on the alarm that has a diagnosis, unless somebody did."""
    alarm = page.locator("article.alarm").filter(has_text="See diagnosis").first
    alarm.wait_for()
    if alarm.locator(".comment").count() == 0:
        alarm.get_by_role("button", name="Comment").click()
        page.fill("#comment-text", COMMENT)
        page.click("#comment [type=submit]")
        alarm.locator(".comment").wait_for()


def shrink(png: bytes) -> bytes:
    """Reduce it to a palette: a third of the size, without a visible difference."""
    out = io.BytesIO()
    image = Image.open(io.BytesIO(png)).convert("RGB")
    image.quantize(COLOURS).save(out, "PNG", optimize=True)
    return out.getvalue()


if __name__ == "__main__":
    if len(sys.argv) != 5:
        sys.exit(__doc__)
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
