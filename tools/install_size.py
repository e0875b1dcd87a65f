"""How much the base installation and each extra take, measured in this environment.

    python tools/install_size.py

It writes the table in docs/installation.md. Sizes are those of the files that pip has installed,
byte code included; what an extra takes is beside the base alone.
"""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

from tools.audit import needs_of, reached
from twin.extras import EXTRAS

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "installation.md"
MARKED = re.compile(r"(<!-- extras: [^\n]*-->\n).*?(<!-- end -->)", re.DOTALL)
OURS = "ejector-twin"
MB = 1e6


def sizes() -> dict[str, float]:
    """Size (MB) of the base by the name "", and of each extra beside it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    base = reached(project["dependencies"], needs_of)
    of_extras = {
        extra: reached(project["optional-dependencies"][extra], needs_of) - base - {OURS}
        for extra in EXTRAS
    }
    return {name: sum(map(_size, some)) for name, some in {"": base, **of_extras}.items()}


def _size(package: str) -> float:
    """Size (MB) of the files of a package; 0 where it is not installed."""
    try:
        paths = [file.locate() for file in files(package) or ()]
    except PackageNotFoundError:
        return 0.0
    return sum(Path(path).stat().st_size for path in map(str, paths) if Path(path).is_file()) / MB


def table(measured: dict[str, float]) -> str:
    """The table of the page."""
    rows = ["| extra | what it is for | MB beside the base |", "| --- | --- | --- |"]
    rows += [f"| `[{name}]` | {EXTRAS[name].purpose} | {measured[name]:.0f} |" for name in EXTRAS]
    return "\n".join(rows)


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    text = MARKED.sub(lambda match: f"{match[1]}{table(sizes())}\n{match[2]}", text)
    PAGE.write_text(text, encoding="utf-8")
