"""Which column of a file is which of the known ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from twin.errors import ConfigError, SourceError
from twin.signals import BAR, MBAR, SL_MIN, ZERO_C, Command, Reported
from twin.tables.settings import Column, ImportSettings

DIGITS = {Column.TIME_S: 9, Column.TIME_MS: 6, Column.TIME_US: 3, Column.TIME_NS: 0}  # down to ns
REPORTED = {  # which bit says it, and which that it is known; an empty cell says nothing
    Column.REPORTED_NOZZLE: (Reported.NOZZLE, Reported.NOZZLE_KNOWN),
    Column.REPORTED_AIR_SAVING: (Reported.NOZZLE, Reported.NOZZLE_KNOWN),
    Column.REPORTED_PART_PRESENT: (Reported.PART, Reported.PART_KNOWN),
}
BESIDE = {  # column of SAMPLE, what one unit is in SI, and where it counts from
    Column.SUPPLY_BAR: ("supply", BAR, 0.0),
    Column.AMBIENT_MBAR: ("ambient", MBAR, 0.0),
    Column.TEMPERATURE_C: ("temperature", 1.0, ZERO_C),
    Column.PRESSURE_2_MBAR: ("pressure_2", MBAR, 0.0),
    Column.FLOW_SL_MIN: ("flow", SL_MIN, 0.0),
}
COMMANDS = {Column.SUCTION: Command.SUCTION, Column.BLOW_OFF: Command.BLOW_OFF}
ABSOLUTE = {  # in Pa
    Column.PRESSURE_MBAR: MBAR,
    Column.PRESSURE_PA: 1.0,
    Column.PRESSURE_BAR: BAR,
}
BELOW_AMBIENT = {  # in Pa
    Column.VACUUM_MBAR: MBAR,
    Column.VACUUM_PA: 1.0,
    Column.VACUUM_BAR: BAR,
}

ONE_OF_THEM = (Column.REPORTED_NOZZLE, Column.REPORTED_AIR_SAVING)

_REQUIRED = (tuple(DIGITS), (*ABSOLUTE, *BELOW_AMBIENT))


@dataclass(frozen=True)
class Layout:
    """The columns that are taken; the file's other ones are ignored."""

    theirs: Mapping[Column, str]  # name in the file
    ignored: tuple[str, ...]

    @property
    def lacking(self) -> tuple[Column, ...]:
        """The commands that the file does not have."""
        return tuple(name for name in COMMANDS if name not in self.theirs)

    @property
    def time(self) -> Column:
        """The column of time."""
        return next(name for name in DIGITS if name in self.theirs)

    @property
    def pressure(self) -> Column:
        """The column of pressure."""
        return next(name for name in (*ABSOLUTE, *BELOW_AMBIENT) if name in self.theirs)


def find_layout(
    header: Sequence[str], settings: ImportSettings, place: str, *, derive: bool = False
) -> Layout:
    """Find the known columns among a file's; SourceError names ``place`` and what is amiss.

    With ``derive`` commands may be lacking, and one must.
    """
    wanted = {name: settings.columns.get(name, name.value) for name in Column}
    claimed = set(settings.columns.values())  # not taken by its own name as well
    theirs = {
        name: there
        for name, there in wanted.items()
        if there in header and (name in settings.columns or there not in claimed)
    }
    for name in settings.columns:
        if name not in theirs:
            what = f"no column {wanted[name]!r}, which [import.columns] gives for {name}"
            raise _missing(what, name, header, place)
    commands = [] if derive else [(name,) for name in COMMANDS]
    for names in (*_REQUIRED, *commands):
        _require_one(names, theirs, header, place)
    if derive and all(name in theirs for name in COMMANDS):
        raise ConfigError(
            f"{place}: the file has both commands, {' and '.join(COMMANDS)}: none is to be derived",
            "leave --derive-commands out",
        )
    _require_unit(theirs, settings, place)
    both = [theirs[name] for name in ONE_OF_THEM if name in theirs]
    if len(both) > 1:
        raise _too_many(f"columns {' and '.join(map(repr, both))} say the same", place)
    for there in theirs.values():
        if header.count(there) > 1:
            raise _too_many(f"column {there!r} stands there {header.count(there)} times", place)
    ignored = set(header) - set(theirs.values()) - {""}
    return Layout(theirs, tuple(name for name in dict.fromkeys(header) if name in ignored))


def _require_one(
    names: Sequence[Column], theirs: Mapping[Column, str], header: Sequence[str], place: str
) -> None:
    found = [theirs[name] for name in names if name in theirs]
    if not found:
        raise _missing(f"no column {' or '.join(names)}", names[0], header, place)
    if len(found) > 1:
        raise _too_many(f"only one of the columns {', '.join(map(repr, found))} can be used", place)


def _require_unit(theirs: Mapping[Column, str], settings: ImportSettings, place: str) -> None:
    """ConfigError if the column of pressure is in another unit than the settings say."""
    column = next(name for name in (*ABSOLUTE, *BELOW_AMBIENT) if name in theirs)
    kind, _, unit = column.rpartition("_")
    said = settings.pressure_unit
    if said is not None and said.lower() != unit:
        raise ConfigError(
            f'{place}: pressure_unit = "{said}" under [import], but column {theirs[column]!r} is'
            f" taken as {column}",
            f'say under [import.columns]: {kind}_{said.lower()} = "{theirs[column]}", or leave'
            " pressure_unit out",
        )


def _missing(what: str, name: Column, header: Sequence[str], place: str) -> SourceError:
    there = ", ".join(map(repr, header))
    shown = there if len(there) <= 300 else f"{there[:300]} ..."
    hint = f'say under [import.columns] which one it is: {name} = "NAME IN THE FILE"'
    if name in COMMANDS:
        hint += "; if nobody recorded it, twin import --derive-commands finds it from the pressure"
    return SourceError(f"{place}: {what}; the columns are {shown}", hint)


def _too_many(what: str, place: str) -> SourceError:
    return SourceError(f"{place}: {what}", "take one of them out of the file, or rename it")
