"""Style of pictures, and their conversion to self-contained SVG text."""

import base64
import html
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator, ScalarFormatter

from twin.files import require_ending, said_plainly
from twin.languages.texts import notation, numeral

WIDTH = 9.6  # inches
NARROW, TALLER = 4.6, 1.15  # inches on a phone, where more of the height goes into the legend
PANEL = 0.8  # share of a narrow picture's width that a panel has
ABOVE, LINE = 3.0, 12.0  # points between a panel and a name above it, and from line to line
LETTER, HANDLE = 0.075, 0.6  # inches of a letter, and of the mark of a name, in a legend
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
    "text.parse_math": False,  # names of units and files may contain dollar signs
}
ANONYMOUS = dict.fromkeys(("Creator", "Date", "Format", "Type"))  # output must be reproducible
FORMATS = {".svg": ANONYMOUS, ".png": {"Software": None}}  # of picture files, with their metadata


class Picture(Figure):
    """A figure in the style of all pictures, with a text alternative; notebooks show it as SVG.

    ``name`` makes the ids in it unique among pictures; ``size`` is in inches.
    """

    def __init__(self, name: str, size: tuple[float, float], alt: str) -> None:
        super().__init__(figsize=size, layout="constrained")
        self.name, self.alt = name, alt
        self.named: list[Axes] = []  # whose lines the legend names
        self._above: list[tuple[Axes, Annotation]] = []  # names above panels, from left to right

    def name_above(self, axes: Axes, x: float, name: str) -> None:
        """Write a name above a panel at ``x``; where names would touch, one stands higher."""
        place, offset = axes.get_xaxis_transform(), "offset points"
        text = axes.annotate(name, (x, 1.0), (0.0, ABOVE), place, offset, ha="center")
        self._above.append((axes, text))

    def resize(self, width: float, height: float) -> None:
        """Make it larger or smaller (inches), with letters as they are."""
        self.set_size_inches(width, height)
        if self.named:
            self.legends[0].remove()
            with _style(self.name):
                legend(self, self.named)
        end = -np.inf  # of the last name on the lower line, inches
        for axes, name in self._above:
            low, high = axes.get_xlim()
            middle = PANEL * width * (name.xy[0] - low) / (high - low)
            half = len(name.get_text()) * LETTER / 2.0
            touches = middle - half < end
            name.set_position((0.0, ABOVE + LINE if touches else ABOVE))
            end = end if touches else middle + half

    def savefig(self, *args: Any, **options: Any) -> None:
        """Matplotlib's method, in the style of the picture: ticks are made only now."""
        for axes in self.axes:
            for axis in (axes.xaxis, axes.yaxis):
                if isinstance(axis.get_major_formatter(), ScalarFormatter):
                    axis.set_major_formatter(_Numbers())
        with _style(self.name):
            super().savefig(*args, **options)

    def _repr_svg_(self) -> str:
        return as_svg(self)

    def _repr_html_(self) -> str:
        """An image with its text alternative, which notebooks do not take over from SVG."""
        content = base64.b64encode(as_svg(self).encode()).decode()
        source = f"data:image/svg+xml;base64,{content}"
        return f'<img alt="{html.escape(self.alt)}" style="max-width: 100%" src="{source}">'


class _Numbers(ScalarFormatter):
    """Numbers of an axis in the notation of the chosen language."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return notation(super().__call__(x, pos))


@contextmanager
def empty(name: str, height: float, alt: str, width: float = WIDTH) -> Iterator[Picture]:
    """Give an empty picture to draw in while the context lasts; see ``Picture``."""
    with _style(name):
        yield Picture(name, (width, height), alt)


@contextmanager
def _style(name: str) -> Iterator[None]:
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        yield


def as_svg(picture: Picture) -> str:
    """The picture as an svg element with its text alternative."""
    text = io.StringIO()
    picture.savefig(text, format="svg", metadata=ANONYMOUS)
    svg = text.getvalue()
    svg = re.sub(
        r'<g id="[^"]*"', "<g", svg[svg.index("<svg") :]
    )  # ids are unique within one picture only
    return svg.replace("<svg", f'<svg role="img" aria-label="{html.escape(picture.alt)}"', 1)


def as_narrow_svg(picture: Picture) -> str:
    """The same for a phone, with letters of the same size; ``picture`` is as before afterwards."""
    name, width, height = picture.name, *picture.get_size_inches()
    picture.name = f"{name}-narrow"
    picture.resize(NARROW, TALLER * height)
    svg = as_svg(picture)
    picture.name = name
    picture.resize(width, height)
    return svg


def write_picture(picture: Picture, path: Path) -> None:
    """Write a picture, SVG or PNG as ``path`` ends.

    ConfigError if it ends otherwise, SourceError if the file cannot be written.
    """
    require_ending(path, *FORMATS)
    with said_plainly(path):
        picture.savefig(path, metadata=FORMATS[path.suffix.lower()], dpi=110)


def legend(figure: Picture, panels: Iterable[Axes]) -> None:
    """One legend above all panels, each name once."""
    named: dict[str, Artist] = {}
    figure.named = list(panels)
    for axes in figure.named:
        handles, labels = axes.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    columns = legend_columns(list(named), figure.get_figwidth())
    figure.legend(
        list(named.values()), list(named), loc="outside upper center", ncols=columns, fontsize=9
    )


def legend_columns(names: Sequence[str], width: float) -> int:
    """How many columns of names a legend has: at most 4, and as many as fit in a width (inches)."""
    lengths = np.array([len(name) for name in names])
    for columns in (3 if len(names) in (3, 5, 6) else 4, 3, 2):
        parts = np.array_split(lengths, columns)  # as Matplotlib fills the columns
        letters = sum(int(part.max()) for part in parts if len(part))
        if letters * LETTER + columns * HANDLE <= width:
            return columns
    return 1


def logarithmic(axes: Axes, marked: Sequence[float] = (1.0,)) -> None:
    """Make the x axis logarithmic, with plain numbers at ``marked`` in each decade."""
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=marked))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: numeral(x, "g")))
    axes.xaxis.set_minor_locator(NullLocator())
