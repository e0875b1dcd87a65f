"""``twin users``: who may look, acknowledge and configure, on the page and over OPC UA."""

import getpass
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.audit import Act, in_words, records
from twin.cli.app import App, audit_of, read_config, user_here
from twin.cli.options import JsonAlone
from twin.errors import ConfigError, SourceError
from twin.files import write_json

if TYPE_CHECKING:
    from twin.users import Users

users_app = App("Users of the page and of the OPC UA servers: roles, passwords.")

Name = Annotated[str, typer.Argument(metavar="NAME", help="Letters, digits and . @ - _")]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="CONFIG", help="users.toml beside it; default: in here."),
]
UsersFile = Annotated[
    Path | None, typer.Option("--users", metavar="FILE", help="Another file of users.")
]
ROLES = "look, acknowledge (alarms, and shelve them), configure (take them out of service)"


@users_app.command("list")
def list_(config: ConfigFile = None, users: UsersFile = None) -> None:
    """Print every user with the role."""
    registry = _users(config, users)
    for name in registry.names:
        print(f"{registry.role(name):<11}  {name}")
    if not registry.names:
        print(f"{registry.path}: no users", file=sys.stderr)


@users_app.command()
def add(
    name: Name,
    role: Annotated[str, typer.Option(metavar="ROLE", help=ROLES)] = "look",
    config: ConfigFile = None,
    users: UsersFile = None,
) -> None:
    """Ask for a password, and keep its hash; the file is for its owner only."""
    from twin.users import role_of

    registry, new_role = _users(config, users), role_of(role)
    registry.add(name, _password(name), new_role)
    _record(registry, Act.USER_ADDED, name, role=new_role)
    print(f"{name} has the role {new_role}")


@users_app.command()
def role(
    name: Name,
    role: Annotated[str, typer.Argument(metavar="ROLE", help=ROLES)],
    config: ConfigFile = None,
    users: UsersFile = None,
) -> None:
    """Give a user another role; it holds at once."""
    from twin.users import role_of

    registry, new_role = _users(config, users), role_of(role)
    registry.set_role(name, new_role)
    _record(registry, Act.ROLE_CHANGED, name, role=new_role)
    print(f"{name} has the role {new_role}")


@users_app.command()
def password(name: Name, config: ConfigFile = None, users: UsersFile = None) -> None:
    """Give a user a new password; the page's sessions with the old one end."""
    registry = _users(config, users)
    registry.set_password(name, _password(name))
    _record(registry, Act.PASSWORD_CHANGED, name)
    print(f"{name} has a new password")


@users_app.command()
def remove(name: Name, config: ConfigFile = None, users: UsersFile = None) -> None:
    """Take a user away; it holds at once."""
    registry = _users(config, users)
    registry.remove(name)
    _record(registry, Act.USER_REMOVED, name)
    print(f"{name} is no user any more")


@users_app.command()
def audit(config: ConfigFile = None, users: UsersFile = None, json_file: JsonAlone = None) -> None:
    """Print who logged in, failed to, acknowledged, shelved or changed users; times are UTC.

    The newest comes last. Acts of the page, the OPC UA servers and the commands with this --config.
    """
    folder = _users(config, users).path.parent
    try:
        acts, broken = records(folder)
    except OSError as error:
        raise SourceError(f"the audit trail in {folder} cannot be read: {error}") from error
    for act in acts:
        print(in_words(act))
    if broken:
        print(f"twin: {broken} lines of the audit trail cannot be read", file=sys.stderr)
    if json_file is not None:
        write_json(json_file, acts)


def _users(config: Path | None, users: Path | None) -> "Users":
    from twin.users import FILE, Users

    folder = Path(read_config(config).name).parent if config else Path()
    return Users(users or folder / FILE)


def _record(users: "Users", act: Act, name: str, **details: str) -> None:
    audit_of(users.path.parent).record(act, user_here(), user=name, **details)


def _password(name: str) -> str:
    """A password: asked for twice on a terminal, the first line from a pipe."""
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\r\n")
    password = getpass.getpass(f"password of {name}: ")
    if getpass.getpass("once more: ") != password:
        raise ConfigError("the two passwords differ", "try again")
    return password
