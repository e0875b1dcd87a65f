"""What SECURITY.md promises is held by a test that is there."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROW = re.compile(r"^\| (?P<promise>[^|]+) \| `(?P<file>tests/\w+\.py)::(?P<test>\w+)` \|$", re.M)


def test_every_promise_has_its_test() -> None:
    text = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    heads = "| promise | test |", "| --- | --- |"
    table = [line for line in text.splitlines() if line.startswith("|") and line not in heads]
    rows = list(ROW.finditer(text))
    assert len({row["test"] for row in rows}) == len(rows)
    assert [row[0] for row in rows] == table
    for row in rows:
        tree = ast.parse((ROOT / row["file"]).read_text(encoding="utf-8"))
        assert row["test"] in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
