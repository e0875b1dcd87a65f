"""What alarms watch: values made of what the loop says happened."""

from twin.events import Event, Kind
from twin.figures.warnings import CAUTIONS

_SWITCHED = {  # events that begin and end something
    Kind.PLC_STALE: ("plc_stale", 1.0),
    Kind.PLC_BACK: ("plc_stale", 0.0),
    Kind.SIGNAL_BAD: ("signal_bad", 1.0),
    Kind.SIGNAL_GOOD: ("signal_bad", 0.0),
    Kind.DEVIATION: ("deviation", 1.0),
    Kind.DEVIATION_CLEARED: ("deviation", 0.0),
}
NAMES = {name for name, _ in _SWITCHED.values()} | set(CAUTIONS)


def values(event: Event) -> dict[str, float]:
    """The values that an event changes, 1 or 0 each: by the names of NAMES.

    A warning that a cycle could not judge keeps the value it had.
    """
    if event.kind in _SWITCHED:
        name, value = _SWITCHED[event.kind]
        return {name: value}
    if event.kind is not Kind.CYCLE or "warnings" not in event.data:
        return {}
    standing = event.data["warnings"]
    return {
        name: float(name in standing)
        for name, caution in CAUTIONS.items()
        if f"{caution.figure}_measured" in event.data
    }
