"""The command line in this process, and configurations with one passage changed."""

import sys
from pathlib import Path

import pytest
import rigs

from twin.cli.main import main


def twin(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    """Run the command line in this process; gives its exit code."""
    monkeypatch.setattr(sys, "argv", ["twin", *map(str, arguments)])
    try:
        main()
    except SystemExit as left:
        return int(left.code or 0)
    return 0


def edited(folder: Path, old: str, new: str, name: str = "test_rig") -> tuple[Path, int]:
    """A configuration with one passage changed, and the line of it."""
    text = rigs.path_of(name).read_text()
    assert old in text
    path = folder / "cell.toml"
    path.write_text(text.replace(old, new, 1))
    return path, text[: text.index(old)].count("\n") + 1
