"""Print branch coverage by module, and which modules are below 85 %.

    python tools/coverage_table.py coverage.json

``make coverage`` runs it. Lines and branches count alike. What Numba compiles is not seen by the
measurement and left out of it (``[tool.coverage.report]`` in pyproject.toml).
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ENOUGH = 85.0  # %
COLUMNS = "| module | lines | not run | branches | not taken | covered |"


def table(report: Mapping[str, Any]) -> str:
    """A coverage.json as Markdown: modules, the total, and modules below ENOUGH."""
    files = {name: summary["summary"] for name, summary in sorted(report["files"].items())}
    rows = [COLUMNS, "|" + " --- |" * 6]
    rows += [row(name, summary) for name, summary in [*files.items(), ("all", report["totals"])]]
    low = [(summary["percent_covered"], name) for name, summary in files.items()]
    below = [f"- {name}: {share:.1f} %" for share, name in sorted(low) if share < ENOUGH]
    return "\n".join([*rows, "", f"Below {ENOUGH:.0f} %:", *(below or ["none"])])


def row(name: str, summary: Mapping[str, Any]) -> str:
    """One line of the table."""
    counts = ("num_statements", "missing_lines", "num_branches", "missing_branches")
    numbers = " | ".join(str(summary[key]) for key in counts)
    return f"| {name} | {numbers} | {summary['percent_covered']:.1f} % |"


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    print(table(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))))
