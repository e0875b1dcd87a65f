"""The table ``[alarms]``: which rules, and whether and where states and episodes are kept."""

from pathlib import Path

from twin.alarms.rules import Rule, by_cause, default_rules, read_rules
from twin.alarms.watch import NAMES
from twin.assets.configured import DatabaseSettings
from twin.errors import ConfigError
from twin.settings import Document


class AlarmSettings(DatabaseSettings):
    """Alarms of one ejector."""

    rules: str = ""  # a TOML file from the configuration's folder; else those of the program
    keep: bool = False  # twin run keeps states and episodes, and takes what people ask for


def chosen_rules(document: Document | None) -> tuple[Rule, ...]:
    """The rules that a configuration names, else the program's; ConfigError names the file."""
    file_name = document.section(AlarmSettings, "alarms").rules if document else ""
    if not file_name or document is None:
        return default_rules()
    path = Path(document.name).parent / file_name
    rules = read_rules(Document.read(path))
    for rule in rules:
        if rule.value not in NAMES:
            raise ConfigError(
                f"{path}: {rule.name} watches {rule.value}, which nothing here says",
                f"there are: {', '.join(sorted(NAMES))}",
            )
    return rules


def board_rules(document: Document | None) -> tuple[Rule, ...]:
    """The rules of ``chosen_rules``, with one for each cause."""
    return by_cause(chosen_rules(document))
