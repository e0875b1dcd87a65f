"""uPlot comes as a package of npm, and where it is missing each says so in a sentence."""

import json
import os
import stat
import tarfile
from pathlib import Path

import hatchling.build
import pytest
import rigs
from command_line import twin
from page_site import write_config

from hatch_build import UPLOT, bring, is_here
from twin.errors import ConfigError
from twin.page import chart_library as library_module
from twin.page.chart_library import FILES, PAGE, chart_library

VERSION = json.loads((PAGE / "package-lock.json").read_text())["packages"][str(UPLOT)]["version"]
BRINGS = f"""#!/bin/sh
echo "$@" > asked
mkdir -p {UPLOT}
echo '{{"version": "{VERSION}"}}' > {UPLOT}/package.json
"""
FAILS = """#!/bin/sh
echo npm error code ENOTFOUND >&2
exit 1
"""


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """A page whose library was not brought yet."""
    (folder := tmp_path / "page").mkdir()
    (folder / "package-lock.json").write_text((PAGE / "package-lock.json").read_text())
    return folder


def npm(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a program of this name on the path."""
    (folder / "npm").write_text(script)
    (folder / "npm").chmod(stat.S_IRWXU)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}/bin{os.pathsep}/usr/bin")


def test_the_version_is_exact_and_has_a_checksum() -> None:
    wanted = json.loads((PAGE / "package.json").read_text())["dependencies"]
    locked = json.loads((PAGE / "package-lock.json").read_text())["packages"]
    assert wanted == {"uplot": VERSION}
    assert locked.keys() == {"", str(UPLOT)}  # it needs no other
    assert locked[str(UPLOT)]["integrity"].startswith("sha512-")
    assert "resolved" not in locked[str(UPLOT)]  # the registry is whose npm is configured


def test_npm_brings_it_once_and_anew_for_another_version(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    npm(tmp_path, BRINGS, monkeypatch)
    monkeypatch.delenv("PIP_NO_INDEX", raising=False)
    assert bring(page) == ""
    assert "ci --omit=dev --ignore-scripts" in (page / "asked").read_text()
    (page / "asked").unlink()
    assert bring(page) == ""
    assert not (page / "asked").exists()
    (page / UPLOT / "package.json").write_text('{"version": "1.6.31"}')
    assert not is_here(page)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    assert bring(page) == ""
    assert "--offline" in (page / "asked").read_text()


def test_without_npm_or_its_registry_a_sentence_says_so(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert bring(page).endswith("draws no curves: npm is not installed (Debian: apt install npm)")
    npm(tmp_path, FAILS, monkeypatch)
    assert bring(page).endswith("--no-fund): npm error code ENOTFOUND")


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What a package is made of, without the library and without npm."""
    for name in ("hatch_build.py", "pyproject.toml", "README.md", "LICENSE"):
        (tmp_path / name).write_bytes((rigs.ROOT / name).read_bytes())
    for folder in ("twin/page", "drivers"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "__init__.py").touch()
    lock = (PAGE / "package-lock.json").read_text()
    (tmp_path / "twin" / "page" / "package-lock.json").write_text(lock)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    return tmp_path


def test_an_editable_installation_goes_on_without_it_and_a_wheel_is_not_built(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert hatchling.build.build_editable(str(checkout)).endswith(".whl")
    captured = capsys.readouterr()
    assert "npm is not installed" in captured.out + captured.err
    with pytest.raises(SystemExit, match="npm is not installed"):
        hatchling.build.build_wheel(str(checkout))


@pytest.mark.needs("uplot")
def test_a_wheel_of_a_source_distribution_needs_no_npm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(rigs.ROOT)
    name = hatchling.build.build_sdist(str(tmp_path))
    with tarfile.open(tmp_path / name) as archive:
        archive.extractall(tmp_path, filter="data")
    monkeypatch.chdir(tmp_path / name.removesuffix(".tar.gz"))
    assert is_here(Path("twin", "page"))
    assert hatchling.build.build_wheel(str(tmp_path)).endswith(".whl")


def test_what_is_missing_is_said_with_the_command_that_brings_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(library_module, "PAGE", tmp_path)
    with pytest.raises(ConfigError, match=r"needs uPlot.*iife\.min\.js cannot be read") as error:
        chart_library()
    assert error.value.hint.endswith(f"npm ci --omit=dev --ignore-scripts --prefix {tmp_path}")


def test_twin_serve_does_not_start_without_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(library_module, "PAGE", tmp_path)
    path = write_config(tmp_path)
    assert twin(monkeypatch, "serve", "--config", path, "--port", "0") == 2
    assert "the page needs uPlot, which draws its curves" in capsys.readouterr().err


@pytest.mark.needs("uplot")
def test_its_files_are_those_that_a_browser_needs() -> None:
    library = chart_library()
    assert library.keys() == FILES.keys()
    assert b"uPlot" in library["uPlot.iife.min.js"]
