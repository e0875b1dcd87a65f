"""What the documents point to is there: files, names in them, links, commands, keys, targets."""

import ast
import json
import re
import shlex
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, get_args

import pytest
import rigs
from pydantic.fields import FieldInfo
from typer import BadParameter
from typer.main import get_command

from drivers.modbus import hil as hil_modbus
from drivers.modbus.settings import ModbusSettings
from drivers.opcua.hil_settings import HilSettings as OpcuaHilSettings
from drivers.opcua.settings import OpcuaSettings
from drivers.outputs.settings import ResultsSettings
from drivers.plc.settings import PlcSettings
from twin.alarms.settings import AlarmSettings
from twin.assets.database_url import AssetsSettings
from twin.cli.main import app
from twin.config import TABLES, Asset, LogSettings
from twin.errors import ConfigError
from twin.figures.settings import FigureSettings
from twin.model.dataset import DataSet
from twin.monitor.settings import MonitorSettings
from twin.notifications.settings import (
    MqttSettings,
    NotificationSettings,
    OutletsSettings,
    WebhookSettings,
)
from twin.page.settings import PageSettings
from twin.settings import Document, Settings
from twin.tables.settings import ImportSettings

ROOT = rigs.ROOT
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *DOCS.rglob("*.md")]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
# Folders that the sources lie in: what begins with one of them is a file of ours.
OURS = {"twin", "drivers", "tests", "tools", "configs", "docs", ".ci"}
OF_OTHERS = {"--no-nanny", "--without"}
USAGE_ERROR = BadParameter.__mro__[1]  # which typer hands out under no name of its own
TARGET = re.compile(r"^([a-z]+):", re.MULTILINE)
FENCE = re.compile(r"^```([\w{}-]*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)|!\[[^\]]*\]\(([^)\s]+)\)")


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def prose(name: str) -> str:
    """A page without its code blocks."""
    return FENCE.sub("", text_of(name))


def spans(name: str) -> list[str]:
    """What stands between single backticks in a page, in one line."""
    return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose(name))]


def blocks(name: str, *languages: str) -> list[str]:
    return [code for language, code in FENCE.findall(text_of(name)) if language in languages]


@cache
def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text("utf-8")), re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        found.add(re.sub(r"[^\w\- ]", "", plain).replace(" ", "-"))
    return found


@pytest.mark.parametrize("name", NAMES)
def test_links_and_anchors_lead_somewhere(name: str) -> None:
    for match in LINK.finditer(prose(name)):
        target, _, anchor = (match[1] or match[2]).partition("#")
        if target.startswith(("http://", "https://")):
            continue
        page = (ROOT / name).parent / target if target else ROOT / name
        assert page.exists(), match[0]
        if anchor:
            assert anchor in anchors(page.resolve()), match[0]


def files(name: str) -> Iterator[tuple[str, str]]:
    """Files that a page names, with the name in them that it says is there."""
    for span in [*spans(name), *re.findall(r"\((\w+/[\w./]+)[,) ]", prose(name))]:
        path, _, inside = span.partition(":")
        if re.fullmatch(r"[\w.-]+(/[\w.*-]+)+/?", path) and path.split("/")[0] in OURS:
            yield path, inside


@pytest.mark.parametrize("name", NAMES)
def test_files_and_what_is_in_them_are_there(name: str) -> None:
    for path, inside in files(name):
        assert (ROOT / path).exists() or list(ROOT.glob(f"{path}*")), path
        if inside:
            assert inside in top_names(path), f"{path}:{inside}"


@cache
def top_names(path: str) -> set[str]:
    """What a module defines at its top."""
    found: set[str] = set()
    for node in ast.parse(text_of(path)).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return found


def test_a_name_that_is_said_to_stand_in_a_file_is_defined_there() -> None:
    """``NAME`` in `path/of/file.py`, in words."""
    said = r"`([A-Za-z_]\w+)`\s+(?:in|of)\s+`((?:twin|drivers|tools|tests)/[\w/]+\.py)`"
    pairs = [(name, *pair) for name in NAMES for pair in re.findall(said, prose(name))]
    assert pairs
    assert [pair for pair in pairs if pair[1] not in top_names(pair[2])] == []


def test_every_picture_has_a_maker() -> None:
    table = re.findall(r"^\| (`.*?) \|", text_of("CONTRIBUTING.md"), re.MULTILINE)
    named = {name for row in table for name in re.findall(r"`([\w-]+\.(?:png|svg))`", row)}
    assert named == {path.name for path in (DOCS / "pictures").iterdir()}


# --- command lines --------------------------------------------------------------------------------


def lines(name: str) -> Iterator[str]:
    """Lines of a page's shell examples, those that go on made one; the comment taken off."""
    for code in blocks(name, "sh", ""):
        yield from re.sub(r"\\\n\s*", "", code).splitlines()


def twin_lines(name: str) -> Iterator[tuple[str, bool]]:
    """Command lines of ``twin`` in a page; whether they are whole."""
    for line in lines(name):
        for part in line.split("&&"):
            if match := re.match(r"\s*(?:\.venv/bin/)?twin (.*)", part):
                yield match[1], not re.search(r" {3,}", match[1].strip())
    for span in spans(name):
        if match := re.match(r"(?:\.venv/bin/)?twin ([a-z].*)", span):
            yield match[1], False


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name != "CHANGELOG.md"])
def test_command_lines_are_those_of_the_program(name: str) -> None:
    for line, whole in twin_lines(name):
        check_line(line, whole)


def check_line(line: str, whole: bool) -> None:
    """A command, its options and its arguments are known; none that is needed is missing."""
    said = re.split(r" {3,}| > ", line.strip())[0]
    words = [word.strip("[]") for word in shlex.split(said, comments=True)]
    command = get_command(app)
    while hasattr(command, "commands") and words:
        assert words[0] in command.commands, f"twin {line}"
        command = command.commands[words.pop(0)]
    if hasattr(command, "commands"):
        return
    context = command.context_class(command, resilient_parsing=True)
    try:
        given, left, _ = command.make_parser(context).parse_args(words)
    except USAGE_ERROR as error:
        if "requires an argument" in str(error) and not whole:
            return
        raise AssertionError(f"twin {line}: {error}") from error
    assert left == [], f"twin {line}: too many arguments"
    if whole and "--help" not in words:
        needed = [parameter for parameter in command.params if parameter.required]
        assert [
            parameter.name for parameter in needed if not given.get(parameter.name or "")
        ] == [], f"twin {line}"


@pytest.mark.parametrize("name", NAMES)
def test_tools_and_targets_are_there(name: str) -> None:
    targets = set(TARGET.findall(text_of("Makefile")))
    for line in (*lines(name), *spans(name)):
        for target in re.findall(r"\bmake ([a-z]+)\b(?! it| sure)", line.partition("#")[0]):
            assert target in targets, line
        for path, options in re.findall(r"\b(tools/\w+\.py)([^#`]*)", line):
            source = text_of(path)
            for option in re.findall(r"(--[a-z-]+)", options):
                known = f'"{option}"' in source or option == "--help"
                assert known or ('f"--{' in source), f"{path} has no {option}"


# --- configurations -------------------------------------------------------------------------------

TABLES_OF: dict[str, type[Settings]] = {
    "alarms": AlarmSettings,
    "asset": Asset,
    "assets": AssetsSettings,
    "figures": FigureSettings,
    "import": ImportSettings,
    "log": LogSettings,
    "monitor": MonitorSettings,
    "mqtt": MqttSettings,
    "notifications": NotificationSettings,
    "outlets": OutletsSettings,
    "page": PageSettings,
    "plc": PlcSettings,
    "results": ResultsSettings,
    "webhook": WebhookSettings,
}
OF_A_PACKAGE = "docs/write-a-driver.md"  # its tables are in tests/test_installed_drivers.py
SNIPPETS = [(name, code) for name in NAMES if name != OF_A_PACKAGE for code in blocks(name, "toml")]


def settings_of(table: str, given: dict[str, Any]) -> type[Settings]:
    """The class that takes a table."""
    if table == "driver":
        return {"modbus": ModbusSettings, "opcua": OpcuaSettings}[given.get("kind", "modbus")]
    if table == "hil":
        over_opcua = "node" in given["tags"]["pressure"]
        return OpcuaHilSettings if over_opcua else hil_modbus.HilSettings
    return TABLES_OF[table]


def test_every_table_of_a_configuration_is_known_here() -> None:
    assert {*TABLES_OF, "driver", "hil", "data"} == set(TABLES)


@pytest.mark.parametrize(("name", "code"), SNIPPETS, ids=[name for name, _ in SNIPPETS])
def test_configurations_load(name: str, code: str) -> None:
    load(Document.parse(code, name))
    with suppress_clashes():
        load(Document.parse(switched_on(code), name))


@contextmanager
def suppress_clashes() -> Iterator[None]:
    """Two ways that exclude each other are no mistake; a key that is not known is one."""
    try:
        yield
    except ConfigError as error:
        if "unknown key" in str(error):
            raise


def load(document: Document) -> None:
    """Have every table checked by the part of the program that takes it."""
    for table, given in document.tables.items():
        if table == "data":
            document.section(DataSet, "data")
        else:
            document.section(settings_of(table, given), table)


def switched_on(code: str) -> str:
    """A snippet with the settings that stand in it as comments, as far as they do not clash."""
    kept: list[str] = []
    for line in code.splitlines():
        match = re.match(r"# ([\[\w].*(?:=|\]).*)", line)
        candidate = [*kept, match[1] if match else line]
        try:
            tomllib.loads("\n".join(candidate))
        except tomllib.TOMLDecodeError:
            candidate = [*kept, line]
        kept = candidate
    return "\n".join(kept)


# --- keys -----------------------------------------------------------------------------------------

KEY_TABLES = {"docs/connect-your-plc.md": ModbusSettings, "docs/opcua.md": OpcuaSettings}
KEY_ROW = re.compile(r"^\| `([\w.]+)` \| ([^|]*?) \|[^|]+\|$", re.MULTILINE)


def keys_of(table: type[Settings], below: str = "", seen: set[type] | None = None) -> Any:
    """Each key of a table and of the tables in it, dotted, with its default as a page writes it.

    Of several tables of one kind only the first is told key by key.
    """
    seen = set() if seen is None else seen
    for key, field in table.model_fields.items():
        inner = tables_in(field.annotation)
        if inner is None or inner in seen:
            yield below + key, written(field)
        else:
            seen.add(inner)
            yield from keys_of(inner, f"{below}{key}.", seen)


def tables_in(annotation: Any) -> type[Settings] | None:
    """The settings class that a key takes, if it takes one."""
    for kind in (annotation, *get_args(annotation)):
        if isinstance(kind, type) and issubclass(kind, Settings):
            return kind
    return None


def written(field: FieldInfo) -> str:
    """A default as it stands in a page."""
    if field.is_required():
        return "required"
    if field.default is None or field.default == "" or isinstance(field.default, Settings):
        return "–"
    if isinstance(field.default, int | float):
        return f"{field.default:g}"
    return f'`"{str(field.default).partition(" ")[0]}"`'  # an address is told in two ways


@pytest.mark.parametrize("page", KEY_TABLES)
def test_a_page_has_every_key_of_the_driver_with_its_default(page: str) -> None:
    table = text_of(page).partition("<!-- keys of [driver] -->")[2].partition("<!-- end -->")[0]
    assert dict(KEY_ROW.findall(table)) == dict(keys_of(KEY_TABLES[page]))


@pytest.mark.parametrize(
    ("page", "table"),
    [
        ("docs/opcua.md", ResultsSettings),
        ("docs/alarms.md", AlarmSettings),
        ("docs/csv.md", ImportSettings),
        ("docs/key-figures.md", FigureSettings),
        ("docs/live-fleet.md docs/outlets.md", MqttSettings),
        ("docs/live-fleet.md docs/outlets.md", OutletsSettings),
        ("docs/outlets.md", WebhookSettings),
        ("docs/outlets.md", NotificationSettings),
        ("docs/hil.md docs/connect-your-plc.md", hil_modbus.HilSettings),
        ("docs/hil.md docs/opcua.md", OpcuaHilSettings),
        ("docs/page.md", PageSettings),
    ],
    ids=lambda one: one if isinstance(one, str) else one.__name__,
)
def test_pages_name_every_key_of_a_table(page: str, table: type[Settings]) -> None:
    code = [part for name in page.split() for part in (*spans(name), *blocks(name, "toml"))]
    words = set(re.findall(r"\w+", " ".join(code)))
    assert {key for path, _ in keys_of(table) for key in path.split(".")} - words == set()


def test_options_that_are_named_alone_are_those_of_a_command_or_a_tool() -> None:
    known = set(options_of(get_command(app))) | {"--help", "--version"}
    for tool in (ROOT / "tools").glob("*.py"):
        known |= set(re.findall(r"(?<=\")--[a-z-]+", tool.read_text(encoding="utf-8")))
    for name in NAMES:
        for span in spans(name):
            if match := re.match(r"(--[a-z][a-z-]+)", span):
                assert match[1] in known | OF_OTHERS, f"{name}: {span}"


def options_of(command: Any) -> Iterator[str]:
    for below in getattr(command, "commands", {}).values():
        yield from options_of(below)
    for parameter in command.params:
        yield from (*parameter.opts, *parameter.secondary_opts)


# --- the rest -------------------------------------------------------------------------------------


def test_documents_that_the_sources_name_are_there() -> None:
    for folder in ("twin", "drivers", "tools", "tests", "configs"):
        for path in (ROOT / folder).rglob("*.*"):
            if path.suffix in (".py", ".toml"):
                for said in re.findall(r"\bdocs/[\w/-]+(?:\.md)?", path.read_text("utf-8")):
                    assert (ROOT / said).exists() or list(ROOT.glob(f"{said}*")), f"{path}: {said}"


@pytest.mark.parametrize("name", NAMES)
def test_decisions_go_by_their_numbers(name: str) -> None:
    for number, file in re.findall(r"decision (\d+)\]\([\w/]*?(\d{4})-", text_of(name)):
        assert int(number) == int(file), name
    if match := re.match(r"docs/decisions/(\d{4})-", name):
        assert text_of(name).startswith(f"# {int(match[1])}. ")


@pytest.mark.parametrize("name", NAMES)
def test_json_examples_are_json(name: str) -> None:
    for code in blocks(name, "json"):
        json.loads(code)


def test_the_readme_says_what_each_package_is_for() -> None:
    packages = {path.parent.relative_to(ROOT) for path in ROOT.glob("twin/*/__init__.py")}
    told = set(re.findall(r"`(twin/\w+)/`", text_of("README.md")))
    assert {str(package) for package in packages} == told
