"""What commands share: plain help, ``-h`` and ``--version``, and common messages."""

import getpass
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from twin.audit import Audit
from twin.errors import ConfigError, known_names

if TYPE_CHECKING:
    from collections.abc import Sequence

    from twin.assets.unit import Unit
    from twin.fleet.runner import Wanted
    from twin.log.reader import Log
    from twin.settings import Document


def _show_version(wanted: bool) -> None:
    if wanted:
        program, python = version("ejector-twin"), sys.version.partition(" ")[0]
        print(f"twin {program} (ejector-twin, Python {python})")
        raise typer.Exit


_only_version = typer.Typer(add_completion=False)


@_only_version.command()
def _version(
    _wanted: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None: ...


_VERSION = get_command(_only_version).params[0]
_VERSION.expose_value = False  # it ends the program, so no command has it as a parameter


class _Common:
    """Mixin for Typer's classes: ``--version``, no option twice, and help that is not cut off."""

    help: str | None

    def get_params(self, ctx: Any) -> list[Any]:
        return [_VERSION, *super().get_params(ctx)]  # type: ignore[misc]

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse as Click does, but reject repeated options: Click silently takes the last value."""
        _, _, options = self.make_parser(ctx).parse_args(args=list(args))  # type: ignore[attr-defined]
        for option in options:
            if options.count(option) > 1 and not _may_repeat(option):
                ctx.fail(f"{option.opts[0]} is given twice, and only one can be used")
        return super().parse_args(ctx, args)  # type: ignore[misc,no-any-return]

    def get_short_help_str(self, limit: int = 0) -> str:
        return " ".join((self.help or "").partition("\n\n")[0].split())


def _may_repeat(option: Any) -> bool:
    return bool(option.param_type_name == "argument" or option.multiple or option.is_flag)


class _Command(_Common, TyperCommand):
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """As above; a configuration in place of an argument gets the option that takes it."""
        _, extra, _ = self.make_parser(ctx).parse_args(args=list(args))
        takes_config = any("--config" in option.opts for option in self.params)
        configs = [name for name in extra if name.endswith(".toml")] if takes_config else []
        if configs:
            ctx.fail(f"Got unexpected extra argument ({configs[0]}). Say: --config {configs[0]}")
        return super().parse_args(ctx, args)


class _Group(_Common, TyperGroup):
    order: Sequence[str] = ()  # of its commands in the help; empty: as they were added
    instead: Mapping[str, str] = {}  # what is there for commands that people look for

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] in self.instead:
            ctx.fail(f"No such command '{args[0]}'. There is: {self.instead[args[0]]}")
        if args and self.get_command(ctx, args[0]) is None:
            likely = get_close_matches(args[0], self.list_commands(ctx), n=1)
            if likely:
                ctx.fail(f"No such command '{args[0]}'. Did you mean {likely[0]}?")
        return super().resolve_command(ctx, args)

    def list_commands(self, ctx: Any) -> list[str]:
        names = super().list_commands(ctx)
        return sorted(names, key=self.order.index) if self.order else names


class App(typer.Typer):
    """Commands whose help is plain text: Rich's markup would drop ``[table]`` from it.

    ``order`` names all commands; with it the shell can complete them. With ``alone`` it does
    something without a command too. ``instead`` has what to type for commands that people look for
    in vain.
    """

    def __init__(
        self,
        help: str,  # noqa: A002 - Typer's name
        order: Sequence[str] = (),
        *,
        alone: bool = False,
        epilog: str | None = None,
        instead: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(
            cls=type("_Ordered", (_Group,), {"order": order, "instead": instead or {}}),
            help=help,
            epilog=epilog,
            no_args_is_help=not alone,
            add_completion=bool(order),
            rich_markup_mode=None,
            pretty_exceptions_enable=False,
            context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
        )

    def command(self, name: str | None = None, **options: Any) -> Callable[..., Any]:
        """Typer's method, with what all commands share."""
        return super().command(name, cls=_Command, **options)


def say_if_cut(recorded: "Log | Wanted", log: Path, action: str) -> None:
    """Report a log that does not end properly; ``action`` says what is done with it."""
    if not recorded.complete:
        print(f"twin: {log} is not complete; what can be read is {action}", file=sys.stderr)


def say_if_new(url: str, document: "Document | None") -> None:
    """Report that the chosen database is missing and will be created."""
    from twin.assets.database_url import chosen, is_new
    from twin.assets.engine import shown

    if is_new(url, document):
        print(f"twin: making a new asset database, {shown(chosen(url, document))}", file=sys.stderr)


def read_config(path: Path) -> "Document":
    """Read a configuration for a command that uses some of its tables.

    Errors as from ``Document.read``. ConfigError if it has a table that no command knows: then it
    is another kind of file.
    """
    from twin.config import TABLES
    from twin.settings import Document

    document = Document.read(path)
    document.refuse_unknown_tables(TABLES)
    return document


class Units(Protocol):
    """A database that holds the rows of several units."""

    @property
    def name(self) -> str:
        """What messages call it."""

    def units(self) -> "Sequence[Unit]":
        """Those that have rows in it."""


def chosen_unit(store: Units, config: Path | None, unit: str) -> "Unit":
    """The chosen unit: the named one, else that of the configuration, else the only one.

    ConfigError where that is none, or not one alone.
    """
    units = store.units()
    requested = unit
    if not requested and config:
        requested = str(read_config(config).tables.get("asset", {}).get("id", ""))
    matches = [candidate for candidate in units if not requested or candidate.id == requested]
    if len(matches) != 1:
        hint = known_names(requested, (candidate.id or candidate.type for candidate in units))
        problem = f"{len(matches)} units {requested!r}" if requested else f"{len(matches)} units"
        raise ConfigError(f"{store.name}: {problem}", f"choose with --id; {hint}")
    return matches[0]


def not_negative(value: float | None) -> float | None:
    """Callback of a numeric option: usage error unless the number is finite and not negative."""
    if value is not None and not (math.isfinite(value) and value >= 0.0):
        raise typer.BadParameter(f"{value:g} is not a finite number from 0 on")
    return value


def positive(value: float | None) -> float | None:
    """Callback of a numeric option: usage error unless the number is finite and above 0."""
    if value is not None and not (math.isfinite(value) and value > 0.0):
        raise typer.BadParameter(f"{value:g} is not a finite number above 0")
    return value


def audit_of(folder: Path) -> Audit:
    """The audit trail for actions of commands."""
    return Audit(folder, "command", lambda text: print(f"twin: {text}", file=sys.stderr))


def user_here() -> str:
    """Name of the user who runs this program, or the user's number without a name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # as in a container
        return f"uid {os.getuid()}"
