"""Labels of marks in a real Chromium: to be read, inside the curves, and each beside its mark."""

from itertools import combinations
from typing import Any

import pytest
from playwright.sync_api import Page, expect
from test_page_browser import Site, site

__all__ = ["site"]
pytestmark = pytest.mark.needs("uplot")
AWAY_PX = 8  # of a label from its mark, at most
CROWD = {  # seconds before the end of the ten that are shown, of each label
    "Leckage": 9.9,
    "Sprung": 6.2,
    "T1 über Grenzwert": 6.1,
    "T1 über Grenzwert: vorbei": 6.0,
    "Filter setzt sich zu: quittiert": 5.0,
    "Undichtes Rückschlagventil": 4.9,
    "Versorgungsdruck zu niedrig": 4.8,
    "Sensor driftet": 0.3,
    "Düse verschlissen": 0.1,
}
DRAWN = """(before) => new Promise((resolve) => {
  const { chart } = live;
  const { ctx, bbox } = chart.plot;
  const boxes = [];
  ctx.fillText = function (text, x, y) { // in place of its class's
    CanvasRenderingContext2D.prototype.fillText.call(ctx, text, x, y);
    if (!(text in before)) return;
    const { a: ratio, e, f } = ctx.getTransform();
    const [left, top] = [x + (e - bbox.left) / ratio, y + (f - bbox.top) / ratio];
    const ink = ctx.measureText(text);
    boxes.push({ text,
      left: left - ink.actualBoundingBoxLeft, right: left + ink.actualBoundingBoxRight,
      top: top - ink.actualBoundingBoxAscent, bottom: top + ink.actualBoundingBoxDescent });
  };
  const [, end] = chart.range();
  const marks = Object.entries(before)
    .map(([text, s]) => ({ at: end - s, text, colour: "--alarm" }));
  chart.options.marks = () => marks;
  chart.draw();
  requestAnimationFrame(() => requestAnimationFrame(() => {
    delete ctx.fillText;
    const at = Object.fromEntries(marks.map((mark) => [mark.text, chart.x(mark.at)]));
    resolve({ boxes, area: chart.area, at });
  }));
})"""


def drawn(page: Page, before: dict[str, float]) -> dict[str, Any]:
    """In px: the ink of labels that are drawn, the size of where curves are, and the marks."""
    page.wait_for_function("() => live.chart.waits === false")
    found: dict[str, Any] = page.evaluate(DRAWN, before)
    return found


@pytest.mark.parametrize(("size", "at_least"), [("phone", 4), ("desktop", 6)])
def test_labels_of_marks_close_together_can_be_read(site: Site, size: str, at_least: int) -> None:
    site.run.suck(10.0)
    page = site.open(size=size)
    expect(page.locator("#measured")).to_have_text("600")
    found = drawn(page, CROWD)
    boxes, area = found["boxes"], found["area"]
    assert len(boxes) >= at_least
    assert boxes[0]["text"] == "Leckage"  # who comes first has the choice
    assert [one["text"] for one in boxes if not _is_inside(one, area)] == []
    away = {one["text"]: _distance(one, found["at"][one["text"]]) for one in boxes}
    assert {text: px for text, px in away.items() if px > AWAY_PX} == {}
    pairs = [(a["text"], b["text"]) for a, b in combinations(boxes, 2) if _overlap(a, b)]
    assert pairs == []
    assert all(_has_a_line(page, x) for x in found["at"].values())  # also without its label


def test_a_label_at_the_edge_is_left_of_its_mark_and_one_that_is_too_long_left_out(
    site: Site,
) -> None:
    site.run.suck(10.0)
    page = site.open(size="phone")
    expect(page.locator("#measured")).to_have_text("600")
    found = drawn(page, {"Leckage": 0.0, "Undichtes Rückschlagventil" * 3: 5.0})
    (label,) = found["boxes"]
    assert label["text"] == "Leckage"
    assert label["right"] < found["at"]["Leckage"]


def _is_inside(box: dict[str, Any], area: dict[str, float]) -> bool:
    across = 0 <= box["left"] <= box["right"] <= area["width"]
    return across and 0 <= box["top"] <= box["bottom"] <= area["height"]


def _distance(box: dict[str, Any], x: float) -> float:
    return max(0.0, box["left"] - x, x - box["right"])


def _overlap(one: dict[str, Any], other: dict[str, Any]) -> bool:
    beside = one["right"] <= other["left"] or other["right"] <= one["left"]
    below = one["bottom"] <= other["top"] or other["bottom"] <= one["top"]
    return not beside and not below


def _has_a_line(page: Page, x: float) -> bool:
    """Whether half-way down the curves there is the colour of an alarm."""
    found: bool = page.evaluate(
        """(x) => {
          const { ctx, bbox } = live.chart.plot;
          const wanted = colour("--alarm");
          const place = [bbox.left + x * uPlot.pxRatio - 1, bbox.top + bbox.height / 2, 3, 1];
          const { data } = ctx.getImageData(...place.map(Math.round));
          const [r, g, b] = [1, 3, 5].map((at) => parseInt(wanted.slice(at, at + 2), 16));
          return [0, 4, 8].some((i) => data[i] === r && data[i + 1] === g && data[i + 2] === b);
        }""",
        x,
    )
    return found
