"""The page "The first change, in an hour" is followed to the letter, in a copy of the project."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from doc_examples import blocks

ROOT = Path(__file__).resolve().parents[1]
PAGE = "first-change.md"
PROGRAMS = {"python": [sys.executable], "twin": [sys.executable, "-m", "twin.cli"]}
ANSWER, CHANGED_FILES = blocks(PAGE, "text")


def run(folder: Path, *command: str, text: str = "") -> str:
    """Run a command in a folder with the code that is there; gives its output."""
    environment = os.environ | {"PYTHONPATH": str(folder)}
    process = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        input=text,
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    output = process.stdout + process.stderr
    assert process.returncode == 0, f"{shlex.join(command)}\n{output}"
    return output


def run_block(folder: Path, block: str) -> list[str]:
    """Run each line of a block of commands; gives their outputs."""
    commands = [shlex.split(line) for line in block.splitlines()]
    return [run(folder, *PROGRAMS[name], *arguments) for name, *arguments in commands]


def translate(catalogue: Path, entries: str) -> None:
    """Fill in the translations of a block where the catalogue has none."""
    text = catalogue.read_text(encoding="utf-8")
    for entry in entries.strip().split("\n\n"):
        message, _ = entry.splitlines()
        untranslated = f'{message}\nmsgstr ""\n'
        assert text.count(untranslated) == 1, f"{catalogue.name} does not ask for {message}"
        text = text.replace(untranslated, f"{entry.strip()}\n")
    catalogue.write_text(text, encoding="utf-8")


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A repository with the files of the working tree, committed or not."""
    folder = tmp_path / "clone"
    made = shutil.ignore_patterns(".*", "__pycache__", "node_modules", "site", "demo", "audit")
    shutil.copytree(ROOT, folder, symlinks=True, ignore=made)
    shutil.copy(ROOT / ".gitignore", folder)
    run(folder, "git", "init", "--quiet")
    run(folder, "git", "add", "--all")
    author = ("-c", "user.name=newcomer", "-c", "user.email=newcomer@localhost")
    run(folder, "git", *author, "commit", "--quiet", "--message", "before the first change")
    return folder


@pytest.mark.slow
@pytest.mark.timeout(600)  # the copy compiles the model once more
@pytest.mark.needs("git")
def test_whoever_follows_the_page_has_added_an_effect(clone: Path) -> None:
    (entry,) = blocks(PAGE, "diff")
    (translations,) = blocks(PAGE, "po")
    tables, tests, diagnosis = blocks(PAGE, "sh")

    run(clone, "git", "apply", text=entry)
    run_block(clone, tables)
    translate(clone / "twin" / "locale" / "de.po", translations)
    for output in run_block(clone, tests):
        assert re.search(r"\d+ passed", output)
        assert not re.search(r"failed|skipped|error", output)
    *_, answer = run_block(clone, diagnosis)
    assert ANSWER.strip() in answer
    shutil.rmtree(clone / "first")

    status = run(clone, "git", "status", "--short")
    assert [line.split()[-1] for line in status.splitlines()] == CHANGED_FILES.split()
