"""The table that ``make coverage`` prints."""

from tools.coverage_table import table


def summary(covered: float, missing: int = 0) -> dict[str, dict[str, float]]:
    counts = {"num_statements": 10, "missing_lines": missing, "num_branches": 4}
    return {"summary": {**counts, "missing_branches": 1, "percent_covered": covered}}


def test_modules_below_the_bound_are_listed_the_lowest_first() -> None:
    files = {"b.py": summary(84.96), "a.py": summary(50.0, 5), "c.py": summary(85.0)}
    said = table({"files": files, "totals": summary(73.3)["summary"]})
    assert "| a.py | 10 | 5 | 4 | 1 | 50.0 % |" in said
    assert "| all | 10 | 0 | 4 | 1 | 73.3 % |" in said
    assert said.endswith("Below 85 %:\n- a.py: 50.0 %\n- b.py: 85.0 %")
    assert table({"files": {}, "totals": summary(100.0)["summary"]}).endswith("none")
