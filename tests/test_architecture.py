"""The picture of the architecture is that of the code: its layers, its boxes, its arrows."""

import xml.etree.ElementTree as ET
from itertools import pairwise

from tools.architecture import (
    PAGE,
    PICTURE,
    drivers,
    filled,
    imports,
    placed,
    reduced,
    svg,
    upper_layers,
)


def test_picture_and_table_are_those_of_the_imports() -> None:
    """After a new module or another import: python tools/architecture.py."""
    assert PICTURE.read_text(encoding="utf-8") == svg()
    page = PAGE.read_text(encoding="utf-8")
    assert page == filled(page)


def test_each_package_is_a_box_and_names_fit_in_it() -> None:
    texts = [
        text.text or "" for text in ET.fromstring(svg()).iter("{http://www.w3.org/2000/svg}text")
    ]
    words = (word for text in texts for word in text.split())
    shown = {part for word in words for part in (word, word.partition(".")[0])}
    packages = {name for edge in imports().items() for name in (edge[0], *edge[1])}
    assert {name.partition(".")[2] for name in packages} - {""} - shown == set()
    assert max(len(name) for row in upper_layers() for name in row) <= len("twin.notifications")
    assert set(drivers()) <= packages


def test_boxes_of_a_row_lie_apart_and_arrows_point_downwards() -> None:
    rows = upper_layers()
    edges = reduced(imports(), {name for row in rows for name in row})
    for row in placed(rows, edges):
        for left, right in pairwise(row):
            assert right.x - left.x >= (left.width + right.width) / 2.0
        assert all(below.row > node.row for node in row for below in node.below)


def test_an_arrow_that_follows_from_others_is_left_out() -> None:
    edges = {"a": {"b", "c"}, "b": {"c"}}
    assert reduced(edges, {"a", "b", "c"}) == {"a": ["b"], "b": ["c"], "c": []}
