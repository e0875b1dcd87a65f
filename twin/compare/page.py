"""A comparison as a part of a page, for a cell of a notebook."""

from twin.compare.compare import Comparison
from twin.compare.picture import draw
from twin.compare.text import HEADER, conclusion, remarks, row
from twin.diagnosis import page


def summary(comparison: Comparison) -> str:
    """The comparison as a part of a page: conclusion, what differs, and a small picture."""
    a, b = (
        f"{side.name}: {side.asset or 'no asset named'}, {len(side.cycles)} cycles"
        for side in (comparison.a, comparison.b)
    )
    different = [row(quantity)[:-1] for quantity in comparison.different]
    parts = [page.pairs([("A", a), ("B", b)])]
    if different:
        parts.append(page.table("Differs beyond chance", HEADER[:-1], different, range(2, 6)))
    parts += [page.paragraph(remark) for remark in remarks(comparison)]
    return page.summary(conclusion(comparison), parts, draw(comparison))
