"""Style of pictures, and their conversion to self-contained SVG text."""

import html
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

WIDTH = 9.6  # inches
MEASURED, BEFORE, AFTER, QUIET = "#1a1a1a", "#c8500a", "#0a62a8", "#8a8a8a"
EACH = ("#0a62a8", "#8a3d9e", "#2e7d4f")  # a colour for each cause
BAND, PALE = "#d5ead8", "#b9b9b9"
STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.fonttype": "none",  # text stays text: small, selectable, in the reader's own font
}
ANONYMOUS = dict.fromkeys(("Creator", "Date", "Format", "Type"))  # output must be reproducible


@contextmanager
def empty(name: str, height: float) -> Iterator[Figure]:
    """Give an empty figure; ``name`` makes the ids in it unique among pictures."""
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        yield Figure(figsize=(WIDTH, height), layout="constrained")


def as_svg(figure: Figure, alt: str) -> str:
    """The figure as an svg element with a text alternative."""
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata=ANONYMOUS)
    svg = text.getvalue()
    svg = re.sub(
        r'<g id="[^"]*"', "<g", svg[svg.index("<svg") :]
    )  # ids are unique within one picture only
    return svg.replace("<svg", f'<svg role="img" aria-label="{html.escape(alt)}"', 1)


def legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """One legend above all panels, each name once."""
    named: dict[str, Artist] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    columns = 3 if len(named) in (3, 5, 6) else 4
    figure.legend(
        list(named.values()), list(named), loc="outside upper center", ncols=columns, fontsize=9
    )


def logarithmic(axes: Axes, marked: Sequence[float] = (1.0,)) -> None:
    """Make the x axis logarithmic, with plain numbers at ``marked`` in each decade."""
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=marked))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
