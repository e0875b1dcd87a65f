"""What the twin is made of, under which licences, and what is known to be wrong with it.

    python tools/audit.py FOLDER [--advisories FILE]

``make audit`` runs it and installs what it needs into ``.venv/audit``. It writes ``sbom.json``
(CycloneDX), ``licences.md`` and ``vulnerabilities.md`` into FOLDER. pip-audit asks PyPI; without a
network FILE is an export of OSV's advisories on PyPI, a ZIP file of one JSON document each:
https://osv-vulnerabilities.storage.googleapis.com/PyPI/all.zip. Exit code 1: something vulnerable
is installed, or nobody could be asked.
"""

import argparse
import json
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from typing import Any, NamedTuple

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version

ROOT = Path(__file__).resolve().parents[1]
TOOLS = Path(sys.prefix) / "audit" / "bin"
SCOPES = {
    "required": "the base needs it",
    "optional": "an extra needs it",
    "excluded": "development alone needs it, and it is not shipped",
}
UNSTATED = "not stated in its metadata"


Needs = Callable[[str], Iterable[str]]  # requirements of a package, by its name


class Vulnerability(NamedTuple):
    """A known weakness of an installed package."""

    package: str
    version: str
    name: str  # CVE, GHSA or PYSEC number
    fixed: str  # versions, empty where there is none
    summary: str


class Unreachable(Exception):  # noqa: N818 - says what happened
    """Nobody could be asked about vulnerabilities."""


# --- what is installed --------------------------------------------------------------------------


def bill_of_materials() -> dict[str, Any]:
    """The CycloneDX document of this environment, each component with its scope."""
    command = [TOOLS / "cyclonedx-py", "environment", sys.executable, "--output-reproducible"]
    project = ["--pyproject", ROOT / "pyproject.toml"]
    done = subprocess.run([*command, *project], check=True, capture_output=True)
    found: dict[str, Any] = json.loads(done.stdout)
    tables = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [one for of in tables["optional-dependencies"].values() for one in of]
    scoped(found, tables["dependencies"], extras, needs_of)
    return found


def scoped(
    document: dict[str, Any], base: Iterable[str], extras: Iterable[str], needs: Needs
) -> None:
    """Write each component's scope: reached from the base, from an extra, or from neither."""
    required, optional = reached(base, needs), reached(extras, needs)
    for one in document["components"]:
        name = canonicalize_name(one["name"])
        is_optional = "optional" if name in optional else "excluded"
        one["scope"] = "required" if name in required else is_optional


def reached(requirements: Iterable[str], needs: Needs) -> set[str]:
    """The packages that these ask for, directly or not, here and with these extras."""
    waiting, seen = [Requirement(one) for one in requirements], set[tuple[str, str]]()
    while waiting:
        wanted = waiting.pop()
        name = canonicalize_name(wanted.name)
        for extra in {"", *wanted.extras} - {extra for of, extra in seen if of == name}:
            seen.add((name, extra))
            waiting += [
                one
                for one in map(Requirement, needs(name))
                if one.marker is None or one.marker.evaluate({"extra": extra})
            ]
    return {name for name, _ in seen}


def needs_of(name: str) -> list[str]:
    """What an installed package says that it needs; nothing of one that is not here."""
    try:
        return requires(name) or []
    except PackageNotFoundError:
        return []


def licence(component: Mapping[str, Any]) -> str:
    """What a component says of its licence, SPDX before classifiers before names."""
    stated = component.get("licenses", [])
    expressions = [one["expression"] for one in stated if "expression" in one]
    entries = [one["license"] for one in stated if "license" in one]
    spdx = [one["id"] for one in entries if "id" in one]
    others = [one["name"].rpartition(" :: ")[2] for one in entries if "name" in one]
    return "; ".join(expressions or spdx or others) or UNSTATED


def licences(document: Mapping[str, Any]) -> str:
    """The licence list as Markdown, by scope."""
    lines = ["# Licences", ""]
    for scope, why in SCOPES.items():
        lines += [f"## {scope.capitalize()}: {why}", "", "| package | version | licence |"]
        lines += ["| --- | --- | --- |"]
        lines += [
            f"| {one['name']} | {one['version']} | {licence(one).replace('|', '/')} |"
            for one in sorted(document["components"], key=lambda one: one["name"].lower())
            if one["scope"] == scope
        ]
        lines.append("")
    return "\n".join(lines)


# --- what is wrong with it ----------------------------------------------------------------------


def asked() -> list[Vulnerability]:
    """What pip-audit hears from PyPI; Unreachable where it does not."""
    where = ["--path", sysconfig.get_path("purelib"), "--format", "json", "--desc", "on"]
    command = [TOOLS / "pip-audit", *where, "--progress-spinner", "off"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    try:
        packages = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        raise Unreachable(f"pip-audit: {done.stderr.strip()[-300:]}") from None
    return heard(packages)


def heard(packages: Iterable[Mapping[str, Any]]) -> list[Vulnerability]:
    """What pip-audit's answer says; Unreachable where it skipped a package that is not ours."""
    known, skipped = [], []
    for one in packages:
        (skipped if "skip_reason" in one else known).append(one)
    unasked = sorted({one["name"] for one in skipped} - {"ejector-twin"})
    if unasked:
        few = ", ".join(unasked[:3])
        raise Unreachable(f"pip-audit could not ask PyPI about {len(unasked)} packages: {few} …")
    return [
        Vulnerability(
            one["name"],
            one["version"],
            of["id"],
            ", ".join(of["fix_versions"]),
            first_line(of.get("description", "")),
        )
        for one in known
        for of in one["vulns"]
    ]


def first_line(text: str) -> str:
    """The first line that says something, without Markdown's marks."""
    return next((line.strip("# ") for line in text.splitlines() if line.strip("# ")), "")


def advisories(path: Path) -> Iterator[dict[str, Any]]:
    """The records of an export of OSV."""
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            if name.endswith(".json"):
                yield json.loads(archive.read(name))


def looked_up(
    records: Iterable[Mapping[str, Any]], installed: Mapping[str, str]
) -> list[Vulnerability]:
    """Which advisories are about what is installed: versions by canonical name."""
    found = []
    for record in records:
        for affected in () if "withdrawn" in record else record.get("affected", ()):
            package = affected.get("package", {})
            name = canonicalize_name(package.get("name", ""))
            if package.get("ecosystem") != "PyPI" or name not in installed:
                continue
            version = installed[name]
            if is_affected(affected, version):
                summary = record.get("summary") or first_line(record.get("details", ""))
                fixed = ", ".join(dict.fromkeys(_events(affected, "fixed")))
                found.append(Vulnerability(name, version, record["id"], fixed, summary))
    return found


def is_affected(affected: Mapping[str, Any], installed: str) -> bool:
    """Whether a version is listed, or lies in a range; as OSV's schema evaluates them."""
    version = Version(installed)
    if any(_version(one) == version for one in affected.get("versions", [])):
        return True
    for of in affected.get("ranges", []):
        inside = False
        events = [item for event in of["events"] for item in event.items()]
        if of["type"] == "ECOSYSTEM":
            for kind, text in sorted(events, key=lambda item: _version(item[1])):
                at = _version(text)
                if kind == "introduced" and version >= at:
                    inside = True
                elif (kind == "fixed" and version >= at) or (
                    kind == "last_affected" and version > at
                ):
                    inside = False
        if inside:
            return True
    return False


def _events(affected: Mapping[str, Any], kind: str) -> Iterator[str]:
    for of in affected.get("ranges", []):
        if of["type"] == "ECOSYSTEM":
            yield from (event[kind] for event in of["events"] if kind in event)


def _version(text: str) -> Version:
    try:
        return Version(text)
    except InvalidVersion:  # of long ago; before all that count
        return Version("0.dev0")


def report(found: Iterable[Vulnerability], source: str, document: Mapping[str, Any]) -> str:
    """The vulnerabilities as Markdown, and who was asked."""
    scopes = {canonicalize_name(one["name"]): one["scope"] for one in document["components"]}
    lines = ["# Known vulnerabilities", "", f"Asked: {source}.", ""]
    rows = [
        f"| {one.package} | {one.version} | {scopes.get(canonicalize_name(one.package), '')} "
        f"| {one.name} | {one.fixed or 'none'} | {one.summary.replace('|', '/')} |"
        for one in sorted(found)
    ]
    head = ["| package | version | scope | advisory | fixed in | what |", "|" + " --- |" * 6]
    return "\n".join([*lines, *([*head, *rows] if rows else ["None."]), ""])


def main() -> int:
    """Write the three files; 1 for bad news."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--advisories", type=Path)
    wanted = parser.parse_args()
    wanted.folder.mkdir(parents=True, exist_ok=True)
    document = bill_of_materials()
    write(wanted.folder / "sbom.json", json.dumps(document, indent=2) + "\n")
    write(wanted.folder / "licences.md", licences(document))
    installed = {canonicalize_name(one["name"]): one["version"] for one in document["components"]}
    try:
        if wanted.advisories:
            source = f"OSV's advisories in {wanted.advisories.name}"
            found = looked_up(advisories(wanted.advisories), installed)
        else:
            source, found = "PyPI, by pip-audit", asked()
    except Unreachable as error:
        print(f"Vulnerabilities are not audited. {error}.", file=sys.stderr)
        print("Give an export of OSV's advisories: make audit ADVISORIES=all.zip", file=sys.stderr)
        (wanted.folder / "vulnerabilities.md").unlink(missing_ok=True)
        return 1
    write(wanted.folder / "vulnerabilities.md", report(found, source, document))
    print(f"{len(found)} known vulnerabilities in {len(installed)} packages ({source})")
    return 1 if found else 0


def write(path: Path, text: str) -> None:
    """Write a file and say so."""
    path.write_text(text, encoding="utf-8")
    print(path)


if __name__ == "__main__":
    sys.exit(main())
