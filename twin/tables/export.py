"""A log as a table for other programs, lossless."""

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from pyarrow import csv, parquet

from twin.errors import SourceError
from twin.files import refuse_existing, require_ending
from twin.log.header import LogHeader
from twin.quality import Quality
from twin.signals import BAR, MBAR, SL_MIN, ZERO_C, Command, Phase, Reported, Samples, Signal, Ticks

ROWS = 100_000  # a good block size for export: a Parquet reader takes that many at once

Rows = Iterable[tuple[Samples, Ticks]]


_Column = Callable[[Samples, Ticks], npt.NDArray[np.generic]]


class _Field(NamedTuple):
    unit: str
    kind: pa.DataType
    of: _Column


def _commanded(bit: Command) -> _Column:
    return lambda samples, _: (samples["commands"] & bit.value) != 0


def _signalled(bit: Signal) -> _Column:
    return lambda _, ticks: (ticks["signals"] & bit.value) != 0


def _reported(bit: Reported, known: Reported) -> _Column:
    """A column of 0 or 1; NaN where nothing was reported."""

    def of(samples: Samples, _: Ticks) -> npt.NDArray[np.float64]:
        is_set = (samples["reported"] & bit.value) != 0
        return np.where(samples["reported"] & known.value, is_set, np.nan)

    return of


def _measured(column: str, unit: float, zero: float = 0.0) -> _Column:
    """A column in ``unit``; 0 means not measured, and becomes NaN."""

    def of(samples: Samples, _: Ticks) -> npt.NDArray[np.float64]:
        values = samples[column].astype(np.float64)
        return np.where(values != 0.0, (values - zero) / unit, np.nan)

    return of


def _flow(samples: Samples, _: Ticks) -> npt.NDArray[np.float64]:
    is_known = (samples["reported"] & Reported.FLOW_KNOWN.value) != 0
    return np.where(is_known, _wide(samples["flow"], SL_MIN), np.nan)


def _wide(column: npt.NDArray[np.float32], unit: float) -> npt.NDArray[np.float64]:
    """The column in ``unit``, with enough digits to restore it to the bit."""
    return column.astype(np.float64) / unit


_FLAGS = ", ".join(f"{flag.value} {str(flag.name).lower()}" for flag in Quality)
_PHASES = ", ".join(f"{phase.value} {phase.name.lower()}" for phase in Phase)

_FIELDS = {
    "time_ns": _Field("ns, PLC time", pa.int64(), lambda s, _: s["time_ns"]),
    "sequence": _Field("scans of the PLC", pa.int64(), lambda s, _: s["sequence"]),
    "suction": _Field("0 or 1", pa.uint8(), _commanded(Command.SUCTION)),
    "blow_off": _Field("0 or 1", pa.uint8(), _commanded(Command.BLOW_OFF)),
    "pressure_mbar": _Field("mbar absolute", pa.float64(), lambda s, _: _wide(s["pressure"], MBAR)),
    "supply_bar": _Field("bar gauge", pa.float64(), lambda s, _: _wide(s["supply"], BAR)),
    "reported_nozzle": _Field(
        "0 or 1, on", pa.uint8(), _reported(Reported.NOZZLE, Reported.NOZZLE_KNOWN)
    ),
    "reported_part_present": _Field(
        "0 or 1", pa.uint8(), _reported(Reported.PART, Reported.PART_KNOWN)
    ),
    "ambient_mbar": _Field("mbar absolute", pa.float64(), _measured("ambient", MBAR)),
    "temperature_c": _Field("°C", pa.float64(), _measured("temperature", 1.0, ZERO_C)),
    "pressure_2_mbar": _Field("mbar absolute", pa.float64(), _measured("pressure_2", MBAR)),
    "flow_sl_min": _Field("sl/min", pa.float64(), _flow),
    "quality": _Field(f"sum of {_FLAGS}", pa.uint8(), lambda s, _: s["quality"]),
    "expected_mbar": _Field("mbar absolute", pa.float64(), lambda _, t: _wide(t["expected"], MBAR)),
    "phase": _Field(_PHASES, pa.uint8(), lambda _, t: t["phase"]),
    "level_mbar": _Field(
        "mbar absolute, on which the model was set anew",
        pa.float64(),
        lambda _, t: _wide(t["level"], MBAR),
    ),
    "part_present": _Field("0 or 1, H2", pa.uint8(), _signalled(Signal.PART_PRESENT)),
    "air_saving": _Field("0 or 1, H1", pa.uint8(), _signalled(Signal.AIR_SAVING)),
    "host_ns": _Field("ns, time of receipt", pa.int64(), lambda s, _: s["host_ns"]),
}


def export(rows: Rows, header: LogHeader, path: Path, *, force: bool = False) -> None:
    """Write rows of a log as CSV or Parquet, by the suffix of ``path``, one block in memory.

    The file appears once it is complete, or not at all. ConfigError for another suffix,
    SourceError if there is a file of that name and no ``force``, or it cannot be written.
    """
    write = _KINDS[require_ending(path, *_KINDS)]
    with complete_file(path, force=force) as file:
        write(rows, header, file)


def _write_csv(rows: Rows, header: LogHeader, file: BinaryIO) -> None:
    lines = [f"{name}: {text}" for name, text in _origin(header).items()]
    lines += [f"{name}: {field.unit}" for name, field in _FIELDS.items()]
    file.writelines(f"# {' '.join(line.split())}\n".encode() for line in lines)
    options = csv.WriteOptions(quoting_style="none", quoting_header="none", batch_size=10_000)
    with csv.CSVWriter(file, _schema(header), write_options=options) as writer:
        for samples, ticks in rows:
            writer.write_batch(_batch(samples, ticks, header))


def _write_parquet(rows: Rows, header: LogHeader, file: BinaryIO) -> None:
    with parquet.ParquetWriter(
        file, _schema(header), compression="zstd", write_page_checksum=True
    ) as writer:
        for samples, ticks in rows:
            writer.write_batch(_batch(samples, ticks, header))


_KINDS = {".csv": _write_csv, ".parquet": _write_parquet}


def _batch(samples: Samples, ticks: Ticks, header: LogHeader) -> pa.RecordBatch:
    columns = [
        pa.array(field.of(samples, ticks), from_pandas=True).cast(field.kind)
        for field in _FIELDS.values()  # from_pandas: NaN becomes null
    ]
    return pa.record_batch(columns, _schema(header))


def _schema(header: LogHeader) -> pa.Schema:
    fields = [
        pa.field(name, field.kind, metadata={"unit": field.unit}) for name, field in _FIELDS.items()
    ]
    return pa.schema(fields, _origin(header))


def _origin(header: LogHeader) -> dict[str, str]:
    origin = {
        "asset_type": header.asset_type,
        "asset_id": header.asset_id,
        "config_name": header.config_name,
        "ambient_pa": repr(header.ambient),
    }
    return header.metadata | origin


@contextmanager
def complete_file(path: Path, *, force: bool = False) -> Iterator[BinaryIO]:
    """A file to write to, which gets its name once it is complete; ``force`` replaces another."""
    refuse_existing(path, force=force)
    draft = path.with_name(f"{path.name}.part")
    try:
        try:
            with draft.open("wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)
    except OSError as error:
        message = f"{path}: cannot be written: {error.strerror or error}"
        raise SourceError(message, "check that the folder exists and has space") from error
