"""The causes that a deviation can have: each has an alarm of its own."""

from twin.model.effects import EFFECTS, UNKNOWN

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
