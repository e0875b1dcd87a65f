"""Rules on the deviation become one rule for each cause that it can have."""

from collections.abc import Iterator, Sequence

from twin.alarms.rules import Rule
from twin.model.effects import EFFECTS

DEVIATION = "deviation"
UNLISTED = "unlisted"  # a deviation that no effect explains
CAUSES = (*EFFECTS, UNLISTED)


def value_of(cause: str) -> str:
    """The value that is 1 while the deviation has this cause."""
    return f"{DEVIATION}.{cause}"


def known(effect: str) -> str:
    """The cause that an effect's name stands for; UNLISTED for one that is none."""
    return effect if effect in EFFECTS else UNLISTED


def by_cause(rules: Sequence[Rule]) -> tuple[Rule, ...]:
    """The rules as a board takes them; whose alarms suppress another, all of theirs do."""
    made = {rule.name: tuple(_of_causes(rule)) for rule in rules}
    names = {name: [one.name for one in those] for name, those in made.items()}
    return tuple(
        one.model_copy(
            update={"suppressed_by": tuple(n for name in one.suppressed_by for n in names[name])}
        )
        for those in made.values()
        for one in those
    )


def _of_causes(rule: Rule) -> Iterator[Rule]:
    if rule.value != DEVIATION:
        yield rule
        return
    for cause in CAUSES:
        first = f"Look at {EFFECTS[cause].look_at}. " if cause in EFFECTS else ""
        changed = {"name": f"{rule.name}_{cause}", "value": value_of(cause)}
        yield rule.model_copy(update={**changed, "action": f"{first}{rule.action}"})
