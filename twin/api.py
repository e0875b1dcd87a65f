"""What an analyst needs in a notebook: a log as columns, simulation, calibration, diagnosis.

``import twin`` has all of it. ``calibrate`` and ``diagnose`` are the commands of the same name
without their files, and give the same answers. Columns are in SI units, which end their names; what
the field has names for (key figures, sizes of causes, values of a data set) comes in the field's
units, as everywhere.
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
    """Say nothing of what is being done."""


@dataclass(frozen=True)
class Log:
    """A recorded log, or a table of another program, beside its twin; ``open`` makes one.

    ``config`` is the configuration it is read with, the data set of its unit included.
    """

    path: Path
    config: Config
    assets: str = ""  # the asset database that was named
    _source: Source = field(kw_only=True)

    def __repr__(self) -> str:
        asset = " ".join(filter(None, (self.config.asset.type, self.config.asset.id)))
        return f"<Log {self.path} of {asset}>"

    def columns(self) -> Columns:
        """All rows, one array for each column: what was measured and what the twin says to it.

        Of a log they are as they were recorded; beside a table the twin runs now.
        """
        rows = list(self._rows())
        samples = joined(np.empty(0, SAMPLE), *(one for one, _ in rows))
        ticks = joined(np.empty(0, TICK), *(one for _, one in rows))
        since = samples["time_ns"] - samples["time_ns"][:1]
        return {
            "time_s": since * NS,
            "time_ns": samples["time_ns"],
            "sequence": samples["sequence"],
            **_bits(samples["commands"], _COMMANDS),
            "pressure_pa": samples["pressure"].astype(np.float64),
            "supply_pa": samples["supply"].astype(np.float64),
            "quality": samples["quality"],
            "expected_pa": ticks["expected"].astype(np.float64),
            "deviation_pa": deviation(samples, ticks),
            "phase": ticks["phase"],
            **_bits(ticks["signals"], _SIGNALS),
        }

    def frame(self) -> Any:
        """The columns as a ``pandas.DataFrame``; ConfigError where pandas is not installed."""
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

        What a cycle cannot tell is left out of it.
        """
        teller = key_figures(self.config)
        told = (teller.take(cycle) for cycle in cut(unbroken(self._rows())))
        return [one.plain() for one in told if one is not None]

    @property
    def _header(self) -> LogHeader:
        """What the log says of itself, or would say as one."""
        if not isinstance(self._source, Table):
            return self._source.header
        derived = self._source.commands
        return self.config.log_header({DERIVED: derived} if derived else None)

    def _samples(self) -> Iterator[Samples]:
        """What was measured, in blocks."""
        if isinstance(self._source, Table):
            return self._source.blocks()
        return (samples for samples, _ in self._source.blocks())

    def _rows(self) -> Iterator[tuple[Samples, Ticks]]:
        """The same with what the twin says to it."""
        if isinstance(self._source, Table):
            return Twin.of(self.config.data).over(self._source.blocks())
        return self._source.blocks()


@dataclass(frozen=True)
class Calibrated:
    """What healthy cycles say of one unit; ``str`` has it as a table.

    ``config`` is the configuration with the data set that was fitted: open other logs with it.
    """

    config: Config
    _calibration: Calibration = field(repr=False)
    _log: Log = field(repr=False)

    def __str__(self) -> str:
        return calibration_report.in_words(self._calibration)

    @property
    def values(self) -> dict[str, dict[str, Any]]:
        """By name each value with its unit, its 95 % interval and whether the log determines it."""
        return calibration_report.parameters(self._calibration)

    def save(self) -> Record:
        """Keep it in the asset database as the unit's data set, as ``twin calibrate`` does.

        ConfigError where no unit is named.
        """
        if not self.config.asset.id:
            hint = "open the log with unit=ID, or say [asset] id in the configuration"
            raise ConfigError("no unit is named", hint)
        record, _ = store(self._calibration, self.config, self._log.assets, self._log.path)
        return record


@dataclass(frozen=True)
class Answer:
    """What the simulation gets wrong on a log, and why; ``str`` has it in words.

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
        """Each with its effect, course, sizes and a sentence that says why; none if nothing is."""
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

    A log carries its configuration and the data set it was recorded beside; ``config``, a file or
    that of another log or calibration, takes its place. A table needs one. ``unit`` and ``assets``
    are the unit and the asset database in place of the configured ones. ``derive_commands`` finds
    the commands that a table lacks from its pressure, and warns of what cannot be told then.

    SourceError where a file cannot be read, ConfigError where a configuration cannot be used or is
    that of another ejector.
    """
    path = Path(path)
    source: Source
    notes: Sequence[str] = ()  # as of an encoding that had to be guessed
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
        settings, notes = replace(settings, gauge=source.counts_from_ambient), source.notes
        remark = f"columns not taken: {', '.join(source.ignored)}" if source.ignored else ""
    log = Log(path, settings, assets, _source=source)
    instead = settings.instead if unit else ""
    for what in filter(None, (*notes, remark, log._header.derived, instead)):
        warnings.warn(what, stacklevel=2)
    return log


def simulate(
    config: Place | Config,
    time_s: npt.ArrayLike,
    suction: npt.ArrayLike,
    blow_off: npt.ArrayLike,
    effects: Mapping[str, Mapping[str, float]] | None = None,
) -> Columns:
    """Run the model alone, as it answers commands: what a sensor would read.

    ``time_s`` (n) goes forward, ``suction`` and ``blow_off`` (n) are 0 or 1; it begins at ambient.
    ``effects`` says what is to be wrong, in the field's units:
    ``{"leakage": {"sonic_flow": 2.0}}``. Gives ``time_s``, the commands, ``pressure_pa``
    (absolute), ``part_present`` and ``air_saving``. ConfigError for columns that do not fit.
    """
    settings = _configured(config)
    samples = _commanded(time_s, {"suction": suction, "blow_off": blow_off})
    theta = coefficients(settings.data)
    for name, values in (effects or {}).items():
        theta = apply(theta, name, values)
    pressure, signals = Plant(theta, settings.data.terms).run(samples)
    return {
        "time_s": np.asarray(time_s, np.float64),
        **_bits(samples["commands"], _COMMANDS),
        "pressure_pa": pressure,
        **_bits(signals, _SIGNALS),
    }


def calibrate(log: Log, progress: Progress = _quiet) -> Calibrated:
    """Fit the data set of one unit to the healthy cycles of a log, beginning with its type's.

    ``progress`` is told what is being done: ``print``, for example. ConfigError where the log does
    not suffice, or is not that of a healthy unit.
    """
    log._header.require_commands(str(log.path))
    document, unit = log.config.document, log.config.asset.id
    known = Config.of(document, log.assets, unit, calibrated=False)
    settings = replace(known, gauge=log.config.gauge)
    found = fit_unit(settings, log._samples(), progress)
    monitor = settings.monitor.model_copy(update={"healthy": found.healthy})
    fitted = replace(settings, data=found.fitted.data, monitor=monitor, origin=f"{log.path}")
    return Calibrated(fitted, found, log)


def diagnose(log: Log, progress: Progress = _quiet) -> Answer:
    """Say what the simulation gets wrong on a log, why, and what knowing it gains.

    ``progress`` as in ``calibrate``.
    """
    samples, derived = log._samples(), log._header.derived
    return Answer(find_cause(log.config, samples, str(log.path), progress, derived=derived))


# --- what these share ---------------------------------------------------------------------------


def _configured(config: Place | Config, assets: str = "", unit: str = "", own: str = "") -> Config:
    """The configuration with what is known of its unit; one that is at hand as it is."""
    if not isinstance(config, Config):
        return Config.of(Document.read(Path(config)), assets, unit, own=own)
    return Config.of(config.document, assets, unit, own=own) if assets or unit else config


def _of_log(recorded: Recorded, config: Place | Config | None, assets: str, unit: str) -> Config:
    """A log's own configuration or another one, not that of another ejector."""
    name = str(recorded.path)
    if config is None:
        return Config.of_recorded(recorded.header, name, assets=assets, unit=unit)
    settings = _configured(config, assets, unit, recorded.header.asset_id)
    if not unit:
        settings.refuse_another(recorded.header, name)
    return settings.of_rows(recorded.header)


def _table(path: Path, settings: Config, derive: bool) -> Table:
    """A table whose columns are as the configuration says, maybe with derived commands."""
    wanted = settings.document.section(ImportSettings, "import")
    ambient = settings.data.ambient.pressure_mbar * MBAR
    table = open_table(path, wanted, ambient, derive=derive)
    return table.with_commands() if derive else table


def _bits(flags: npt.NDArray[np.uint8], bits: Mapping[str, int]) -> Columns:
    """A column of true and false for each bit."""
    return {name: (flags & np.uint8(bit)) != 0 for name, bit in bits.items()}


def _commanded(time_s: npt.ArrayLike, commands: Mapping[str, npt.ArrayLike]) -> Samples:
    """Rows of a PLC that commands this; ConfigError where the columns do not fit."""
    time = np.atleast_1d(np.asarray(time_s, np.float64))
    if not np.isfinite(time).all() or (np.diff(time) < NS).any():
        raise ConfigError("time_s does not go forward from row to row", "sort it, in seconds")
    samples = np.zeros(len(time), SAMPLE)
    samples["time_ns"] = np.rint(time / NS)
    for name, column in commands.items():
        if np.shape(column) != time.shape:
            what = f"{name} has the shape {np.shape(column)}, time_s {time.shape}"
            raise ConfigError(what, "give each of them one value for each time")
        samples["commands"] |= np.where(np.asarray(column, bool), _COMMANDS[name], 0).astype("u1")
    return samples
