"""Which column of a file is which of the known ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

from twin.errors import ConfigError, SourceError
from twin.signals import MBAR, SL_MIN, ZERO_C, Command, Reported
from twin.tables.meaning import PRESSURES, SUPPLIES, Meaning, find_meaning
from twin.tables.settings import Column, ColumnSource, ImportSettings

DIGITS = {Column.TIME_S: 9, Column.TIME_MS: 6, Column.TIME_US: 3, Column.TIME_NS: 0}  # down to ns
TIMES = (*DIGITS, Column.TIME)
REPORTED = {  # which bit says it, and which that it is known; an empty cell says nothing
    Column.REPORTED_NOZZLE: (Reported.NOZZLE, Reported.NOZZLE_KNOWN),
    Column.REPORTED_AIR_SAVING: (Reported.NOZZLE, Reported.NOZZLE_KNOWN),
    Column.REPORTED_PART_PRESENT: (Reported.PART, Reported.PART_KNOWN),
}
BESIDE = {  # column of SAMPLE, what one unit is in SI, and where it counts from
    Column.AMBIENT_MBAR: ("ambient", MBAR, 0.0),
    Column.TEMPERATURE_C: ("temperature", 1.0, ZERO_C),
    Column.PRESSURE_2_MBAR: ("pressure_2", MBAR, 0.0),
    Column.FLOW_SL_MIN: ("flow", SL_MIN, 0.0),
}
COMMANDS = {Column.SUCTION: Command.SUCTION, Column.BLOW_OFF: Command.BLOW_OFF}

ONE_OF_THEM = (
    (Column.REPORTED_NOZZLE, Column.REPORTED_AIR_SAVING),
    tuple(SUPPLIES),
)
_REQUIRED = (TIMES, tuple(PRESSURES))
_MEASURED = (*PRESSURES, *SUPPLIES, *BESIDE)  # whose numbers may be scaled


@dataclass(frozen=True)
class Layout:
    """The columns that are taken; the file's other ones are ignored."""

    theirs: Mapping[Column, str]  # name in the file
    ignored: tuple[str, ...]
    meanings: Mapping[Column, Meaning]  # of pressure and supply
    lines: Mapping[Column, tuple[float, float]]  # scale and offset of other numbers
    lacking: tuple[Column, ...]  # commands that the file does not have, and the ejector has

    @property
    def time(self) -> Column:
        """The column of time."""
        return next(name for name in TIMES if name in self.theirs)

    @property
    def pressure(self) -> Column:
        """The column of pressure."""
        return next(name for name in PRESSURES if name in self.theirs)


def find_layout(
    header: Sequence[str], settings: ImportSettings, place: str, *, derive: bool = False
) -> Layout:
    """Find the known columns among a file's; SourceError names ``place`` and what is amiss.

    With ``derive`` commands may be lacking, and one must.
    """
    sources = {name: settings.columns.get(name, ColumnSource(name=name)) for name in Column}
    claimed = {source.name for source in settings.columns.values()}  # not by its own name as well
    theirs = {
        name: source.name
        for name, source in sources.items()
        if source.name in header and (name in settings.columns or source.name not in claimed)
    }
    for name in settings.columns:
        if name not in theirs:
            what = f"no column {sources[name].name!r}, which [import.columns] gives for {name}"
            raise _missing(what, name, header, place, sources[name].name)
    has = tuple(name for name in COMMANDS if not (settings.no_blow_off and name is Column.BLOW_OFF))
    if settings.no_blow_off and Column.BLOW_OFF in theirs:
        what = f"column {theirs[Column.BLOW_OFF]!r} is blow_off, and no_blow_off says there is none"
        raise ConfigError(f"{place}: {what}", "take no_blow_off out of [import]")
    for names in (*_REQUIRED, *([] if derive else [(name,) for name in has])):
        _require_one(names, theirs, header, place)
    lacking = tuple(name for name in has if name not in theirs)
    if derive and not lacking:
        raise ConfigError(
            f"{place}: the file has {_all_commands(has)}: none is to be derived",
            "leave --derive-commands out",
        )
    for same in ONE_OF_THEM:
        both = [theirs[name] for name in same if name in theirs]
        if len(both) > 1:
            raise _too_many(f"columns {' and '.join(map(repr, both))} say the same", place)
    for there in theirs.values():
        if header.count(there) > 1:
            raise _too_many(f"column {there!r} stands there {header.count(there)} times", place)
    _refuse_scaled(sources, theirs, place)
    meanings = {
        name: find_meaning(name, sources[name], settings, place)
        for name in (*PRESSURES, *SUPPLIES)
        if name in theirs
    }
    lines = {name: sources[name].line for name in BESIDE if name in theirs}
    ignored = set(header) - set(theirs.values()) - {""}
    left = tuple(name for name in dict.fromkeys(header) if name in ignored)
    return Layout(theirs, left, meanings, lines, lacking)


def wanted_names(settings: ImportSettings) -> set[str]:
    """What a header may have: the names that the settings give, and those of known columns."""
    return {*Column, *(source.name for source in settings.columns.values())}


def _all_commands(names: Sequence[Column]) -> str:
    return f"both commands, {' and '.join(names)}" if len(names) > 1 else names[0]


def _refuse_scaled(
    sources: Mapping[Column, ColumnSource], theirs: Mapping[Column, str], place: str
) -> None:
    """ConfigError if something is said of a column that only numbers with a unit can have."""
    for name in theirs:
        source = sources[name]
        of_pressure = source.unit is not None or source.reference is not None
        if (name in BESIDE and of_pressure) or not (name in _MEASURED or source.is_name_only):
            what = "unit and reference" if name in BESIDE else "unit, reference and scale"
            raise ConfigError(
                f"{place}: {name} cannot have {what}",
                f'write under [import.columns]: {name} = "{source.name}"',
            )


def _require_one(
    names: Sequence[Column], theirs: Mapping[Column, str], header: Sequence[str], place: str
) -> None:
    found = [theirs[name] for name in names if name in theirs]
    if not found:
        raise _missing(f"no column {' or '.join(names)}", names[0], header, place)
    if len(found) > 1:
        raise _too_many(f"only one of the columns {', '.join(map(repr, found))} can be used", place)


def _missing(
    what: str, name: Column, header: Sequence[str], place: str, asked: str = ""
) -> SourceError:
    there = ", ".join(map(repr, header))
    shown = there if len(there) <= 300 else f"{there[:300]} ..."
    hint = f'say under [import.columns] which one it is: {name} = "NAME IN THE FILE"'
    nearest = get_close_matches(asked, header, n=1) if asked else []
    if nearest:
        hint = f"did you mean {nearest[0]!r}? {hint}"
    if name is Column.BLOW_OFF:
        hint += "; if the ejector has none, say no_blow_off = true under [import]"
    if name in COMMANDS:
        hint += "; if nobody recorded it, twin import --derive-commands finds it from the pressure"
    return SourceError(f"{place}: {what}; the columns are {shown}", hint)


def _too_many(what: str, place: str) -> SourceError:
    return SourceError(f"{place}: {what}", "take one of them out of the file, or rename it")
