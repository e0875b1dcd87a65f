"""A comparison as text, with tables and a conclusion; and as JSON."""

import math
from collections.abc import Sequence
from typing import Any

from twin.compare.compare import FEWEST, Comparison, Quantity, Values
from twin.compare.side import Side
from twin.figures.key_figures import NO_DASH

FORMAT = "ejector-twin-compare/1"
NAMED = 3  # in the conclusion
FOLLOWS = (  # figures that follow from others; they come after them
    "leakage_band",
    "quality",
    "performance",
    "nozzle_share",
    "air",
    "energy",
    "switchings",
    "quick_switchings",
)
HEADER = ("figure", "unit", "A (expected)", "B (expected)", "B − A", "95 %", "")


def in_words(comparison: Comparison) -> str:
    """The whole comparison: the sides, the tables and the conclusion."""
    sides = [
        f"{label}  {side.name}: {side.asset or 'no asset named'}, {_cycles(len(side.cycles))}"
        for label, side in (("A", comparison.a), ("B", comparison.b))
    ]
    rows = [HEADER, *map(row, comparison.figures)]
    deviations = [
        ("deviation", "unit", "A", "B", "B − A", "95 %", ""),
        *map(row, comparison.deviations),
    ]
    tables = [_table(rows), *([_table(deviations)] if comparison.deviations else [])]
    legend = "mean ± spread of a cycle; * differs beyond chance, all figures considered"
    return "\n\n".join(["\n".join(sides), *tables, legend, conclusion(comparison)])


def conclusion(comparison: Comparison) -> str:
    """The conclusion in a sentence or two."""
    counts = [len(side.cycles) for side in (comparison.a, comparison.b)]
    if min(counts) < FEWEST:
        return (
            f"Too few cycles to say whether they differ: {counts[0]} and {counts[1]}, and"
            f" {FEWEST} on each side are needed."
        )
    different = comparison.different
    figures = [quantity for quantity in different if quantity in comparison.figures]
    figures.sort(key=lambda quantity: quantity.name in FOLLOWS)
    deviations = [
        quantity
        for quantity in different
        if quantity in comparison.deviations and "rms" in quantity.name
    ]
    if not different:
        compared = len(comparison.figures) + len(comparison.deviations)
        return f"B does not differ from A beyond chance: {compared} figures over {_both(counts)}."
    parts = [", ".join(map(_change, figures[:NAMED])) + _more(len(figures) - NAMED)]
    if not figures:
        parts = ["no key figure differs beyond chance"]
    if deviations:
        parts.append(f"deviation from the twin: {', '.join(map(_change, deviations[:1]))}")
    return f"B against A: {'; '.join(parts)}."


def remarks(comparison: Comparison) -> list[str]:
    """Reasons other than the ejector for a difference, which a person should know."""
    a, b = comparison.a, comparison.b
    sentences = []
    if a.header.asset_type != b.header.asset_type:
        sentences.append(
            f"different types of asset, {a.header.asset_type or 'none named'} and"
            f" {b.header.asset_type or 'none named'}: figures differ by that alone"
        )
    elif a.header.asset_id != b.header.asset_id:
        sentences.append(
            f"different units, {a.header.asset_id or 'none'} and {b.header.asset_id or 'none'}"
        )
    for label, side in (("A", a), ("B", b)):
        if side.derived:
            sentences.append(f"{label}: {side.header.derived}")
    if a.derived != b.derived:
        sentences.append(
            "the commands of one log were recorded and of the other derived: compare no times with"
            " them, for a recorded command comes before the pressure moves"
        )
    if a.data_set != b.data_set:
        sentences.append(
            "the logs were made beside different data sets: what is expected, and deviations,"
            " differ by that too"
        )
    return sentences


def plain(comparison: Comparison) -> dict[str, Any]:
    """The comparison as a JSON document; unknown values are null."""
    return {
        "format": FORMAT,
        "a": _side(comparison.a),
        "b": _side(comparison.b),
        "figures": [_plain(quantity) for quantity in comparison.figures],
        "deviations": [_plain(quantity) for quantity in comparison.deviations],
        "remarks": remarks(comparison),
        "conclusion": conclusion(comparison),
    }


def _side(side: Side) -> dict[str, Any]:
    asset = {"type": side.header.asset_type, "id": side.header.asset_id}
    return {"log": side.name, "asset": asset, "data_set": side.data_set, "cycles": side.cycles}


def _plain(quantity: Quantity) -> dict[str, Any]:
    return {
        "name": quantity.name,
        "unit": quantity.unit,
        "what": quantity.what,
        "a": _values(quantity.a),
        "b": _values(quantity.b),
        "difference": _rounded(quantity.difference),
        "low95": _rounded(quantity.low),
        "high95": _rounded(quantity.high),
        "differs": quantity.differs,
    }


def _values(values: Values) -> dict[str, Any]:
    rounded = {name: _rounded(getattr(values, name)) for name in ("mean", "spread", "expected")}
    return {"cycles": values.count, **rounded}


def _rounded(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None


def row(quantity: Quantity) -> Sequence[str]:
    """A quantity in the columns of ``HEADER``: mean ± spread, difference, and a * if it differs."""
    finest = _finest(quantity)
    has_interval = math.isfinite(quantity.low)
    return (
        quantity.name,
        quantity.unit,
        _cell(quantity.a, finest),
        _cell(quantity.b, finest),
        _number(quantity.difference, finest, "+"),
        f"{_number(quantity.low, finest, '+')} to {_number(quantity.high, finest, '+')}"
        if has_interval
        else "-",
        "*" if quantity.differs else "",
    )


def _cell(values: Values, finest: float) -> str:
    if not values.count:
        return "-"
    spread = f" ± {_number(values.spread, finest)}" if math.isfinite(values.spread) else ""
    expectation = f" ({_number(values.expected, finest)})" if math.isfinite(values.expected) else ""
    return f"{_number(values.mean, finest)}{spread}{expectation}"


def _finest(quantity: Quantity) -> float:
    """The smallest spread; numbers are written with two digits of it."""
    spreads = [side.spread for side in (quantity.a, quantity.b) if side.spread > 0.0]
    means = [abs(side.mean) for side in (quantity.a, quantity.b) if side.mean % 1.0]
    return min(spreads or [0.01 * mean for mean in means] or [10.0])


def _number(value: float, finest: float, sign: str = "") -> str:
    if not math.isfinite(value):
        return "-"
    decimals = min(max(1 - math.floor(math.log10(finest)), 0), 4) if finest > 0.0 else 0
    return f"{value:{sign if value else ''}.{decimals}f}"


def _table(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column_index < 2 else cell.rjust(width)
            for column_index, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def _change(figure: Quantity) -> str:
    unit = NO_DASH.get(figure.unit, f" {figure.unit}")
    return (
        f"{figure.name.replace('_', ' ')} {_short(figure.a.mean)} → {_short(figure.b.mean)}{unit}"
        f" ({_short(figure.low, '+')} to {_short(figure.high, '+')} at 95 %)"
    )


def _short(value: float, sign: str = "") -> str:
    return f"{value:{sign}.0f}" if abs(value) >= 100.0 else f"{value:{sign}.3g}"


def _more(count: int) -> str:
    return f" and {count} more" if count > 0 else ""


def _cycles(count: int) -> str:
    return f"{count} cycle{'' if count == 1 else 's'}"


def _both(counts: Sequence[int]) -> str:
    return f"{counts[0]} and {_cycles(counts[1])}"
