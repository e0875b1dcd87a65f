"""What an analyst needs in a notebook: a log as columns, simulation, calibration, diagnosis.

``import twin`` provides all of it. ``commission``, ``calibrate`` and ``diagnose`` give the same
answers as the commands of the same name, without their files. Columns are in SI units, with which
their names end. Key figures, sizes of causes and values of a data set are in the field's units, as
everywhere; columns have properties in those units, too. A notebook shows each object as a summary
with a small picture, and ``plot()`` gives the picture.
"""

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from twin.assets.record import Record
from twin.calibration import page as calibration_page
from twin.calibration import report as calibration_report
from twin.calibration.calibrate import Calibration
from twin.calibration.calibrate import calibrate as fit_unit
from twin.calibration.commission import Commissioned as Commissioning
from twin.calibration.commission import commission as fit_unknown
from twin.calibration.picture import draw_fit
from twin.calibration.save import store, store_first
from twin.columns import Columns as Columns  # noqa: PLC0414 (``import twin`` has it)
from twin.columns import LogColumns
from twin.compare import page as compare_page
from twin.compare import picture as compare_picture
from twin.compare import text as compare_text
from twin.compare.compare import Comparison
from twin.compare.compare import compare as compare_sides
from twin.compare.side import side_of
from twin.config import Config
from twin.diagnosis import report as diagnosis_report
from twin.diagnosis.answer import Diagnosis
from twin.diagnosis.answer import diagnose as find_cause
from twin.diagnosis.drawing import Picture
from twin.diagnosis.text import listed, spoken
from twin.errors import ConfigError
from twin.errors import TwinError as TwinError  # noqa: PLC0414 (``import twin`` has it)
from twin.figures.cycle import compiled as key_figures
from twin.hil import Plant
from twin.languages.choice import language_of
from twin.live import Twin
from twin.log.header import DERIVED, LogHeader
from twin.log.reader import Log as Recorded
from twin.log.reader import open_log
from twin.model import theta as c
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

Place = str | Path
CORRECT = "correct the configuration, or record healthy cycles"  # after a refused fit
Progress = Callable[[str], None]
Source = Recorded | Table

MCAP = ".mcap"
SHOWN_S = 60.0  # of a log, in its summary: a log may have days
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
        return f"<Log {self.path} of {_name(self.config)}>"

    def _repr_html_(self) -> str:
        facts = [("ejector", _name(self.config)), ("data set", self.config.origin)]
        return self.columns(end_s=SHOWN_S).summary(facts)

    def columns(self, begin_s: float = 0.0, end_s: float = math.inf) -> LogColumns:
        """Rows, one array for each column: the measurement and the twin's expectation.

        ``begin_s`` and ``end_s`` choose a range of time since the first row; default: all rows.
        A log's rows are as recorded; for a table the twin runs now. Names end with SI units; the
        columns as a whole have the same in mbar and ms, for example ``vacuum_mbar``.
        """
        blocks = list(self._rows_between(begin_s, end_s))
        samples = joined(np.empty(0, SAMPLE), *(block for block, _, _ in blocks))
        ticks = joined(np.empty(0, TICK), *(block for _, block, _ in blocks))
        columns = {
            "time_s": np.concatenate([np.empty(0), *(since for _, _, since in blocks)]),
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
        ambient = float(coefficients(self.config.data)[c.AMBIENT])
        return LogColumns(columns, ambient, f"{self.path}: {_name(self.config)}")

    def plot(self, begin_s: float = 0.0, end_s: float = math.inf) -> Picture:
        """Draw measured and expected vacuum (mbar) over a range of time (s), and the deviation."""
        return self.columns(begin_s, end_s).plot()

    def compare(self, other: "Log") -> "Compared":
        """Say what differs between this log and another one, like ``twin compare``.

        SourceError if no cycle of one of them can be compared.
        """
        ours, theirs = (
            side_of(log._recording(), log.config, key_figures(log.config)) for log in (self, other)
        )
        return Compared(compare_sides(ours, theirs))

    def frame(self) -> Any:
        """The columns as a ``pandas.DataFrame``, with those in mbar and ms beside them."""
        return self.columns().frame()

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

    def _rows_between(
        self, begin_s: float, end_s: float
    ) -> Iterator[tuple[Samples, Ticks, npt.NDArray[np.floating]]]:
        """Rows of a range of time, in blocks, with their time since the first row (s)."""
        first_ns: np.int64 | None = None
        for samples, ticks in self._rows():
            if not len(samples):
                continue
            first_ns = samples["time_ns"][0] if first_ns is None else first_ns
            since = (samples["time_ns"] - first_ns) * NS
            inside = (since >= begin_s) & (since <= end_s)
            yield samples[inside], ticks[inside], since[inside]
            if since[-1] > end_s:
                return

    def _recording(self) -> "_Recording":
        return _Recording(self.path, self._header, self._rows)


@dataclass(frozen=True)
class _Recording:
    """A log or a table as ``twin.compare`` reads it."""

    path: Path
    header: LogHeader
    blocks: Callable[[], Iterator[tuple[Samples, Ticks]]]


@dataclass(frozen=True)
class Calibrated:
    """The data set fitted to one unit's healthy cycles; ``str`` gives it as a table.

    ``config`` is the configuration with the fitted data set: open other logs with it.
    """

    config: Config
    _calibration: Calibration = field(repr=False)
    _log: Log = field(repr=False)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {_name(self.config)}: {self.verdict}>"

    def __str__(self) -> str:
        return calibration_report.in_words(self._calibration)

    def _repr_html_(self) -> str:
        asset = self.config.asset
        return calibration_page.calibration_summary(self._calibration, asset, self._samples())

    @property
    def values(self) -> dict[str, dict[str, Any]]:
        """Each value by name, with unit, 95 % interval and whether the log determines it."""
        return calibration_report.parameters(self._calibration)

    @property
    def verdict(self) -> str:
        """Good, usable, or refused: off by more than twice what the cycles of the log differ by."""
        return self._outcome.verdict.word

    @property
    def remarks(self) -> list[str]:
        """What the record contradicts in the configuration, and the line to write instead."""
        return [f"{remark.text}: {remark.line}" for remark in self._outcome.remarks]

    @property
    def doubts(self) -> list[str]:
        """Reasons to doubt that the unit is healthy, each with what to do."""
        return [f"{doubt.text}: {doubt.action}" for doubt in self._outcome.doubts]

    @property
    def rms_mbar(self) -> float:
        """Deviation (mbar, rms) that the fit leaves in the healthy cycles."""
        return self._calibration.fitted.left / MBAR

    @property
    def suction_capacity_sl_min(self) -> float:
        """Fitted suction capacity at ambient pressure, sl/min."""
        return self._calibration.fitted.data.ejector.suction_capacity_sl_min

    @property
    def leak_sl_min(self) -> float:
        """Fitted leak of the healthy system, sl/min."""
        return self._calibration.fitted.data.system.leak_sl_min

    def plot(self) -> Picture:
        """Draw a typical healthy cycle (mbar, ms), measured and fitted, and the deviation."""
        return draw_fit(self.config.data, self._samples())

    def save(self) -> Record:
        """Store it in the asset database as the unit's data set, like ``twin calibrate``.

        ConfigError if no unit is named, or the fit is refused.
        """
        _require_unit(self.config)
        if self.verdict == "refused":
            verdict = calibration_report.calibration_verdict(self._calibration.verdict)
            raise ConfigError(verdict, CORRECT)
        record, _ = store(self._calibration, self.config, self._log.assets, self._log.path)
        return record

    @property
    def _outcome(self) -> Calibration | Commissioning:
        """What the verdict, the remarks and the doubts are of."""
        return self._calibration

    def _samples(self) -> Samples:
        return joined(np.empty(0, SAMPLE), *self._log._samples())


@dataclass(frozen=True, repr=False)
class Commissioned(Calibrated):
    """The data set fitted to a unit that nobody has seen before, with the verdict on the fit."""

    _commissioning: Commissioning = field(repr=False)

    def __str__(self) -> str:
        return calibration_report.commissioned_in_words(self._commissioning)

    def _repr_html_(self) -> str:
        return calibration_page.summary(self._commissioning, self.config.asset)

    @property
    def _outcome(self) -> Commissioning:
        return self._commissioning

    def report(self, path: Place, language: str = "en") -> None:
        """Write it with pictures as one HTML file, in a language such as ``de``.

        ConfigError if there are no texts in it, SourceError if the file cannot be written.
        """
        calibration_page.write_page(
            self._commissioning, self.config.asset, Path(path), language_of(language, "language")
        )

    def save(self) -> Record:
        """Store it in the asset database as the unit's data set, like ``twin commission``.

        An unknown type is stored, too. ConfigError if no unit is named, or the fit is refused.
        """
        _require_unit(self.config)
        if self.verdict == "refused":
            verdict = calibration_report.headline(self._commissioning.verdict)
            raise ConfigError(verdict, CORRECT)
        record, _ = store_first(self._commissioning, self.config, self._log.assets, self._log.path)
        return record

    def _samples(self) -> Samples:
        return self._commissioning.samples


@dataclass(frozen=True)
class Compared:
    """What differs between two logs; ``str`` gives it as tables with a conclusion.

    ``json`` is what ``twin compare --json`` writes.
    """

    _comparison: Comparison = field(repr=False)

    def __repr__(self) -> str:
        return f"<Compared: {self.conclusion}>"

    def __str__(self) -> str:
        return compare_text.in_words(self._comparison)

    def _repr_html_(self) -> str:
        return compare_page.summary(self._comparison)

    @property
    def conclusion(self) -> str:
        """The answer in a sentence."""
        return compare_text.conclusion(self._comparison)

    @property
    def json(self) -> dict[str, Any]:
        """All figures of both logs, with their difference and its 95 % interval."""
        return compare_text.plain(self._comparison)

    def plot(self) -> Picture:
        """Draw both mean cycles (mbar), their difference and their deviations, over time (s)."""
        return compare_picture.draw(self._comparison)


@dataclass(frozen=True)
class Answer:
    """What the simulation gets wrong on a log, and why; ``str`` gives it in words.

    ``json`` is what ``twin diagnose --json`` writes.
    """

    _diagnosis: Diagnosis = field(repr=False)

    def __repr__(self) -> str:
        causes = ", ".join(cause["effect"] for cause in self.causes)
        return f"<Answer {self.verdict}{causes and ': '}{causes}>"

    def __str__(self) -> str:
        return diagnosis_report.in_words(self._diagnosis)

    def _repr_html_(self) -> str:
        return diagnosis_report.summary(self._diagnosis)

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

    def plot(self, picture: str = "cycle") -> Picture:
        """Draw a picture of the report (mbar, ms): cycle, log, phases, left, mechanism or ranking.

        ConfigError for another name, or if this answer has no such picture.
        """
        return diagnosis_report.draw(self._diagnosis, picture).picture

    def report(self, path: Place, language: str = "en") -> None:
        """Write the answer with pictures as one HTML file, in a language such as ``de``.

        ConfigError if there are no texts in it, SourceError if the file cannot be written.
        """
        diagnosis_report.write_report(
            self._diagnosis, Path(path), language_of(language, "language")
        )


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
    ``air_saving``; also in ms and mbar as ``time_ms``, ``pressure_mbar`` and ``vacuum_mbar``.
    ConfigError for columns that do not fit.
    """
    settings = _configured(config)
    samples = _command_rows(time_s, {"suction": suction, "blow_off": blow_off})
    theta = coefficients(settings.data)
    for name, values in (effects or {}).items():
        theta = apply(theta, name, values)
    pressure, signals = Plant(theta, settings.data.terms).run(samples)
    columns = {
        "time_s": np.atleast_1d(np.asarray(time_s, np.float64)),
        **_bit_columns(samples["commands"], _COMMANDS),
        "pressure_pa": pressure,
        **_bit_columns(signals, _SIGNALS),
    }
    faults = f" with {listed([spoken(name) for name in effects])}" if effects else ""
    return Columns(columns, float(theta[c.AMBIENT]), f"Simulation of {_name(settings)}{faults}")


def commission(log: Log, progress: Progress = _quiet) -> Commissioned:
    """Fit a unit that nobody has seen before to a record of healthy cycles.

    The configuration says roughly what hangs on the ejector; the record corrects it.
    ``progress`` as in ``calibrate``. ConfigError if the record does not suffice.
    """
    settings = _uncalibrated(log)
    result = fit_unknown(settings, log._samples(), progress)
    return Commissioned(_fitted(settings, result.calibration, log), result.calibration, log, result)


def calibrate(log: Log, progress: Progress = _quiet) -> Calibrated:
    """Fit the data set of one unit to the healthy cycles of a log, beginning with its type's.

    ``progress`` is called with a text about each step: ``print``, for example. ConfigError if the
    log does not suffice, or is not that of a healthy unit.
    """
    settings = _uncalibrated(log)
    result = fit_unit(settings, log._samples(), progress)
    return Calibrated(_fitted(settings, result, log), result, log)


def diagnose(log: Log, progress: Progress = _quiet) -> Answer:
    """Say what the simulation gets wrong on a log, why, and what knowing it gains.

    ``progress`` as in ``calibrate``.
    """
    samples, derived = log._samples(), log._header.derived
    return Answer(find_cause(log.config, samples, str(log.path), progress, derived=derived))


# --- shared helpers -----------------------------------------------------------------------------


def _name(config: Config) -> str:
    """Type and unit of an ejector, for people."""
    return " ".join(filter(None, (config.asset.type, config.asset.id)))


def _require_unit(config: Config) -> None:
    if not config.asset.id:
        hint = "open the log with unit=ID, or say [asset] id in the configuration"
        raise ConfigError("no unit is named", hint)


def _uncalibrated(log: Log) -> Config:
    """The configuration of a log's unit with the data set of its type."""
    log._header.require_commands(str(log.path))
    unit = log.config.asset.id
    settings = Config.of(log.config.document, log.assets, unit, calibrated=False)
    return settings.with_sensor(is_gauge=log.config.is_gauge)


def _fitted(settings: Config, calibration: Calibration, log: Log) -> Config:
    """The configuration with the data set that was fitted to a log."""
    monitor = settings.monitor.model_copy(update={"healthy": calibration.healthy})
    data = calibration.fitted.data
    return replace(settings, data=data, monitor=monitor, origin=f"{log.path}")


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


def _bit_columns(
    flags: npt.NDArray[np.uint8], bits: Mapping[str, int]
) -> dict[str, npt.NDArray[Any]]:
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
