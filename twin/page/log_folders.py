"""The folders with logs of an ejector: each run stores its folder for the page."""

from pathlib import Path

NAME = "logs.txt"  # in the ejector's page folder: one folder a line, the newest last
MOST = 20  # folders that are kept


def remember(folder: Path, logs: Path) -> None:
    """Add the folder ``logs``; OSError if that cannot be written."""
    known = remembered(folder)
    here = logs.resolve()
    if known[-1:] == [here]:
        return
    lines = [str(path) for path in [*(path for path in known if path != here), here]][-MOST:]
    folder.mkdir(parents=True, exist_ok=True)
    written = folder / f"{NAME}.new"
    written.write_text("\n".join(lines) + "\n", encoding="utf-8")
    written.replace(folder / NAME)


def remembered(folder: Path) -> list[Path]:
    """All stored folders; empty if no run has logged."""
    try:
        lines = (folder / NAME).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return []
    return [Path(line) for line in lines[-MOST:] if line]
