"""uPlot, which draws the page's curves: a package of npm, which hatch_build.py brings.

It is beside this module in a checkout, in an editable installation, and in a wheel.
"""

import shlex
from pathlib import Path

from twin.errors import ConfigError

PAGE = Path(__file__).parent
FILES = {"uPlot.iife.min.js": "text/javascript", "uPlot.min.css": "text/css"}


def chart_library() -> dict[str, bytes]:
    """The files of uPlot that a browser needs, by name; ConfigError where one is missing."""
    folder = PAGE / "node_modules" / "uplot" / "dist"
    try:
        return {name: (folder / name).read_bytes() for name in FILES}
    except OSError as error:
        command = ["npm", "ci", "--omit=dev", "--ignore-scripts", "--prefix", str(PAGE)]
        raise ConfigError(
            f"the page needs uPlot, which draws its curves: {error.filename} cannot be read",
            f"npm brings it (Debian: apt install npm): {shlex.join(command)}",
        ) from error
