"""docs/bench.md says what docs/bench.json holds, and the bench measures as the program runs."""

import importlib
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parent.parent
TOOLS = ROOT / "tools"


class Bench(NamedTuple):
    """The modules of the bench that this is about."""

    bench: ModuleType
    figures: ModuleType
    page: ModuleType


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.syspath_prepend(str(TOOLS))
    return Bench(*map(importlib.import_module, ("bench", "benchmarks.figures", "benchmarks.page")))


def test_the_page_is_that_of_the_measured_figures(modules: Bench) -> None:
    known = modules.bench.BENCHMARKS
    written = modules.page.page(modules.page.read(known), known)
    assert (ROOT / "docs" / "bench.md").read_text(encoding="utf-8") == written


def test_the_first_sentence_counts_every_limit_that_the_table_judges(modules: Bench) -> None:
    figures, page = modules.figures, modules.page
    kept, broken, open_ = (figures.Figure(name, "s", limit=1.0) for name in ("a", "b", "c"))
    known = [figures.Benchmark("all", lambda _: (), "how", (kept, broken, open_))]
    long = page.Session(["long"], [(broken, figures.Measured([2.0]))])
    text = page.page([page.Session(["short"], [(kept, figures.Measured([0.5]))]), long], known)
    assert "**1 of the 2 limits that were judged are kept.**" in text
    assert "Not kept: b, 2 s, limit 1 s" in text
    assert "Not judged (not measured): 1 of c" in text


def test_a_newer_run_keeps_what_it_did_not_measure_or_could_not_judge(modules: Bench) -> None:
    figures, page = modules.figures, modules.page
    a, b = (figures.Figure(name, "s", limit=1.0) for name in ("a", "b"))
    old = page.Session(["old"], [(a, figures.Measured([0.5])), (b, figures.Measured([0.5]))])
    new = page.Session(
        ["new"], [(a, figures.Measured([0.4])), (b, figures.Measured([9], valid=False))]
    )
    first, second = page.with_newer([old], new)
    assert first.results == [(a, figures.Measured([0.4]))]
    assert second.results == [(b, figures.Measured([0.5]))]
    assert page.with_newer([first], new)[1:] == []


def test_the_bench_takes_as_many_threads_as_the_command_line() -> None:
    # On the one core that is measured, a second thread of OpenBLAS made the monitor seem slower.
    code = "import sys, benchmarks, os; assert 'numpy' not in sys.modules; print(os.environ[{!r}])"
    name = "OPENBLAS_NUM_THREADS"
    environment = {key: value for key, value in os.environ.items() if key != name}
    command = [sys.executable, "-c", code.format(name)]
    done = subprocess.run(
        command, cwd=TOOLS, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "1"
    assert (
        f'os.environ.setdefault("{name}", "1")' in (ROOT / "twin" / "cli" / "main.py").read_text()
    )
