"""The README says what the code does: its tables, commands and pictures."""

import re
from pathlib import Path

from typer.main import get_command

from tools.readme import PAGES, filled
from twin.cli.main import app

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_generated_tables_are_those_of_the_code() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert filled(text) == text, f"{page.name}: run python tools/readme.py"


def test_every_command_is_described_and_every_described_command_exists() -> None:
    known = set()
    for name, command in get_command(app).commands.items():
        inside = getattr(command, "commands", None)
        known |= {f"{name} {below}" for below in inside or ()}
        if not inside or command.invoke_without_command:
            known.add(name)
    groups = "log |assets |figures |fleet |alarms |users |config |effects "
    described = set(re.findall(rf"`twin ((?:{groups})?[a-z-]+)(?: [A-Z-]|`)", README))
    assert described == known


def test_links_lead_somewhere() -> None:
    for link in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / link).exists(), link


def test_the_first_commands_need_no_more_than_make_demo_installs() -> None:
    commands = README.partition("## Using it")[2].split("```")[1]
    assert "twin run" in commands
    assert not re.search(r"--view|--rrd|twin serve|--aasx", commands)
