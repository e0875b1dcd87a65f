"""Parts of the report's page: one HTML file that needs no network, with its style inside.

All text is escaped; pictures are SVG.
"""

import base64
import html
import io
import re
from collections.abc import Iterable, Sequence
from string import Template

from twin.diagnosis.drawing import FORMATS, Picture, as_narrow_svg, as_svg

PAGE = Template("""<!DOCTYPE html>
<html lang="$language">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
:root { color-scheme: light; --ink: #1a1a1a; --ground: #fff; --dim: #444; --line: #ccc;
  --rule: #888; --box: #f3f6fa; --blue: #0a62a8; }
/* On paper it stays light. Pictures keep their hues; their white becomes the ground. */
@media screen and (prefers-color-scheme: dark) {
  :root { color-scheme: dark; --ink: #ececec; --ground: #121212; --dim: #b8b8b8; --line: #4a4a4a;
    --rule: #8a8a8a; --box: #1b242e; --blue: #62b0ff; }
  svg { filter: invert(.93) hue-rotate(180deg); }
}
body { font: 16px/1.45 system-ui, "Segoe UI", Roboto, "DejaVu Sans", Arial, sans-serif;
  color: var(--ink); background: var(--ground); max-width: 60rem; margin: 1.5rem auto;
  padding: 0 1rem; }
.banner { background: $colour; color: #fff; border-radius: .4rem; padding: .8rem 1.2rem;
  print-color-adjust: exact; -webkit-print-color-adjust: exact; }
.banner p { margin: 0; font-weight: 600; letter-spacing: .03em; }
.banner h1 { margin: .2rem 0 0; font-size: 1.35rem; line-height: 1.3; }
h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
h3 { font-size: 1rem; margin: 0 0 .3rem; }
article, aside { border: 1px solid var(--line); border-left: .3rem solid $colour;
  border-radius: .3rem; padding: .7rem 1rem; margin: .8rem 0; }
aside { background: var(--box); border-left-color: var(--blue);
  print-color-adjust: exact; -webkit-print-color-adjust: exact; }
article p, aside p { margin: 0; }
article dl { margin: .5rem 0 0; grid-template-columns: 7.5rem 1fr; }
figure { margin: 0; }
summary { cursor: pointer; padding: .3rem 0; }
svg { width: 100%; height: auto; }
.on-phone { display: none; }
@media screen and (max-width: 44rem) {
  .on-screen { display: none; }
  .on-phone { display: block; max-width: 34rem; }
}
figcaption, footer { color: var(--dim); font-size: .88rem; }
footer { border-top: 1px solid var(--line); margin-top: 2rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; margin: .3rem 0 1.4rem; min-width: 50%; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
th, td { text-align: left; padding: .25rem 1.6rem .25rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; hyphens: auto; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1.6rem; }
dt { color: var(--dim); }
dd { margin: 0; overflow-wrap: anywhere; }
thead :is(th, td) { border-bottom: 2px solid var(--rule); font-weight: 600; }
tbody th { font-weight: 400; white-space: nowrap; }
td { min-width: 2.5rem; }
td:nth-child(2) { min-width: 7rem; }
.number { text-align: right; font-variant-numeric: tabular-nums; max-width: 14rem; }
@media (max-width: 56rem) {
  th, td { padding-right: .6rem; }
  td, td:nth-child(2) { min-width: 0; }
}
@media (max-width: 40rem) {
  body { margin: .6rem auto; padding: 0 .6rem; }
  dl, article dl { grid-template-columns: fit-content(9rem) 1fr; gap: .2rem .8rem; }
  tbody th { white-space: normal; }
  table { font-size: .88rem; }
  .many, .many :is(caption, tbody, tr, th, td) { display: block; }
  .many { width: 100%; margin-bottom: .8rem; }
  .many thead { display: none; }
  .many tr { border-bottom: 1px solid var(--rule); padding: .4rem 0; }
  .many :is(td, tbody th) { border: 0; padding: .1rem 0; max-width: none; text-align: left; }
  .many tbody th { font-weight: 600; }
  .many td[data-head] { display: grid; grid-template-columns: 9rem 1fr; gap: .8rem; }
  .many td[data-head]::before { content: attr(data-head); color: var(--dim); }
  .many td:empty { display: none; }
}
figure, table, article, aside { break-inside: avoid; }
h2, h3 { break-after: avoid; }
@media print {
  body { margin: 0; max-width: none; padding: 0; font-size: 10.5pt; }
  svg { max-height: 8.8cm; }
  section { break-inside: avoid; }
}
</style>
</head>
<body>
<header class="banner">
<p><span aria-hidden="true">$mark</span> $verdict</p>
<h1>$headline</h1>
</header>
<main>
$body
</main>
<footer>
$footer
</footer>
</body>
</html>
""")

MANY = 5  # columns: from here on a phone shows each row as a list of head and value
SHARP = 130  # dots per inch of a picture in a summary, which is shown at about half its size

# What a notebook shows of an object. Its style is below one class, so that no page loses its own.
SUMMARY = Template("""<div class="twin-summary">
<style>
.twin-summary { font: 14px/1.4 system-ui, "Segoe UI", Roboto, "DejaVu Sans", Arial, sans-serif;
  color: #1a1a1a; background: #fff; max-width: 46rem; padding: .4rem .8rem; }
.twin-summary .headline { margin: 0 0 .4rem; padding-left: .6rem;
  border-left: .3rem solid $colour; font-weight: 600; overflow-wrap: anywhere; }
.twin-summary dl { display: grid; grid-template-columns: max-content 1fr; gap: 0 1.2rem;
  margin: .3rem 0; }
.twin-summary dt { color: #444; font-weight: 400; }
.twin-summary dd { margin: 0; overflow-wrap: anywhere; }
.twin-summary .wide { overflow-x: auto; }
.twin-summary table { border-collapse: collapse; margin: .3rem 0; font-size: inherit; }
.twin-summary caption { text-align: left; font-weight: 600; }
.twin-summary :is(th, td) { text-align: left; padding: .1rem 1.2rem .1rem 0; border: 0;
  border-bottom: 1px solid #ddd; font-weight: 400; background: none; }
.twin-summary .number { text-align: right; font-variant-numeric: tabular-nums; }
.twin-summary img { width: 100%; height: auto; display: block; }
</style>
<p class="headline">$headline</p>
$body
</div>""")


def summary(
    headline: str, parts: Iterable[str], picture: Picture | None = None, colour: str = "#0a62a8"
) -> str:
    """Parts of a page under a headline, and maybe a small picture, for a cell of a notebook."""
    body = [*parts, *([_image(picture)] if picture else [])]
    return SUMMARY.substitute(headline=html.escape(headline), colour=colour, body="\n".join(body))


def _image(picture: Picture) -> str:
    """The picture as PNG, whose size does not depend on how many points were drawn."""
    content = io.BytesIO()
    picture.savefig(content, format="png", metadata=FORMATS[".png"], dpi=SHARP)
    data = base64.b64encode(content.getvalue()).decode()
    return f'<img alt="{html.escape(picture.alt)}" src="data:image/png;base64,{data}">'


def section(title: str, body: str) -> str:
    """A part of the page under a heading."""
    return f"<section><h2>{html.escape(title)}</h2>\n{body}\n</section>"


def picture(title: str, drawn: Picture, caption: str) -> str:
    """A picture under a heading that states the conclusion, drawn for screen and for phone."""
    wide = f'<div class="on-screen">{as_svg(drawn)}</div>'
    narrow = f'<div class="on-phone">{as_narrow_svg(drawn)}</div>'
    caption = f"<figcaption>{html.escape(caption)}</figcaption>"
    return section(title, f"<figure>{wide}{narrow}{caption}</figure>")


def card(title: str, sentence: str, rows: Iterable[tuple[str, str]]) -> str:
    """One finding, with its details."""
    top = f"<h3>{html.escape(title)}</h3>\n<p>{html.escape(sentence)}</p>"
    return f"<article>{top}\n{pairs(rows)}</article>"


def english_card(title: str, sentence: str) -> str:
    """One finding in a sentence that stays English on a page of any language."""
    top = f'<h3>{html.escape(title)}</h3>\n<p lang="en">{html.escape(sentence)}</p>'
    return f"<article>{top}</article>"


def box(title: str, text: str) -> str:
    """A box with an action."""
    return f"<aside><h3>{html.escape(title)}</h3><p>{html.escape(text)}</p></aside>"


def details(title: str, body: str) -> str:
    """A part that opens when its title is chosen: for what few people look up."""
    return f"<details><summary>{html.escape(title)}</summary>\n{body}\n</details>"


def paragraph(text: str) -> str:
    """A paragraph of text."""
    return f"<p>{html.escape(text)}</p>"


def pairs(rows: Iterable[tuple[str, str]]) -> str:
    """A list of terms and descriptions."""
    items = (
        f"<dt>{html.escape(term)}</dt><dd>{html.escape(description)}</dd>"
        for term, description in rows
    )
    return f"<dl>{''.join(items)}</dl>"


def table(
    caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], numbers: Iterable[int] = ()
) -> str:
    """Return a table; the columns ``numbers`` are right-aligned.

    On a phone the rows of ``MANY`` columns become lists.
    """
    right = set(numbers)
    style = [' class="number"' if i in right else "" for i in range(len(head))]
    top = "".join(  # the corner above the rows' heads, which has no text, is no heading
        f'<th scope="col"{s}>{html.escape(h)}</th>' if h else f"<td{s}></td>"
        for h, s in zip(head, style, strict=True)
    )
    heads = [f' data-head="{html.escape(h)}"' if h else "" for h in head]
    attributes = [s + h for s, h in zip(style, heads, strict=True)]
    body = "".join(f"<tr>{_row(row, attributes)}</tr>\n" for row in rows)
    many = ' class="many"' if len(head) >= MANY else ""
    top_line = f"<caption>{html.escape(caption)}</caption>\n" if caption else ""
    return (
        f'<div class="wide" tabindex="0"><table{many}>{top_line}'
        f"<thead><tr>{top}</tr></thead>\n<tbody>{body}</tbody></table></div>"
    )


def _row(cells: Sequence[str], attributes: Sequence[str]) -> str:
    first, *rest = map(html.escape, cells)
    first = re.sub(r"(?<=\w[._])(?=\w)", "<wbr>", first)  # where a long key may be broken
    described = zip(rest, attributes[1:], strict=True)
    data_cells = "".join(f"<td{attribute}>{cell}</td>" for cell, attribute in described)
    return f'<th scope="row">{first}</th>{data_cells}'
