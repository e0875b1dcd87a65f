"""What is in the tree is the project's own, and packages and licences are what they say."""

import ast
import os
import re
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator, Mapping
from email.parser import BytesParser
from functools import cache
from hashlib import sha256
from importlib.metadata import packages_distributions
from pathlib import Path

import hatchling.build
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from test_extras import DECLARED, packages_of

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("configs", "docs", "drivers", "tests", "tools", "twin")
OURS = ("twin", "drivers", "tests", "tools")
MADE = {"__pycache__", "node_modules"}
TINY = 64  # bytes: below, files are alike by chance
LONGEST = 500  # characters in a line that a person has written
UPLOT = "twin/page/node_modules/uplot"
# What a wheel has of it.
OF_UPLOT = ("LICENSE", "package.json", "dist/uPlot.iife.min.js", "dist/uPlot.min.css")
OF_SOURCES = {".gitignore", "LICENSE", "PKG-INFO", "README.md", "hatch_build.py", "pyproject.toml"}
INSTALLED = Path(sysconfig.get_path("purelib"))


def files(folder: Path) -> Iterator[Path]:
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(set(folders) - MADE)
        yield from (Path(place, name) for name in names)


def our_files() -> list[Path]:
    """All of the tree but LICENSE, whose text is meant to be everybody's."""
    roots = [file for file in ROOT.iterdir() if file.is_file() and file.name != "LICENSE"]
    return [*roots, *(file for folder in FOLDERS for file in files(ROOT / folder))]


def copies(ours: list[Path], installed: Path) -> dict[str, str]:
    """Which files are byte by byte those of an installed package."""
    sizes: dict[int, list[Path]] = {}
    for file in ours:
        if file.stat().st_size >= TINY:
            sizes.setdefault(file.stat().st_size, []).append(file)
    found = {}
    for other in files(installed):
        if other.relative_to(installed).parts[0].startswith("ejector_twin-"):
            continue
        for same_size in sizes.get(other.stat().st_size, []):
            if digest(same_size) == digest(other):
                found[str(same_size)] = str(other)
    return found


@cache
def digest(path: Path) -> bytes:
    return sha256(path.read_bytes()).digest()


@pytest.mark.slow
def test_no_file_is_that_of_an_installed_package() -> None:
    assert copies(our_files(), INSTALLED) == {}


@pytest.mark.needs("uplot")
def test_no_file_is_that_of_an_npm_package() -> None:
    assert len([*files(ROOT / UPLOT)]) > 5
    assert copies(our_files(), ROOT / UPLOT) == {}


def test_a_copied_file_is_found(tmp_path: Path) -> None:
    """The check above sees what it is to see: a header of FMI, as it once stood in the tree."""
    (copied := tmp_path / "a.h").write_bytes(
        (INSTALLED / "fmpy/c-code/fmi3Functions.h").read_bytes()
    )
    assert copies([copied], INSTALLED / "fmpy") == {
        str(copied): str(INSTALLED / "fmpy/c-code/fmi3Functions.h")
    }


def test_nobody_else_wrote_what_is_shipped() -> None:
    """Minified scripts have no line that a person writes, and copies bring their notices."""
    for path in (*files(ROOT / "twin"), *files(ROOT / "drivers")):
        text = path.read_text(encoding="utf-8")
        assert max(map(len, text.splitlines()), default=0) < LONGEST, path
        assert not re.search(r"copyright|\(c\) \d{4}|licen[cs]ed under", text, re.IGNORECASE), path


# --- wheel and licences -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[zipfile.ZipFile]:
    folder = tmp_path_factory.mktemp("wheel")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        name = hatchling.build.build_wheel(str(folder))
    with zipfile.ZipFile(folder / name) as archive:
        yield archive


@pytest.mark.needs("uplot")
def test_a_wheel_has_the_packages_whole_and_says_the_licence_of_each_part(
    wheel: zipfile.ZipFile,
) -> None:
    inside = [*files(ROOT / "twin"), *files(ROOT / "drivers")]
    expected = {file.relative_to(ROOT).as_posix() for file in inside}
    expected |= {f"twin/starters/{file.name}" for file in (ROOT / "configs").glob("*.toml")}
    expected |= {f"{UPLOT}/{name}" for name in OF_UPLOT}
    shipped = set(wheel.namelist())
    (metadata,) = (name for name in shipped if name.endswith(".dist-info/METADATA"))
    assert {name for name in shipped if ".dist-info/" not in name} == expected
    told = BytesParser().parsebytes(wheel.read(metadata))
    assert told["License-Expression"] == "Apache-2.0 AND MIT"
    assert told.get_all("License-File") == ["LICENSE", f"{UPLOT}/LICENSE"]
    for licence, words in (("LICENSE", b"Apache License"), (f"{UPLOT}/LICENSE", b"MIT License")):
        text = wheel.read(metadata.replace("METADATA", f"licenses/{licence}"))
        assert text == (ROOT / licence).read_bytes()
        assert words in text


def test_measured_data_says_whose_it_is_and_is_not_distributed() -> None:
    page = (ROOT / "tests" / "data" / "README.md").read_text(encoding="utf-8")
    for folder in (folder for folder in (ROOT / "tests" / "data").iterdir() if folder.is_dir()):
        (row,) = (line for line in page.splitlines() if f"`{folder.name}/` |" in line)
        assert row.rstrip(" |").endswith("MIT"), row


@pytest.mark.needs("uplot")
def test_a_source_distribution_has_what_the_wheel_is_made_of(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        name = hatchling.build.build_sdist(str(tmp_path))
    with tarfile.open(tmp_path / name) as archive:
        inside = {member.name.split("/", 1)[1] for member in archive if member.isfile()}
    assert "twin/starters/test_rig.toml" in inside
    others = {name for name in inside if not name.startswith(("twin/", "drivers/"))}
    assert others == OF_SOURCES
    assert {f"{UPLOT}/{name}" for name in OF_UPLOT} <= inside


# --- imports and declarations -------------------------------------------------------------------

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS = {extra: [*map(str, packages_of(extra))] for extra in DECLARED}
# What imports a package, and what it is installed with beside the base. One that is not here has
# the base alone.
NEEDS_EXTRA = {
    "drivers/opcua/": "opcua",
    "drivers/outputs/conditions.py": "opcua",
    "drivers/outputs/nodes.py": "opcua",
    "drivers/outputs/serve.py": "opcua",
    "drivers/plc/opcua": "opcua",
    "twin/alarms/export.py": "tables",
    "twin/api.py": "notebook",
    "twin/columns.py": "notebook",
    "twin/compare/picture.py": "reports",
    "twin/diagnosis/": "reports",
    "twin/exchange/aas.py": "aas",
    "twin/exchange/elements.py": "aas",
    "twin/exchange/fmu_file.py": "aas",
    "twin/exchange/submodels.py": "aas",
    "twin/figures/export.py": "tables",
    "twin/figures/picture.py": "reports",
    "twin/fleet/engines.py": "dask",
    "twin/fleet/report_page.py": "fleet",
    "twin/paper/picture.py": "reports",
    "twin/tables/": "tables",
    "twin/languages/catalogues.py": "serve",
    "twin/page/": "serve",
    "twin/view.py": "view",
}

NEIGHBOURS = {file.stem for folder in ("tests", "tools") for file in (ROOT / folder).iterdir()}
NEIGHBOURS.add("hatch_build")


def declared(requirements: list[str]) -> set[str]:
    return {canonicalize_name(Requirement(requirement).name) for requirement in requirements}


@cache
def imported(path: Path) -> list[tuple[str, int]]:
    """Packages of others that a module imports, anywhere in it, with the line."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [str(node.module)]
        elif is_named_import(node):
            names = [node.args[0].value]  # type: ignore[attr-defined]
        for name in (name.partition(".")[0] for name in names):
            if name not in sys.stdlib_module_names and name not in OURS:
                found.append((name, node.lineno))  # type: ignore[attr-defined]
    return found


def is_named_import(node: ast.AST) -> bool:
    """``importlib.import_module("name")``."""
    return (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr == "import_module"
        and isinstance(node.args[0], ast.Constant)
    )


def undeclared(path: Path, allowed: set[str], providers: Mapping[str, list[str]]) -> list[str]:
    """Where a module imports what nothing declares; tests and tools also have their neighbours."""
    return [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for name, line in imported(path)
        if not (name in NEIGHBOURS and path.relative_to(ROOT).parts[0] in ("tests", "tools"))
        if not allowed & {canonicalize_name(provider) for provider in providers.get(name, [])}
    ]


def allowed_for(path: Path) -> set[str]:
    base = declared(PROJECT["project"]["dependencies"])
    name = path.relative_to(ROOT).as_posix()
    if not name.startswith(("twin/", "drivers/")):
        groups = PROJECT["dependency-groups"]
        return base.union(*map(declared, [*EXTRAS.values(), *groups.values()]))
    extras = {extra for place, extra in NEEDS_EXTRA.items() if name.startswith(place)}
    return base.union(*(declared(EXTRAS[extra]) for extra in extras))


@pytest.mark.slow
def test_what_is_imported_is_declared_where_it_is_needed() -> None:
    providers = packages_distributions()
    modules = [file for folder in OURS for file in files(ROOT / folder) if file.suffix == ".py"]
    assert len(modules) > 300
    assert [
        bad for module in modules for bad in undeclared(module, allowed_for(module), providers)
    ] == []


@pytest.mark.slow
def test_what_is_declared_is_imported() -> None:
    """A dependency that nothing imports would be installed for nothing."""
    providers = packages_distributions()
    shipped = [*files(ROOT / "twin"), *files(ROOT / "drivers")]
    used = {
        canonicalize_name(distribution)
        for path in shipped
        if path.suffix == ".py"
        for name, _ in imported(path)
        for distribution in providers.get(name, [])
    }
    # SQLAlchemy loads it for postgresql+psycopg, and uvicorn for WebSockets.
    loaded_by_name = {"psycopg", "websockets"}
    wanted = declared(
        [*PROJECT["project"]["dependencies"], *(r for of in EXTRAS.values() for r in of)]
    )
    assert wanted - used == loaded_by_name
