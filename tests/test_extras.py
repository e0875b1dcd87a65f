"""The line that installs an extra works for the installation at hand."""

import shlex
import sys
import tomllib
from pathlib import Path

import pytest

from twin.extras import install_hint

ROOT = Path(__file__).resolve().parents[1]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def test_a_checkout_is_installed_with_the_extra_from_wherever_one_is() -> None:
    pip = [sys.executable, "-m", "pip", "install"]
    assert shlex.split(install_hint("view")) == [*pip, "-e", f"{ROOT}[view]"]


@pytest.mark.parametrize("extra", EXTRAS)
def test_without_a_checkout_the_packages_are_named(extra: str, tmp_path: Path) -> None:
    packages = shlex.split(install_hint(extra, tmp_path))[4:]
    assert len(packages) == len(EXTRAS[extra])
    for package, wanted in zip(packages, EXTRAS[extra], strict=True):
        assert package.startswith(wanted.partition(">=")[0])
        assert ";" not in package


def test_no_hint_names_a_package_index_or_folder_that_may_not_be_there() -> None:
    for path in (*(ROOT / "twin").rglob("*.py"), *(ROOT / "drivers").rglob("*.py")):
        text = path.read_text()
        assert "pip install" not in text, path
        assert ".venv" not in text, path
