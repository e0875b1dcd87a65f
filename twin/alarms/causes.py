"""The causes that a deviation can have; each has its own alarm."""

from twin.model.effects import EFFECTS, UNKNOWN, find_effect

DEVIATION = "deviation"
UNLISTED = "unlisted"  # a deviation that no effect explains
CAUSES = (*EFFECTS, UNLISTED, UNKNOWN)


def value_of(cause: str) -> str:
    """The value that is 1 while the deviation has this cause."""
    return f"{DEVIATION}.{cause}"


def cause_of(value: str) -> str:
    """The cause that a value stands for; empty if the value is not one of the deviation."""
    cause = value.removeprefix(f"{DEVIATION}.")
    return cause if cause != value and cause in CAUSES else ""


def cause_or_unlisted(effect: str) -> str:
    """The cause with an effect's name; UNLISTED if there is none."""
    return effect if effect in CAUSES else UNLISTED


def catalogue_evidence(effect: str) -> dict[str, dict[str, str]]:
    """Evidence that describes a catalogue's effect, which has no alarm of its own; else empty."""
    catalogued = None if effect in CAUSES else find_effect(effect)
    if catalogued is None:
        return {}
    return {
        "taken_in": {"name": effect, "sentence": catalogued.sentence, "look_at": catalogued.look_at}
    }
