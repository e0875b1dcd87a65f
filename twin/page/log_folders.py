"""Which folders the logs of an ejector lie in: a run leaves word for the page."""

from pathlib import Path

NAME = "logs.txt"  # in the ejector's folder of the page: a folder a line, the newest last
MOST = 20  # folders


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
    """All folders; none if no run has logged."""
    try:
        lines = (folder / NAME).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return []
    return [Path(line) for line in lines[-MOST:] if line]
