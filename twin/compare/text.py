"""A comparison for people, in a table and a conclusion; and as JSON."""

import math
from collections.abc import Sequence
from typing import Any

from twin.compare.compare import FEWEST, Comparison, Quantity, Values
from twin.compare.side import Side

FORMAT = "ejector-twin-compare/1"
NAMED = 3  # in the conclusion
FOLLOWS = (  # from other figures: said after them
    "leakage_band",
    "quality",
    "performance",
    "nozzle_share",
    "air",
    "energy",
    "switchings",
    "quick_switchings",
)
NO_DASH = {"-": "", "0 or 1": "", "0 to 3": ""}


def in_words(comparison: Comparison) -> str:
    """All of it: the sides, the tables, and what to conclude."""
    sides = [
        f"{label}  {side.name}: {side.asset or 'no asset named'}, {_cycles(len(side.cycles))}"
        for label, side in (("A", comparison.a), ("B", comparison.b))
    ]
    head = ("figure", "unit", "A (expected)", "B (expected)", "B − A", "95 %", "")
    rows = [head, *map(_row, comparison.figures)]
    off = [("deviation", "unit", "A", "B", "B − A", "95 %", ""), *map(_row, comparison.deviations)]
    tables = [_table(rows), *([_table(off)] if comparison.deviations else [])]
    legend = "mean ± spread of a cycle; * differs beyond chance, all figures considered"
    return "\n\n".join(["\n".join(sides), *tables, legend, conclusion(comparison)])


def conclusion(comparison: Comparison) -> str:
    """What to conclude, in a sentence or two."""
    counts = [len(side.cycles) for side in (comparison.a, comparison.b)]
    if min(counts) < FEWEST:
        return (
            f"Too few cycles to say whether they differ: {counts[0]} and {counts[1]}, and"
            f" {FEWEST} on each side are needed."
        )
    different = comparison.different
    figures = [one for one in different if one in comparison.figures]
    figures.sort(key=lambda one: one.name in FOLLOWS)
    off = [one for one in different if one in comparison.deviations and "rms" in one.name]
    if not different:
        looked = len(comparison.figures) + len(comparison.deviations)
        return f"B does not differ from A beyond chance: {looked} figures over {_both(counts)}."
    told = [", ".join(map(_change, figures[:NAMED])) + _more(len(figures) - NAMED)]
    if not figures:
        told = ["no key figure differs beyond chance"]
    if off:
        told.append(f"deviation from the twin: {', '.join(map(_change, off[:1]))}")
    return f"B against A: {'; '.join(told)}."


def remarks(comparison: Comparison) -> list[str]:
    """What a person should know before taking differences for those of the ejector."""
    a, b = comparison.a, comparison.b
    said = []
    if a.header.asset_type != b.header.asset_type:
        said.append(
            f"different types of asset, {a.header.asset_type or 'none named'} and"
            f" {b.header.asset_type or 'none named'}: figures differ by that alone"
        )
    elif a.header.asset_id != b.header.asset_id:
        said.append(
            f"different units, {a.header.asset_id or 'none'} and {b.header.asset_id or 'none'}"
        )
    for label, side in (("A", a), ("B", b)):
        if side.derived:
            said.append(f"{label}: {side.header.derived}")
    if a.derived != b.derived:
        said.append(
            "the commands of one log were recorded and of the other derived: compare no times with"
            " them, for a recorded command comes before the pressure moves"
        )
    if a.data_set != b.data_set:
        said.append(
            "the logs were made beside different data sets: what is expected, and deviations,"
            " differ by that too"
        )
    return said


def plain(comparison: Comparison) -> dict[str, Any]:
    """As JSON has it; what is not known is null."""
    return {
        "format": FORMAT,
        "a": _side(comparison.a),
        "b": _side(comparison.b),
        "figures": [_plain(one) for one in comparison.figures],
        "deviations": [_plain(one) for one in comparison.deviations],
        "remarks": remarks(comparison),
        "conclusion": conclusion(comparison),
    }


def _side(side: Side) -> dict[str, Any]:
    asset = {"type": side.header.asset_type, "id": side.header.asset_id}
    return {"log": side.name, "asset": asset, "data_set": side.data_set, "cycles": side.cycles}


def _plain(one: Quantity) -> dict[str, Any]:
    return {
        "name": one.name,
        "unit": one.unit,
        "what": one.what,
        "a": _values(one.a),
        "b": _values(one.b),
        "difference": _known(one.difference),
        "low95": _known(one.low),
        "high95": _known(one.high),
        "differs": one.differs,
    }


def _values(values: Values) -> dict[str, Any]:
    known = {name: _known(getattr(values, name)) for name in ("mean", "spread", "expected")}
    return {"cycles": values.count, **known}


def _known(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None


def _row(one: Quantity) -> Sequence[str]:
    finest = _finest(one)
    known = math.isfinite(one.low)
    return (
        one.name,
        one.unit,
        _cell(one.a, finest),
        _cell(one.b, finest),
        _number(one.difference, finest, "+"),
        f"{_number(one.low, finest, '+')} to {_number(one.high, finest, '+')}" if known else "-",
        "*" if one.differs else "",
    )


def _cell(values: Values, finest: float) -> str:
    if not values.count:
        return "-"
    spread = f" ± {_number(values.spread, finest)}" if math.isfinite(values.spread) else ""
    beside = f" ({_number(values.expected, finest)})" if math.isfinite(values.expected) else ""
    return f"{_number(values.mean, finest)}{spread}{beside}"


def _finest(one: Quantity) -> float:
    """The smallest spread there is: what is written has two digits of it."""
    spreads = [side.spread for side in (one.a, one.b) if side.spread > 0.0]
    means = [abs(side.mean) for side in (one.a, one.b) if side.mean % 1.0]
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
            cell.ljust(width) if place < 2 else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def _change(one: Quantity) -> str:
    unit = NO_DASH.get(one.unit, f" {one.unit}")
    return (
        f"{one.name.replace('_', ' ')} {_short(one.a.mean)} → {_short(one.b.mean)}{unit}"
        f" ({_short(one.low, '+')} to {_short(one.high, '+')} at 95 %)"
    )


def _short(value: float, sign: str = "") -> str:
    return f"{value:{sign}.0f}" if abs(value) >= 100.0 else f"{value:{sign}.3g}"


def _more(count: int) -> str:
    return f" and {count} more" if count > 0 else ""


def _cycles(count: int) -> str:
    return f"{count} cycle{'' if count == 1 else 's'}"


def _both(counts: Sequence[int]) -> str:
    return f"{counts[0]} and {_cycles(counts[1])}"
