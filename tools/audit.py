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
NPM_LOCK = ROOT / "twin" / "page" / "package-lock.json"
NPM = "pkg:npm/"
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
    """No source of vulnerabilities could be reached."""


# --- what is installed --------------------------------------------------------------------------


def bill_of_materials() -> dict[str, Any]:
    """The CycloneDX document of this environment, each component with its scope."""
    command = [TOOLS / "cyclonedx-py", "environment", sys.executable, "--output-reproducible"]
    project = ["--pyproject", ROOT / "pyproject.toml"]
    process = subprocess.run([*command, *project], check=True, capture_output=True)
    document: dict[str, Any] = json.loads(process.stdout)
    tables = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [
        requirement for group in tables["optional-dependencies"].values() for requirement in group
    ]
    scoped(document, tables["dependencies"], extras, needs_of)
    document["components"] += npm_components()
    return document


def npm_components() -> list[dict[str, Any]]:
    """What a wheel has of npm's packages, by the lock file: the page's, of the extra ``serve``."""
    packages = json.loads(NPM_LOCK.read_text(encoding="utf-8"))["packages"]
    return [
        {
            "type": "library",
            "bom-ref": f"{NPM}{name}@{package['version']}",
            "name": name,
            "version": package["version"],
            "purl": f"{NPM}{name}@{package['version']}",
            "licenses": [{"license": {"id": package["license"]}}],
            "scope": "optional",
        }
        for path, package in packages.items()
        if (name := path.removeprefix("node_modules/"))
    ]


def scoped(
    document: dict[str, Any], base: Iterable[str], extras: Iterable[str], needs: Needs
) -> None:
    """Write each component's scope: reached from the base, from an extra, or from neither."""
    required, optional = reached(base, needs), reached(extras, needs)
    for component in document["components"]:
        name = canonicalize_name(component["name"])
        is_optional = "optional" if name in optional else "excluded"
        component["scope"] = "required" if name in required else is_optional


def reached(requirements: Iterable[str], needs: Needs) -> set[str]:
    """Packages that these require, directly or not, in this environment and with these extras."""
    waiting, seen = (
        [Requirement(requirement) for requirement in requirements],
        set[tuple[str, str]](),
    )
    while waiting:
        needed = waiting.pop()
        name = canonicalize_name(needed.name)
        for extra in {"", *needed.extras} - {extra for package, extra in seen if package == name}:
            seen.add((name, extra))
            waiting += [
                requirement
                for requirement in map(Requirement, needs(name))
                if requirement.marker is None or requirement.marker.evaluate({"extra": extra})
            ]
    return {name for name, _ in seen}


def needs_of(name: str) -> list[str]:
    """Requirements of an installed package; empty if it is not installed."""
    try:
        return requires(name) or []
    except PackageNotFoundError:
        return []


def licence(component: Mapping[str, Any]) -> str:
    """The stated licence of a component: SPDX before classifiers before names."""
    stated = component.get("licenses", [])
    expressions = [entry["expression"] for entry in stated if "expression" in entry]
    entries = [entry["license"] for entry in stated if "license" in entry]
    spdx = [entry["id"] for entry in entries if "id" in entry]
    classifiers = [entry["name"].rpartition(" :: ")[2] for entry in entries if "name" in entry]
    return "; ".join(expressions or spdx or classifiers) or UNSTATED


def licences(document: Mapping[str, Any]) -> str:
    """The licence list as Markdown, by scope."""
    lines = ["# Licences", ""]
    for scope, description in SCOPES.items():
        lines += [f"## {scope.capitalize()}: {description}", "", "| package | version | licence |"]
        lines += ["| --- | --- | --- |"]
        lines += [
            f"| {component['name']} | {component['version']} |"
            f" {licence(component).replace('|', '/')} |"
            for component in sorted(
                document["components"], key=lambda component: component["name"].lower()
            )
            if component["scope"] == scope
        ]
        lines.append("")
    return "\n".join(lines)


# --- what is wrong with it ----------------------------------------------------------------------


def query_pypi() -> list[Vulnerability]:
    """Vulnerabilities by pip-audit from PyPI; raises Unreachable without an answer."""
    options = ["--path", sysconfig.get_path("purelib"), "--format", "json", "--desc", "on"]
    command = [TOOLS / "pip-audit", *options, "--progress-spinner", "off"]
    process = subprocess.run(command, check=False, capture_output=True, text=True)
    try:
        packages = json.loads(process.stdout)["dependencies"]
    except (ValueError, KeyError):
        raise Unreachable(f"pip-audit: {process.stderr.strip()[-300:]}") from None
    return vulnerabilities_in(packages)


def vulnerabilities_in(packages: Iterable[Mapping[str, Any]]) -> list[Vulnerability]:
    """Vulnerabilities in pip-audit's answer; Unreachable if it skipped a package of others."""
    checked, skipped = [], []
    for package in packages:
        (skipped if "skip_reason" in package else checked).append(package)
    unasked = sorted({package["name"] for package in skipped} - {"ejector-twin"})
    if unasked:
        names = ", ".join(unasked[:3])
        raise Unreachable(f"pip-audit could not ask PyPI about {len(unasked)} packages: {names} …")
    return [
        Vulnerability(
            package["name"],
            package["version"],
            vulnerability["id"],
            ", ".join(vulnerability["fix_versions"]),
            first_line(vulnerability.get("description", "")),
        )
        for package in checked
        for vulnerability in package["vulns"]
    ]


def first_line(text: str) -> str:
    """The first line that is not empty, without Markdown's marks."""
    return next((line.strip("# ") for line in text.splitlines() if line.strip("# ")), "")


def advisories(path: Path) -> Iterator[dict[str, Any]]:
    """The records of an export of OSV."""
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            if name.endswith(".json"):
                yield json.loads(archive.read(name))


def matching_advisories(
    records: Iterable[Mapping[str, Any]], installed: Mapping[str, str]
) -> list[Vulnerability]:
    """Advisories that affect the ``installed`` versions, by canonical name."""
    vulnerabilities = []
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
                vulnerabilities.append(Vulnerability(name, version, record["id"], fixed, summary))
    return vulnerabilities


def is_affected(affected: Mapping[str, Any], installed: str) -> bool:
    """Whether a version is listed, or lies in a range; as OSV's schema evaluates them."""
    version = Version(installed)
    if any(_version(listed) == version for listed in affected.get("versions", [])):
        return True
    for version_range in affected.get("ranges", []):
        inside = False
        events = [item for event in version_range["events"] for item in event.items()]
        if version_range["type"] == "ECOSYSTEM":
            for kind, text in sorted(events, key=lambda item: _version(item[1])):
                bound = _version(text)
                if kind == "introduced" and version >= bound:
                    inside = True
                elif (kind == "fixed" and version >= bound) or (
                    kind == "last_affected" and version > bound
                ):
                    inside = False
        if inside:
            return True
    return False


def _events(affected: Mapping[str, Any], kind: str) -> Iterator[str]:
    for version_range in affected.get("ranges", []):
        if version_range["type"] == "ECOSYSTEM":
            yield from (event[kind] for event in version_range["events"] if kind in event)


def _version(text: str) -> Version:
    try:
        return Version(text)
    except InvalidVersion:  # old versions; they sort before all others
        return Version("0.dev0")


def is_npm(component: Mapping[str, Any]) -> bool:
    """Whether a component is a package of npm."""
    return str(component.get("purl", "")).startswith(NPM)


def report(
    vulnerabilities: Iterable[Vulnerability], source: str, document: Mapping[str, Any]
) -> str:
    """The vulnerabilities as Markdown, with their source."""
    scopes = {canonicalize_name(entry["name"]): entry["scope"] for entry in document["components"]}
    lines = ["# Known vulnerabilities", "", f"Asked: {source}.", ""]
    if unasked := sorted(entry["name"] for entry in document["components"] if is_npm(entry)):
        lines += [f"Not asked: npm, about {', '.join(unasked)}; `npm audit` in twin/page does.", ""]
    rows = [
        f"| {entry.package} | {entry.version} | {scopes.get(canonicalize_name(entry.package), '')} "
        f"| {entry.name} | {entry.fixed or 'none'} | {entry.summary.replace('|', '/')} |"
        for entry in sorted(vulnerabilities)
    ]
    head = ["| package | version | scope | advisory | fixed in | what |", "|" + " --- |" * 6]
    return "\n".join([*lines, *([*head, *rows] if rows else ["None."]), ""])


def main() -> int:
    """Write the three files; 1 if something is vulnerable or unknown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--advisories", type=Path)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    document = bill_of_materials()
    write(arguments.folder / "sbom.json", json.dumps(document, indent=2) + "\n")
    write(arguments.folder / "licences.md", licences(document))
    installed = {
        canonicalize_name(component["name"]): component["version"]
        for component in document["components"]
        if not is_npm(component)
    }
    try:
        if arguments.advisories:
            source = f"OSV's advisories in {arguments.advisories.name}"
            vulnerabilities = matching_advisories(advisories(arguments.advisories), installed)
        else:
            source, vulnerabilities = "PyPI, by pip-audit", query_pypi()
    except Unreachable as error:
        print(f"Vulnerabilities are not audited. {error}.", file=sys.stderr)
        print("Give an export of OSV's advisories: make audit ADVISORIES=all.zip", file=sys.stderr)
        (arguments.folder / "vulnerabilities.md").unlink(missing_ok=True)
        return 1
    write(arguments.folder / "vulnerabilities.md", report(vulnerabilities, source, document))
    print(f"{len(vulnerabilities)} known vulnerabilities in {len(installed)} packages ({source})")
    return 1 if vulnerabilities else 0


def write(path: Path, text: str) -> None:
    """Write a file and print its path."""
    path.write_text(text, encoding="utf-8")
    print(path)


if __name__ == "__main__":
    sys.exit(main())
