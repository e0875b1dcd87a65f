"""What axe-core says of a page: whether it is fit for keyboards and screen readers."""

from typing import Literal

from needs import PEERS
from playwright.sync_api import Page

Rules = dict[str, list[str]]  # as axe.run() takes them
ALL: Rules = {}
OF_COLOURS: Rules = {"runOnly": ["color-contrast", "link-in-text-block"]}
Scheme = Literal["light", "dark"]
SCHEMES: dict[Scheme, Rules] = {"light": ALL, "dark": OF_COLOURS}


def violations(page: Page, rules: Rules = ALL) -> list[str]:
    """What axe-core finds wrong, with where; its context must bypass the page's policy."""
    if not page.evaluate("typeof axe !== 'undefined'"):
        axe = PEERS / "node_modules" / "axe-core" / "axe.min.js"
        page.add_script_tag(content=axe.read_text())
    found: list[str] = page.evaluate(
        """async (rules) => (await axe.run(rules)).violations.map(
          ({ id, nodes }) => `${id}: ${nodes.map((one) => one.html.slice(0, 120)).join(" | ")}`)""",
        rules,
    )
    return found


def violations_light_and_dark(page: Page) -> list[str]:
    """The same in both; they differ in colours alone, so all other rules are asked in light."""
    found = []
    for scheme, rules in SCHEMES.items():
        page.emulate_media(color_scheme=scheme)
        found += [f"{scheme}: {violation}" for violation in violations(page, rules)]
    return found
