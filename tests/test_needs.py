"""What a test needs of the system: it finds that and no more, and without it is skipped."""

import os
import re
import shutil
import subprocess
import sys

import needs
import pytest
import rigs
from needs import NEEDS

PROGRAMS = {program for need in NEEDS.values() for program in (*need.programs, *need.aliases)}


def run_without(need: str, *options: str, ci: str = "") -> "subprocess.CompletedProcess[str]":
    """The tests with a mark, in a process that cannot find a need."""
    command = [sys.executable, "-m", "pytest", "-q", "-m", "needs", "--without", need, *options]
    return subprocess.run(
        command,
        cwd=rigs.ROOT,
        env={**os.environ, "CI": ci},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.timeout(400)  # all tests are collected once more
def test_without_any_program_nothing_fails_and_a_table_says_what_is_left_out() -> None:
    done = run_without("all")
    assert done.returncode == 0, done.stdout
    assert re.fullmatch(r"\d+ skipped, \d+ deselected in .*", done.stdout.splitlines()[-1])
    _, _, table = done.stdout.partition("left out: make peers installs what these tests need")
    for name, need in NEEDS.items():
        packages = re.escape(" ".join(need.packages))
        assert re.search(rf"^ *[1-9]\d*  {re.escape(name)} +{packages} +\S", table, re.M), name


@pytest.mark.slow
def test_several_processes_say_together_what_is_left_out() -> None:
    done = run_without("cc", "-n", "2", "tests/test_bench_kernel.py", "tests/test_translate.py")
    assert done.returncode == 0, done.stdout
    count = re.search(r"^ *(\d+)  cc ", done.stdout, re.M)
    assert count is not None
    assert f"{count[1]} skipped" in done.stdout


@pytest.mark.slow
def test_in_ci_a_missing_program_is_a_failure() -> None:
    done = run_without("cc", "tests/test_bench_kernel.py", ci="true")
    assert done.returncode == 1, done.stdout
    assert "no cc (make peers; on Debian or Ubuntu: apt install gcc libc6-dev)" in done.stdout
    assert "skipped" not in done.stdout


def test_a_test_that_names_no_need_finds_no_program() -> None:
    assert {program for program in {*PROGRAMS, "sh", "git"} if shutil.which(program)} == set()


@pytest.mark.needs("openssl")
def test_a_test_finds_the_programs_that_it_names_and_no_other_need() -> None:
    assert {program for program in PROGRAMS if shutil.which(program)} == {"openssl"}
    assert shutil.which("sh"), "programs may call the rest of the system"


# --- make peers ---------------------------------------------------------------------------------


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A machine without any of the programs, whose commands are noted and not run."""
    ran: list[str] = []
    monkeypatch.setattr(needs, "search_path", lambda: "/nowhere")
    monkeypatch.setattr(needs.subprocess, "run", lambda command, **_: ran.append(" ".join(command)))
    return ran


def test_make_peers_installs_all_packages_of_the_table(
    bare: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(needs.os, "geteuid", lambda: 0)
    monkeypatch.setattr(needs.shutil, "which", {"apt-get": "/usr/bin/apt-get"}.get)
    monkeypatch.setattr(needs, "find", lambda *_: {})
    assert needs.main() == 1
    update, install = bare
    assert update == "apt-get update -q"
    assert set(install.split()) > {package for need in NEEDS.values() for package in need.packages}
    assert "mosquitto is missing: alarms" in capsys.readouterr().out


@pytest.mark.parametrize("sudo", [True, False])
def test_make_peers_without_root_asks_sudo_or_prints_the_line(
    bare: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    sudo: bool,
) -> None:
    there = {"apt-get": "/usr/bin/apt-get"} | ({"sudo": "/usr/bin/sudo"} if sudo else {})
    monkeypatch.setattr(needs.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(needs.shutil, "which", there.get)
    needs.install(["mosquitto"])
    line = f"{needs.INSTALL} mosquitto"
    assert bare == (["sudo apt-get update -q", f"sudo {line}"] if sudo else [])
    assert line in capsys.readouterr().out


def test_what_is_there_is_not_installed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Node.js of another make than Debian's would be in the way of Debian's npm."""
    here = {"node-opcua": False}
    monkeypatch.setattr(needs, "find", lambda *_: {"any": "/usr/bin/any"})
    monkeypatch.setattr(needs, "is_here", lambda name, _: here.get(name, True))
    monkeypatch.setattr(needs.shutil, "which", lambda *_, **__: "/usr/bin/npm")
    assert needs.to_install("") == []
    here["libmodbus"] = False  # the program is there, a header is not
    assert needs.to_install("") == ["libmodbus-dev", "pkg-config"]
