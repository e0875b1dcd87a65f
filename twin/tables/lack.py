"""What a file and its settings lack, in one refusal: columns, units, and how to read its times."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

from twin.errors import SourceError
from twin.tables.first_cells import FirstCells, form_of, unsaid_of_times
from twin.tables.likely import likely_columns
from twin.tables.settings import (
    TIMES,
    Column,
    ColumnSource,
    ImportSettings,
    Unsaid,
    toml_string,
)
from twin.tables.units import PRESSURES, UnsaidError, find_meaning, transmitter_line

_SIGNAL = re.compile(r"[\[(]\s*(mA|V)\s*[\])]\s*$")
_OF_TIMES = ", or time_ms, time_us, time_ns by its unit; time, if it is a date or a time of day"
_COMMANDS = (Column.SUCTION, Column.BLOW_OFF)


@dataclass(frozen=True)
class Lack:
    """What a file lacks, by its header and the settings."""

    header: Sequence[str]
    file_names: Mapping[Column, str]  # that are known
    absent: Sequence[Sequence[Column]]  # one column of each is required
    commands: Sequence[Column]  # that are absent, and may be derived
    unsaid: Sequence[Unsaid]  # of the known columns' units

    def refusal(self, settings: ImportSettings, location: str, cells: FirstCells) -> SourceError:
        """The error that names all of it, with the lines to write."""
        likely = self._likely(cells, settings)
        columns, of_likely = _lines(likely, settings, location)
        of_columns = [*self.unsaid, *of_likely]
        of_times = unsaid_of_times(cells, {**self.file_names, **likely}, settings)
        texts = [self._absent()] if self.absent else []
        texts += [unsaid.text for unsaid in (*of_columns, *of_times)]
        texts += [_listed(self.header)] if self.absent else []
        lines = [*columns, *(unsaid.line for unsaid in of_columns)]
        nameless = [names for names in self.absent if not likely.keys() & {*names}]
        if any(Column.PRESSURE in names for names in nameless):
            lines += self._transmitter()
        hints = [_how_to_name(nameless)] if nameless else []
        if lines or of_times:
            lead = "by their names and cells these may be" if likely else "write"
            hints.append(_block(lead, [unsaid.line for unsaid in of_times], lines))
        return SourceError(f"{location}: {'; '.join(texts)}", "; ".join(hints))

    def _likely(self, cells: FirstCells, settings: ImportSettings) -> Mapping[Column, str]:
        """Columns that may be the absent ones."""
        forms = {name: form_of(column, settings.date_order) for name, column in cells.items()}
        likely = likely_columns(self.header, self.file_names.values(), forms)
        wanted = {*self.commands, *(name for names in self.absent for name in names)}
        if Column.TIME in wanted:
            wanted.add(Column.DATE)
        return {name: header for name, header in likely.items() if name in wanted}

    def _absent(self) -> str:
        first, *others = self.absent
        text = f"no column {' or '.join(first)}"
        if others:
            text += f", and none for {_and([_short(names) for names in others])}"
        return text

    def _transmitter(self) -> list[str]:
        """A line for a transmitter's signal, if a name has its unit."""
        signal = next(filter(None, map(_SIGNAL.search, self.header)), None)
        if signal is None:
            return []
        return [transmitter_line(signal.string, "[0, 10]" if signal[1] == "V" else "[4, 20]")]


def misnamed(column: Column, name: str, header: Sequence[str], location: str) -> SourceError:
    """The error for a column of ``[import.columns]`` whose ``name`` the file does not have."""
    text = f"no column {name!r}, which [import.columns] gives for {column}"
    nearest = get_close_matches(name, header, n=1)
    guess = f"did you mean {nearest[0]!r}? " if nearest else ""
    return SourceError(
        f"{location}: {text}; {_listed(header)}", f"{guess}{_how_to_name([(column,)])}"
    )


def _how_to_name(absent: Sequence[Sequence[Column]]) -> str:
    """How to name columns that nothing was found for, and how to do without them."""
    which = "which one it is" if len(absent) == 1 else "which ones they are"
    lines = ", ".join(f'{names[0]} = "NAME IN THE FILE"' for names in absent)
    hint = f"say under [import.columns] {which}: {lines}"
    first = {names[0] for names in absent}
    if first & {*TIMES}:
        hint += _OF_TIMES
    if Column.BLOW_OFF in first:
        hint += "; if the ejector has none, say no_blow_off = true under [import]"
    if first & {*_COMMANDS}:
        hint += "; if nobody recorded it, twin import --derive-commands finds it from the pressure"
    return hint


def _lines(
    likely: Mapping[Column, str], settings: ImportSettings, location: str
) -> tuple[list[str], list[Unsaid]]:
    """Lines of ``[import.columns]``, and those that a person has to complete."""
    lines, unsaid = [], []
    for column, name in likely.items():
        try:
            if column in PRESSURES:
                find_meaning(column, ColumnSource(name=name), settings, location)
            lines.append(f"{column} = {toml_string(name)}")
        except UnsaidError as error:
            unsaid.append(error.unsaid)
    return lines, unsaid


def _block(lead: str, times: Sequence[str], columns: Sequence[str]) -> str:
    """Lines to write into a configuration."""
    if any('"..."' in line for line in (*times, *columns)):
        lead += ', with your answer for each "..."'
    head = ["[import]", *times] if times else []
    body = ["[import.columns]", *columns] if columns else []
    return "\n  ".join([f"{lead}:", *head, *body])


def _short(names: Sequence[Column]) -> str:
    return names[0].partition("_")[0] if len(names) > 1 else names[0]


def _and(names: Sequence[str]) -> str:
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def _listed(header: Sequence[str]) -> str:
    names = ", ".join(map(repr, header))
    return f"the columns are {names if len(names) <= 300 else f'{names[:300]} ...'}"
