"""The commit that a tool measures."""

import os
import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).parent.parent


def commit() -> str:
    """Short hash of the commit of the sources, with "-dirty" if they differ; "unknown" without."""
    # Tests are given an empty path, on which it would be "unknown" for each of them.
    git = shutil.which("git", path=os.pathsep.join([os.environ.get("PATH", ""), os.defpath]))
    command = [git or "git", "describe", "--always", "--dirty", "--exclude=*"]
    try:
        process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return process.stdout.strip()
