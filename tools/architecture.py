"""Draw the architecture from the imports: docs/pictures/architecture.svg, and the page's table.

    python tools/architecture.py

Rows are the layers of import-linter's contract in pyproject.toml; each box imports only what stands
below it. An arrow that follows from two others is left out.
"""

import ast
import html
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "pictures" / "architecture.svg"
PAGE = ROOT / "docs" / "architecture.md"
LOWEST = "twin.model"  # the last layer of boxes; below it is what all others may import
WIDTH, BOX, HEIGHT, ROW, GAP = 700.0, 96.0, 26.0, 54.0, 12.0  # pixels
DRIVERS = 150.0  # width of the frame of the drivers, on the right
BEND = 8.0  # width that an arrow takes where it passes a row
SWEEPS = 30
STYLE = """
text { font: 13px system-ui, "Segoe UI", Roboto, "DejaVu Sans", Arial, sans-serif; fill: #1a1a1a; }
.box { fill: #e6f0f8; stroke: #0a62a8; }
.frame { fill: none; stroke: #8a8a8a; stroke-dasharray: 4 3; }
.base { fill: #f3f3f3; stroke: #8a8a8a; }
.arrow { fill: none; stroke: #555; stroke-width: 1.1; marker-end: url(#head); }
.small { font-size: 11px; fill: #444; }
"""

Edges = Mapping[str, set[str]]


def layers(inside: str = "twin") -> list[list[str]]:
    """The layers inside a package, the highest first, as import-linter checks them."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    name = f"Inside {inside}, imports point downwards only"
    contract = next(contract for contract in contracts if contract["name"] == name)
    return [[name.strip() for name in layer.split("|")] for layer in contract["layers"]]


def upper_layers() -> list[list[str]]:
    """The layers that are drawn as boxes."""
    rows = layers()
    return rows[: next(number for number, row in enumerate(rows) if LOWEST in row) + 1]


def drivers() -> list[str]:
    """The packages and modules of the drivers, the highest first."""
    names = [name for layer in layers("drivers") for name in layer]
    return list(dict.fromkeys(".".join(name.split(".")[:2]) for name in names))


def imports() -> Edges:
    """Which package or module right below twin and drivers imports which others."""
    edges: dict[str, set[str]] = {}
    for folder in ("twin", "drivers"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            importer = _part(".".join(file.relative_to(ROOT).with_suffix("").parts))
            edges.setdefault(importer, set()).update(_imported(file) - {importer})
    return {
        importer: {name for name in names if name in edges} for importer, names in edges.items()
    }


def _imported(file: Path) -> set[str]:
    """The packages and modules that a file imports, wherever it does."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return {_part(name) for name in names}


def _part(module: str) -> str:
    """The package or module right below twin or drivers that a module belongs to."""
    return ".".join(module.removesuffix(".__init__").split(".")[:2])


def reduced(edges: Edges, names: set[str]) -> dict[str, list[str]]:
    """The imports among ``names`` without those that follow from others."""
    among = {name: edges.get(name, set()) & names for name in names}

    def reached(name: str) -> set[str]:
        return among[name].union(*(reached(below) for below in among[name]))

    return {
        name: sorted(below - {far for near in below for far in reached(near)})
        for name, below in sorted(among.items())
    }


@dataclass(eq=False)
class Node:
    """A box, or where an arrow passes a row; ``x`` is its middle."""

    name: str
    row: int
    width: float
    x: float = 0.0
    above: list["Node"] = field(default_factory=list)
    below: list["Node"] = field(default_factory=list)

    @property
    def top(self) -> float:
        """Its upper edge."""
        return GAP + self.row * ROW

    @property
    def bottom(self) -> float:
        """Its lower edge."""
        return self.top + (HEIGHT if self.name else 0.0)


def placed(rows: Sequence[Sequence[str]], edges: Mapping[str, Sequence[str]]) -> list[list[Node]]:
    """The boxes of each row from left to right, with the bends of arrows that pass it."""
    nodes = [[Node(name, row, BOX) for name in names] for row, names in enumerate(rows)]
    by_name = {node.name: node for row in nodes for node in row}
    for name, targets in edges.items():
        for target in targets:
            last = by_name[name]
            for passed in range(last.row + 1, by_name[target].row):
                bend = Node("", passed, BEND)
                nodes[passed].append(bend)
                last = _joined(last, bend)
            _joined(last, by_name[target])
    for row in nodes:
        _spread(row, [WIDTH * (number + 0.5) / len(row) for number in range(len(row))])
    for sweep in range(SWEEPS):
        for row in nodes if sweep % 2 else nodes[::-1]:
            near = [(node.above if sweep % 2 else node.below) or [node] for node in row]
            wanted = [sum(other.x for other in others) / len(others) for others in near]
            order = sorted(range(len(row)), key=lambda number, by=wanted: by[number])
            row[:] = [row[number] for number in order]
            _spread(row, [wanted[number] for number in order])
    return nodes


def _joined(upper: Node, lower: Node) -> Node:
    upper.below.append(lower)
    lower.above.append(upper)
    return lower


def _spread(row: Sequence[Node], wanted: Sequence[float]) -> None:
    """Put a row where it is wanted, as far as its order and the picture's width allow."""
    for node, x in zip(row, wanted, strict=True):
        node.x = x
    for _ in range(SWEEPS):
        for left, right in pairwise(row):
            overlap = (left.width + right.width) / 2.0 + GAP - (right.x - left.x)
            if overlap > 0.0:
                left.x, right.x = left.x - overlap / 2.0, right.x + overlap / 2.0
        for node in row:
            node.x = min(max(node.x, GAP + node.width / 2.0), WIDTH - GAP - node.width / 2.0)


def svg() -> str:
    """The picture."""
    rows = upper_layers()
    base = layers()[len(rows) :]
    nodes = placed(rows, reduced(imports(), {name for row in rows for name in row}))
    boxes = [node for row in nodes for node in row if node.name]
    end = GAP + len(rows) * ROW
    height = end + ROW / 2 + len(base) * (HEIGHT + 4.0) + 2.0 * GAP
    width = WIDTH + DRIVERS + 2.0 * GAP
    parts = [*_arrows(boxes), *map(_box, boxes), *_drivers(drivers(), boxes, end)]
    parts += _base(base, end, width)
    title = "Packages of ejector-twin in layers, with their imports"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" role="img"'
        f' aria-label="{title}">\n<title>{title}</title>\n<style>{STYLE}</style>\n'
        '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7"'
        ' markerHeight="7" orient="auto"><path d="M0 0L8 4L0 8z" fill="#555"/></marker></defs>\n'
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#fff"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def _arrows(boxes: Sequence[Node]) -> Iterator[str]:
    """An arrow from each box to each below it, through the bends between them."""
    for box in boxes:
        for first in box.below:
            path = [f"M{box.x:.0f} {box.bottom:.0f}"]
            last, node = (box.x, box.bottom), first
            while True:
                middle = (last[1] + node.top) / 2.0
                path.append(
                    f"C{last[0]:.0f} {middle:.0f} {node.x:.0f} {middle:.0f}"
                    f" {node.x:.0f} {node.top:.0f}"
                )
                if node.name:
                    break
                path.append(f"V{node.top + HEIGHT:.0f}")
                last, node = (node.x, node.top + HEIGHT), node.below[0]
            yield f'<path class="arrow" d="{"".join(path)}"/>'


def _box(node: Node) -> str:
    name = html.escape(node.name.removeprefix("twin."))
    left = node.x - BOX / 2.0
    return (
        f'<rect class="box" x="{left:.0f}" y="{node.top:.0f}" width="{BOX:.0f}"'
        f' height="{HEIGHT:.0f}" rx="4"/>'
        f'<text x="{node.x:.0f}" y="{node.top + 17:.0f}" text-anchor="middle">{name}</text>'
    )


def _drivers(names: Sequence[str], boxes: Sequence[Node], end: float) -> Iterator[str]:
    """The frame of the drivers, the arrow from the command line, and that to the vocabulary."""
    left, top = WIDTH + GAP, GAP + ROW
    height = len(names) * (HEIGHT + 4.0) + HEIGHT
    cli = next(node for node in boxes if node.name == "twin.cli")
    middle = left + DRIVERS / 2.0
    yield (
        f'<path class="arrow" d="M{cli.x + BOX / 2.0:.0f} {cli.top + HEIGHT / 2.0:.0f}'
        f'H{middle:.0f}V{top:.0f}"/>'
    )
    yield (
        f'<rect class="frame" x="{left:.0f}" y="{top:.0f}" width="{DRIVERS:.0f}"'
        f' height="{height:.0f}" rx="6"/>'
        f'<text class="small" x="{middle:.0f}" y="{top + 16:.0f}" text-anchor="middle">'
        "drivers</text>"
    )
    for number, name in enumerate(names):
        y = top + HEIGHT + number * (HEIGHT + 4.0) - 2.0
        yield (
            f'<rect class="box" x="{left + 8:.0f}" y="{y:.0f}" width="{DRIVERS - 16:.0f}"'
            f' height="{HEIGHT:.0f}" rx="4"/><text x="{middle:.0f}" y="{y + 17:.0f}"'
            f' text-anchor="middle">{html.escape(name.removeprefix("drivers."))}</text>'
        )
    yield f'<path class="arrow" d="M{middle:.0f} {top + height:.0f}V{end + HEIGHT / 2 + 6:.0f}"/>'


def _base(rows: Sequence[Sequence[str]], end: float, width: float) -> Iterator[str]:
    """The layers that all others may import, without arrows."""
    top = end + HEIGHT / 2.0
    label = "imported by all that stand above:"
    yield f'<text class="small" x="{GAP:.0f}" y="{top:.0f}">{label}</text>'
    for number, row in enumerate(rows):
        y = top + 8.0 + number * (HEIGHT + 4.0)
        names = "   ".join(name.removeprefix("twin.") for name in row)
        yield (
            f'<rect class="base" x="{GAP:.0f}" y="{y:.0f}" width="{width - 2 * GAP:.0f}"'
            f' height="{HEIGHT:.0f}" rx="4"/><text x="{width / 2.0:.0f}" y="{y + 17:.0f}"'
            f' text-anchor="middle" xml:space="preserve">{html.escape(names)}</text>'
        )


def table() -> str:
    """Each box of the picture with the first line of its docstring."""
    names = [*(name for row in upper_layers() for name in row), *drivers()]
    lines = [f"| `{name}` | {summary(name)} |" for name in names]
    return "\n".join(["| part | what it is |", "| --- | --- |", *lines])


def summary(name: str) -> str:
    """The first line of a package's or module's docstring."""
    folder = ROOT / name.replace(".", "/")
    file = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return docstring.partition("\n\n")[0].replace("\n", " ").replace("``", "`")


def filled(page: str) -> str:
    """The page with its table made anew."""
    marked = r"(<!-- parts: [^\n]*-->\n).*?(<!-- end -->)"
    return re.sub(marked, lambda match: f"{match[1]}{table()}\n{match[2]}", page, flags=re.DOTALL)


if __name__ == "__main__":
    PICTURE.write_text(svg(), encoding="utf-8")
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
