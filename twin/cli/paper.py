"""``twin paper``: the founding paper's figures, recomputed."""

from pathlib import Path
from typing import Annotated

import typer

from twin.files import require_writable, write_json


def paper(
    json_file: Annotated[
        Path | None,
        typer.Option("--json", metavar="F", help="Write the recomputed figures as JSON."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="F.(svg|png)", help="Draw the curves.")
    ] = None,
) -> None:
    """Recompute the founding paper's tables 2 and 4, and say what they can tell."""
    from twin.paper.separation import separate
    from twin.paper.tables import late_by, recomputed
    from twin.paper.text import in_words

    require_writable(json_file, picture)
    rows = recomputed()
    separation = separate(late_by(rows))
    if picture is not None:
        from twin.paper.picture import draw

        draw(rows, separation, picture)
    if json_file is not None:
        write_json(json_file, [row.json for row in rows])
    print(in_words(rows, separation))
