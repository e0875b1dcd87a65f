"""What ``make audit`` says of packages, licences and known vulnerabilities."""

import json
import zipfile
from pathlib import Path
from typing import Any

import pytest

from tools import audit

NEEDS = {
    "mid": ["Leaf.Package>=1", "rich; extra == 'colours'", "windows-only; sys_platform == 'win32'"],
    "leaf-package": ["mid"],  # in a circle
    "extra-only": ["mid[colours]"],
}


def component(name: str, version: str = "1.0", **more: Any) -> dict[str, Any]:
    return {"name": name, "version": version, **more}


def advisory(name: str = "mid", **affected: Any) -> dict[str, Any]:
    package = {"ecosystem": "PyPI", "name": name}
    return {"id": "GHSA-1", "summary": "bad", "affected": [{"package": package, **affected}]}


def between(*events: dict[str, str]) -> dict[str, Any]:
    return {"ranges": [{"type": "ECOSYSTEM", "events": list(events)}]}


def test_a_component_is_in_the_scope_of_whoever_needs_it() -> None:
    names = ("Mid", "leaf_package", "rich", "extra-only", "windows-only", "pytest")
    document = {"components": [component(name) for name in names]}
    audit.scoped(document, ["mid>=1"], ["extra-only"], lambda name: NEEDS.get(name, []))
    scopes = {component["name"]: component["scope"] for component in document["components"]}
    assert [name for name in names if scopes[name] == "required"] == ["Mid", "leaf_package"]
    assert [name for name in names if scopes[name] == "optional"] == ["rich", "extra-only"]


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ([{"expression": "MIT OR Apache-2.0"}], "MIT OR Apache-2.0"),
        ([{"license": {"name": "License :: OSI Approved :: BSD License"}}], "BSD License"),
        ([{"license": {"name": "a text"}}, {"license": {"id": "LGPL-3.0-only"}}], "LGPL-3.0-only"),
        ([], audit.UNSTATED),
    ],
)
def test_a_licence_is_what_a_component_states(stated: list[Any], said: str) -> None:
    one = component("a", licenses=stated, scope="required")
    assert audit.licence(one) == said
    assert f"| a | 1.0 | {said} |" in audit.licences({"components": [one]})


@pytest.mark.parametrize(
    ("affected", "versions"),
    [
        (between({"introduced": "0"}, {"fixed": "1.5"}), ["1.0", "1.4.9", "1.5rc1"]),
        (between({"introduced": "1.4"}, {"last_affected": "2"}), ["1.4.9", "1.5rc1", "1.5", "2.0"]),
        (
            between({"fixed": "2.0"}, {"introduced": "1.5"}, {"introduced": "0"}, {"fixed": "1.2"}),
            ["1.0", "1.5"],
        ),
        ({"versions": ["1.4.9", "2.0.0", "1.0-old-style"]}, ["1.4.9", "2.0"]),
        ({"ranges": [{"type": "GIT", "events": [{"introduced": "0"}]}]}, []),
    ],
)
def test_an_advisory_holds_for_the_versions_that_it_says(
    affected: dict[str, Any], versions: list[str]
) -> None:
    every = ("1.0", "1.4.9", "1.5rc1", "1.5", "2.0", "3.0")
    found = [
        version
        for version in every
        if audit.matching_advisories([advisory(**affected)], {"mid": version})
    ]
    assert found == versions


def test_others_and_withdrawn_ones_do_not_count() -> None:
    everything = between({"introduced": "0"})
    withdrawn = advisory(**everything) | {"withdrawn": "2026-01-01T00:00:00Z"}
    crates = advisory(**everything)
    crates["affected"][0]["package"]["ecosystem"] = "crates.io"
    records = [withdrawn, crates, advisory("other", **everything)]
    assert audit.matching_advisories(records, {"mid": "1.0"}) == []


def test_an_export_of_advisories_is_read_and_told(tmp_path: Path) -> None:
    affected = between({"introduced": "0"}, {"fixed": "1.5"})
    with zipfile.ZipFile(tmp_path / "all.zip", "w") as archive:
        archive.writestr("GHSA-1.json", json.dumps(advisory("Mid", **affected)))
    found = audit.matching_advisories(audit.advisories(tmp_path / "all.zip"), {"mid": "1.0"})
    assert found == [audit.Vulnerability("mid", "1.0", "GHSA-1", "1.5", "bad")]
    document = {"components": [component("Mid", scope="optional")]}
    told = audit.report(found, "OSV's advisories in all.zip", document)
    assert "| mid | 1.0 | optional | GHSA-1 | 1.5 | bad |" in told
    assert "Asked: OSV's advisories in all.zip." in told
    assert "None." in audit.report([], "PyPI, by pip-audit", document)


def test_what_comes_of_npm_is_listed_with_its_licence_and_as_not_asked_about() -> None:
    document = {"components": audit.npm_components()}
    assert [entry["name"] for entry in document["components"]] == ["uplot"]
    optional = audit.licences(document).partition("## Optional")[2]
    assert "| uplot | 1.6.32 | MIT |" in optional
    assert "Not asked: npm, about uplot" in audit.report([], "PyPI, by pip-audit", document)


def test_no_answer_is_not_taken_for_a_good_one() -> None:
    vulnerable = {"id": "PYSEC-1", "fix_versions": ["2.0"], "description": "\n### Summary\nmore"}
    mid = {"name": "mid", "version": "1.0", "vulns": [vulnerable]}
    ours = {"name": "ejector-twin", "skip_reason": "not found on PyPI"}
    found = audit.Vulnerability("mid", "1.0", "PYSEC-1", "2.0", "Summary")
    assert audit.vulnerabilities_in([mid, ours]) == [found]
    with pytest.raises(audit.Unreachable, match="about 1 packages: other"):
        audit.vulnerabilities_in([mid, ours, ours | {"name": "other"}])
