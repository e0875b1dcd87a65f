"""Functions have types: those that compile as well. Exceptions are few, and they are counted."""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
MOST = 20  # functions without types
UNTYPED = re.compile(r"#\s*type:\s*ignore\[[^\]]*\bno-untyped-def\b")


def test_hardly_any_function_is_without_types() -> None:
    files = [
        path
        for folder in ("twin", "drivers", "tools", "tests")
        for path in (ROOT / folder).rglob("*.py")
    ]
    untyped = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in files
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if UNTYPED.search(line)
    ]
    assert len(files) > 500
    assert len(untyped) < MOST, f"give these functions types: {', '.join(untyped)}"
