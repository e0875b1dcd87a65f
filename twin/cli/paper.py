"""``twin paper``: the founding paper's figures, recomputed."""

from pathlib import Path
from typing import Annotated

from twin.cli.console import status
from twin.cli.options import JSON, PICTURES, JsonFile, PictureFile, chosen
from twin.cli.options import output as output_option
from twin.files import require_writable, write_json


def paper(
    output: Annotated[Path | None, output_option(JSON, *PICTURES)] = None,
    json_file: JsonFile = None,
    picture: PictureFile = None,
) -> None:
    """Recompute the founding paper's tables 2 and 4, and say what they can tell."""
    from twin.paper.separation import separate
    from twin.paper.tables import late_by, recomputed
    from twin.paper.text import in_words

    json_file = chosen(output, "--json", json_file, JSON)
    picture = chosen(output, "--picture", picture, *PICTURES)
    require_writable(json_file, picture)
    with status() as say:
        say("recomputing the paper's tables")
        rows = recomputed()
        say("separating wall heat from the bulge")
        separation = separate(late_by(rows))
        if picture is not None:
            from twin.paper.picture import draw

            say("drawing the curves")
            draw(rows, separation, picture)
    if json_file is not None:
        write_json(json_file, [row.json for row in rows])
    print(in_words(rows, separation))
