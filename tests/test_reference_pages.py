"""The pages of all keys and all commands are the program's, and nothing is missing in them."""

import re
from collections.abc import Iterator
from typing import Any

import pytest
import rigs
from typer.main import get_command

from tools.reference import PAGES
from twin.cli.config import json_schema, sections
from twin.cli.main import app
from twin.config import TABLES

DOCS = rigs.ROOT / "docs"


def page(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_the_programs(name: str) -> None:
    assert page(name) == PAGES[name](), "run python tools/reference.py"


def test_every_table_has_its_settings() -> None:
    assert set(sections()) == TABLES


def reachable(schema: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Each table of the schema with each of its keys, however deep it lies."""
    for name, table in schema["$defs"].items():
        yield from ((name, key) for key in table.get("properties", {}))


def test_every_key_is_on_the_page_with_what_it_is() -> None:
    rows = re.findall(r"^\| `([a-z0-9_]+)` \|(.*)\|$", page("configuration.md"), re.MULTILINE)
    by_key: dict[str, int] = {}
    for key, rest in rows:
        by_key[key] = by_key.get(key, 0) + 1
        default, _, what = (cell.strip() for cell in rest.replace("\\|", "/").split("|"))
        assert default, key
        assert what, f"{key}: say beside the key in the sources what it is"
    in_schema: dict[str, int] = {}
    for _, key in reachable(json_schema()):
        in_schema[key] = in_schema.get(key, 0) + 1
    assert len(in_schema) > 200
    assert {key for key, count in in_schema.items() if by_key.get(key, 0) < count} == set()


def test_every_command_and_option_is_on_the_page() -> None:
    text = page("commands.md")
    count = 0
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        for below, subcommand in getattr(command, "commands", {"": command}).items():
            title = f"twin {name} {below}".strip()
            match = re.search(rf"^##+ {title}\n(.*?)(?=^##|\Z)", text, re.DOTALL | re.MULTILINE)
            assert match is not None, title
            shown = (it for it in subcommand.params if not getattr(it, "hidden", False))
            for option in shown:
                count += 1
                names = option.opts if option.param_type_name == "option" else [option.metavar]
                assert all(str(it).replace("|", r"\|") in match[1] for it in names if it), title
    assert count > 150
