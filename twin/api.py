"""What an analyst needs in a notebook: a log as columns, simulation, calibration, diagnosis.

``import twin`` provides all of it. ``calibrate`` and ``diagnose`` give the same answers as the
commands of the same name, without their files. Columns are in SI units, with which their names end.
Key figures, sizes of causes and values of a data set are in the field's units, as everywhere.
"""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from twin.assets.record import Record
from twin.calibration import report as calibration_report
from twin.calibration.calibrate import Calibration
from twin.calibration.calibrate import calibrate as fit_unit
from twin.calibration.save import store
from twin.config import Config
from twin.diagnosis.answer import Diagnosis
from twin.diagnosis.answer import diagnose as find_cause
from twin.diagnosis.report import in_words, write_report
from twin.errors import ConfigError
from twin.errors import TwinError as TwinError  # noqa: PLC0414 (``import twin`` has it)
from twin.extras import install_hint
from twin.figures.cycle import compiled as key_figures
from twin.hil import Plant
from twin.live import Twin
from twin.log.header import DERIVED, LogHeader
from twin.log.reader import Log as Recorded
from twin.log.reader import open_log
from twin.model.dataset import coefficients
from twin.model.effects import apply
from twin.monitor.cycles import cut
from twin.settings import Document
from twin.signals import (
    MBAR,
    NS,
    SAMPLE,
    TICK,
    Command,
    Samples,
    Signal,
    Ticks,
    deviation,
    joined,
    unbroken,
)
from twin.tables.reader import Table, open_table
from twin.tables.settings import ImportSettings

Columns = dict[str, npt.NDArray[Any]]
Place = str | Path
Progress = Callable[[str], None]
Source = Recorded | Table

MCAP = ".mcap"
_COMMANDS = {"suction": Command.SUCTION, "blow_off": Command.BLOW_OFF}
_SIGNALS = {"part_present": Signal.PART_PRESENT, "air_saving": Signal.AIR_SAVING}


def _quiet(_what: str) -> None:
    """Report no progress."""


@dataclass(frozen=True)
class Log:
    """A recorded log, or a table of another program, with its twin; ``open`` returns one.

    ``config`` is the configuration for reading it, including the data set of its unit.
    """

    path: Path
    config: Config
    assets: str = ""  # the asset database, if one was named
    _source: Source = field(kw_only=True)

    def __repr__(self) -> str:
        asset = " ".join(filter(None, (self.config.asset.type, self.config.asset.id)))
        return f"<Log {self.path} of {asset}>"

    def columns(self) -> Columns:
        """All rows, one array for each column: the measurement and the twin's expectation.

        A log's rows are as recorded; for a table the twin runs now.
        """
        rows = list(self._rows())
        samples = joined(np.empty(0, SAMPLE), *(block for block, _ in rows))
        ticks = joined(np.empty(0, TICK), *(block for _, block in rows))
        elapsed_ns = samples["time_ns"] - samples["time_ns"][:1]
        return {
            "time_s": elapsed_ns * NS,
            "time_ns": samples["time_ns"],
            "sequence": samples["sequence"],
            **_bit_columns(samples["commands"], _COMMANDS),
            "pressure_pa": samples["pressure"].astype(np.float64),
            "supply_pa": samples["supply"].astype(np.float64),
            "quality": samples["quality"],
            "expected_pa": ticks["expected"].astype(np.float64),
            "deviation_pa": deviation(samples, ticks),
            "phase": ticks["phase"],
            **_bit_columns(ticks["signals"], _SIGNALS),
        }

    def frame(self) -> Any:
        """The columns as a ``pandas.DataFrame``; ConfigError if pandas is not installed."""
        try:
            from pandas import DataFrame  # noqa: PLC0415  (an extra)
        except ImportError as error:
            raise ConfigError(
                f"a DataFrame needs pandas, which is not installed: {error}",
                f"{install_hint('notebook')}, or take columns()",
            ) from error
        return DataFrame(self.columns())

    def cycles(self) -> list[dict[str, Any]]:
        """Key figures of every cycle, measured and expected, in the field's units.

        Figures that a cycle cannot give are left out of it.
        """
        reader = key_figures(self.config)
        figures = (reader.take(cycle) for cycle in cut(unbroken(self._rows())))
        return [cycle_figures.plain() for cycle_figures in figures if cycle_figures is not None]

    @property
    def _header(self) -> LogHeader:
        """The header of the log; for a table, the header that its log would have."""
        if not isinstance(self._source, Table):
            return self._source.header
        derived = self._source.commands
        return self.config.log_header({DERIVED: derived} if derived else None)

    def _samples(self) -> Iterator[Samples]:
        """The measured rows in blocks."""
        if isinstance(self._source, Table):
            return self._source.blocks()
        return (samples for samples, _ in self._source.blocks())

    def _rows(self) -> Iterator[tuple[Samples, Ticks]]:
        """The measured rows with the twin's ticks, in blocks."""
        if isinstance(self._source, Table):
            return Twin.of(self.config.data).over(self._source.blocks())
        return self._source.blocks()


@dataclass(frozen=True)
class Calibrated:
    """The data set fitted to one unit's healthy cycles; ``str`` gives it as a table.

    ``config`` is the configuration with the fitted data set: open other logs with it.
    """

    config: Config
    _calibration: Calibration = field(repr=False)
    _log: Log = field(repr=False)

    def __str__(self) -> str:
        return calibration_report.in_words(self._calibration)

    @property
    def values(self) -> dict[str, dict[str, Any]]:
        """Each value by name, with unit, 95 % interval and whether the log determines it."""
        return calibration_report.parameters(self._calibration)

    def save(self) -> Record:
        """Store it in the asset database as the unit's data set, like ``twin calibrate``.

        ConfigError if no unit is named.
        """
        if not self.config.asset.id:
            hint = "open the log with unit=ID, or say [asset] id in the configuration"
            raise ConfigError("no unit is named", hint)
        record, _ = store(self._calibration, self.config, self._log.assets, self._log.path)
        return record


@dataclass(frozen=True)
class Answer:
    """What the simulation gets wrong on a log, and why; ``str`` gives it in words.

    ``json`` is what ``twin diagnose --json`` writes.
    """

    _diagnosis: Diagnosis = field(repr=False)

    def __str__(self) -> str:
        return in_words(self._diagnosis)

    @property
    def json(self) -> dict[str, Any]:
        """The whole answer."""
        return self._diagnosis.json

    @property
    def verdict(self) -> str:
        """Consistent, explained, unlisted or insufficient."""
        return str(self.json["verdict"])

    @property
    def causes(self) -> list[dict[str, Any]]:
        """Each cause with its effect, course, sizes and a sentence that says why; maybe none."""
        return list(self.json["causes"])

    def report(self, path: Place) -> None:
        """Write the answer with pictures as one HTML file; SourceError if it cannot be written."""
        write_report(self._diagnosis, Path(path))


def open(  # noqa: A001  (as a module's open is called)
    path: Place,
    config: Place | Config | None = None,
    *,
    unit: str = "",
    assets: str = "",
    derive_commands: bool = False,
) -> Log:
    """Open a log (MCAP), or a table (CSV, Excel, Parquet) of a PLC's trace.

    A log contains its configuration and the data set of its recording. ``config`` replaces both: a
    file, or the configuration of another log or calibration. A table needs ``config``. ``unit`` and
    ``assets`` replace the configured unit and asset database. ``derive_commands`` derives a table's
    missing commands from its pressure, and warns about what cannot be known then.

    SourceError if a file cannot be read, ConfigError if a configuration cannot be used or is that
    of another ejector.
    """
    path = Path(path)
    source: Source
    notes: Sequence[str] = ()  # for example about a guessed encoding
    if path.suffix.lower() == MCAP:
        source = open_log(path)
        settings = _of_log(source, config, assets, unit)
        remark = "" if source.complete else f"{path} is not complete; what can be read is taken"
    elif config is None:
        hint = "give the configuration of its ejector as well: open(path, config)"
        raise ConfigError(f"{path}: a table does not say which ejector it is of", hint)
    else:
        settings = _configured(config, assets, unit)
        source = _table(path, settings, derive_commands)
        settings = settings.with_sensor(is_gauge=source.counts_from_ambient)
        notes = source.notes
        remark = f"columns not taken: {', '.join(source.ignored)}" if source.ignored else ""
    log = Log(path, settings, assets, _source=source)
    substitution = settings.instead if unit else ""
    for warning in filter(None, (*notes, remark, log._header.derived, substitution)):
        warnings.warn(warning, stacklevel=2)
    return log


def simulate(
    config: Place | Config,
    time_s: npt.ArrayLike,
    suction: npt.ArrayLike,
    blow_off: npt.ArrayLike,
    effects: Mapping[str, Mapping[str, float]] | None = None,
) -> Columns:
    """Run the model alone with some commands; returns what a sensor would read.

    ``time_s`` (n) rises; ``suction`` and ``blow_off`` (n) are 0 or 1; the start is at ambient.
    ``effects`` are faults to simulate, in the field's units: ``{"leakage": {"sonic_flow": 2.0}}``.
    Returns ``time_s``, the commands, ``pressure_pa`` (absolute), ``part_present`` and
    ``air_saving``. ConfigError for columns that do not fit.
    """
    settings = _configured(config)
    samples = _command_rows(time_s, {"suction": suction, "blow_off": blow_off})
    theta = coefficients(settings.data)
    for name, values in (effects or {}).items():
        theta = apply(theta, name, values)
    pressure, signals = Plant(theta, settings.data.terms).run(samples)
    return {
        "time_s": np.asarray(time_s, np.float64),
        **_bit_columns(samples["commands"], _COMMANDS),
        "pressure_pa": pressure,
        **_bit_columns(signals, _SIGNALS),
    }


def calibrate(log: Log, progress: Progress = _quiet) -> Calibrated:
    """Fit the data set of one unit to the healthy cycles of a log, beginning with its type's.

    ``progress`` is called with a text about each step: ``print``, for example. ConfigError if the
    log does not suffice, or is not that of a healthy unit.
    """
    log._header.require_commands(str(log.path))
    document, unit = log.config.document, log.config.asset.id
    unit_config = Config.of(document, log.assets, unit, calibrated=False)
    settings = unit_config.with_sensor(is_gauge=log.config.is_gauge)
    result = fit_unit(settings, log._samples(), progress)
    monitor = settings.monitor.model_copy(update={"healthy": result.healthy})
    fitted = replace(settings, data=result.fitted.data, monitor=monitor, origin=f"{log.path}")
    return Calibrated(fitted, result, log)


def diagnose(log: Log, progress: Progress = _quiet) -> Answer:
    """Say what the simulation gets wrong on a log, why, and what knowing it gains.

    ``progress`` as in ``calibrate``.
    """
    samples, derived = log._samples(), log._header.derived
    return Answer(find_cause(log.config, samples, str(log.path), progress, derived=derived))


# --- shared helpers -----------------------------------------------------------------------------


def _configured(config: Place | Config, assets: str = "", unit: str = "", own: str = "") -> Config:
    """The configuration with the data set of its unit; a ``Config`` stays as it is."""
    if not isinstance(config, Config):
        return Config.of(Document.read(Path(config)), assets, unit, own=own)
    return Config.of(config.document, assets, unit, own=own) if assets or unit else config


def _of_log(recorded: Recorded, config: Place | Config | None, assets: str, unit: str) -> Config:
    """The configuration for a log: its own or another one, but not that of another ejector."""
    name = str(recorded.path)
    if config is None:
        return Config.of_recorded(recorded.header, name, assets=assets, unit=unit)
    settings = _configured(config, assets, unit, recorded.header.asset_id)
    if not unit:
        settings.refuse_another(recorded.header, name)
    return settings.of_rows(recorded.header)


def _table(path: Path, settings: Config, derive: bool) -> Table:
    """A table with the configured columns, maybe with derived commands."""
    import_settings = settings.document.section(ImportSettings, "import")
    ambient = settings.data.ambient.pressure_mbar * MBAR
    table = open_table(path, import_settings, ambient, derive=derive)
    return table.with_commands() if derive else table


def _bit_columns(flags: npt.NDArray[np.uint8], bits: Mapping[str, int]) -> Columns:
    """A Boolean column for each bit."""
    return {name: (flags & np.uint8(bit)) != 0 for name, bit in bits.items()}


def _command_rows(time_s: npt.ArrayLike, commands: Mapping[str, npt.ArrayLike]) -> Samples:
    """Rows of a PLC with these commands; ConfigError if the columns do not fit."""
    time = np.atleast_1d(np.asarray(time_s, np.float64))
    if not np.isfinite(time).all() or (np.diff(time) < NS).any():
        raise ConfigError("time_s does not go forward from row to row", "sort it, in seconds")
    samples = np.zeros(len(time), SAMPLE)
    samples["time_ns"] = np.rint(time / NS)
    for name, column in commands.items():
        if np.shape(column) != time.shape:
            mismatch = f"{name} has the shape {np.shape(column)}, time_s {time.shape}"
            raise ConfigError(mismatch, "give each of them one value for each time")
        samples["commands"] |= np.where(np.asarray(column, bool), _COMMANDS[name], 0).astype("u1")
    return samples
