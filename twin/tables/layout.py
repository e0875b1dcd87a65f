"""Match the columns of a file to the known columns."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from twin.errors import ConfigError, SourceError
from twin.signals import MBAR, SL_MIN, ZERO_C, Command, Reported
from twin.tables.first_cells import FirstCells
from twin.tables.lack import Lack, misnamed
from twin.tables.settings import TIMES, Column, ColumnSource, ImportSettings, Unsaid
from twin.tables.units import PRESSURES, SUPPLIES, Meaning, UnsaidError, find_meaning

REPORTED = {  # the state's bit, and the bit that it is known; an empty cell leaves it unknown
    Column.REPORTED_NOZZLE: (Reported.NOZZLE, Reported.NOZZLE_KNOWN),
    Column.REPORTED_AIR_SAVING: (Reported.NOZZLE, Reported.NOZZLE_KNOWN),
    Column.REPORTED_PART_PRESENT: (Reported.PART, Reported.PART_KNOWN),
}
BESIDE = {  # column of SAMPLE, the unit in SI, and its zero
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
    """The columns that are read; the file's other ones are ignored."""

    file_names: Mapping[Column, str]  # name in the file
    ignored: tuple[str, ...]
    meanings: Mapping[Column, Meaning]  # of pressure and supply
    lines: Mapping[Column, tuple[float, float]]  # scale and offset of other numbers
    lacking: tuple[Column, ...]  # commands that the file does not have, and the ejector has

    @property
    def time(self) -> Column:
        """The column of time."""
        return next(name for name in TIMES if name in self.file_names)

    @property
    def pressure(self) -> Column:
        """The column of pressure."""
        return next(name for name in PRESSURES if name in self.file_names)


def find_layout(
    header: Sequence[str],
    settings: ImportSettings,
    location: str,
    first_cells: Callable[[], FirstCells],
    *,
    derive: bool = False,
) -> Layout:
    """Find the known columns in a file's header; SourceError names ``location`` and the problem.

    With ``derive`` commands may be lacking, and at least one must be. What columns, units and times
    lack is one error, which proposes lines by the ``first_cells``.
    """
    sources = {name: settings.columns.get(name, ColumnSource(name=name)) for name in Column}
    claimed = {source.name for source in settings.columns.values()}  # not under its own name too
    file_names = {
        name: source.name
        for name, source in sources.items()
        if source.name in header and (name in settings.columns or source.name not in claimed)
    }
    for name in settings.columns:
        if name not in file_names:
            raise misnamed(name, sources[name].name, header, location)
    commands = tuple(
        name for name in COMMANDS if not (settings.no_blow_off and name is Column.BLOW_OFF)
    )
    if settings.no_blow_off and Column.BLOW_OFF in file_names:
        text = (
            f"column {file_names[Column.BLOW_OFF]!r} is blow_off,"
            " and no_blow_off says there is none"
        )
        raise ConfigError(f"{location}: {text}", "take no_blow_off out of [import]")
    required = (*_REQUIRED, *([] if derive else [(name,) for name in commands]))
    _refuse_several(required, file_names, location)
    absent = [names for names in required if not file_names.keys() & {*names}]
    lacking = tuple(name for name in commands if name not in file_names)
    if derive and not lacking:
        raise ConfigError(
            f"{location}: the file has {_all_commands(commands)}: none is to be derived",
            "leave --derive-commands out",
        )
    for alternatives in ONE_OF_THEM:
        duplicates = [file_names[name] for name in alternatives if name in file_names]
        if len(duplicates) > 1:
            raise _too_many(f"columns {' and '.join(map(repr, duplicates))} say the same", location)
    for header_name in file_names.values():
        if header.count(header_name) > 1:
            raise _too_many(
                f"column {header_name!r} stands there {header.count(header_name)} times", location
            )
    _refuse_scaled(sources, file_names, location)
    meanings, unsaid = _find_meanings(sources, file_names, settings, location)
    if absent or unsaid:
        lack = Lack(header, file_names, absent, lacking, unsaid)
        raise lack.refusal(settings, location, first_cells())
    lines = {name: sources[name].line for name in BESIDE if name in file_names}
    ignored = set(header) - set(file_names.values()) - {""}
    in_order = tuple(name for name in dict.fromkeys(header) if name in ignored)
    return Layout(file_names, in_order, meanings, lines, lacking)


def wanted_names(settings: ImportSettings) -> set[str]:
    """Names to look for in a header: those of known columns, and those that the settings give."""
    return {*Column, *(source.name for source in settings.columns.values())}


def _all_commands(names: Sequence[Column]) -> str:
    return f"both commands, {' and '.join(names)}" if len(names) > 1 else names[0]


def _refuse_scaled(
    sources: Mapping[Column, ColumnSource], file_names: Mapping[Column, str], location: str
) -> None:
    """ConfigError if a column has settings that only numbers with a unit can have."""
    for name in file_names:
        source = sources[name]
        of_pressure = source.unit is not None or source.reference is not None
        if (name in BESIDE and of_pressure) or not (name in _MEASURED or source.is_name_only):
            attributes = "unit and reference" if name in BESIDE else "unit, reference and scale"
            raise ConfigError(
                f"{location}: {name} cannot have {attributes}",
                f"write under [import.columns]: {name} = {source.quoted}",
            )


def _refuse_several(
    required: Sequence[Sequence[Column]], file_names: Mapping[Column, str], location: str
) -> None:
    for names in required:
        present = [file_names[name] for name in names if name in file_names]
        if len(present) > 1:
            raise _too_many(
                f"only one of the columns {', '.join(map(repr, present))} can be used", location
            )


def _find_meanings(
    sources: Mapping[Column, ColumnSource],
    file_names: Mapping[Column, str],
    settings: ImportSettings,
    location: str,
) -> tuple[Mapping[Column, Meaning], list[Unsaid]]:
    """Meanings of pressure and supply, and what nothing says of them."""
    meanings, unsaid = {}, []
    for name in (*PRESSURES, *SUPPLIES):
        if name in file_names:
            try:
                meanings[name] = find_meaning(name, sources[name], settings, location)
            except UnsaidError as error:
                unsaid.append(error.unsaid)
    return meanings, unsaid


def _too_many(problem: str, location: str) -> SourceError:
    return SourceError(f"{location}: {problem}", "take one of them out of the file, or rename it")
