"""Programs of the system that tests speak to, and the Debian packages that bring them.

``NEEDS`` is the only list of them. A test names its needs with ``@pytest.mark.needs("mosquitto")``
and finds their programs by name on the path; a test without this mark finds no program there.
tests/conftest.py does that, and skips a test that lacks a need. Run as a program this file installs
what is missing: that is ``make peers``, and it needs Python alone.
"""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

PEERS = Path(__file__).parent / "peers"  # programs of ours around npm packages and libmodbus
PATIENCE_S = 60.0
NPM = ("npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund")


@dataclass(frozen=True)
class Need:
    """Programs that tests speak to."""

    programs: tuple[str, ...]
    packages: tuple[str, ...]  # Debian's
    tested: str  # what is tested with it
    aliases: tuple[str, ...] = ()  # other programs that do the same: hidden along with them
    probe: tuple[str, ...] = ()  # fails where a part of it is missing that is no program
    source: str = ""  # what the probe reads
    install: tuple[str, ...] = ()  # brings what the packages do not


NEEDS: Mapping[str, Need] = {
    "postgresql": Need(
        ("initdb", "postgres"),
        ("postgresql",),
        "assets, alarms and key figures in PostgreSQL",
    ),
    "mosquitto": Need(
        ("mosquitto", "mosquitto_passwd"),
        ("mosquitto",),
        "alarms, data and uploads through an MQTT broker",
    ),
    "openssl": Need(("openssl",), ("openssl",), "MQTT and webhooks inside TLS"),
    "node-opcua": Need(
        ("node",),
        ("nodejs", "npm"),
        "OPC UA with a server and clients of other make",
        probe=("node", "-e", "require.resolve('node-opcua-server')"),
        install=NPM,
    ),
    "axe": Need(
        ("node",),
        ("nodejs", "npm"),
        "whether the page is fit for keyboards and screen readers",
        probe=("node", "-e", "require.resolve('axe-core')"),
        install=NPM,
    ),
    "uplot": Need(
        ("node", "npm"),
        ("nodejs", "npm"),
        "the technician's page with its curves, and the wheel, which has what draws them",
        probe=("node", "-e", "require.resolve('../../twin/page/node_modules/uplot')"),
        install=(*NPM, "--omit=dev", "--prefix", "../../twin/page"),
    ),
    "cc": Need(
        ("cc",),
        ("gcc", "libc6-dev"),
        "FMUs and the model as C",
        aliases=("gcc", "clang", "c89", "c99"),
        probe=("cc", "-fsyntax-only", "-x", "c", "-"),
        source="#include <math.h>\n",
    ),
    "c++": Need(
        ("c++", "make"),
        ("g++", "make"),
        "an FMU that FMPy compiles: its CMake project asks for C++",
        aliases=("g++", "clang++", "gmake", "ninja"),
        probe=("c++", "-fsyntax-only", "-x", "c++", "-"),
        source="#include <cmath>\n",
    ),
    "libmodbus": Need(
        ("pkg-config",),
        ("pkg-config", "libmodbus-dev"),
        "Modbus with a server of other make",
        aliases=("pkgconf",),
        probe=("pkg-config", "--exists", "libmodbus"),
    ),
    "stunnel": Need(("stunnel",), ("stunnel4",), "Modbus inside TLS", aliases=("stunnel4",)),
    "git": Need(("git",), ("git",), "the contributor's first change"),
    "chromium": Need(("chromium",), ("chromium",), "the technician's page and the documentation"),
}
INSTALL = "env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends"


def search_path() -> str:
    """Where programs are looked for: Debian keeps some off the path of ordinary users."""
    postgresql = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)  # newest first
    return os.pathsep.join([*map(str, postgresql), os.environ.get("PATH", ""), "/usr/sbin"])


def find(name: str, path: str) -> dict[str, str]:
    """Where each program of a need is; nothing if one of them is missing."""
    found = {program: shutil.which(program, path=path) for program in NEEDS[name].programs}
    there = {program: place for program, place in found.items() if place}
    return there if len(there) == len(found) else {}


def is_here(name: str, path: str) -> bool:
    """Whether its programs are here, with what the probe looks for."""
    need = NEEDS[name]
    if not need.probe or not find(name, path):
        return bool(find(name, path))
    probed = subprocess.run(
        need.probe,
        input=need.source.encode(),
        cwd=PEERS,
        env={**os.environ, "PATH": path},
        capture_output=True,
        timeout=PATIENCE_S,
        check=False,
    )
    return probed.returncode == 0


class Programs:
    """Lets a test find the programs that it names on the path, and no others."""

    def __init__(self, folder: Path, hidden: Collection[str]) -> None:
        """Empty the path of this process; ``folder`` holds links to what is offered on it.

        Needs that are ``hidden`` count as missing.
        """
        self._folder = folder
        self._before = os.environ.get("PATH", "")
        self._searched = search_path()
        self.is_missing = cache(lambda name: name in hidden or not is_here(name, self._searched))
        self._none = self._linked("none", {})
        self.offer([])

    def offer(self, names: Collection[str]) -> None:
        """Put the programs of these needs on the path, and what they may call themselves."""
        folders = [self._linked(name, find(name, self._searched)) for name in names]
        folders.append(self._linked("others", self._others()) if names else self._none)
        os.environ["PATH"] = os.pathsep.join(map(str, folders))

    def close(self) -> None:
        os.environ["PATH"] = self._before

    def _linked(self, name: str, programs: Mapping[str, str]) -> Path:
        folder = self._folder / name
        if not folder.exists():
            folder.mkdir()
            for program, place in programs.items():
                (folder / program).symlink_to(place)
        return folder

    @cache  # noqa: B019  # there is one for a run
    def _others(self) -> dict[str, str]:
        """All programs on the path that are no need of any test."""
        needs = {program for need in NEEDS.values() for program in (*need.programs, *need.aliases)}
        places = [Path(folder) for folder in reversed(self._before.split(os.pathsep)) if folder]
        files = (file for place in places for file in place.glob("*"))
        return {file.name: str(file.absolute()) for file in files if file.name not in needs}


# --- make peers ---------------------------------------------------------------------------------


def to_install(path: str) -> list[str]:
    """Debian packages that are missing here."""
    packages: set[str] = set()
    for name, need in NEEDS.items():
        if is_here(name, path):
            continue
        if not find(name, path) or not need.install:
            packages.update(need.packages)
        elif not shutil.which(need.install[0], path=path):
            packages.add(need.install[0])
    return sorted(packages)


def install(packages: Collection[str]) -> None:
    """As root, by sudo, or by whoever reads the line that is printed."""
    command = f"{INSTALL} {' '.join(packages)}"
    sudo = "" if os.geteuid() == 0 else "sudo "
    if shutil.which("apt-get") is None or (sudo and shutil.which("sudo") is None):
        sys.stdout.write(f"Run this as root, or install what these packages bring:\n  {command}\n")
        return
    for line in (f"{sudo}apt-get update -q", f"{sudo}{command}"):
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()
        subprocess.run(shlex.split(line), check=False)


def main() -> int:
    """Install what is missing; 1 if something still is."""
    if packages := to_install(search_path()):
        install(packages)
    path = search_path()  # PostgreSQL brings a folder of its own
    wanted = (need.install for name, need in NEEDS.items() if need.install and find(name, path))
    for command in dict.fromkeys(wanted):  # one of npm brings all of its packages
        if shutil.which(command[0]):
            sys.stdout.write(f"{shlex.join(command)} (in {PEERS})\n")
            sys.stdout.flush()
            subprocess.run(command, cwd=PEERS, check=False)
    missing = [name for name in NEEDS if not is_here(name, path)]
    for name in missing:
        sys.stdout.write(f"{name} is missing: {NEEDS[name].tested} stays untested\n")
    if not missing:
        sys.stdout.write("All programs that the tests speak to are here.\n")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
