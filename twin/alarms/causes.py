"""The causes that a deviation can have: each has an alarm of its own."""

from twin.model.effects import EFFECTS, UNKNOWN, find_effect

DEVIATION = "deviation"
UNLISTED = "unlisted"  # a deviation that no effect explains
CAUSES = (*EFFECTS, UNLISTED, UNKNOWN)


def value_of(cause: str) -> str:
    """The value that is 1 while the deviation has this cause."""
    return f"{DEVIATION}.{cause}"


def cause_of(value: str) -> str:
    """The cause that a value stands for; empty for a value that is none of the deviation."""
    cause = value.removeprefix(f"{DEVIATION}.")
    return cause if cause != value and cause in CAUSES else ""


def known(effect: str) -> str:
    """The cause that an effect's name stands for; UNLISTED for one that is none."""
    return effect if effect in CAUSES else UNLISTED


def catalogue_words(effect: str) -> dict[str, dict[str, str]]:
    """Words for an effect of a catalogue, which has no alarm of its own, beside other evidence."""
    found = None if effect in CAUSES else find_effect(effect)
    if found is None:
        return {}
    return {"taken_in": {"name": effect, "sentence": found.sentence, "look_at": found.look_at}}
