"""Write docs/configuration.md and docs/commands.md anew: all keys and all commands, from the code.

What is said of a key is the comment beside it; what is said of a command is its help.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema
from typer.main import get_command

from twin.cli.config import sections
from twin.cli.main import app
from twin.keys import UNWRITTEN, comments_of, defaults_of, tables_below
from twin.validation import models_at

DOCS = Path(__file__).parent.parent / "docs"
# The unit that a key's name ends with, longest first.
UNITS = {
    "_mbar_s": "mbar/s",
    "_sl_min": "sl/min",
    "_kwh_m3": "kWh/m³",
    "_mbar": "mbar",
    "_sigma": "sigma",
    "_hours": "h",
    "_days": "days",
    "_bar": "bar",
    "_cm2": "cm²",
    "_min": "min",
    "_pct": "%",
    "_ms": "ms",
    "_mm": "mm",
    "_m2": "m²",
    "_ml": "ml",
    "_mb": "MB",
    "_gb": "GB",
    "_s": "s",
    "_m": "m",
    "_c": "°C",
}
BOUNDS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
KINDS = {
    "number": "number",
    "integer": "whole number",
    "boolean": "true or false",
    "array": "list",
    "object": "table",
    "path": "path",
    "string": "text",
    "null": "",
    "": "",
}

CONFIGURATION = """# All keys of a configuration

Made from the program by `python tools/reference.py`.
`twin config check FILE` names all mistakes of a configuration at once.
`twin config schema > twin.schema.json` makes a JSON Schema of these tables. An editor that knows
TOML schemas (Taplo, Even Better TOML) then completes and checks keys, if the first line of a
configuration is `#:schema ./twin.schema.json`. `twin init` makes a configuration that begins so.

Every table and key may be left out, unless it is *required*.
"""
COMMANDS = """# All commands

Made from the program by `python tools/reference.py`. `twin COMMAND --help` says the same.
Results go to stdout, messages to stderr. Exit codes: 0 done, 1 bad news where an option asks for
it, 2 usage or configuration, 3 a source or file could not be read, 130 interrupted.
"""


def configuration() -> str:
    """The reference of all keys, table by table."""
    parts = [CONFIGURATION]
    for name, by_kind in sections().items():
        for kind, settings in by_kind.items():
            title = f"## [{name}]" + (f', kind = "{kind}"' if kind else "")
            parts.append(f"{title}\n\n{_summary(settings)}\n")
            parts += _tables(settings, name)
    return "\n".join(parts)


def _tables(settings: type[BaseModel], name: str) -> Iterator[str]:
    """Each kind of table below one of the configuration, with the paths that may have it."""
    paths_by_kind: dict[type[BaseModel], list[str]] = {}
    for path, kind in tables_below(settings, (name,)):
        paths_by_kind.setdefault(kind, []).append(".".join(path))
    for kind, paths in paths_by_kind.items():
        if paths != [name]:
            yield f"### {', '.join(f'`{_written(path)}`' for path in paths)}\n\n{_summary(kind)}\n"
        yield _rows(kind) + "\n"


def _written(path: str) -> str:
    return f"[[{path.removesuffix('[]')}]]" if path.endswith("[]") else f"[{path}]"


def _summary(kind: type[BaseModel]) -> str:
    return " ".join((kind.__doc__ or "").split()).replace("``", "`")


def _rows(kind: type[BaseModel]) -> str:
    _, schema = models_json_schema([(kind, "validation")])
    definitions = schema["$defs"]
    properties = definitions[_name_of(kind, definitions)]["properties"]
    comments = comments_of(kind)
    lines = ["| key | default | unit, range | what |", "| --- | --- | --- | --- |"]
    for key, value_schema in properties.items():
        if key not in UNWRITTEN:
            description = _sentence(comments[key] or _inner(kind, key))
            cells = (
                f"`{key}`",
                _default(kind, key),
                _range(key, value_schema, definitions),
                description,
            )
            lines.append(_row(cells))
    return "\n".join(lines)


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}".removesuffix(".")


def _inner(kind: type[BaseModel], key: str) -> str:
    """Summary of the table that a key holds."""
    tables = models_at(kind, (key,))
    return next((_summary(table).partition(". ")[0] for table in tables), "")


def _name_of(kind: type[BaseModel], definitions: Mapping[str, Any]) -> str:
    names = [name for name in definitions if name.rpartition("__")[2] == kind.__name__]
    return next(name for name in names if set(definitions[name]["properties"]) == _keys(kind))


def _keys(kind: type[BaseModel]) -> set[str]:
    return {field.alias or name for name, field in kind.model_fields.items()}


def _default(kind: type[BaseModel], key: str) -> str:
    field = kind.model_fields[key]
    if field.is_required():
        return "*required*"
    if field.default_factory_takes_validated_data:
        return "*from other keys*"
    value = defaults_of(kind)[key]
    if value is None or value in ("", [], {}):
        return "-"
    if any(models_at(kind, (key,))) or (
        isinstance(field.default, tuple)
        and any(isinstance(item, BaseModel) for item in field.default)
    ):
        return "*see there*"
    return f"`{json.dumps(value, ensure_ascii=False)}`"


def _range(key: str, schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    """Unit, bounds, choices or kind of a key's value."""
    unit = next((unit for ending, unit in UNITS.items() if key.endswith(ending)), "")
    texts = [
        _kind(alternative, definitions)
        for alternative in schema.get("anyOf", schema.get("oneOf", [schema]))
    ]
    text = " or ".join(dict.fromkeys(text for text in texts if text))
    if not unit:
        return text
    return f"{unit}, {text.removeprefix('number').removeprefix(', ')}".removesuffix(", ")


def _kind(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rpartition("/")[2]]
    choices = schema.get("enum", [schema["const"]] if "const" in schema else [])
    if choices:
        return ", ".join(f"`{json.dumps(choice)}`" for choice in choices)
    kind = "path" if schema.get("format") == "path" else schema.get("type", "")
    signs = [f"{sign} {schema[name]:g}" for name, sign in BOUNDS.items() if name in schema]
    return ", ".join([KINDS[kind], *([" and ".join(signs)] if signs else [])])


def commands() -> str:
    """The reference of all commands, in the order of the help."""
    parts = [COMMANDS]
    for name, command in _in_order(get_command(app)):
        parts.append(f"## twin {name}\n\n{_command(command)}\n")
        if not hasattr(command, "commands"):
            continue
        parts += [
            f"### twin {name} {subname}\n\n{_command(subcommand)}\n"
            for subname, subcommand in _in_order(command)
        ]
    return "\n".join(parts)


def _in_order(group: Any) -> Iterator[tuple[str, Any]]:
    yield from ((name, group.commands[name]) for name in group.list_commands(None))


def _command(command: Any) -> str:
    lines = [_plain(command.help)]
    shown = (parameter for parameter in command.params if not getattr(parameter, "hidden", False))
    rows = [_parameter(parameter) for parameter in shown]
    if rows:
        lines += ["", "| argument, option | default | what |", "| --- | --- | --- |", *rows]
    return "\n".join(lines)


def _parameter(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        name = parameter.metavar or parameter.name.upper()
    else:
        name = ", ".join([*parameter.opts, *parameter.secondary_opts])
        if not parameter.is_flag:
            name += f" {parameter.metavar or parameter.display_type(None).strip('<>')}"
    default = "*required*" if parameter.required else _given(parameter.default)
    return _row((f"`{name}`", default, _plain(parameter.help)))


def _given(default: Any) -> str:
    if default is None or default is False or default in ("", (), []):
        return "-"
    return f"`{getattr(default, 'value', default)}`"


def _plain(text: str | None) -> str:
    return re.sub(r"(\[+[a-z.]+\]+)", r"`\1`", " ".join((text or "").split()))


PAGES = {"configuration.md": configuration, "commands.md": commands}

if __name__ == "__main__":
    for page, text in PAGES.items():
        (DOCS / page).write_text(text(), encoding="utf-8")
