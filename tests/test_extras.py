"""The extras: each is declared and described, and its hint works for the installation at hand."""

import re
import shlex
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tools.install_size import PAGE, sizes
from twin.errors import ConfigError
from twin.extras import EXTRAS, install_hint, require

ROOT = Path(__file__).resolve().parents[1]
DECLARED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def packages_of(extra: str) -> list[Requirement]:
    """What an extra installs, with the extras that it names."""
    packages: dict[str, Requirement] = {}
    for package in map(Requirement, DECLARED[extra]):
        if package.name == "ejector-twin":
            packages |= {
                requirement.name: requirement
                for name in package.extras
                for requirement in packages_of(name)
            }
        else:
            packages[package.name] = package
    return list(packages.values())


def test_each_extra_is_described_and_all_has_all() -> None:
    assert {*DECLARED} == {*EXTRAS, "all"}
    (everything,) = map(Requirement, DECLARED["all"])
    assert everything.extras == {*EXTRAS}


@pytest.mark.slow
@pytest.mark.parametrize("extra", EXTRAS)
def test_a_module_is_asked_for_of_each_package(extra: str) -> None:
    distributions = packages_distributions()
    asked = {
        canonicalize_name(name)
        for module in EXTRAS[extra].modules
        for name in distributions[module.partition(".")[0]]
    }
    assert asked == {canonicalize_name(package.name) for package in packages_of(extra)}


def test_the_page_says_what_each_extra_is_for_and_how_big_it_is() -> None:
    (stated,) = re.findall(r"<!-- extras: .*?-->\n(.*?)\n<!-- end -->", PAGE.read_text(), re.DOTALL)
    rows = [line.split(" | ") for line in stated.splitlines()[2:]]
    measured = sizes()
    assert [(name.strip("| `[]"), purpose) for name, purpose, _ in rows] == [
        (name, extra.purpose) for name, extra in EXTRAS.items()
    ]
    for name, _, size in rows:  # another system or version has others, by a little
        assert float(size.strip(" |")) == pytest.approx(measured[name.strip("| `[]")], rel=0.3)


def test_a_missing_module_is_an_error_with_the_extra_and_the_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    require("opcua", "a test")
    monkeypatch.setitem(sys.modules, "asyncua", None)
    with pytest.raises(ConfigError) as refused:
        require("opcua", "a test")
    assert str(refused.value) == "a test needs the extra [opcua]: asyncua is not installed"
    assert refused.value.hint == install_hint("opcua")


def test_a_checkout_is_installed_with_the_extra_from_wherever_one_is() -> None:
    pip = [sys.executable, "-m", "pip", "install"]
    assert shlex.split(install_hint("view")) == [*pip, "-e", f"{ROOT}[view]"]


@pytest.mark.parametrize("extra", EXTRAS)
def test_without_a_checkout_the_packages_are_named(extra: str, tmp_path: Path) -> None:
    hinted = [
        Requirement(requirement) for requirement in shlex.split(install_hint(extra, tmp_path))[4:]
    ]
    assert sorted(map(str, hinted)) == sorted(map(str, packages_of(extra)))


def test_no_hint_names_a_package_index_or_folder_that_may_not_be_there() -> None:
    for path in (*(ROOT / "twin").rglob("*.py"), *(ROOT / "drivers").rglob("*.py")):
        text = path.read_text()
        assert "pip install" not in text, path
        assert ".venv" not in text, path
