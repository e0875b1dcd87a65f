"""What axe-core says of a page: whether it is fit for keyboards and screen readers."""

from needs import PEERS
from playwright.sync_api import Page


def violations(page: Page) -> list[str]:
    """What axe-core finds wrong, with where; its context must bypass the page's policy."""
    if not page.evaluate("typeof axe !== 'undefined'"):
        axe = PEERS / "node_modules" / "axe-core" / "axe.min.js"
        page.add_script_tag(content=axe.read_text())
    found: list[str] = page.evaluate(
        """async () => (await axe.run()).violations.map(
          ({ id, nodes }) => `${id}: ${nodes.map((one) => one.html.slice(0, 120)).join(" | ")}`)"""
    )
    return found
