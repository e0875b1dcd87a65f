"""Brings uPlot, which draws the page's curves, before the project is installed or packed.

npm installs it beside the page, of the version and with the checksum of twin/page/package-lock.json
and from the registry that npm is configured with. A source distribution has it already. An editable
installation goes on without it; `twin serve` then says what is missing.
"""

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

NPM = ("npm", "ci", "--omit=dev", "--ignore-scripts", "--no-audit", "--no-fund")
UPLOT = Path("node_modules", "uplot")


class ChartLibrary(BuildHookInterface[Any]):
    """Called by hatchling before each build."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Bring the library; what is packed without it is no page."""
        why_not = bring(Path(self.root, "twin", "page"))
        if why_not and version == "editable":
            self.app.display_warning(why_not)
        elif why_not:
            raise SystemExit(why_not)


def bring(page: Path) -> str:
    """Have npm install it unless it is there; returns why it is not there, empty if it is."""
    if is_here(page):
        return ""
    where = f"without uPlot in {page / UPLOT} the page of twin serve draws no curves"
    npm = shutil.which(NPM[0])
    if npm is None:
        return f"{where}: npm is not installed (Debian: apt install npm)"
    offline = ["--offline"] if os.environ.get("PIP_NO_INDEX") else []
    done = subprocess.run(
        [npm, *NPM[1:], *offline], cwd=page, capture_output=True, text=True, check=False
    )
    if done.returncode == 0 and is_here(page):
        return ""
    said = " ".join(done.stderr.split())[-400:]
    return f"{where}: npm did not bring it (in {page}: {' '.join(NPM)}): {said}"


def is_here(page: Path) -> bool:
    """Whether the version of the lock file is there."""
    try:
        wanted, found = (
            json.loads((page / name).read_text(encoding="utf-8"))
            for name in ("package-lock.json", UPLOT / "package.json")
        )
    except OSError:
        return False
    return bool(wanted["packages"][UPLOT.as_posix()]["version"] == found["version"])
